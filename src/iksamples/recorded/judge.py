"""Methods on beginnings of random orders of records, judged by the records held out."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.target import Target, turn_between
from iksamples.calibration.fit import fit_samples
from iksamples.errors import IksamplesError
from iksamples.methods.predictor import NotApplicableError, attempt
from iksamples.methods.registry import fit_or_failed
from iksamples.recorded.read import Recording
from iksamples.region import Region
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import normalisation
from iksamples.study import RECORDED, Study
from iksamples.task import Space, Task


if TYPE_CHECKING:
    import pandas as pd

_STREAM = 50
"""Stream of an order's generator, beside its number."""
_KNOWS_ARM = ("nominal", "calibrated", "residual")
_NEAR = 2


@dataclass(frozen=True, eq=False)
class Orders:
    """Random orders of records, and which of them judge.

    Attributes:
        learned: Records to learn from, in their order, shape (orders, n - held).
        held: Records that judge, shape (orders, held).
    """

    learned: Any
    held: Any


def n_held(study: Study, n: int) -> int:
    """How many of n records judge."""
    settings = study.recording
    return max(2, round(settings.held_out_share * n))


def orders(study: Study, n: int) -> Orders:
    """The study's orders of n records.

    Raises:
        IksamplesError: There are fewer records than the study's sizes ask for.
    """
    settings = study.recording
    held = n_held(study, n)
    if study.sizes[-1] > n - held:
        raise IksamplesError(
            f"{settings.path}: {n} records, of which {held} judge, leave {n - held} to learn from; "
            f"samples.sizes asks for {study.sizes[-1]}. Record more, or leave that size out."
        )
    drawn = np.stack(
        [
            np.random.default_rng([seed, _STREAM, study.samples.seed]).permutation(n)
            for seed in range(settings.subsets)
        ]
    )
    return Orders(drawn[:, held:], drawn[:, :held])


def whole_set(study: Study, recording: Recording) -> SampleSet:
    """All records as a set of samples, over the box that they span."""
    x, inputs = recording.x, recording.inputs
    units = Target(inputs, "free" if recording.rotation is None else "fixed").units
    low, high = x.min(axis=0), x.max(axis=0)
    joints = recording.joints
    none_x, none_joints = np.empty((0, len(inputs))), np.empty((0, joints.shape[1]))
    return SampleSet(
        RECORDED,
        RECORDED,
        Space(inputs, units, low, high),
        Space(recording.joint_names, recording.joint_units, joints.min(axis=0), joints.max(axis=0)),
        Region.box(low, high),
        x,
        joints,
        none_x,
        none_joints,
        none_x,
        none_joints,
        *normalisation(study.samples.normalisation, x),
        np.nan,
        np.nan,
        0,
    )


def beginning(whole: SampleSet, rows: Any) -> SampleSet:
    """Some records of a set."""
    return replace(whole, x=whole.x[rows], joints=whole.joints[rows])


