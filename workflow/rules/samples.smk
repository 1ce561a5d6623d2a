"""
Samples: all sets of all designs in one job, since starting Python costs more than recording.

REQUIRED INPUTS
    the arm's URDF
OUTPUTS
    results/<study>/samples/<samples>.parquet
"""


rule samples:
    """Record every set of samples."""
    output:
        expand("results/{{study}}/samples/{samples}.parquet", samples=ALL_LABELS),
    log:
        "results/{study}/logs/samples.log",
    benchmark:
        "results/{study}/benchmarks/samples.jsonl"
    resources:
        **asked(STUDY, "samples"),
    params:
        **told(
            "samples",
            "iksamples.samples.record",
            *(["iksamples.answer.adaptive"] if ADAPTIVE else []),
        ),
        arm=ARM,
        settings=settings("robot", "arm", "task", "workspace", "samples"),
        arms=list(STUDY.arms),
        held_out=settings(training={"held_out"}),
        # What an adaptive set depends on besides: the networks that choose its points.
        guides=settings("network", "training") if ADAPTIVE else None,
    shell:
        iksamples("samples {params.study:q} --output {params.results:q}/samples")
