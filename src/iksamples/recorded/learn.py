"""A learning curve from records: which study is made of them, and what they say."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from iksamples.answer.collect import WORKSPACE
from iksamples.arm.chain import Floats, angles_of
from iksamples.columns import ANGLES, ERRORS
from iksamples.errors import IksamplesError
from iksamples.files import require_plain
from iksamples.recorded.curve import FAILED, runs_table
from iksamples.recorded.doubts import checked
from iksamples.recorded.judge import judged, n_held, orders
from iksamples.recorded.lerobot import is_lerobot, read_lerobot
from iksamples.recorded.read import Recording, read_recording
from iksamples.recorded.sockets import (
    FILES,
    is_sockets,
    judged_sockets,
    n_held_places,
    odd_postures,
    read_places,
)
from iksamples.region import Region
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import sample_set
from iksamples.study import Study, Workspace, parse_study
from iksamples.task import Task, study_chain, study_task
from iksamples.text import several


if TYPE_CHECKING:
    import pandas as pd

ABOUT, JUDGED = "recorded.json", "judged.parquet"
"""Files of a recorded study: what its recording is, and every record held out."""
MEASURED = "measured"
"""What the design of samples is called that a study's networks learn from."""
_FEWEST, _MOST_SIZES = 4, 8
_OFF_MM = 1.0
"""How far off its drawing an arm is told to be."""
_USUAL: dict[str, Any] = {
    "network": {"hidden": [16], "activation": "tanh"},
    "training": {"optimizer": "levenberg-marquardt", "epochs": 200},
    "methods": {
        "gaussian-process": {"kind": "gaussian-process"},
        "nominal": {"kind": "nominal"},
        "calibrated": {"kind": "calibrated"},
        "residual": {"kind": "residual"},
    },
}
"""Methods of a recording that nobody wrote a study for."""


class Learned(NamedTuple):
    """What a recording says.

    Attributes:
        head: What it is, in a sentence.
        doubts: What is odd about it, a sentence each.
        judged: A row per method, size, order and record held out (``judge.judged``).
        left_out: Why a method has none.
    """

    head: str
    doubts: list[str]
    judged: "pd.DataFrame"
    left_out: dict[str, str]

    @property
    def runs(self) -> "pd.DataFrame":
        """The same as a table of runs, an order for a seed."""
        return runs_table(runs_of(self.judged))


def sized_study(settings: dict[str, Any], where: str) -> Study:
    """A study of a recording that says nothing of methods and sizes: the usual ones.

    Args:
        settings: What it says.
        where: Where from, for messages.

    Raises:
        IksamplesError: A setting is wrong, or the recording cannot be read.
    """
    study = parse_study(settings | _USUAL, where)
    recorded = study.recording
    if recorded.kind == "sockets":
        places = read_places(recorded, study_chain(study))
        counts = sorted(sum(map(len, sockets)) for sockets in places.values())
        n = sum(counts[: len(counts) - n_held_places(recorded, places)])
    else:
        recording, _ = read_checked(study, "robot" in settings)
        n = len(recording) - n_held(study, len(recording))
    sizes = np.unique(np.geomspace(_FEWEST, n, _MOST_SIZES).round().astype(int)).tolist()
    samples = settings["samples"] | {"sizes": sizes}
    return parse_study(settings | _USUAL | {"samples": samples}, where)


def read_checked(study: Study, has_drawing: bool) -> tuple[Recording, list[str]]:
    """The study's records, and what is odd about them (``doubts.checked``).

    Args:
        study: The study.
        has_drawing: Whether its arm's file is a drawing of theirs.

    Raises:
        IksamplesError: They cannot be read, or not be used.
    """
    settings = study.recording
    if not Path(settings.path).exists():
        raise IksamplesError(settings.missing())
    drawing = study_chain(study) if has_drawing else None
    if settings.kind == "lerobot" or is_lerobot(Path(settings.path)):
        return checked(read_lerobot(settings, drawing), drawing)
    if Path(settings.path).is_dir():
        raise IksamplesError(
            f"{settings.path}: postures in sockets; they are for iksamples size, or a study with "
            "samples.recorded.kind: sockets."
            if is_sockets(Path(settings.path))
            else f"{settings.path}: a folder, but neither a LeRobot data set (meta/info.json) nor "
            f"postures in sockets (a folder for each place with {' and '.join(FILES)})."
        )
    recording, doubts = checked(read_recording(settings.path, drawing, settings.columns), drawing)
    if drawing is None:
        doubts.append(
            "no drawing of the arm is known: errors of joints are told in mm to first order, by "
            "how the tool moves between the records near by."
        )
    return recording, doubts


def read_samples(
    study: Study, task: Task, path: str | Path, columns: Mapping[str, str] | None = None
) -> tuple[SampleSet, list[str]]:
    """Samples that a study's networks can learn from, and what is odd about them.

    Args:
        study: The study; its fresh points check the training.
        task: Its task.
        path: A table of its inputs and joints, or a set that a study has kept.
        columns: As ``read_recording``.

    Raises:
        IksamplesError: They cannot be read, or not be used.
    """
    if _is_kept(Path(path)):
        samples = SampleSet.load(path)
        if samples.joint_names != task.q.names:
            raise IksamplesError(
                f"{path}: samples of the joints {', '.join(samples.joint_names)}, but the study's "
                f"arm has {', '.join(task.q.names)}. Name the study they were recorded for."
            )
        return samples, []
    found = read_recording(path, task.drawing, columns, 2, task.x.names)
    found, doubts = checked(found, task.drawing, 2, task.reach)
    off_mm = float(np.median(task.target.position_error_mm(task.drawing, found.joints, found.x)))
    if off_mm > _OFF_MM:
        doubts.append(
            f"half of the records are {off_mm:.3g} mm or more from where the drawing puts the "
            "tool, by which poses are proposed and errors told."
        )
    label = f"{MEASURED}{len(found)}"
    return sample_set(study, task, label, MEASURED, found.x, found.joints), doubts