# Hundreds of small matrices: a second thread costs more than it brings, on a busy machine by far.
@threadpool_limits.wrap(limits=1, user_api="blas")
def judged(
    study: Study, recording: Recording, task: Task | None
) -> "tuple[pd.DataFrame, dict[str, str]]":
    """Every method on beginnings of every order, judged by the records that the order holds out.

    What is judged is how far the tool would be from where it was measured. Of a model of the arm
    that is the distance from where it puts the tool for the recorded joints. Of joints that are
    answered it is how far the tool goes from them to those recorded: by the drawing, or else to
    first order, by a plane fitted to the records nearest to it.

    Args:
        study: The study, with ``samples.recorded``.
        recording: The records.
        task: Its task; None: no drawing is known.

    Returns:
        A row per method (and ``design``), size (``n_samples``), order (``seed``) and record held
        out (``record``, its index): ``error_mm``, ``angle_deg`` and ``joint_deg`` (of the joint
        that is off farthest), NaN where it is not known, and ``failed``, why the method had no
        answer, empty where it had. And why a method has no row.

    Raises:
        IksamplesError: There are too few records.
    """
    import pandas as pd

    some, whole = orders(study, len(recording)), whole_set(study, recording)
    frames, left_out = [], {}
    for name, method in study.all_methods.items():
        if method.kind in _KNOWS_ARM and (task is None or recording.of_drawing):
            left_out[name] = (
                "it needs a drawing of the arm (--robot)."
                if task is None
                else "it knows the drawing, whose positions these are."
            )
            continue
        try:
            if method.kind == "network":
                parts = _networks(study, name, recording, whole, some, task)
            elif method.kind in ("nominal", "calibrated"):
                assert task is not None
                parts = _models(study, method.kind, recording, whole, some, task)
            else:
                parts = _fitted(study, method.kind, recording, whole, some, task)
            frames += [part.assign(method=name, design=RECORDED) for part in parts]
        except IksamplesError as error:  # too few, too many, in a plane: this method's own matter
            left_out[name] = str(error).removeprefix(f"{method.kind}: ")
    if not frames:
        raise IksamplesError(f"{recording.table.path}: no method can use these records.")
    return pd.concat(frames, ignore_index=True), left_out


def _models(
    study: Study,
    kind: str,
    recording: Recording,
    whole: SampleSet,
    some: Orders,
    task: Task,
) -> "Iterator[pd.DataFrame]":
    """Models of the arm: the drawing, or what is fitted to it."""
    if kind == "nominal":
        rows = np.arange(len(recording))
        yield frame(0, 0, rows, *off_model(task.drawing, recording, rows))
        return
    for n, seed, held, part in _beginnings(study, whole, some):
        fitted, why = attempt(f"{kind} on {n} records", partial(fit_samples, task, part))
        nothing = np.full(len(held), np.inf), np.full(len(held), np.nan)
        off = off_model(fitted.chain, recording, held) if fitted else nothing
        yield frame(n, seed, held, *off).assign(failed=why)


def _beginnings(
    study: Study, whole: SampleSet, some: Orders
) -> Iterator[tuple[int, int, Any, SampleSet]]:
    """Size, order, the records that judge, and the records that are learned from."""
    for n in study.sizes:
        for seed, (learned, held) in enumerate(zip(some.learned, some.held, strict=True)):
            yield n, seed, held, beginning(whole, learned[:n])


def off_model(model: SerialChain, recording: Recording, rows: Any) -> tuple[Floats, Floats]:
    """How far a model puts the tool from where it was measured [mm], and how it turns it [deg]."""
    position, rotation = model.pose(recording.joints[rows])
    seen = recording.positions
    off = np.linalg.norm(position[:, seen] - recording.where_mm[rows], axis=1)
    if recording.rotation is None:
        return off, np.full(len(off), np.nan)
    return off, np.degrees(turn_between(rotation, recording.rotation[rows]))


def _fitted(
    study: Study,
    kind: str,
    recording: Recording,
    whole: SampleSet,
    some: Orders,
    task: Task | None,
) -> "Iterator[pd.DataFrame]":
    """Methods that learn joints without being trained."""
    if kind == "residual":
        _require_drawn(recording, task)
    for n, seed, held, part in _beginnings(study, whole, some):
        fitted = fit_or_failed(kind, task, part)  # type: ignore[arg-type]
        answers = fitted.predict(whole.x[held])[0]
        yield _of_joints(n, seed, held, answers, recording, task).assign(failed=fitted.failed)


def _require_drawn(recording: Recording, task: Task | None) -> None:
    assert task is not None
    if recording.joints.shape[1] > len(recording.inputs):
        raise NotApplicableError(
            f"residual: {recording.joints.shape[1]} joints and {len(recording.inputs)} measured "
            "coordinates leave the drawing's joints open; use calibrated."
        )
    if not np.isfinite(task.reach(recording.x).joints).all():
        raise NotApplicableError(
            "residual: the drawing cannot reach where the tool was measured to be; use calibrated."
        )


