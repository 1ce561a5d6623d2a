"""
Training: all seeds of all networks on all samples in one job, since starting Lightning costs more
than the training.

A seed that is already in the cache is not trained again, so that another grid, seed or method
costs only what is new, and so does going on after a kill.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
OUTPUTS
    results/<study>/<method>/<samples>/{weights,snapshots}.safetensors, {history,members}.parquet
"""

from iksamples.plan import plan_study


def training_threads(wildcards):
    """One where it is mostly Lightning that is imported: another job can have the other core."""
    # An arm has as many joints as inputs at least; how many hardly matters here.
    methods = plan_study(STUDY, n_joints=len(STUDY.task.inputs)).methods
    return 1 if sum(method.seconds for method in methods) < 5 else 2


rule train:
    """Train every seed of every network on every set of samples."""
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
    output:
        expand(
            "results/{{study}}/{method}/{samples}/{file}",
            method=networks(STUDY),
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
    threads: training_threads
    params:
        study="results/{study}/study.json",
        settings=settings("network", "training", "methods"),
        code=source_digest("iksamples.training.run"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples train {params.study:q} {input.samples:q}'
        " --output {params.results:q} --cache {params.results:q}/cache"
