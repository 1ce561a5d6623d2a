"""
Tracking: one job writes all runs to MLflow, since parallel writers race on a new SQLite file.

REQUIRED INPUTS
    results/<study>/table.csv, answer.json, certificates.csv, <method>/<samples>/errors.parquet
    everything in results/<study>/network/
OUTPUTS
    results/<study>/tracking.json (what was logged), and the runs themselves
"""


rule track:
    """Log the study, its grids and their seeds to MLflow; what is there already is kept."""
    input:
        table="results/{study}/table.csv",
        answer="results/{study}/answer.json",
        errors=expand(
            "results/{{study}}/{method}/{samples}/errors.parquet",
            method=STUDY.all_methods,
            samples=LABELS,
        ),
    output:
        "results/{study}/tracking.json",
    log:
        "results/{study}/logs/track.log",
    benchmark:
        "results/{study}/benchmarks/track.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings(),
        code=source_digest("iksamples.tracking.track"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples track {params.study:q} --results {params.results:q} --output {output:q} 2> >(tee {log:q} >&2)'
