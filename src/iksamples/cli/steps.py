"""One command per step of the workflow that computes, each usable by hand on files."""

from pathlib import Path
from typing import Annotated

import typer

from iksamples.cli.common import (
    MethodFolder,
    MethodName,
    Output,
    Results,
    SamplesFiles,
    Seeds,
    StudyFile,
    app,
    load_samples,
    open_study,
    read,
    record_sets,
    require_feasible,
    require_one_of,
    say,
    seed_range,
    write_tables,
)
from iksamples.columns import stored_table
from iksamples.errors import IksamplesError
from iksamples.files import kept_file, whole_file


@app.command()
def samples(
    study_file: StudyFile,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder that gets a file for each set.")
    ],
    name: Annotated[
        list[str] | None,
        typer.Option(help="Only this set of samples, such as grid5 or sobol125; can be repeated."),
    ] = None,
) -> None:
    """Record sets of samples: positions and the joint angles that reach them."""
    from iksamples.results import sample_sets

    study, task = open_study(study_file)
    sets = sample_sets(study)
    for one in name or ():
        require_one_of(sets, one, f"{study_file}: no samples")
    require_feasible(study, task)
    wanted = {label: sets[label] for label in name or sets}
    for recorded in record_sets(study, task, wanted):
        with kept_file(output / f"{recorded.label}.parquet") as file:
            recorded.save(file)


@app.command()
def train(
    study_file: StudyFile,
    samples_files: SamplesFiles,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder that gets <method>/<samples>/."),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder of trained seeds; a seed that is there is not trained again."),
    ] = None,
    seeds: Seeds = None,
    others: Annotated[
        list[Path] | None,
        typer.Option("--trained", help="Another such folder, which is only read; repeatable."),
    ] = None,
) -> None:
    """Train all seeds of every network of the study on each set of samples.

    A part of the seeds goes to --cache alone, for a call that gets all such folders as --trained.
    """
    from iksamples.training.run import train_study

    if (output is None) == (seeds is None) or not (output or cache):
        raise IksamplesError("train: give --output for all seeds, or --seeds and --cache for some.")
    train_study(
        read(study_file),
        load_samples(samples_files),
        output,
        cache,
        progress=True,
        seeds=seed_range(seeds),
        others=others or (),
    )


@app.command()
def evaluate(
    study_file: StudyFile,
    samples_files: SamplesFiles,
    method: Annotated[list[str], typer.Option(help="Which of the study's methods; repeatable.")],
    results: Results,
) -> None:
    """Send methods along the paths and over the workspace; measure through the FK."""
    from iksamples.evaluation.errors import evaluate as measure
    from iksamples.evaluation.errors import nothing_measured
    from iksamples.methods.predictor import NotApplicableError
    from iksamples.task import study_task

    study = read(study_file)
    for name in method:
        require_one_of(study.all_methods, name, f"{study_file}: no method")
    sets = load_samples(samples_files)
    task = study_task(study, sets[0].region)
    for name in method:
        for samples in sets:
            if samples.design not in study.designs(name):
                continue
            cell = results / name / samples.label
            try:
                write_tables(cell, measure(study, task, samples, name, cell))
            except NotApplicableError as why_not:
                say(str(why_not), err=True)
                write_tables(cell, [nothing_measured()])


@app.command()
def floor(study_file: StudyFile, samples_files: SamplesFiles, output: Output) -> None:
    """Measure what the arms leave of the error of their own inverse: no samples can do better."""
    from iksamples.evaluation.errors import repeatability
    from iksamples.task import study_task

    study = read(study_file)
    if not study.arm:
        raise IksamplesError(f"{study_file}: the arm is its drawing; there is no arm section.")
    task = study_task(study, load_samples(samples_files[:1])[0].region)
    with kept_file(output) as file:
        repeatability(study, task).to_parquet(file)


