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
        study="results/{study}/study.json",
        arm=ARM,
        recording=recording_digest(),
        settings=settings("robot", "task", "samples", "network", "training", "methods"),
        code=source_digest("iksamples.recorded.learn"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples learn {params.study:q} --results {params.results:q} 2> >(tee {log:q} >&2)'


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
        study="results/{study}/study.json",
        settings=settings("tolerance"),
        code=source_digest("iksamples.answer.assess"),
        results=results_folder,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples answer {params.study:q} --results {params.results:q} 2> >(tee {log:q} >&2)'


rule describe:
    """Build the report."""
    input:
        rules.learn.output,
        rules.size.output,
    output:
        html=report("reports/{study}/index.html", category="Report"),
        markdown="reports/{study}/README.md",
        figures=directory("reports/{study}/figures"),
    log:
        "results/{study}/logs/report.log",
    resources:
        **asked(STUDY, "describe"),
    params:
        study="results/{study}/study.json",
        settings=settings(),
        code=source_digest("iksamples.report.recorded"),
        results=results_folder,
        folder=subpath(output.html, parent=True),
        command=typed_command,
    shell:
        '"$IKSAMPLES_PYTHON" -P -m iksamples report {params.study:q} --results {params.results:q}'
        " --output {params.folder:q} --command {params.command:q} 2> >(tee {log:q} >&2)"
