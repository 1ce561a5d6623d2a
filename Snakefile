# Entry point of `snakemake --cores 2`; the workflow lives in workflow/.
include: "workflow/Snakefile"


# Snakemake forgets the first rule of an included file, so the target is named here.
workflow.default_target = "all"