def _is_kept(path: Path) -> bool:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        require_plain(path)
        return b"iksamples" in (parquet.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException):
        return False


_Judge = Callable[[], "tuple[pd.DataFrame, dict[str, str]]"]


def learning_curve(study: Study, has_drawing: bool = True) -> Learned:
    """What a recording says: every method on beginnings of its orders, judged by the rest.

    Args:
        study: The study, with ``samples.recorded``.
        has_drawing: Whether its arm's file is a drawing of theirs.

    Raises:
        IksamplesError: The records cannot be read or used, or are too few.
    """
    head, doubts, judge = _opened(study, has_drawing)
    return Learned(head, doubts, *judge())


def looked_at(study: Study) -> tuple[str, list[str]]:
    """What a study's recording is, and what is odd about it; nothing is learned."""
    return _opened(study, has_drawing=True)[:2]


def _opened(study: Study, has_drawing: bool) -> tuple[str, list[str], _Judge]:
    """What a recording is, what is odd about it, and what judges methods on it."""
    settings = study.recording
    how = f"In each of {settings.subsets} random orders"
    if has_drawing:
        study.require_own_arm()
    if settings.kind == "sockets":
        drawing = study_chain(study)
        places = read_places(settings, drawing)
        n = sum(len(postures) for sockets in places.values() for postures in sockets)
        head = (
            f"{several(n, 'posture')} with the tool in the sockets of "
            f"{several(len(places), 'place')}. {how} of the places "
            f"{n_held_places(settings, places)} judge, and the others are learned from, "
            f"{settings.postures_per_place} postures in each before the next."
        )
        judge = partial(judged_sockets, study, drawing, places)
        return head, odd_postures(places, drawing), judge
    recording, doubts = read_checked(study, has_drawing)
    task = recorded_task(study, recording) if has_drawing else None
    some = orders(study, len(recording))
    head = (
        f"{several(len(recording), 'record')} ({', '.join(recording.inputs)}; "
        f"{', '.join(recording.joint_names)}). {how} {some.held.shape[1]} judge, and the others "
        "are learned from."
    )
    return head, doubts, partial(judged, study, recording, task)


def recorded_task(study: Study, recording: Recording) -> Task:
    """The study's task over the box that the records span.

    Where the study names no home posture it is that of the record in the middle.
    """
    x, n_positions = recording.x, len(recording.positions)
    low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
    box = Workspace(
        lower_mm=tuple(low[:n_positions]),
        upper_mm=tuple(high[:n_positions]),
        lower_rad=tuple(low[n_positions:]),
        upper_rad=tuple(high[n_positions:]),
        min_singular_value_mm=0,
    )
    robot = study.robot
    if not (robot.home_rad or robot.home_mm):
        middle = recording.joints[
            int(np.argmin(np.linalg.norm((x - np.median(x, axis=0)) / np.ptp(x, axis=0), axis=1)))
        ]
        by_unit: dict[str, dict[str, float]] = {"rad": {}, "mm": {}}
        for name, unit, value in zip(
            recording.joint_names, recording.joint_units, middle, strict=True
        ):
            by_unit[unit][name] = float(value)
        robot = robot.model_copy(update={"home_rad": by_unit["rad"], "home_mm": by_unit["mm"]})
    asked = study.task.model_copy(
        update={
            "inputs": list(recording.inputs),
            "orientation": "free" if recording.rotation is None else "fixed",
            "reference_rpy_rad": tuple(angles_of(recording.reference).tolist()),
        }
    )
    task = study_task(
        study.model_copy(update={"robot": robot, "workspace": box, "task": asked}),
        Region.box(np.array(low), np.array(high)),
    )
    return replace(task, expected=study.recording.assumed)


def runs_of(rows: "pd.DataFrame") -> list[dict[str, Any]]:
    """What was judged as records for ``curve.runs_table``: a row per method, size and order."""
    found = []
    for key, own in rows.groupby(["method", "design", "n_samples", "seed"], sort=False):
        method, design, n, seed = cast(tuple[str, str, int, int], key)
        error, angle = own["error_mm"].to_numpy(float), own["angle_deg"].to_numpy(float)
        one = {"method": method, "design": design, "n_samples": int(n), "seed": int(seed)}
        one |= dict(zip(ERRORS, _statistics(error), strict=True))
        if np.isfinite(angle).any():
            one |= dict(zip(ANGLES, _statistics(angle), strict=True))
        why = own["failed"].iloc[0] or ("" if np.isfinite(error).all() else FAILED)
        one |= {"n_points": len(own), "failed": why, "region": WORKSPACE}
        found.append(one)
    return found


def _statistics(values: Floats) -> Sequence[float]:
    """Mean, percentiles and largest, as ``columns.ERRORS`` and ``ANGLES`` have them."""
    if not np.isfinite(values).all():
        return [np.inf] * 4
    return [float(values.mean()), *np.quantile(values, [0.95, 0.99]).tolist(), float(values.max())]
