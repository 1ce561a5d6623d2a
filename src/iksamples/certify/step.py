"""The steps that prove: worst case and mean of every network, and more of those that pictures show.

A picture shows one network of each set of samples: on each of the study's paths the one whose mean
error is the median over the seeds. Of these few is proved, too, where the error is too large and
how the worst case fell along the training.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, SerialChain
from iksamples.certify.compared import Measure
from iksamples.certify.mean import MeanError, certify_coverage, certify_mean
from iksamples.certify.proof import checked, degrees_down, degrees_up
from iksamples.certify.search import Certificate, certify_stack
from iksamples.certify.table import Table
from iksamples.columns import certificate_columns, stored_table
from iksamples.evaluation.errors import median_seed, networks_over_epochs
from iksamples.methods.grid import tensor_grid
from iksamples.methods.predictor import NotApplicableError, attempt
from iksamples.network import StackedMLP
from iksamples.results import Cell, certified
from iksamples.samples.dataset import SampleSet
from iksamples.study import MOST_INPUTS_OF_A_MEAN, PROVED_TOGETHER, Study
from iksamples.task import Task


def certify(
    study: Study,
    task: Task,
    method: str,
    samples: SampleSet,
    folder: Path,
    seeds: range | None = None,
) -> pd.DataFrame:
    """Certifies a method on one set of samples.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method.
        samples: What it learnt from.
        folder: Where a network's weights are.
        seeds: Only these networks, beginning at a multiple of ``PROVED_TOGETHER`` from the first;
            None: all.

    Returns:
        As ``certify_networks``; no row where a table of samples that form no full grid is asked
        for.
    """
    if study.all_methods[method].kind == "network":
        network = StackedMLP.load(folder / "weights.safetensors")
        if seeds:
            network = network.select([i for i, one in enumerate(network.seeds) if one in seeds])
        return certify_networks(study, task, method, samples, network)
    arms = study.all_methods[method].training.all_seeds if samples.arms else (0,)
    rows = []
    for seed in arms:
        try:
            grid = tensor_grid(samples.of(seed), method)
        except NotApplicableError:
            break
        table = Table(grid.axes, grid.joints)
        rows += _rows(study, task, method, samples, table, (seed,))
    return _table(rows, samples, task)


def certify_networks(
    study: Study, task: Task, method: str, samples: SampleSet, network: StackedMLP
) -> pd.DataFrame:
    """Certifies every network of a stack over the study's region.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method, for the table.
        samples: What the networks learnt from; the search starts at these points.
        network: The networks. One that is not finite gets no row.

    Returns:
        One row per seed, columns as in ``columns.CERTIFICATES``. A bound that the checker does not
        prove is missing, and all where the numbers defeat the search; ``failed`` says which it is.
    """
    together = 1 if samples.arms else PROVED_TOGETHER  # each on its own arm
    sound = set(network.finite_rows())
    stacks = [
        network.select([row for row in range(first, first + together) if row in sound])
        for first in range(0, network.n_seeds, together)
    ]
    rows = [row for one in stacks for row in _rows(study, task, method, samples, one, one.seeds)]
    return _table(rows, samples, task)


def joined(files: Sequence[Path], labels: Sequence[str]) -> pd.DataFrame:
    """Tables of certificates of some seeds each as the one that all together would have.

    Args:
        files: The tables (CSV), which are not read as numbers, so that none changes.
        labels: The sets of samples, in the order of the table.
    """
    tables = [stored_table(file, dtype=str) for file in files]
    rank = {label: place for place, label in enumerate(labels)}
    whole = pd.concat(tables).reset_index(drop=True)
    order = pd.DataFrame({"label": whole["label"].map(rank), "seed": whole["seed"].astype(int)})
    return whole.loc[order.sort_values(["label", "seed"], kind="stable").index]


def _rows(
    study: Study,
    task: Task,
    method: str,
    samples: SampleSet,
    answers: StackedMLP | Table,
    seeds: tuple[int, ...],
) -> list[dict[str, object]]:
    """A row per network, or for a look-up table; all of one arm. One defeated is not proved."""
    if not seeds:
        return []
    head = {
        "method": method,
        "label": samples.label,
        "samples_per_axis": samples.points_per_axis,
        "n_samples": samples.n_samples,
        "region_share": samples.region_share,
    }
    prove = partial(_proofs, study, task, samples, answers, seeds[0])
    found, why = attempt("the numbers of the proof", prove)
    if found is None and isinstance(answers, StackedMLP) and len(seeds) > 1:
        singly = (answers.select([row]) for row in range(len(seeds)))  # one of them is at fault
        parts = (_rows(study, task, method, samples, one, one.seeds) for one in singly)
        return [row for part in parts for row in part]
    if found is None:
        nothing = {"boxes": 0, "seconds": 0.0, "complete": False, "verified": False}
        found = [nothing | {"failed": why}]
    return [head | {"seed": seed} | row for seed, row in zip(seeds, found, strict=True)]


def _proofs(
    study: Study, task: Task, samples: SampleSet, answers: StackedMLP | Table, seed: int
) -> list[dict[str, object]]:
    chain = task.chain_of(seed)
    positions = _proved(study, task, chain, samples, answers, "position")
    angles = _proved(study, task, chain, samples, answers, "angle") if task.turns else None
    rows = []
    for row, (certificate, lower, upper) in enumerate(positions):
        mean = _mean(study, task, chain, answers, row)
        bounds: dict[str, object] = {"sup_lower_mm": lower, "sup_upper_mm": upper}
        boxes, seconds, done = certificate.boxes, certificate.seconds, certificate.complete
        why = _unproved(certificate, upper)
        if angles is not None:
            turned, least, most = angles[row]
            bounds |= {"angle_lower_deg": degrees_down(least), "angle_upper_deg": degrees_up(most)}
            boxes, seconds = boxes + turned.boxes, seconds + turned.seconds
            done, why = done and turned.complete, why or _unproved(turned, most)
        rows.append(
            {
                **bounds,
                **dict(zip(samples.space.columns("argmax_"), certificate.argmax, strict=True)),
                "mean_lower_mm": mean.lower_mm if mean else np.nan,
                "mean_upper_mm": mean.upper_mm if mean else np.nan,
                "boxes": boxes,
                "seconds": seconds,
                "complete": done,
                "verified": not why,
                "failed": why,
            }
        )
    return rows


def _unproved(found: Certificate, upper: float) -> str:
    """Why there is no bound, empty where there is one."""
    who = "separate checker" if np.isfinite(found.upper) else "search"
    return "" if np.isfinite(upper) else f"the {who} found no finite bound."


def _mean(
    study: Study, task: Task, chain: SerialChain, answers: StackedMLP | Table, row: int
) -> MeanError | None:
    """The mean error, enclosed; None where there are too many inputs for that."""
    if len(task.x) > MOST_INPUTS_OF_A_MEAN:
        return None
    return certify_mean(
        answers, row, chain, task.region, target=task.target,
        rtol=study.bounds.mean_rtol, atol_mm=study.bounds.mean_atol_mm,
    )  # fmt: skip


def _proved(
    study: Study,
    task: Task,
    chain: SerialChain,
    samples: SampleSet,
    answers: StackedMLP | Table,
    measure: Measure,
) -> list[tuple[Certificate, float, float]]:
    """Certificates with the bounds that the checker has proved, NaN where it has none."""
    found = checked(
        answers,
        chain,
        samples.region,
        task.target,
        measure,
        rtol=study.bounds.sup_rtol,
        atol=np.radians(study.bounds.sup_atol_deg) if measure == "angle" else 0.0,
        seeds=samples.x,
    )
    proved = []
    for item, proof in found:
        # The checker's own bound holds also where it cannot prove the search's: rounding differs.
        upper = max(item.upper, proof.upper)
        lower = min(item.lower, proof.lower)
        proved.append((item, lower, upper if np.isfinite(upper) else np.nan))
    return proved


def _table(rows: list[dict[str, object]], samples: SampleSet, task: Task) -> pd.DataFrame:
    columns = certificate_columns(samples.space.columns(), turns=task.turns)
    return pd.DataFrame(rows, columns=columns)


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


def map_cell(study: Study, task: Task, cell: Cell) -> dict[str, pd.DataFrame]:
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
    trainings, boxes = [], []
    for seed in shown_seeds(study, cell) if certified(study) else ():
        trainings += _attempted(cell, seed, partial(_training, task, cell, seed))
        if len(task.x) <= _MOST_INPUTS:
            boxes += _attempted(cell, seed, partial(_unsafe, study, task, cell, seed))
    return {
        name: pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=columns)
        for name, tables, columns in (
            (TRAINING, trainings, list(_TRAINING)),
            (UNSAFE, boxes, _unsafe_columns(task)),
        )
    }


def _attempted(cell: Cell, seed: int, prove: Callable[[], pd.DataFrame]) -> list[pd.DataFrame]:
    """A table, or none where numbers defeat the proof, which is then said."""
    found, why = attempt(f"{cell.method} on {cell.label}", prove)
    if found is not None:
        return [found]
    print(f"{cell.method} on {cell.label}, seed {seed}: no map ({why})", file=sys.stderr)
    return []


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


def _training(task: Task, cell: Cell, seed: int) -> pd.DataFrame:
    """The certified worst case along a training: what the paper leaves as future work.

    All epochs are searched together, which takes less time than starting each search from the
    leaves of the one before.
    """
    epochs, networks = networks_over_epochs(cell, seed)
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


def _unsafe(study: Study, task: Task, cell: Cell, seed: int) -> pd.DataFrame:
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


_BOUNDS = ("sup_lower_mm", "sup_upper_mm")
_TRAINING = ("seed", "epoch", *_BOUNDS, "training_mean_mm", "training_max_mm", "complete")


def _corners(task: Task) -> list[str]:
    """Columns of a box: lower_x_mm, lower_y_mm, .. upper_x_mm, .."""
    return [*task.x.columns("lower_"), *task.x.columns("upper_")]


def _unsafe_columns(task: Task) -> list[str]:
    return ["seed", *_corners(task), "tolerance_mm", "safe_lower", "safe_upper", "drawn"]
