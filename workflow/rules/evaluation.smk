"""
Evaluation: the trained networks sent along the paths and over the workspace.

REQUIRED INPUTS
    results/<study>/network/grid<m>/weights.safetensors
OUTPUTS
    results/<study>/network/grid<m>/{waypoints,cube,errors}.parquet
"""


rule evaluate:
    """Measure the position error of every seed through the forward kinematics."""
    input:
        urdf=STUDY.robot.urdf,
        weights="results/{study}/network/{samples}/weights.safetensors",
    output:
        waypoints="results/{study}/network/{samples}/waypoints.parquet",
        cube="results/{study}/network/{samples}/cube.parquet",
        errors="results/{study}/network/{samples}/errors.parquet",
    log:
        "results/{study}/logs/evaluate/{samples}.log",
    benchmark:
        "results/{study}/benchmarks/evaluate/{samples}.jsonl"
    params:
        study="results/{study}/study.json",
        settings=settings("robot", "workspace", "evaluation"),
        code=source_digest("iksamples.evaluation.errors"),
        folder=subpath(output.errors, parent=True),
    shell:
        "iksamples evaluate {params.study:q} --weights {input.weights:q}"
        " --output {params.folder:q} 2> {log:q}"
