"""The map step: of the networks that pictures show, where the error is too large, and since when.

A picture shows one network of each set of samples: on each of the study's paths the one whose mean
error is the median over the seeds. For these few networks more is proved than for the rest.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats
from iksamples.certify.mean import certify_coverage
from iksamples.certify.search import certify_stack
from iksamples.evaluation.shown import median_seed, networks_over_epochs
from iksamples.results import Cell
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd

TRAINING, UNSAFE = "training_bound", "unsafe"
"""Names of the two tables, beside the others of a cell."""

MAX_BOXES = 400
"""Boxes kept of a network, largest first; more are slow to draw."""

_MOST_INPUTS = 3
"""Inputs of a region whose share can be enclosed in time, and drawn."""
_RTOL = 0.02
# The share is known to within 2 % either way; boxes on the border matter to a picture only.
_ATOL, _MIXED = 0.04, 0.4


def shown_seeds(study: Study, cell: Cell) -> list[int]:
    """The seeds that pictures show of a cell, those of the first path first; none diverged.

    A recording takes the median over all seeds and leaves a grid out whose median one diverged; the
    report takes it over those that did not diverge.
    """
    errors = cell.table("errors").rename(columns={"error_mean_mm": "error_mm"})
    members = cell.table("members")
    sound = set(members.loc[~members["diverged"].astype(bool), "seed"])
    seeds = []
    for path in study.evaluation.paths if sound else ():
        rows = errors[errors["region"] == path]
        seeds += [median_seed(rows[rows["seed"].isin(sound)]), median_seed(rows)]
    return [seed for seed in dict.fromkeys(seeds) if seed in sound]


def map_cell(study: Study, task: Task, cell: Cell) -> "dict[str, pd.DataFrame]":
    """What is proved of the networks that pictures show of a cell.

    Args:
        study: The study.
        task: Its task.
        cell: A trained method on one set of samples, evaluated.

    Returns:
        Name of the table -> table; both may have no row, where every network diverged.

        ``training_bound``: one row per shown seed and epoch kept (at most 60): seed, epoch,
        sup_lower_mm, sup_upper_mm, training_mean_mm, training_max_mm, complete. The bounds hold
        whether complete or not. An epoch whose weights are not finite has no row.

        ``unsafe``: one row per box in which the error is above the study's tolerance everywhere,
        at most 400 for a seed, the largest: seed, lower_x_mm ... upper_z_mm; and the same in every
        row of a seed: tolerance_mm, safe_lower and safe_upper, between which the share of the
        workspace under the tolerance lies, and drawn, the boxes' share. A seed without such a box
        has one row without corners. No row where there are more than three inputs.
    """
    import pandas as pd

    trainings, boxes = [], []
    provable = study.arm is None or study.arm.is_chain
    for seed in shown_seeds(study, cell) if provable else ():
        trainings.append(_training(task, cell, seed))
        if len(task.x) <= _MOST_INPUTS:
            boxes.append(_unsafe(study, task, cell, seed))
    columns = _unsafe_columns(task)
    return {
        TRAINING: pd.concat(trainings, ignore_index=True) if trainings else _empty(list(_TRAINING)),
        UNSAFE: pd.concat(boxes, ignore_index=True) if boxes else _empty(columns),
    }


def merge_boxes(lower: ArrayLike, upper: ArrayLike) -> tuple[Floats, Floats]:
    """Joins boxes that share a whole face, one axis after the other.

    Args:
        lower: Lower corners of boxes that do not overlap, shape (n, d).
        upper: Their upper corners, shape (n, d).

    Returns:
        Corners of fewer boxes that fill the same space.
    """
    low, high = np.array(lower, float), np.array(upper, float)
    for axis in range(low.shape[1] if len(low) else 0):
        others = [k for k in range(low.shape[1]) if k != axis]
        # Corners that are the same number on paper may differ in their last digit.
        sides = np.round(np.concatenate([low[:, others], high[:, others]], axis=1), 9)
        order = np.lexsort([low[:, axis], *sides.T])
        low, high, sides = low[order], high[order], sides[order]
        begins = np.ones(len(low), bool)
        begins[1:] = np.any(sides[1:] != sides[:-1], axis=1)
        begins[1:] |= np.abs(low[1:, axis] - high[:-1, axis]) > 1e-9
        first = np.flatnonzero(begins)
        last = np.append(first[1:], len(low)) - 1
        joined = high[first]
        joined[:, axis] = high[last, axis]
        low, high = low[first], joined
    return low, high


def _training(task: Task, cell: Cell, seed: int) -> "pd.DataFrame":
    """The certified worst case along a training: what the paper leaves as future work.

    All epochs are searched together, which takes less time than starting each search from the
    leaves of the one before.
    """
    import pandas as pd

    epochs, networks = networks_over_epochs(cell.folder / "snapshots.safetensors", seed)
    finite = networks.finite_rows()
    sound, x = networks.select(finite), cell.samples.x
    chain = task.chain_of(seed)
    certificates = certify_stack(sound, chain, task.region, rtol=_RTOL, seeds=x, target=task.target)
    errors = task.target.position_error_mm(chain, sound.predict(x), x)
    return pd.DataFrame(
        {
            "seed": np.array(sound.seeds),
            "epoch": np.asarray(epochs)[finite],
            "sup_lower_mm": [c.lower for c in certificates],
            "sup_upper_mm": [c.upper for c in certificates],
            "training_mean_mm": errors.mean(axis=1),
            "training_max_mm": errors.max(axis=1),
            "complete": [c.complete for c in certificates],
        }
    )[list(_TRAINING)]


def _unsafe(study: Study, task: Task, cell: Cell, seed: int) -> "pd.DataFrame":
    import pandas as pd

    coverage = certify_coverage(
        cell.network,
        cell.network.seeds.index(seed),
        task.chain_of(seed),
        task.region,
        study.tolerance.error_mm,
        atol=_ATOL,
        mixed=_MIXED,
        target=task.target,
    )
    low, high = merge_boxes(coverage.bad_lower_mm, coverage.bad_upper_mm)
    volume = np.prod(high - low, axis=1) / task.region.volume
    largest = np.argsort(-volume, kind="stable")[:MAX_BOXES]
    drawn = float(volume[largest].sum())
    corners = np.hstack([low, high])[largest]
    if not len(largest):
        corners = np.full((1, 2 * len(task.x)), np.nan)
    table = pd.DataFrame(corners, columns=_corners(task))
    return table.assign(
        seed=seed,
        tolerance_mm=coverage.tolerance_mm,
        safe_lower=coverage.lower,
        safe_upper=coverage.upper,
        drawn=drawn,
    )[_unsafe_columns(task)]


_TRAINING = (
    "seed",
    "epoch",
    "sup_lower_mm",
    "sup_upper_mm",
    "training_mean_mm",
    "training_max_mm",
    "complete",
)


def _corners(task: Task) -> list[str]:
    """Columns of a box: lower_x_mm, lower_y_mm, .. upper_x_mm, .."""
    return [*task.x.columns("lower_"), *task.x.columns("upper_")]


def _unsafe_columns(task: Task) -> list[str]:
    return ["seed", *_corners(task), "tolerance_mm", "safe_lower", "safe_upper", "drawn"]


def _empty(columns: list[str]) -> "pd.DataFrame":
    import pandas as pd

    return pd.DataFrame(columns=columns)
