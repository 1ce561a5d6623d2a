"""
Tracking: one job writes all runs to MLflow, since parallel writers race on a new SQLite file.

REQUIRED INPUTS
    results/<study>/runs.parquet, answer.json, samples/<samples>.parquet
    results/<study>/<method>/<samples>/{weights.safetensors,history.parquet}, where it is a network
OUTPUTS
    results/<study>/tracking.json (what was logged), and the runs themselves
"""


rule track:
    """Log the study, its variants and sizes to MLflow; what is there already is kept.

    On a cluster too, where the command was typed: SQLite is no file for several machines.
    """
    input:
        runs="results/{study}/runs.parquet",
        answer="results/{study}/answer.json",
    output:
        "results/{study}/tracking.json",
    log:
        "results/{study}/logs/track.log",
    benchmark:
        "results/{study}/benchmarks/track.jsonl"
    localrule: True
    resources:
        **asked(STUDY, "track"),
    params:
        **told("track", "iksamples.tracking.track"),
        settings=settings(),
    shell:
        iksamples(
            "track {params.study:q} --results {params.results:q} --output {output:q}",
            "--or-later",
        )
