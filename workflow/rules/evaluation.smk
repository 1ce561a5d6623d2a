"""
Evaluation: each method sent along the paths and over the workspace.

Methods that are not trained are measured in one job, since starting Python costs more.

REQUIRED INPUTS
    results/<study>/samples/<samples>.parquet
    results/<study>/<method>/<samples>/weights.safetensors, where the method is a network
OUTPUTS
    results/<study>/<method>/<samples>/{waypoints,cube,errors}.parquet
    results/<study>/floor/errors.parquet, where arms do not repeat exactly
"""

MEASURED = {
    "arm": ARM,
    "waypoints": [
        digest_of(file, "evaluation.paths") for file in STUDY.evaluation.files
    ],
    "settings": settings("robot", "arm", "task", "workspace", "evaluation"),
}


rule evaluate:
    """Measure the position error of every seed through the forward kinematics."""
    input:
        samples=expand("results/{{study}}/samples/{samples}.parquet", samples=LABELS),
        weights=expand(
            "results/{{study}}/{{network}}/{samples}/weights.safetensors",
            samples=LABELS,
        ),
    output:
        expand(
            "results/{{study}}/{{network}}/{samples}/{table}.parquet",
            samples=LABELS,
            table=["waypoints", "cube", "errors"],
        ),
    log:
        "results/{study}/logs/evaluate/{network}.log",
    benchmark:
        "results/{study}/benchmarks/evaluate/{network}.jsonl"
    resources:
        **asked(STUDY, "evaluate"),
    params:
        **told("evaluate", "iksamples.evaluation.errors"),
        **MEASURED,
    shell:
        iksamples(
            "evaluate {params.study:q} {input.samples:q} --method {wildcards.network}",
            "--results {params.results:q}",
        )


# A rule needs an output, and a study may compare no such method.
if UNTRAINED:

    rule evaluate_untrained:
        """Measure the position error of tables, splines, kernels and the exact inverse."""
        input:
            samples=expand(
                "results/{{study}}/samples/{samples}.parquet", samples=ALL_LABELS
            ),
        output:
            [
                of_each(
                    f"results/{{study}}/{{method}}/{{samples}}/{table}.parquet",
                    UNTRAINED,
                )
                for table in ("waypoints", "cube", "errors")
            ],
        log:
            "results/{study}/logs/evaluate/untrained.log",
        benchmark:
            "results/{study}/benchmarks/evaluate/untrained.jsonl"
        resources:
            **asked(STUDY, "evaluate"),
        params:
            **told("evaluate_untrained", "iksamples.evaluation.errors"),
            **MEASURED,
            kinds=UNTRAINED,
            methods=[f"--method={name}" for name in UNTRAINED],
        shell:
            iksamples(
                "evaluate {params.study:q} {input.samples:q} {params.methods}",
                "--results {params.results:q}",
            )


if FLOOR:

    rule floor:
        """Measure what simulated arms leave of the error of their own inverse."""
        input:
            samples=f"results/{{study}}/samples/{LABELS[0]}.parquet",
        output:
            "results/{study}/floor/errors.parquet",
        log:
            "results/{study}/logs/floor.log",
        benchmark:
            "results/{study}/benchmarks/floor.jsonl"
        resources:
            **asked(STUDY, "evaluate"),
        params:
            **told("floor", "iksamples.evaluation.errors"),
            **MEASURED,
        shell:
            iksamples("floor {params.study:q} {input.samples:q} --output {output:q}")
