"""
Training: all seeds of all grids in one job, since starting Lightning costs more than the training.

A grid or a seed that is already in the cache is not trained again, so that adding one costs only
what is new, and so does going on after a kill.

REQUIRED INPUTS
    results/<study>/samples/grid<m>.parquet
OUTPUTS
    results/<study>/network/grid<m>/{weights,snapshots}.safetensors, {history,members}.parquet
"""


rule train:
    """Train every seed on every grid."""
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
    output:
        expand(
            "results/{{study}}/network/{samples}/{file}",
            samples=LABELS,
            file=[
                "weights.safetensors",
                "snapshots.safetensors",
                "history.parquet",
                "members.parquet",
            ],
        ),
    benchmark:
        "results/{study}/benchmarks/train.jsonl"
    threads: 2
    params:
        study="results/{study}/study.json",
        settings=settings("network", "training"),
        code=source_digest("iksamples.training.run"),
        folder="results/{study}/network",
        cache="results/{study}/cache",
    shell:
        "iksamples train {params.study:q} {input.samples:q}"
        " --output {params.folder:q} --cache {params.cache:q}"
