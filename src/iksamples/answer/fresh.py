"""The calibration step: an answer's networks trained again, with seeds it has not seen."""

from collections.abc import Sequence
from pathlib import Path

from iksamples.answer.answer import MethodAnswer, Rung, read_answer
from iksamples.answer.calibration import FRESH, Calibration, calibrate_study
from iksamples.certify.step import certify
from iksamples.evaluation.step import evaluate
from iksamples.results import Cell, sample_sets
from iksamples.study import Method, Study, Training
from iksamples.task import Task
from iksamples.training.step import train_study


def calibrate_results(
    study: Study, task: Task, results: Path, progress: bool = False
) -> list[Calibration]:
    """Holds every network's answer against fresh trainings of it.

    The fresh networks are trained on the study's own samples, at the answer and one rung below, and
    measured and certified as the study's were. They are kept in the results, in
    ``fresh/<method>-<design>``.

    Args:
        study: The study; ``calibration.seeds`` says how many fresh trainings.
        task: Its task.
        results: Its results folder, with its answer.
        progress: Report on stderr.

    Returns:
        One for each network with an answer that was tried.
    """
    answer = read_answer(results)
    answered = [one for one in answer.methods if one.kind == "network" and one.status == "answered"]
    found = []
    for one in answered:
        fresh = fresh_study(study, one)
        _run(fresh, task, one, results, progress)
        folder = _folder(results, one)
        found.append(calibrate_study(answer, study, fresh, folder, one.method, one.design))
    return found


def fresh_study(study: Study, answer: MethodAnswer) -> Study:
    """The study cut down to one method, at its answer and one rung below, with fresh seeds."""
    trainings = [study.training, *(method.training for method in study.methods.values())]
    first = max(training.first_seed + training.seeds for training in trainings)

    def reseeded(training: Training) -> Training:
        seeds = {"seeds": study.calibration.seeds, "first_seed": first}
        return training.model_copy(update=seeds)

    def again(method: Method) -> Method:
        return method.model_copy(update={"training": reseeded(method.training)})

    methods = {name: again(m) for name, m in study.methods.items() if name == answer.method}
    sets = sample_sets(study)
    sizes = [sets[rung.label][1] for rung in _rungs(answer)]
    samples = study.samples.model_copy(
        update={"points_per_axis": sizes, "designs": [answer.design]}
    )
    return study.model_copy(
        update={"training": reseeded(study.training), "methods": methods, "samples": samples}
    )


def _folder(results: Path, answer: MethodAnswer) -> Path:
    """The results folder of an answer's fresh trainings."""
    return results / FRESH / f"{answer.method}-{answer.design}"


def _run(study: Study, task: Task, answer: MethodAnswer, results: Path, progress: bool) -> None:
    """Trains, measures and proves; each table of a fresh network lies where a study's does."""
    import pandas as pd

    method, folder = answer.method, _folder(results, answer)
    cells = [Cell(results, method, rung.label) for rung in _rungs(answer)]
    sets = [cell.samples for cell in cells]
    train_study(study, sets, folder, folder / "cache", progress, methods=[method])
    proofs = []
    for samples in sets:
        cell = Cell(folder, method, samples.label)
        cell.samples_path.parent.mkdir(parents=True, exist_ok=True)
        samples.save(cell.samples_path)
        tables, _ = evaluate(study, task, samples, method, cell.folder)
        for name, table in tables.items():
            table.to_parquet(cell.folder / f"{name}.parquet")
        proofs.append(certify(study, task, method, samples, cell.folder))
    pd.concat(proofs).to_csv(folder / method / "certificates.csv", index=False)


def _rungs(answer: MethodAnswer) -> Sequence[Rung]:
    """The answer's rung and the one below."""
    wanted = {answer.n_samples, answer.below.n_samples if answer.below else None}
    return [rung for rung in answer.rungs if rung.n_samples in wanted]
