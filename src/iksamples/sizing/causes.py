"""Why a method fails: only what the study's own data show, each with its number."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from iksamples.results import Cell
from iksamples.sizing.answer import Cause
from iksamples.sizing.outcomes import errors_at_samples
from iksamples.sizing.statistics import FEWEST_SEEDS, Interval, compare, draws, interval
from iksamples.sizing.words import described, millimetres, percent
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

FALLING = 0.02
"""A training counts as unfinished where its loss still falls by a larger share per tenth of it."""


def causes(
    study: Study,
    rows: "pd.DataFrame",
    cell: Cell,
    sufficient: Mapping[str, int],
    rng: np.random.Generator,
) -> list[Cause]:
    """What the data show about a network that fails at the most samples tried.

    * *fit*: at its own samples it is already off by more than the tolerance, so the samples between
      which it has to guess are not what it lacks. By itself this does not tell a network that is
      too small from one that is not trained enough.
    * *training*: the training loss is still falling when training ends; or a network of the same
      shape, trained otherwise, is better on the same samples and seeds.
    * *capacity*: a network of another shape, trained alike, is better on the same samples.
    * *samples-suffice*: another method does it with no more samples.

    Noise is no cause here: the samples are computed, not measured.

    Args:
        study: The study.
        rows: Outcomes of all methods.
        cell: The network on the most samples tried.
        sufficient: Other methods that meet the tolerance, with the samples they need.
        rng: Draws the resamples.
    """
    found = [
        _misses_its_samples(study, cell),
        _still_falling(cell, rng),
        *_better_networks(study, rows, cell, rng),
        _others_do_it(study, cell, sufficient),
    ]
    return [cause for cause in found if cause is not None]


def loss_fall(history: "pd.DataFrame", rng: np.random.Generator) -> Interval:
    """By which share the training loss falls from the last but one tenth of training to the last.

    Args:
        history: Columns seed, epoch, train_loss_rad2.
        rng: Draws the resamples.

    Returns:
        Median over seeds with its interval.
    """
    falls = []
    for _, losses in history.sort_values("epoch").groupby("seed")["train_loss_rad2"]:
        loss = losses.to_numpy(float)
        tenth = len(loss) // 10
        if tenth and np.isfinite(loss[-2 * tenth :]).all():
            falls.append(1 - loss[-tenth:].mean() / loss[-2 * tenth : -tenth].mean())
    values = np.array(falls)
    if len(values) < FEWEST_SEEDS:
        return Interval(float(np.median(values)) if falls else np.nan, np.nan, np.nan)
    resampled = np.median(values[draws(len(values), rng)], axis=1)
    return interval(float(np.median(values)), resampled)


def _misses_its_samples(study: Study, cell: Cell) -> Cause | None:
    errors = errors_at_samples(study, cell)
    if errors is None or not len(errors):
        return None
    middle, wish = float(np.median(errors)), study.tolerance.error_mm
    if middle <= wish:
        return None
    which = {"worst": "worst", "mean": "mean"}.get(study.tolerance.of)
    what = f"{which} error" if which else f"{study.tolerance.of} of the error"
    return Cause(
        kind="fit",
        text=f"At its own {cell.samples.n_samples} samples it is already off by "
        f"{millimetres(middle)} ({what}, median over {len(errors)} seeds): it lacks capacity or "
        "training before it lacks samples.",
    )


def _still_falling(cell: Cell, rng: np.random.Generator) -> Cause | None:
    fall = loss_fall(cell.table("history"), rng)
    if not fall.known or fall.low <= FALLING:
        return None
    return Cause(
        kind="training",
        text=f"With {cell.samples.n_samples} samples its training loss still falls by "
        f"{percent(fall.value)} (95 % interval {percent(fall.low)} to {percent(fall.high)}) in the "
        "last tenth of training, so the training ends too early.",
    )


def _better_networks(
    study: Study, rows: "pd.DataFrame", cell: Cell, rng: np.random.Generator
) -> list[Cause | None]:
    ours = study.all_methods[cell.method]
    found: list[Cause | None] = []
    for name, other in study.all_methods.items():
        if name == cell.method or other.kind != "network":
            continue
        same_network, same_training = (
            other.network == ours.network,
            other.training == ours.training,
        )
        if same_network == same_training:  # both alike, or two things differ at once
            continue
        pairs = compare(rows, name, cell.method, rng)
        pairs = pairs[pairs["n_samples"] == cell.samples.n_samples]
        if pairs.empty or not pairs["ratio_high"].iloc[0] < 1:
            continue
        row = pairs.iloc[0]
        change = "The same network" if same_network else "Another network, trained alike,"
        found.append(
            Cause(
                kind="training" if same_network else "capacity",
                text=f"{change} ({described(study, name)}) has {percent(row['ratio'])} of its error"
                f" on the same {cell.samples.n_samples} samples (95 % interval "
                f"{percent(row['ratio_low'])} to {percent(row['ratio_high'])}, median over "
                f"{int(row['n_pairs'])} paired seeds).",
            )
        )
    return found


def _others_do_it(study: Study, cell: Cell, sufficient: Mapping[str, int]) -> Cause | None:
    largest = cell.samples.n_samples
    able = {
        name: n
        for name, n in sufficient.items()
        if n <= largest and name != cell.method and study.all_methods[name].kind != "analytic"
    }
    if not able:
        return None
    name = min(able, key=lambda key: able[key])
    return Cause(
        kind="samples-suffice",
        text=f"The samples are enough: {described(study, name)} meets the tolerance with "
        f"{able[name]} of the kind.",
    )
