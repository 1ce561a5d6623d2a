"""
Evaluation: each method sent along the paths and over the workspace.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
    results/<study>/<method>/<samples>/weights.safetensors, where the method is a network
OUTPUTS
    results/<study>/<method>/<samples>/{waypoints,cube,errors}.parquet
"""


def weights(wildcards):
    """What a network needs to be asked; another method needs the samples alone."""
    if wildcards.method not in networks(STUDY):
        return []
    return expand(
        "results/{study}/{method}/{samples}/weights.safetensors",
        study=wildcards.study,
        method=wildcards.method,
        samples=LABELS,
    )


rule evaluate:
    """Measure the position error of every seed through the forward kinematics."""
    input:
        weights,
        urdf=STUDY.robot.urdf,
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
    output:
        expand(
            "results/{{study}}/{{method}}/{samples}/{table}.parquet",
            samples=LABELS,
            table=["waypoints", "cube", "errors"],
        ),
    log:
        "results/{study}/logs/evaluate/{method}.log",
    benchmark:
        "results/{study}/benchmarks/evaluate/{method}.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace", "evaluation"),
        kind=lookup("{method}", within=KINDS),
        code=source_digest("iksamples.evaluation.step"),
        folder="results/{study}/{method}",
    shell:
        "iksamples evaluate {params.study:q} {input.samples:q} --method {wildcards.method}"
        " --folder {params.folder:q} 2> >(tee {log:q} >&2)"
