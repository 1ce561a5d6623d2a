"""
Bounds: what the paper's equations say of each trained network, and whether it holds.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
    results/<study>/network/<samples>/weights.safetensors, cube.parquet
OUTPUTS
    results/<study>/network/<samples>/bounds.parquet
"""


rule bounds:
    """The paper's bounds for every seed, beside its errors."""
    input:
        urdf=STUDY.robot.urdf,
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
        weights=expand(
            "results/{{study}}/network/{samples}/weights.safetensors", samples=LABELS
        ),
        cube=expand("results/{{study}}/network/{samples}/cube.parquet", samples=LABELS),
    output:
        expand("results/{{study}}/network/{samples}/bounds.parquet", samples=LABELS),
    log:
        "results/{study}/logs/bounds.log",
    benchmark:
        "results/{study}/benchmarks/bounds.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace", "evaluation", "bounds"),
        code=source_digest("iksamples.bounds.audit"),
        folder="results/{study}/network",
    shell:
        "iksamples bounds {params.study:q} {input.samples:q} --folder {params.folder:q} 2> {log:q}"
