"""
Samples: one set per grid.

REQUIRED INPUTS
    the arm's URDF
OUTPUTS
    results/<study>/samples/grid<m>.parquet
"""


rule samples:
    """Record one grid of samples."""
    input:
        urdf=STUDY.robot.urdf,
    output:
        "results/{study}/samples/grid{m}.parquet",
    log:
        "results/{study}/logs/samples/grid{m}.log",
    benchmark:
        "results/{study}/benchmarks/samples/grid{m}.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace", "samples"),
        held_out=STUDY.training.held_out.model_dump_json(),
        code=source_digest("iksamples.samples.dataset"),
    shell:
        "iksamples samples {params.study:q} --points-per-axis {wildcards.m}"
        " --output {output:q} 2> {log:q}"
