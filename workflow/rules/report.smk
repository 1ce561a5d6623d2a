"""
Report: one page that opens offline, and a Markdown twin for the repository.

REQUIRED INPUTS
    results/<study>/{runs.parquet,answer.json,samples-needed.csv,certificates.csv}
    results/<study>/{table,claims}.csv, where it is held against the paper
    everything in results/<study>/network/
OUTPUTS
    reports/<study>/index.html, README.md and figures/
    reports/index.html, which has the question and answer of all studies
"""


rule report:
    """Build the report."""
    input:
        runs="results/{study}/runs.parquet",
        paper=(
            multiext("results/{study}/", "table.csv", "claims.csv")
            if STUDY.paper
            else []
        ),
        answer="results/{study}/answer.json",
        # It says where the runs are; in the usual file here there is nothing to wait for.
        tracking=(
            "results/{study}/tracking.json"
            if STUDY.tracking.uri or os.environ.get("MLFLOW_TRACKING_URI")
            else []
        ),
        replication=(
            "results/{study}/replication.json" if STUDY.replication.seeds else []
        ),
        maps=expand(
            "results/{{study}}/network/{samples}/{table}.parquet",
            samples=FIRST_LABELS,
            table=["training_bound", "unsafe", "slices"],
        ),
    output:
        **PAGE,
    log:
        "results/{study}/logs/report.log",
    benchmark:
        "results/{study}/benchmarks/report.jsonl"
    resources:
        **asked(STUDY, "report"),
    params:
        **told("report", "iksamples.report.write"),
        arm=ARM,
        settings=settings(),
        folder=subpath(output.html, parent=True),
        command=typed_command,
    shell:
        iksamples(
            "report {params.study:q} --results {params.results:q}",
            "--output {params.folder:q} --command {params.command:q}",
        )
