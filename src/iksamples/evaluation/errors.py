"""Errors of methods on paths and over the whole region, and what arms leave them at least."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats
from iksamples.arm.inverse import followed
from iksamples.arm.real import Arm, RealArm
from iksamples.errors import IksamplesError
from iksamples.evaluation.paths import count_waypoints, waypoints
from iksamples.methods.predictor import (
    Predictor,
    Single,
    Stacked,
    attempt,
    in_parts,
    no_answer,
)
from iksamples.methods.registry import KINDS, fit_each
from iksamples.network import StackedMLP, layers_of, read_tensors
from iksamples.results import CUBE, Cell
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import region_points
from iksamples.study import MAX_EPOCHS, Evaluation, Study
from iksamples.task import Task


_ROWS, _AT_ONCE = 2**20, 2**16
"""Points of all members in tables that are held at once, and that are followed to the tool."""

MEASURES = {"error_mm": "error_{}_mm", "angle_deg": "angle_{}_deg"}
"""Column of an error measure -> columns of its statistics over the points of a region."""


@dataclass(frozen=True)
class Reached:
    """What a method does when asked for some inputs.

    Attributes:
        joints: Joint values that each seed answers [rad or mm], shape (seeds, points, joints).
        reached_mm: Where the tool goes [mm], shape (seeds, points, 3).
        error_mm: Distance to where it was sent (paper, Eq. 3, unsquared) [mm], over the positions
            among the inputs, shape (seeds, points).
        angle_deg: Angle to how it was to be turned [deg], shape (seeds, points); None where the
            orientation is free.
    """

    joints: Floats
    reached_mm: Floats
    error_mm: Floats
    angle_deg: Floats | None

    def errors(self) -> dict[str, Floats]:
        """The error measures by column name, each of shape (seeds, points)."""
        turned = {} if self.angle_deg is None else {"angle_deg": self.angle_deg}
        return {"error_mm": self.error_mm, **turned}


def send(predictor: Predictor, task: Task, x: Floats) -> Reached:
    """Asks a method for inputs and follows it through the forward kinematics of each seed's arm.

    Args:
        predictor: Stacked networks, or any other fitted method.
        task: What is learned.
        x: Inputs [mm or rad], shape (points, d).
    """
    x = np.asarray(x, float)
    blocks = np.split(x, range(_AT_ONCE, len(x), _AT_ONCE))
    parts = [
        [_followed(part, task, block) for block in blocks]
        for part in in_parts(predictor, max(1, len(x)), _AT_ONCE)
    ]

    def joined(name: str) -> Floats:
        rows = [np.concatenate([getattr(one, name) for one in part], axis=1) for part in parts]
        return np.concatenate(rows)

    angle = joined("angle_deg") if task.turns else None
    return Reached(joined("joints"), joined("reached_mm"), joined("error_mm"), angle)


def _followed(predictor: Predictor, task: Task, x: Floats) -> Reached:
    """As ``send``, all at once."""
    joints, target = predictor.predict(x), task.target
    arms = [task.arm_of(seed) for seed in predictor.seeds]
    # One arm for all of them goes in one piece.
    rows = [slice(None)] if len(set(arms)) == 1 else [slice(i, i + 1) for i in range(len(arms))]

    def of_each(measure: Callable[[Arm, Floats], Floats]) -> Floats:
        return np.concatenate([measure(arms[row][0], joints[row]) for row in rows])

    angle = None
    if task.turns:
        angle = np.degrees(of_each(lambda arm, own: target.angle_error_rad(arm, own, x)))
    return Reached(
        joints,
        of_each(lambda arm, own: arm.forward_mm(own)),
        of_each(lambda arm, own: target.position_error_mm(arm, own, x)),
        angle,
    )


def track_paths(evaluation: Evaluation, task: Task, predictor: Predictor) -> pd.DataFrame:
    """Every waypoint of every path for every seed.

    Returns:
        Columns path, waypoint, seed, pen_up, target_* (the inputs), reached_*_mm, q_* (the joints),
        error_mm and, where the tool's orientation is asked for, angle_deg.
    """
    frames = []
    for name, path in evaluation.paths.items():
        x, pen_up = waypoints(path, task)
        result = send(predictor, task, x)
        n_seeds, n_points = result.error_mm.shape
        columns: dict[str, object] = {
            "path": name,
            "waypoint": np.tile(np.arange(n_points), n_seeds),
            "seed": np.repeat(predictor.seeds, n_points),
            "pen_up": np.tile(pen_up, n_seeds),
        }
        for i, column in enumerate(task.x.columns("target_")):
            columns[column] = np.tile(x[:, i], n_seeds)
        for i, axis in enumerate("xyz"):
            columns[f"reached_{axis}_mm"] = result.reached_mm[..., i].ravel()
        for i, column in enumerate(task.q.columns("q_")):
            columns[column] = result.joints[..., i].ravel()
        columns |= {measure: values.ravel() for measure, values in result.errors().items()}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def cube_errors(evaluation: Evaluation, task: Task, predictor: Predictor) -> pd.DataFrame:
    """The error at every point of the region's dense set for every seed.

    Returns:
        Columns point, seed, error_mm and, where the tool's orientation is asked for, angle_deg;
        point counts along ``region_points``.
    """
    points = region_points(task.region, evaluation.cube_points)
    errors = send(predictor, task, points).errors()
    return pd.DataFrame(
        {
            "point": np.tile(np.arange(len(points), dtype=np.int32), len(predictor.seeds)),
            "seed": np.repeat(np.asarray(predictor.seeds, np.int32), len(points)),
            **{measure: values.astype(np.float32).ravel() for measure, values in errors.items()},
        }
    )


def summarise(waypoints: pd.DataFrame, cube: pd.DataFrame) -> pd.DataFrame:
    """Mean, 95th and 99th percentile and maximum of each error, a row for each region and seed.

    Args:
        waypoints: What ``track_paths`` returned.
        cube: What ``cube_errors`` returned.

    Returns:
        Columns region, seed, error_mean_mm, error_p95_mm, error_p99_mm, error_max_mm, and the same
        of angle_*_deg where the tool's orientation is asked for. Where there is no answer, the
        error counts as infinite.
    """
    measures = [name for name in MEASURES if name in cube]
    everything = pd.concat(
        [
            waypoints[["path", "seed", *measures]].rename(columns={"path": "region"}),
            cube[["seed", *measures]].assign(region=CUBE),
        ]
    ).fillna(dict.fromkeys(measures, np.inf))
    grouped = everything.groupby(["region", "seed"], sort=False)
    statistics = {}
    for measure in measures:
        values, column = grouped[measure], MEASURES[measure].format
        statistics[column("mean")] = values.mean()
        statistics[column("p95")] = values.quantile(0.95)
        statistics[column("p99")] = values.quantile(0.99)
        statistics[column("max")] = values.max()
    return pd.DataFrame(statistics).reset_index()


def evaluate(
    study: Study, task: Task, samples: SampleSet, method: str, folder: Path
) -> Iterator[dict[str, pd.DataFrame]]:
    """Measures a method's errors along the paths and over the workspace, some seeds at a time.

    Args:
        study: The study.
        task: Its task.
        samples: What the method learnt from, or is fitted to now if it is no network.
        method: Name of the method.
        folder: Where a network's weights are.

    Yields:
        The tables waypoints, cube and errors of the next seeds, as ``track_paths``,
        ``cube_errors`` and ``summarise`` return them; the errors of what was fitted say besides
        how sure it is of itself (confident_mm) and why it failed (failed, empty where it did not).

    Raises:
        NotApplicableError: The method cannot use these samples.
    """
    own = study.all_methods[method]
    predictor: Predictor = (
        StackedMLP.load(folder / "weights.safetensors")
        if not KINDS[own.kind].fit
        else fit_each(own.kind, task, samples, own.training.all_seeds)
    )
    n_points = study.evaluation.cube_points + sum(
        count_waypoints(path) for path in study.evaluation.paths.values()
    )
    for part in in_parts(predictor, n_points, _ROWS):
        if isinstance(part, Single | Stacked):
            yield from _fitted(study, task, f"{own.kind} on {samples.label}", part)
        else:
            yield _measured(study.evaluation, task, part)


def _fitted(
    study: Study, task: Task, what: str, fitted: Single | Stacked
) -> Iterator[dict[str, pd.DataFrame]]:
    """The tables of what was fitted; of a member that cannot be asked, those of no answer."""
    tables, why = attempt(what, lambda: _measured(study.evaluation, task, fitted))
    members = fitted.members if isinstance(fitted, Stacked) else [fitted]
    if tables is None and len(members) > 1:  # one of them is at fault
        for row in range(len(members)):
            yield from _fitted(study, task, what, fitted.select([row]))
        return
    if tables is None:
        members = [no_answer(len(task.q), why, fitted.seeds)]
        tables = _measured(study.evaluation, task, members[0])
    own, errors = dict(zip(fitted.seeds, members, strict=True)), tables["errors"]
    errors["failed"] = [own[seed].failed for seed in errors["seed"]]
    errors["confident_mm"] = [own[seed].confident_mm for seed in errors["seed"]]
    errors.loc[errors["region"] != CUBE, "confident_mm"] = np.nan
    yield tables


def nothing_measured() -> dict[str, pd.DataFrame]:
    """The tables of ``evaluate`` for a method that cannot use the samples."""
    empty = {
        "waypoints": pd.DataFrame({"path": [], "seed": [], "error_mm": []}),
        "cube": pd.DataFrame({"point": [], "seed": [], "error_mm": []}),
    }
    return {**empty, "errors": summarise(**empty)}


def _measured(evaluation: Evaluation, task: Task, predictor: Predictor) -> dict[str, pd.DataFrame]:
    waypoints = track_paths(evaluation, task, predictor)
    cube = cube_errors(evaluation, task, predictor)
    return {"waypoints": waypoints, "cube": cube, "errors": summarise(waypoints, cube)}


def median_seed(waypoints: pd.DataFrame) -> int:
    """The seed whose mean error on a path is the median over the seeds.

    Of an even number of seeds it is the better of the middle two, so that it is always a network
    that was trained. Seeds without a finite error come last.

    Args:
        waypoints: Rows of one path with the columns ``seed`` and ``error_mm``.
    """
    errors = waypoints.groupby("seed")["error_mm"].agg(lambda error: error.mean(skipna=False))
    ranked = errors.sort_values(kind="stable", na_position="last")
    return int(ranked.index[(len(ranked) - 1) // 2])


def networks_over_epochs(cell: Cell, seed: int) -> tuple[NDArray[np.int64], StackedMLP]:
    """The network of one seed at every epoch that was kept.

    Args:
        cell: A network's training.
        seed: Which seed.

    Returns:
        The epochs, at most ``MAX_EPOCHS`` with the first and the last, shape (epochs,), and a stack
        with one network per epoch.

    Raises:
        IksamplesError: The file cannot be read, or holds no such networks.
    """
    path = cell.folder / "snapshots.safetensors"
    tensors, header = read_tensors(path)
    try:
        row = header["seeds"].index(seed)
        epochs = tensors["epochs"].astype(np.int64)
        kept = np.unique(np.linspace(0, len(epochs) - 1, MAX_EPOCHS).round().astype(int))
        weights, biases = (
            tuple(array[:, row][kept] for array in part) for part in layers_of(tensors)
        )
        stack = StackedMLP(
            weights,
            biases,
            header["activation"],
            tensors["offset"],
            tensors["scale"],
            (seed,) * len(kept),
        )
        stack.require_sound()
        if [one.shape[1:] for one in weights] != [one.shape[1:] for one in cell.network.weights]:
            raise ValueError
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        raise IksamplesError(
            f"{path}: not these networks over the epochs. Delete it and run the study again."
        ) from None
    return epochs[kept], stack


FLOOR = "floor"
"""Where it lies among a study's results, as ``errors.parquet``."""


