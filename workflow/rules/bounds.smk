"""
Bounds: what the paper's equations say of each trained network, and whether it holds.

REQUIRED INPUTS
    results/<study>/samples/grid<m>.parquet
    results/<study>/network/grid<m>/weights.safetensors, cube.parquet
OUTPUTS
    results/<study>/network/grid<m>/bounds.parquet
"""


rule bounds:
    """The paper's bounds for every seed, beside its errors."""
    input:
        urdf=STUDY.robot.urdf,
        samples="results/{study}/samples/{samples}.parquet",
        weights="results/{study}/network/{samples}/weights.safetensors",
        cube="results/{study}/network/{samples}/cube.parquet",
    output:
        "results/{study}/network/{samples}/bounds.parquet",
    log:
        "results/{study}/logs/bounds/{samples}.log",
    benchmark:
        "results/{study}/benchmarks/bounds/{samples}.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace", "evaluation", "bounds"),
        code=source_digest("iksamples.bounds.audit"),
    shell:
        "iksamples bounds {params.study:q} --samples {input.samples:q} --weights {input.weights:q}"
        " --cube {input.cube:q} --output {output:q} 2> {log:q}"
