"""
Sizing: all results in one table, one row per grid beside the paper's Table 1, and how many samples
each method needs.

REQUIRED INPUTS
    results/<study>/<method>/<samples>/{errors,members}.parquet
    results/<study>/network/<samples>/bounds.parquet
    results/<study>/<method>/certificates.csv
OUTPUTS
    results/<study>/runs.parquet, certificates.csv
    results/<study>/table.csv, claims.csv
    results/<study>/answer.json, samples-needed.csv
    results/<study>/replication.json, where the study asks for fresh trainings
"""


rule collect:
    """One row per variant, set of samples, seed and region: errors and proved bounds."""
    input:
        samples=expand(
            "results/{{study}}/samples/{samples}.parquet", samples=ALL_LABELS
        ),
        errors=of_each(
            "results/{study}/{method}/{samples}/errors.parquet", STUDY.all_methods
        ),
        members=expand(
            "results/{{study}}/{method}/{samples}/members.parquet",
            method=networks(STUDY),
            samples=LABELS,
        ),
        certificates=expand(
            "results/{{study}}/{method}/certificates.csv", method=certified(STUDY)
        ),
    output:
        "results/{study}/runs.parquet",
        "results/{study}/certificates.csv",
    log:
        "results/{study}/logs/collect.log",
    benchmark:
        "results/{study}/benchmarks/collect.jsonl"
    resources:
        **asked(STUDY, "collect"),
    params:
        **told("collect", "iksamples.answer.collect"),
    shell:
        iksamples("collect {params.study:q} --results {params.results:q}")


rule table:
    """Aggregate over seeds."""
    input:
        cells=expand(
            "results/{{study}}/network/{samples}/{table}.parquet",
            samples=LABELS,
            table=["members", "errors", "bounds"],
        ),
        weights=expand(
            "results/{{study}}/network/{samples}/weights.safetensors",
            samples=FIRST_LABELS,
        ),
        certificates="results/{study}/certificates.csv",
    output:
        "results/{study}/table.csv",
        "results/{study}/claims.csv",
    log:
        "results/{study}/logs/table.log",
    benchmark:
        "results/{study}/benchmarks/table.jsonl"
    resources:
        **asked(STUDY, "table"),
    params:
        **told("table", "iksamples.paper.gather"),
        settings=settings(
            "robot", "task", "workspace", "samples", "evaluation", "bounds"
        ),
    shell:
        iksamples("table {params.study:q} --results {params.results:q}")


rule answer:
    """How many samples, by which method, and how sure."""
    input:
        runs="results/{study}/runs.parquet",
        floor="results/{study}/floor/errors.parquet" if FLOOR else [],
    output:
        "results/{study}/answer.json",
        "results/{study}/samples-needed.csv",
    log:
        "results/{study}/logs/answer.log",
    benchmark:
        "results/{study}/benchmarks/answer.jsonl"
    resources:
        **asked(STUDY, "answer"),
    params:
        **told("answer", "iksamples.answer.assess"),
        settings=settings(
            "arm",
            "samples",
            "tolerance",
            "evaluation",
            "methods",
            "training",
            "network",
        ),
    shell:
        iksamples("answer {params.study:q} --results {params.results:q}")


rule replicate:
    """The answer's networks again, with seeds it has not seen."""
    input:
        answer="results/{study}/answer.json",
    output:
        "results/{study}/replication.json",
    log:
        "results/{study}/logs/replicate.log",
    benchmark:
        "results/{study}/benchmarks/replicate.jsonl"
    threads: 2
    resources:
        **asked(STUDY, "replicate"),
    params:
        **told(
            "replicate",
            "iksamples.answer.replication",
            "iksamples.answer.collect",
            "iksamples.training.run",
            "iksamples.evaluation.errors",
            "iksamples.certify.step",
        ),
        settings=settings(
            "robot",
            "arm",
            "task",
            "workspace",
            "training",
            "evaluation",
            "bounds",
            "replication",
        ),
    shell:
        iksamples(
            "replicate {params.study:q} --results {params.results:q}",
            "--output {output:q}",
        )
