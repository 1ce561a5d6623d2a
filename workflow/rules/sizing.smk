"""
Sizing: the table with one row per grid, beside the paper's Table 1.

REQUIRED INPUTS
    results/<study>/network/grid<m>/{members,errors,bounds}.parquet
OUTPUTS
    results/<study>/table.csv
"""


rule table:
    """Aggregate over seeds."""
    input:
        cells=expand(
            "results/{{study}}/network/{samples}/{table}.parquet",
            samples=LABELS,
            table=["members", "errors", "bounds"],
        ),
    output:
        "results/{study}/table.csv",
    log:
        "results/{study}/logs/table.log",
    benchmark:
        "results/{study}/benchmarks/table.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("evaluation", "bounds"),
        code=source_digest("iksamples.sizing.table"),
        results="results/{study}",
    shell:
        "iksamples table {params.study:q} --results {params.results:q} --output {output:q} 2> {log:q}"
