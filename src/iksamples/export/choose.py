"""Which network of a finished study is taken away."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from iksamples.answer.answer import Answer, VariantAnswer, read_answer
from iksamples.answer.collect import WORKSPACE, read_runs
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.results import Cell
from iksamples.study import Study, read_study


@dataclass(frozen=True, eq=False)
class Choice:
    """One network of a study.

    Attributes:
        study: The study.
        cell: Its method on its samples.
        network: The network alone.
        why: Why this one, in a sentence.
    """

    study: Study
    cell: Cell
    network: StackedMLP
    why: str

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.network.seeds[0]


def choose(
    results: Path,
    method: str | None = None,
    samples: str | None = None,
    seed: int | None = None,
) -> Choice:
    """The network that a finished study recommends, or one that is asked for.

    Without being asked, it is of the method that needs the fewest samples among those that are
    trained, at the number of samples that is the answer; if none is the answer, the best network of
    the largest set. Of its seeds it is the one with the least proved worst case; measured, where
    nothing is proved.

    Args:
        results: The study's results folder.
        method: Name of the method.
        samples: Name of the set of samples, such as ``grid5``.
        seed: Seed of the training.

    Raises:
        IksamplesError: The study is not finished, or there is no such network.
    """
    answer, study = read_answer(results), read_study(results / "study.json")
    if study.arm:
        raise IksamplesError(
            f"{study.name}: its networks learnt simulated arms, no two alike, so there is none to "
            "take away. Export from a study without an arm section."
        )
    one, label, why = _variant(answer, method, samples)
    runs = read_runs(results)
    runs = runs[(runs["method"] == one.method) & (runs["label"] == label)]
    runs = runs[(runs["region"] == WORKSPACE) & ~runs["diverged"]]
    if seed is None:
        if runs.empty:
            raise IksamplesError(f"{one.method} on {label}: every training diverged.")
        proved = runs["verified"].any()
        column = "sup_upper_mm" if proved else "error_max_mm"
        seed = int(runs["seed"].to_numpy()[np.nanargmin(runs[column].to_numpy())])
        kind = "the smallest proved worst case" if proved else "the smallest measured error"
        why = f"{why}; of {len(runs)} seeds the one with {kind}"
    elif seed not in set(runs["seed"]):
        known = ", ".join(map(str, sorted(runs["seed"])))
        raise IksamplesError(f"{one.method} on {label}: no sound seed {seed}; there are {known}.")
    cell = Cell(results, one.method, label)
    return Choice(study, cell, cell.network.select([cell.network.seeds.index(seed)]), why)


def _variant(
    answer: Answer, method: str | None, samples: str | None
) -> tuple[VariantAnswer, str, str]:
    """The method and its samples, and why."""
    trained = [one for one in answer.variants if one.kind == "network"]
    known = ", ".join(dict.fromkeys(one.method for one in trained))
    fitting = [one for one in trained if method in (None, one.method)]
    if not fitting:
        asked = f" '{method}'" if method else ""
        raise IksamplesError(
            f"{answer.study}: no trained method{asked}; there are: {known or 'none'}."
        )
    if samples is not None:
        for one in fitting:
            if samples in [size.label for size in one.sizes]:
                return one, samples, "as asked for"
        labels = ", ".join(size.label for one in fitting for size in one.sizes)
        raise IksamplesError(f"{answer.study}: no samples '{samples}'; there are {labels}.")
    answered = [one for one in fitting if one.found]
    if answered:
        best = min(answered, key=lambda one: one.shown.n_samples)
        fewest = f"{best.shown.n_samples}, which {best.method} needs"
        return best, best.shown.label, f"the fewest samples of a trained method are {fewest}"
    best = min(fitting, key=lambda one: _least(one.shown.error_best_mm))
    return (
        best,
        best.shown.label,
        f"no trained method is shown to meet the study's tolerance; {best.method} with "
        f"{best.shown.n_samples} samples has the best network of the largest set",
    )


def _least(error_mm: float | None) -> float:
    return float("inf") if error_mm is None else error_mm
