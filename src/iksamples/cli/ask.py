"""Commands for people: what a study will do and has found, the next poses, and a network of it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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


if TYPE_CHECKING:
    from iksamples.samples.dataset import SampleSet
    from iksamples.study import Study
    from iksamples.task import Task


@app.command()
def check(study_file: StudyFile) -> None:
    """Validate a study file, and say what the arm can reach of its workspace."""
    from iksamples.plan.text import readings_text
    from iksamples.region import Region
    from iksamples.results import networks, sample_sets
    from iksamples.samples.record import region_points
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
    sets, lines = _placed(study, task), [valid]
    found = {one.label: one for one in sets or ()}
    for label, (design, n) in sample_sets(study).items():
        if design == "adaptive":
            lines.append(f"  {label}: {n} samples, chosen in training")
        elif one := found.get(label):
            masked = f", {one.n_masked} left out" if one.n_masked else ""
            lines.append(f"  {label}: {one.n_samples} samples{masked}")
        else:
            lines.append(f"  {label}: not recorded here")
    say("\n".join(lines))
    box = Region.box(task.x.lower, task.x.upper)
    reach = task.reach(region_points(box, min(study.evaluation.cube_points, _MOST_POINTS)))
    say(f"  workspace: {_in_words(reach.summary())}. {reach.where_to_go()}")
    if task.region_share < 1:
        share = percent_down(task.region_share)
        say(f"  everything is over {domain(task.region_share)}, {share} of the box")
    say(f"  methods: {', '.join(study.all_methods)}; paths: {', '.join(study.evaluation.paths)}")
    seeds = sum(study.all_methods[name].training.seeds for name in networks(study))
    trained = len(sample_sets(study, method=NETWORK)) * seeds
    say(f"  {trained} networks to train")
    advise(study, task, sets)


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
    from iksamples.training.run import trained_before

    study, task = open_study(study_file)
    if study.readings:
        say(f"{study.name}\n{readings_text(study, cores)}")
        return
    sets = _placed(study, task)
    cache = (results or Path("results") / study.name) / "cache"
    cached = trained_before(study, sets, cache) if sets and cache.is_dir() else {}
    say(plan_text(study, plan_study(study, cached), cores))
    advise(study, task, sets)


_MOST_S, _MOST_POINTS = 8.0, 2**14
"""Time to look at samples and paths, and points of the workspace, in `check` and `plan`."""


def _placed(study: "Study", task: "Task") -> "list[SampleSet] | None":
    """The study's samples but those chosen in training; None where they take long, which is said.

    Raises:
        IksamplesError: Samples or paths are none that the arm can do.
    """
    from iksamples.plan import costs
    from iksamples.plan.text import in_words
    from iksamples.results import sample_sets
    from iksamples.samples.record import record_samples

    seconds = costs.total(costs.placing(study, costs.shape_of(study)))
    require_feasible(study, task, paths=seconds <= _MOST_S)
    if seconds > _MOST_S:
        say(
            "Note: whether the arm gets to all samples and paths is left to the run, which takes "
            f"about {in_words(seconds)} for it; what is trained already is not looked for.",
            err=True,
        )
        return None
    sets = sample_sets(study).values()
    return [record_samples(study, task, *one) for one in sets if one[0] != "adaptive"]


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