@app.command()
def bounds(study_file: StudyFile, samples_files: SamplesFiles, folder: MethodFolder) -> None:
    """Compute the paper's bounds for trained networks, and how often each is exceeded."""
    import pandas as pd

    from iksamples.methods.predictor import in_parts
    from iksamples.network import StackedMLP
    from iksamples.paper.equations import audit

    study = read(study_file)
    for samples in load_samples(samples_files):
        cell = folder / samples.label
        network, rows = StackedMLP.load(cell / "weights.safetensors"), []
        for part in in_parts(network, study.evaluation.cube_points, 2**18):
            of_these = [("seed", "in", list(part.seeds))]
            cube = stored_table(cell / "cube.parquet", filters=of_these)
            rows.append(audit(study, samples, part, cube))
        with kept_file(cell / "bounds.parquet") as file:
            pd.concat(rows, ignore_index=True).to_parquet(file)


@app.command()
def prove(
    study_file: StudyFile,
    samples_files: SamplesFiles,
    method: MethodName,
    folder: MethodFolder,
    output: Output,
    seeds: Seeds = None,
    proved: Annotated[
        list[Path] | None,
        typer.Option(help="Only join these tables, of some seeds each; repeatable."),
    ] = None,
) -> None:
    """Prove the worst and the mean error of a method over the workspace, network by network."""
    import pandas as pd

    from iksamples.certify.step import certify, joined
    from iksamples.results import certified
    from iksamples.task import study_task

    study = read(study_file)
    require_one_of(certified(study), method, f"{study_file}: nothing can be proved of")
    if proved:
        if seeds:
            raise IksamplesError("prove: --proved joins all tables that it names; no --seeds then.")
        table = joined(proved, [file.stem for file in samples_files])
    else:
        all_samples, some = load_samples(samples_files), seed_range(seeds)
        task = study_task(study, all_samples[0].region)
        rows = [
            certify(study, task, method, samples, folder / samples.label, some)
            for samples in all_samples
            if samples.design in study.designs(method)
        ]
        table = pd.concat(rows)
    # A part is there until it is joined, and its digest would stay.
    with whole_file(output) if seeds else kept_file(output) as file:
        table.to_csv(file, index=False)


@app.command("map")
def map_(study_file: StudyFile, results: Results) -> None:
    """Prove where the shown networks miss the tolerance, and their worst case along training."""
    import pandas as pd

    from iksamples.certify.step import map_cell, shown_seeds
    from iksamples.evaluation.slices import error_slices
    from iksamples.results import cells
    from iksamples.task import study_task

    study = read(study_file)
    all_cells = list(cells(study, results))
    task = study_task(study, all_cells[0].samples.region)
    for cell in all_cells:
        shown = [
            error_slices(task, cell.network, seed, study.evaluation.cube_points)
            for seed in shown_seeds(study, cell)
        ]
        tables = map_cell(study, task, cell)
        tables["slices"] = pd.concat(shown) if shown else pd.DataFrame(columns=["seed"])
        for name, rows in tables.items():
            with kept_file(cell.folder / f"{name}.parquet") as file:
                rows.to_parquet(file)


@app.command()
def collect(study_file: StudyFile, results: Results) -> None:
    """Put all errors and certificates into one table, runs.parquet, and all certificates in one."""
    from iksamples.answer.collect import FILE, certificates
    from iksamples.answer.collect import collect as collect_runs
    from iksamples.results import PROOFS

    study = read(study_file)
    runs = collect_runs(study, results)
    with kept_file(results / PROOFS) as file:
        certificates(study, results).to_csv(file, index=False)
    with kept_file(results / FILE) as file:
        runs.to_parquet(file)


