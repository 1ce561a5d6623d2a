"""
A recorded study: how many records of a real arm it takes; for a study with `samples.recorded`.

REQUIRED INPUTS
    the recording, and the arm's file
OUTPUTS
    results/<study>/judged.parquet, recorded.json   every record held out; what is odd
    results/<study>/runs.parquet, answer.json, samples-needed.csv
    results/<study>/tracking.json
    reports/<study>/index.html, README.md and figures/
"""


rule learn:
    """Learn from beginnings of random orders, and judge by the records held out."""
    output:
        multiext("results/{study}/", "recorded.json", "judged.parquet", "runs.parquet"),
    log:
        "results/{study}/logs/learn.log",
    benchmark:
        "results/{study}/benchmarks/learn.jsonl"
    resources:
        **asked(STUDY, "learn"),
    params:
        **told("learn", "iksamples.recorded.learn"),
        arm=ARM,
        recording=recording_digest(),
        settings=settings("robot", "task", "samples", "network", "training", "methods"),
    shell:
        iksamples("learn {params.study:q} --results {params.results:q}")


rule size:
    """How many records, by which method, and how sure."""
    input:
        rules.learn.output,
    output:
        multiext("results/{study}/", "answer.json", "samples-needed.csv"),
    log:
        "results/{study}/logs/answer.log",
    resources:
        **asked(STUDY, "size"),
    params:
        **told("size", "iksamples.answer.assess"),
        settings=settings("tolerance"),
    shell:
        iksamples("answer {params.study:q} --results {params.results:q}")


rule describe:
    """Build the report."""
    input:
        rules.learn.output,
        rules.size.output,
    output:
        **PAGE,
    log:
        "results/{study}/logs/report.log",
    resources:
        **asked(STUDY, "describe"),
    params:
        **told("describe", "iksamples.report.recorded"),
        settings=settings(),
        folder=subpath(output.html, parent=True),
        command=typed_command,
    shell:
        iksamples(
            "report {params.study:q} --results {params.results:q}",
            "--output {params.folder:q} --command {params.command:q}",
        )
