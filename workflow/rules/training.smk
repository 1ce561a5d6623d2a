"""
Training: all seeds of all networks on all samples in one job, since starting Lightning costs more
than the training; in a large study, jobs that train some of the seeds each, whom it joins.

A seed that is already in the cache is not trained again, so that another grid, seed or method
costs only what is new, and so does going on after a kill.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
OUTPUTS
    results/<study>/<method>/<samples>/{weights,snapshots}.safetensors, {history,members}.parquet
    results/<study>/parts/<seeds>/, a cache of these seeds, until they are joined
"""

from iksamples.plan.steps import plan_study


def training_threads(wildcards):
    """One where it is mostly Lightning that is imported: another job can have the other core."""
    methods = plan_study(STUDY).methods
    return 1 if sum(method.seconds for method in methods) < 5 else 2


rule train:
    """Train the seeds of every network on every set of samples, or a part of the seeds."""
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
        parts=expand("results/{{study}}/parts/{seeds}", seeds=parts(STUDY)),
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
    resources:
        **asked(STUDY, "train"),
    params:
        **told("train", "iksamples.training.run"),
        settings=settings("network", "training", "methods"),
        into=["--output=results/{study}", "--cache=results/{study}/cache"],
        trained=options("--trained", "parts"),
    shell:
        iksamples(
            "train {params.study:q} {input.samples:q} {params.into:q} {params.trained:q}",
            logged=False,
        )


use rule train as train_part with:
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
    output:
        temp(directory("results/{study}/parts/{seeds}")),
    benchmark:
        "results/{study}/benchmarks/train/{seeds}.jsonl"
    params:
        into=["--seeds={seeds}", "--cache=results/{study}/parts/{seeds}"],
        trained="--trained=results/{study}/cache",
