"""
Samples: one set per design and size.

REQUIRED INPUTS
    the arm's URDF
OUTPUTS
    results/<study>/samples/<samples>.parquet
"""


def adaptive_settings(wildcards):
    """What an adaptive set depends on besides: the networks that choose its points."""
    if not wildcards.samples.startswith("adaptive"):
        return None
    return settings("network", "training") + source_digest("iksamples.answer.adaptive")


rule samples:
    """Record one set of samples."""
    input:
        urdf=STUDY.robot.urdf,
    output:
        "results/{study}/samples/{samples}.parquet",
    log:
        "results/{study}/logs/samples/{samples}.log",
    benchmark:
        "results/{study}/benchmarks/samples/{samples}.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace"),
        placing=STUDY.samples.model_dump_json(exclude={"designs", "points_per_axis"}),
        held_out=STUDY.training.held_out.model_dump_json(),
        chosen=adaptive_settings,
        code=source_digest("iksamples.samples.record"),
    shell:
        "iksamples samples {params.study:q} --name {wildcards.samples}"
        " --output {output:q} 2> >(tee {log:q} >&2)"