@dataclass(frozen=True)
class OwnInverse:
    """Each arm's own inverse kinematics, its sag included: no method can know more.

    Attributes:
        task: What is learned.
        seeds: The arms' seeds.
    """

    task: Task
    seeds: tuple[int, ...]

    def predict(self, x: ArrayLike, /) -> Floats:
        """Joint values [rad or mm], shape (arms, points, joints), for inputs (points, d)."""
        drawn = self.task.reach(x)
        answers = []
        for seed in self.seeds:
            actual, arm = followed(drawn, self.task.chain_of(seed)), self.task.arm_of(seed)
            answers.append(arm.unloaded(actual) if isinstance(arm, RealArm) else actual)
        return np.stack(answers)

    def select(self, rows: Sequence[int], /) -> Self:
        """The arms in the given rows, in that order."""
        return replace(self, seeds=tuple(self.seeds[i] for i in rows))


def repeatability(study: Study, task: Task) -> pd.DataFrame:
    """What is left of the error of each arm's own inverse, by the play and the steps of its joints.

    Args:
        study: The study, with an ``arm`` section.
        task: Its task.

    Returns:
        As ``evaluation.errors.summarise``: a row for each region and arm.
    """
    known = OwnInverse(task, study.arms)
    parts = in_parts(known, study.evaluation.cube_points, _ROWS)
    return pd.concat(
        [_measured(study.evaluation, task, part)["errors"] for part in parts], ignore_index=True
    )
