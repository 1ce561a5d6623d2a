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


rule train_part:
    """Train some seeds of every network on every set of samples."""
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
    output:
        temp(directory("results/{study}/parts/{seeds}")),
    benchmark:
        "results/{study}/benchmarks/train/{seeds}.jsonl"
    threads: training_threads
    resources:
        **asked(STUDY, "train"),
    params:
        study="results/{study}/study.json",
        settings=settings("network", "training", "methods"),
        code=source_digest("iksamples.training.run"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples train {params.study:q} {input.samples:q}'
        " --seeds {wildcards.seeds} --cache {output:q} --trained {params.results:q}/cache"


rule train:
    """Train every seed of every network on every set of samples."""
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
        study="results/{study}/study.json",
        settings=settings("network", "training", "methods"),
        code=source_digest("iksamples.training.run"),
        results=results_folder,
        trained=options("--trained", "parts"),
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples train {params.study:q} {input.samples:q}'
        " --output {params.results:q} --cache {params.results:q}/cache {params.trained:q}"
