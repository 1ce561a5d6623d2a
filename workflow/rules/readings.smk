"""
Readings: which reading of the paper gives its Table 1; for a study with a `readings` section.

OUTPUTS
    results/<study>/search/<part>.csv   readings drawn at random, a row per reading and grid
    results/<study>/fresh/<part>.csv    the best of them again, with seeds of their own
    results/<study>/readings.csv        those, ranked; and best.json
    reports/<study>/index.html          which words of the paper must be wrong; README.md
"""


rule search:
    """Train one part of the readings."""
    output:
        "results/{study}/search/{part}.csv",
    log:
        "results/{study}/logs/search/{part}.log",
    benchmark:
        "results/{study}/benchmarks/search/{part}.jsonl"
    resources:
        **asked(STUDY, "search"),
    params:
        **told("search", "iksamples.paper.readings"),
        arm=ARM,
        settings=settings(readings={"count", "seed", "seeds", "jobs"}),
    shell:
        iksamples(
            "readings search {params.study:q} --part {wildcards.part}",
            "--output {output:q}",
        )


rule confirm:
    """Train one part of the best readings again, with fresh seeds."""
    input:
        searched=expand(
            "results/{{study}}/search/{part}.csv", part=range(STUDY.readings.jobs)
        ),
    output:
        "results/{study}/fresh/{part}.csv",
    log:
        "results/{study}/logs/confirm/{part}.log",
    benchmark:
        "results/{study}/benchmarks/confirm/{part}.jsonl"
    resources:
        **asked(STUDY, "confirm"),
    params:
        **told("confirm", "iksamples.paper.readings"),
        arm=ARM,
        settings=settings(readings={"best", "fresh_seeds", "jobs"}),
    shell:
        iksamples(
            "readings confirm {params.study:q} {input.searched:q}",
            "--part {wildcards.part} --output {output:q}",
        )


rule rank:
    """Rank the readings by their fresh networks."""
    input:
        expand("results/{{study}}/fresh/{part}.csv", part=range(STUDY.readings.jobs)),
    output:
        ranked="results/{study}/readings.csv",
        best="results/{study}/best.json",
    log:
        "results/{study}/logs/rank.log",
    resources:
        **asked(STUDY, "rank"),
    params:
        **told("rank", "iksamples.paper.readings"),
    shell:
        iksamples(
            "readings rank {input:q} --output {output.ranked:q} --best {output.best:q}",
        )


rule page:
    """Say which of the paper's words must be wrong."""
    input:
        expand("results/{{study}}/search/{part}.csv", part=range(STUDY.readings.jobs)),
        "results/{study}/readings.csv",
    output:
        **PAGE,
    log:
        "results/{study}/logs/page.log",
    resources:
        **asked(STUDY, "page"),
    params:
        **told("page", "iksamples.report.readings"),
        settings=settings("title", "readings"),
        folder=subpath(output.html, parent=True),
    shell:
        iksamples(
            "readings report {params.study:q} --results {params.results:q}",
            "--output {params.folder:q}",
        )
