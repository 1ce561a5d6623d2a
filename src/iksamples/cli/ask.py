"""Commands for people: what a study will do and has found, the next poses, and a network of it."""

from pathlib import Path
from typing import Annotated

import typer

from iksamples.cli.common import (
    FinishedStudy,
    StudyFile,
    advise,
    app,
    open_study,
    read,
    require_feasible,
    say,
)
from iksamples.files import whole_file


@app.command()
def check(study_file: StudyFile) -> None:
    """Validate a study file, and say what the arm can reach of its workspace."""
    from iksamples.plan.text import readings_text
    from iksamples.region import Region
    from iksamples.results import networks, sample_sets
    from iksamples.samples.record import record_samples, region_points
    from iksamples.study import NETWORK
    from iksamples.task import study_task
    from iksamples.text import domain, percent_down

    study = read(study_file)
    if study.samples.recorded:
        from iksamples.recorded.learn import looked_at

        head, doubts = looked_at(study)
        lines = [f"Note: {doubt}" for doubt in doubts]
        say("\n".join([f"{study.name}: valid; digest {study.digest()}. {head}", *lines]))
        return
    task = study_task(study)
    valid = f"{study.name}: valid; digest {study.digest()}, joints {', '.join(task.q.names)}"
    if study.readings:
        say(f"{valid}\n{readings_text(study)}")
        return
    require_feasible(study, task)
    sets, all_recorded, lines = sample_sets(study), [], [valid]
    for label, (design, n) in sets.items():
        if design == "adaptive":
            lines.append(f"  {label}: {n} samples, chosen in training")
            continue
        recorded = record_samples(study, task, design, n)
        all_recorded.append(recorded)
        masked = f", {recorded.n_masked} left out" if recorded.n_masked else ""
        lines.append(f"  {label}: {recorded.n_samples} samples{masked}")
    say("\n".join(lines))
    box = region_points(Region.box(task.x.lower, task.x.upper), study.evaluation.cube_points)
    reach = task.reach(box)
    say(f"  workspace: {_in_words(reach.summary())}. {reach.where_to_go()}")
    if task.region_share < 1:
        share = percent_down(task.region_share)
        say(f"  everything is over {domain(task.region_share)}, {share} of the box")
    say(f"  methods: {', '.join(study.all_methods)}; paths: {', '.join(study.evaluation.paths)}")
    seeds = sum(study.all_methods[name].training.seeds for name in networks(study))
    trained = len(sample_sets(study, method=NETWORK)) * seeds
    say(f"  {trained} networks to train")
    advise(study, task, all_recorded)


@app.command()
def plan(
    study_file: StudyFile,
    cores: Annotated[int, typer.Option(min=1, help="As for snakemake.")] = 2,
    results: Annotated[
        Path | None,
        typer.Option(help="Where trained seeds are looked for; by default results/<study>."),
    ] = None,
) -> None:
    """Say what a study would take: networks to train, time, memory. Nothing is run."""
    from iksamples.plan.steps import plan_study
    from iksamples.plan.text import plan_text, readings_text
    from iksamples.results import sample_sets
    from iksamples.samples.record import record_samples
    from iksamples.training.run import trained_before

    study, task = open_study(study_file)
    if study.readings:
        say(f"{study.name}\n{readings_text(study, cores)}")
        return
    require_feasible(study, task)
    sets = [
        record_samples(study, task, design, n)
        for design, n in sample_sets(study).values()
        if design != "adaptive"
    ]
    cache = (results or Path("results") / study.name) / "cache"
    cached = trained_before(study, sets, cache) if cache.is_dir() else {}
    say(plan_text(study, plan_study(study, cached), cores))
    advise(study, task, sets)


@app.command()
def recommend(results: FinishedStudy = None) -> None:
    """Print the answer of a finished study: how many samples, by which method, how sure."""
    from iksamples.answer.answer import newest
    from iksamples.answer.answer import recommend as advise
    from iksamples.answer.replication import read_replications

    if results is None:
        results = newest("results")
        say(f"{results}, the study answered last:\n")
    say(advise(results))
    for one in read_replications(results):
        say(f"\n{one.method}, {one.design}, with fresh seeds: {one.statement}")


@app.command()
def handbook(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")] = Path(
        "config"
    ),
) -> None:
    """Write README.md and schema.json: every setting of a study file, every column of its table."""
    from iksamples.handbook import schema, settings_page

    for name, text in (("README.md", settings_page()), ("schema.json", schema())):
        with whole_file(output / name) as file:
            file.write_text(text, encoding="utf-8")


def _in_words(summary: dict[str, int]) -> str:
    rest = [
        f"{n} {kind.replace('_', ' ')}" for kind, n in summary.items() if n and kind != "points"
    ]
    return f"{summary['points']} points: " + ", ".join(rest)


@app.command()
def export(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the files.", file_okay=False)
    ],
    results: FinishedStudy = None,
    method: Annotated[
        str | None, typer.Option(help="Method; by default the one that needs the fewest samples.")
    ] = None,
    samples: Annotated[
        str | None,
        typer.Option(help="Set of samples, such as grid5; by default the study's answer."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed; by default the one with the smallest proved worst case."),
    ] = None,
    input_unit: Annotated[str, typer.Option(help="What positions are given in: mm or m.")] = "mm",
    output_unit: Annotated[
        list[str] | None,
        typer.Option(
            help="What joint values come in: rad (default) or deg; mm (default) or m for "
            "prismatic joints."
        ),
    ] = None,
) -> None:
    """Write a trained network as ONNX and as C, and a certificate of it beside them."""
    from iksamples.answer.answer import newest
    from iksamples.export.write import C_FILE, CERTIFICATE, ONNX_FILE, choose
    from iksamples.export.write import export as write

    choice = choose(results or newest("results"), method, samples, seed)
    certificate = write(choice, output, input_unit, output_unit or ())
    errors = [
        certificate[name] for name in ("position_error", "angle_error") if name in certificate
    ]
    say(
        f"{choice.study.name}, {choice.cell.method}, {choice.cell.label}, seed {choice.seed}: "
        f"{choice.why}.\n"
        + "".join(f"{error['says']}\n" for error in errors)
        + f"Written to {output}: {ONNX_FILE}, {C_FILE}, {CERTIFICATE}"
    )
