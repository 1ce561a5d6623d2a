"""
Bounds: what the paper's equations say of each trained network, and what can be proved.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
    results/<study>/<method>/<samples>/weights.safetensors, cube.parquet
OUTPUTS
    results/<study>/network/<samples>/bounds.parquet
    results/<study>/<method>/certificates.csv
"""


rule bounds:
    """The paper's bounds for every seed, beside its errors."""
    input:
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
    resources:
        **asked(STUDY, "bounds"),
    params:
        **told("bounds", "iksamples.paper.equations"),
        arm=ARM,
        settings=settings("robot", "task", "workspace", "evaluation", "bounds"),
    shell:
        iksamples(
            "bounds {params.study:q} {input.samples:q}",
            "--folder {params.results:q}/network",
        )


rule prove:
    """The worst and the mean error over the workspace, proved for networks of a method."""
    input:
        weights,
        samples=samples_of,
        parts=proof_parts,
    output:
        "results/{study}/{method}/certificates.csv",
    log:
        "results/{study}/logs/prove/{method}.log",
    benchmark:
        "results/{study}/benchmarks/prove/{method}.jsonl"
    resources:
        **asked(STUDY, "prove"),
    params:
        **told("prove", "iksamples.certify.step"),
        arm=ARM,
        settings=settings("robot", "arm", "task", "workspace"),
        tightness=settings(
            bounds={"sup_rtol", "sup_atol_deg", "mean_rtol", "mean_atol_mm"}
        ),
        kind=lookup("{method}", within=KINDS),
        share=options("--proved", "parts"),
    shell:
        iksamples(
            "prove {params.study:q} {input.samples:q} --method {wildcards.method}",
            "--folder {params.results:q}/{wildcards.method}",
            "--output {output:q} {params.share:q}",
        )


use rule prove as prove_part with:
    input:
        weights,
        samples=samples_of,
    output:
        temp("results/{study}/{method}/certificates/{seeds}.csv"),
    log:
        "results/{study}/logs/prove/{method}-{seeds}.log",
    benchmark:
        "results/{study}/benchmarks/prove/{method}-{seeds}.jsonl"
    params:
        share="--seeds={seeds}",


rule map:
    """Where the shown networks miss the tolerance, and their worst case along the training."""
    input:
        snapshots=expand(
            "results/{{study}}/network/{samples}/snapshots.safetensors",
            samples=FIRST_LABELS,
        ),
        waypoints=expand(
            "results/{{study}}/network/{samples}/waypoints.parquet",
            samples=FIRST_LABELS,
        ),
    output:
        expand(
            "results/{{study}}/network/{samples}/{table}.parquet",
            samples=FIRST_LABELS,
            table=["training_bound", "unsafe", "slices"],
        ),
    log:
        "results/{study}/logs/map.log",
    benchmark:
        "results/{study}/benchmarks/map.jsonl"
    resources:
        **asked(STUDY, "map"),
    params:
        **told("map", "iksamples.certify.step", "iksamples.evaluation.slices"),
        arm=ARM,
        settings=settings(
            "robot", "arm", "task", "workspace", "evaluation", "tolerance"
        ),
    shell:
        iksamples("map {params.study:q} --results {params.results:q}")
