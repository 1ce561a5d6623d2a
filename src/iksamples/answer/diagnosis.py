"""Why a method fails: only what the study's own data show, each with its number."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from iksamples.answer.answer import Diagnosis, Size
from iksamples.answer.collect import Variant, errors_at_samples
from iksamples.results import Cell
from iksamples.stats import FEWEST_SEEDS, Interval, compare, draws, interval
from iksamples.study import Study
from iksamples.text import (
    allowed,
    described,
    millimetres,
    percent,
    same_training,
    several,
)


FALLING = 0.02
"""A training counts as unfinished where its loss still falls by a larger share per tenth of it."""


def diagnose(
    study: Study,
    variant: Variant,
    outcomes: Mapping[Variant, "pd.DataFrame"],
    cell: Cell,
    answers: Mapping[Variant, Size],
    rng: np.random.Generator,
) -> list[Diagnosis]:
    """What the data show about a network that fails at the most samples tried.

    * *fit*: at its own samples it already misses by more than the tolerance, so what it lacks is
      not samples. By itself this does not tell a network that is too small from one that is not
      trained enough.
    * *training*: the training loss is still falling when training ends; or a network of the same
      shape, trained otherwise, is better on the same samples and seeds.
    * *capacity*: a network of another shape, trained alike, is better on the same samples.
    * *samples-suffice*: another method does it with no more samples of the same design.

    Noise is not looked for: samples are computed, and simulated arms' noise is the study's own.

    Args:
        study: The study.
        variant: The network and design.
        outcomes: Outcomes of all variants.
        cell: The network on the most samples tried.
        answers: Variants that meet the tolerance, with the size that is their answer.
        rng: Draws the resamples.
    """
    found = [
        _misses_its_samples(study, cell),
        _still_falling(cell, rng),
        *_better_networks(study, variant, outcomes, cell.samples.n_samples, rng),
        _others_do_it(study, variant, answers, cell.samples.n_samples),
    ]
    return [cause for cause in found if cause is not None]


def loss_fall(history: pd.DataFrame, rng: np.random.Generator) -> Interval:
    """By which share the training loss falls from the last but one tenth of training to the last.

    Args:
        history: Columns seed, epoch, train_loss.
        rng: Draws the resamples.

    Returns:
        Median over the seeds that trained for twenty epochs or more, with its interval.
    """
    falls = []
    for _, losses in history.sort_values("epoch").groupby("seed")["train_loss"]:
        loss = losses.to_numpy(float)
        tenth = len(loss) // 10
        if tenth >= 2 and np.isfinite(loss[-2 * tenth :]).all():
            falls.append(1 - loss[-tenth:].mean() / loss[-2 * tenth : -tenth].mean())
    values = np.array(falls)
    if len(values) < FEWEST_SEEDS:
        return Interval(float(np.median(values)) if falls else np.nan, np.nan, np.nan)
    resampled = np.median(values[draws(len(values), rng)], axis=1)
    return interval(float(np.median(values)), resampled)


def _misses_its_samples(study: Study, cell: Cell) -> Diagnosis | None:
    errors = errors_at_samples(study, cell)
    if errors is None or not len(errors):
        return None
    tolerance = study.tolerance
    failed = int((errors > tolerance.error_mm).sum())
    if failed <= len(errors) * (1 - tolerance.success_share) or tolerance.best_of > 1:
        return None
    what = {"worst": "worst", "mean": "mean"}.get(tolerance.of)
    what = f"{what} error" if what else f"{tolerance.of} of the error"
    return Diagnosis(
        kind="fit",
        text=f"At its own {several(cell.samples.n_samples, 'sample')} {failed} of {len(errors)} "
        f"trainings are already not within {allowed(tolerance)} ({what}, "
        f"median {millimetres(float(np.median(errors)))}): it lacks capacity or training before it "
        "lacks samples.",
    )


def _still_falling(cell: Cell, rng: np.random.Generator) -> Diagnosis | None:
    fall = loss_fall(cell.table("history"), rng)
    if not fall.known or fall.low <= FALLING:
        return None
    return Diagnosis(
        kind="training",
        text=f"With {several(cell.samples.n_samples, 'sample')} its training loss still falls by "
        f"{percent(fall.value)} (95 % interval {percent(fall.low)} to {percent(fall.high)}) in the "
        "last tenth of training, so the training ends too early.",
    )


def _better_networks(
    study: Study,
    variant: Variant,
    outcomes: Mapping[Variant, "pd.DataFrame"],
    n_samples: int,
    rng: np.random.Generator,
) -> list[Diagnosis]:
    ours = study.all_methods[variant.method]
    found = []
    for other_variant, of_other in outcomes.items():
        other = study.all_methods[other_variant.method]
        if other_variant.design != variant.design or other.kind != "network":
            continue
        same_network = other.network == ours.network
        if same_network == same_training(other.training, ours.training):
            continue  # itself, or two things differ at once
        pairs = compare(of_other, outcomes[variant], rng)
        pairs = pairs[pairs["n_samples"] == n_samples]
        if pairs.empty or not pairs["ratio_high"].iloc[0] < 1:
            continue
        row = pairs.iloc[0]
        change = "The same network trained otherwise" if same_network else "Another network"
        found.append(
            Diagnosis(
                kind="training" if same_network else "capacity",
                text=f"{change}, {described(study, other_variant.method)}, has "
                f"{percent(row['ratio'])} of its error on the same "
                f"{several(n_samples, 'sample')} (95 % interval {percent(row['ratio_low'])} to "
                f"{percent(row['ratio_high'])}, median over {int(row['n_pairs'])} paired seeds).",
            )
        )
    return found


def _others_do_it(
    study: Study, variant: Variant, answers: Mapping[Variant, Size], n_samples: int
) -> Diagnosis | None:
    able = {
        other.method: size
        for other, size in answers.items()
        if other.design == variant.design
        and size.n_samples <= n_samples
        and study.all_methods[other.method].kind != "nominal"
    }
    if not able:
        return None
    name = min(able, key=lambda key: able[key].n_samples)
    size = able[name]
    proof = "certified" if size.certified else "measured, not certified"
    return Diagnosis(
        kind="samples-suffice",
        text=f"The samples are enough: {described(study, name)} meets the tolerance with "
        f"{several(size.n_samples, 'sample')} ({proof}).",
    )