@app.command()
def learn(study_file: StudyFile, results: Results) -> None:
    """Learn from a study's recording, judged by what is held out: runs.parquet, judged.parquet.

    What the recording is, what is odd about it, and which methods cannot use it: recorded.json.
    """
    import json

    from iksamples.answer.collect import FILE
    from iksamples.recorded.learn import ABOUT, JUDGED, learning_curve

    found = learning_curve(read(study_file))
    about = {"head": found.head, "doubts": found.doubts, "left_out": found.left_out}
    for doubt in found.doubts:
        say(f"Note: {doubt}", err=True)
    with kept_file(results / ABOUT) as file:
        file.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    with kept_file(results / JUDGED) as file:
        found.judged.to_parquet(file)
    with kept_file(results / FILE) as file:
        found.runs.to_parquet(file)


@app.command()
def table(study_file: StudyFile, results: Results) -> None:
    """Aggregate over seeds: table.csv beside the paper's Table 1, and its claims judged."""
    from iksamples.paper.gather import claims_table, study_table
    from iksamples.results import PROOFS, cells
    from iksamples.results import proofs as read_proofs

    study, task = open_study(study_file)
    proofs = read_proofs(study, results / PROOFS, task.x.columns("argmax_"))
    tables = {
        "table.csv": study_table(study, cells(study, results), proofs),
        "claims.csv": claims_table(study, task, results, proofs),
    }
    for name, rows in tables.items():
        with kept_file(results / name) as file:
            rows.to_csv(file, index=False)


@app.command()
def answer(study_file: StudyFile, results: Results) -> None:
    """Answer how many samples each method needs: answer.json and samples-needed.csv."""
    from iksamples.answer.assess import answer_study, samples_needed
    from iksamples.answer.collect import outcomes, read_runs

    study = read(study_file)
    found = answer_study(study, results)
    for line in found.failures:
        say(line, err=True)
    with kept_file(results / "samples-needed.csv") as file:
        samples_needed(study, outcomes(study, read_runs(study, results))).to_csv(file, index=False)
    with kept_file(results / "answer.json") as file:
        file.write_text(found.to_json(), encoding="utf-8")


@app.command()
def replicate(study_file: StudyFile, results: Results, output: Output) -> None:
    """Train the answer's networks again with fresh seeds, and count how many meet the tolerance.

    The steps are the study's own, on its samples, for a study of the fresh seeds alone that lies in
    fresh/ among its results.
    """
    from iksamples.answer.answer import read_answer
    from iksamples.answer.collect import outcomes, read_runs
    from iksamples.answer.replication import (
        FRESH,
        answers_to_replicate,
        fresh_study,
        replication,
        to_json,
    )
    from iksamples.results import certified, sample_sets
    from iksamples.samples.dataset import SampleSet
    from iksamples.samples.record import on_arms
    from iksamples.study import NETWORK
    from iksamples.task import study_task

    study = read(study_file)
    if not study.replication.seeds:
        raise IksamplesError(
            f"{study_file}: replication.seeds is 0; say how many fresh trainings, 200 for example."
        )
    found = []
    for one in answers_to_replicate(read_answer(results, study)):
        fresh = fresh_study(study, one)
        folder = results / FRESH / f"{one.method}-{one.design}"
        settings, network = folder / "study.json", folder / NETWORK
        with kept_file(settings) as file:
            file.write_text(fresh.model_dump_json(indent=2) + "\n", encoding="utf-8")
        sets = [folder / "samples" / f"{label}.parquet" for label in sample_sets(fresh)]
        for samples in sets:
            recorded = SampleSet.load(results / "samples" / samples.name)
            with kept_file(samples) as file:
                on_arms(fresh, study_task(fresh, recorded.region), recorded).save(file)
        train(settings, sets, folder, folder / "cache")
        evaluate(settings, sets, [NETWORK], folder)
        if NETWORK in certified(fresh):
            prove(settings, sets, NETWORK, network, network / "certificates.csv")
        collect(settings, folder)
        check = replication(study.tolerance, one, outcomes(fresh, read_runs(fresh, folder)))
        say(f"{one.method}, {one.design}: {check.statement}")
        found.append(check)
    with kept_file(output) as file:
        file.write_text(to_json(found), encoding="utf-8")
