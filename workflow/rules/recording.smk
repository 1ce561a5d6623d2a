"""
Recordings: the arm drawing each path, for the Rerun viewer; all in one job, since starting Python
with Rerun costs more than recording.

REQUIRED INPUTS
    results/<study>/samples/, results/<study>/network/grid<m>/{weights,snapshots,waypoints}
OUTPUTS
    results/<study>/recordings/<path>.rrd
"""


rule record:
    """Record every path with all grids in it."""
    input:
        waypoints=expand(
            "results/{{study}}/network/{samples}/waypoints.parquet", samples=LABELS
        ),
        maps=expand(
            "results/{{study}}/network/{samples}/{table}.parquet",
            samples=FIRST_LABELS,
            table=["training_bound", "unsafe"],
        ),
        certificates=(
            "results/{study}/network/certificates.csv" if certified(STUDY) else []
        ),
    output:
        expand("results/{{study}}/recordings/{path}.rrd", path=STUDY.evaluation.paths),
    log:
        "results/{study}/logs/record.log",
    benchmark:
        "results/{study}/benchmarks/record.jsonl"
    resources:
        **asked(STUDY, "record"),
    params:
        **told("record", "iksamples.recording.record"),
        arm=ARM,
        settings=settings("robot", "arm", "task", "workspace", "evaluation"),
    shell:
        iksamples(
            "record {params.study:q} --results {params.results:q}",
            "--output {params.results:q}/recordings",
        )