def _networks(
    study: Study,
    name: str,
    recording: Recording,
    whole: SampleSet,
    some: Orders,
    task: Task | None,
) -> "Iterator[pd.DataFrame]":
    """A network per order, all orders of a size at once."""
    from iksamples.training.module import fit, make_engine
    from iksamples.training.problem import pose_problem
    from iksamples.training.record import final_network
    from iksamples.training.run import choose_engine

    seeds = range(len(some.learned))
    asked = study.model_copy(
        update={"task": study.task.model_copy(update={"inputs": list(recording.inputs)})}
    )
    for n in study.sizes:
        own = asked.for_method(name, n)
        problem = pose_problem(own, whole, seeds)
        nothing = np.empty((len(seeds), 0), np.int32)
        rows = some.learned[:, :n].astype(np.int32)
        problem = replace(problem, train_rows=rows, validation_rows=nothing, test_rows=nothing)
        engine = make_engine(choose_engine(own, len(recording.joint_names)), problem)
        network = final_network(problem, whole, fit(problem, engine))
        answers = network.predict(whole.x)
        for seed in seeds:
            held = some.held[seed]
            yield _of_joints(n, seed, held, answers[seed][held], recording, task)


def _of_joints(
    n: int, seed: int, held: Any, answers: Floats, recording: Recording, task: Task | None
) -> "pd.DataFrame":
    """Answered joints, held against those recorded."""
    q = recording.joints[held]
    joint_deg = np.degrees(np.max(np.abs(answers - q)[:, recording.revolute], axis=1, initial=0))
    angle = np.full(len(q), np.nan)
    if task is None:
        off = np.linalg.norm(_first_order(recording, held, answers - q), axis=1)
    else:
        seen = recording.positions
        (there, turned), (here, own) = task.drawing.pose(answers), task.drawing.pose(q)
        off = np.linalg.norm((there - here)[:, seen], axis=1)
        if recording.rotation is not None:
            sound = np.flatnonzero(np.isfinite(off))
            angle = np.full(len(q), np.inf)
            angle[sound] = np.degrees(turn_between(turned[sound], own[sound]))
    off = np.where(np.isfinite(off), off, np.inf)
    return frame(n, seed, held, off, angle, joint_deg)


def _first_order(recording: Recording, rows: Any, moved: Floats) -> Floats:
    """How far the tool moves with some joints [mm]: planes fitted to the records nearest to each.

    Args:
        recording: The records.
        rows: Which records, by index.
        moved: How far their joints move [rad or mm], shape (rows, joints).
    """
    from scipy.spatial import KDTree

    q = recording.joints
    where = recording.where_mm
    extent = np.ptp(q, axis=0)
    scaled = q / np.where(extent > 0, extent, 1)
    k = min(len(q), _NEAR * (q.shape[1] + 1))
    _, near = KDTree(scaled).query(scaled[rows], k=k)
    found = np.empty((len(moved), where.shape[1]))
    for i, (row, own) in enumerate(zip(rows, near, strict=True)):
        slope, *_ = np.linalg.lstsq(q[own] - q[row], where[own] - where[row], rcond=1e-6)
        found[i] = moved[i] @ slope
    return found


def frame(
    n: int, seed: int, rows: Any, error_mm: Floats, angle_deg: Any = np.nan, joint_deg: Any = np.nan
) -> "pd.DataFrame":
    """Rows of what is judged: ``judged`` says what they hold."""
    import pandas as pd

    return pd.DataFrame(
        {
            "n_samples": n,
            "seed": seed,
            "record": rows,
            "error_mm": error_mm,
            "angle_deg": angle_deg,
            "joint_deg": joint_deg,
            "failed": "",
        }
    )
