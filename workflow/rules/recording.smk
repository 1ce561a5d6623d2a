"""
Recordings: the arm drawing each path, for the Rerun viewer.

REQUIRED INPUTS
    results/<study>/samples/, results/<study>/network/grid<m>/{weights,snapshots,waypoints}
OUTPUTS
    results/<study>/recordings/<path>.rrd
"""


rule record:
    """Record one path with all grids in it."""
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
        "results/{study}/recordings/{path}.rrd",
    log:
        "results/{study}/logs/record/{path}.log",
    benchmark:
        "results/{study}/benchmarks/record/{path}.jsonl"
    params:
        study="results/{study}/study.json",
        arm=ARM,
        settings=settings("robot", "arm", "task", "workspace", "evaluation"),
        code=source_digest("iksamples.recording.record"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples record {params.study:q} --path {wildcards.path:q} --results {params.results:q}'
        " --output {output:q} 2> >(tee {log:q} >&2)"
