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
        html=report("reports/{study}/index.html", category="Report"),
        markdown="reports/{study}/README.md",
        figures=directory("reports/{study}/figures"),
    log:
        "results/{study}/logs/report.log",
    benchmark:
        "results/{study}/benchmarks/report.jsonl"
    resources:
        **asked(STUDY, "report"),
    params:
        study="results/{study}/study.json",
        arm=ARM,
        settings=settings(),
        code=source_digest("iksamples.report.write"),
        results=results_folder,
        folder=subpath(output.html, parent=True),
        command=typed_command,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples report {params.study:q} --results {params.results:q}'
        " --output {params.folder:q} --command {params.command:q} 2> >(tee {log:q} >&2)"
