"""What is odd about records, by their rows: mixed units, repeats, outliers, branches, limits."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.inverse import Solution
from iksamples.arm.target import turn_between
from iksamples.errors import IksamplesError
from iksamples.recorded.read import Recording
from iksamples.samples.measured import FEWEST


Flags = NDArray[np.bool_]

_OFF, _OFF_PLANE = 6.0, 12.0
"""Times the median miss from which on a record is odd: of the drawing's, and of planes', which are
less alike."""
_FLOOR_SHARE, _FLOOR_MM, _FLOOR_RAD = 0.02, 1.0, 0.5
"""A miss is none where it is less than this share of the records' spread, or than this."""
_OTHERS = {"mm": (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001), "rad": (180 / np.pi, np.pi / 180)}
_WORDS = {
    10.0: "cm among mm, or mm among m",
    100.0: "m among cm",
    1000.0: "m among mm",
    180 / np.pi: "rad among deg",
}
_LOOSE = 0.1
_OTHER_FRAME_DEG = 15.0
_ROUNDS, _DAMPING = 12, 1e-9
MOST_RAD, _SHORTEST_MM, _LONGEST_MM = 4 * np.pi, 5.0, 50_000.0
_FARTHEST = 6.0
"""How far the tool may move per radian, by how far it comes from the base."""
_UNLIKE = {"mm": 5.0, "rad": 20.0}
"""How many times farther one column may extend than another, before it is asked about."""
_GROUP, _APART = 3, 20.0
"""Records in a group, and how many times farther out another one begins: units are mixed."""


def checked(
    recording: Recording,
    drawing: SerialChain | None,
    fewest: int = FEWEST,
    reach: Callable[[Floats], Solution] | None = None,
) -> tuple[Recording, list[str]]:
    """Records that can be learned from, and what is odd about them, a sentence each.

    What stands there twice is left out; everything else that is odd is kept, and named.

    Args:
        recording: The records.
        drawing: The arm as drawn; None: what is odd shows in records that lie near each other.
        fewest: Records needed.
        reach: The joints that a study asks for at a place; None: it may be any branch.

    Raises:
        IksamplesError: Some records are in other units than the rest, or too few are left.
    """
    whole = np.concatenate([recording.where_mm, recording.joints], axis=1)
    first = first_of_each(whole)
    again = np.setdiff1d(np.arange(len(whole)), first)
    lines = [*recording.remarks]
    if len(again):
        lines.append(
            f"{len(again)} of {len(whole)} records stand there twice, the same in every number, "
            f"and are left out ({recording.table.listed(again)})."
        )
        recording = recording.select(first)
    if len(recording) < fewest:
        raise IksamplesError(
            f"{recording.table.path}: {len(recording)} different records; at least {fewest} are "
            "needed."
        )
    flat = np.flatnonzero(np.ptp(recording.x, axis=0) == 0)
    if len(flat):
        raise IksamplesError(
            f"{recording.table.path}: {recording.inputs[flat[0]]} is the same in every record, so "
            "nothing can be learned of it. Record some at another place."
        )
    if drawing is None:
        lines += _implausible(recording)
    elif recording.rotation is not None:
        apart = np.degrees(turn_between(drawing.rotation(recording.joints), recording.rotation))
        if np.median(apart) > _OTHER_FRAME_DEG:
            lines.append(
                f"the orientations are left out: half of them are {np.median(apart):.0f} deg or "
                "more from the drawing's tool, so they are of another frame or told in another "
                "way (expected: a URDF's roll, pitch, yaw, or qx, qy, qz, qw, in the base frame)."
            )
            inputs = recording.inputs[: len(recording.positions)]
            recording = replace(recording, rotation=None, inputs=inputs, x=recording.where_mm)
    missed = _position_misses(recording, drawing)
    bound = _bound(missed, _floor(recording), _OFF_PLANE if drawing is None else _OFF)
    far = missed > bound
    _require_one_unit(recording, drawing, far, bound)
    return recording, [*lines, *_doubts(recording, drawing, missed, far, reach)]


def first_of_each(rows: Floats) -> NDArray[np.intp]:
    """Indices of rows but for those that an earlier one equals in every number."""
    return np.sort(np.unique(rows, axis=0, return_index=True)[1])


def _floor(recording: Recording) -> float:
    where = recording.where_mm
    spread = np.sqrt(np.mean(np.sum((where - np.median(where, axis=0)) ** 2, axis=1)))
    return float(max(_FLOOR_MM, _FLOOR_SHARE * min(spread, 50 * np.median(np.abs(where)))))


def _position_misses(recording: Recording, drawing: SerialChain | None) -> Floats:
    """How far each tool is from where the drawing, or else its neighbours, put it [mm]."""
    where = recording.where_mm
    if drawing is not None:
        seen = recording.positions
        return np.linalg.norm(drawing.forward_mm(recording.joints)[:, seen] - where, axis=1)
    return np.linalg.norm(_off_neighbours(recording.joints, where, _floor(recording)), axis=1)


def _off_neighbours(key: Floats, values: Floats, floor: float) -> Floats:
    """How far records are off planes through those that are nearest to each, shape of the values.

    In a second pass only through those that were not odd in the first, which an odd neighbour may
    have made so.

    Args:
        key: What says who is near, and the planes' variables, shape (n, d).
        values: What lies in a plane, shape (n, k).
        floor: A distance that is not odd.
    """
    sound = np.ones(len(key), bool)
    off = values
    for _ in range(2):
        off = values - _planes(key, values, sound)
        missed = np.linalg.norm(off, axis=1)
        sound = missed <= _bound(missed, floor)
        if sound.sum() < FEWEST:
            break
    return off


def _planes(key: Floats, values: Floats, sound: Flags) -> Floats:
    """Values at each record of a plane fitted to the sound ones nearest to it."""
    from scipy.spatial import KDTree

    scale = np.subtract(*np.quantile(key[sound], [0.75, 0.25], axis=0))
    scaled = key / np.where(scale > 0, scale, 1)
    among = np.flatnonzero(sound)
    k = min(3 * (key.shape[1] + 1), len(among) - 1)
    _, near = KDTree(scaled[sound]).query(scaled, k=k + 1)
    near = among[near]
    # The record itself has no part in its own plane.
    itself = near == np.arange(len(key))[:, None]
    itself[~itself.any(axis=1), -1] = True
    near = near[~itself].reshape(len(key), k)
    step = scaled[near] - scaled[:, None]
    design = np.concatenate([np.ones((*step.shape[:2], 1)), step], axis=2)
    there = values[near] - values[:, None]
    weight = np.ones((*step.shape[:2], 1))
    for _ in range(_ROUNDS):  # of least squares, weighted so that they add up distances
        turned = np.swapaxes(weight * design, 1, 2)
        gram = turned @ design
        damped = gram + _DAMPING * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(
            design.shape[2]
        )
        plane = np.linalg.solve(damped, turned @ there)
        left = np.linalg.norm(there - design @ plane, axis=2, keepdims=True)
        weight = 1 / np.maximum(left, 1e-3 * left.max(axis=1, keepdims=True) + 1e-12)
    return values + plane[:, 0]


def _bound(missed: Floats, floor: float, times: float = _OFF_PLANE) -> float:
    """The largest miss that is not odd."""
    return max(times * float(np.median(missed)), floor)


def _require_one_unit(
    recording: Recording, drawing: SerialChain | None, far: Flags, bound: float
) -> None:
    """Stops where another unit explains what some records are off by.

    Raises:
        IksamplesError: Names the rows.
    """
    for kind, factors in _OTHERS.items():
        for factor in factors:
            changed = recording.select(np.ones(len(recording), bool))
            if kind == "mm":
                changed.where_mm[far] *= factor
            else:
                changed.joints[np.ix_(far, recording.revolute)] *= factor
            right = far & (_position_misses(changed, drawing) <= bound)
            right &= np.all(np.abs(changed.joints[:, recording.revolute]) < MOST_RAD, axis=1)
            if np.any(right) and np.sum(right) >= 0.5 * np.sum(far):
                rows = np.flatnonzero(right)
                raise IksamplesError(
                    f"{recording.table.path}: {len(rows)} of {len(recording)} records fit the "
                    f"others only with {'positions' if kind == 'mm' else 'angles'} times "
                    f"{factor:.4g}: units are mixed ({_words(factor)}) in "
                    f"{recording.table.listed(rows)}. Correct them, or take them out."
                )


def _implausible(recording: Recording) -> Iterator[str]:
    """What units cannot be as they are said; without a drawing nothing else can tell.

    Raises:
        IksamplesError: A joint turns farther, or the tool comes less far or farther than of any
            arm; or records are of two sizes.
    """
    path, turns = recording.table.path, recording.revolute
    angles, where = recording.joints[:, turns], recording.where_mm
    most = np.max(np.abs(angles), axis=0, initial=0)
    if np.any(most > MOST_RAD):
        name = np.array(recording.joint_names)[turns][int(np.argmax(most))]
        raise IksamplesError(
            f"{path}: {name} turns by {most.max():.4g} rad as its column is said to be, more than "
            "joints do. Is it in degrees?"
        )
    reach_mm = float(np.linalg.norm(where, axis=1).max())
    if not _SHORTEST_MM <= reach_mm <= _LONGEST_MM:
        less = reach_mm < _SHORTEST_MM
        raise IksamplesError(
            f"{path}: the tool comes {reach_mm:.3g} mm from the base as its columns are said to "
            f"be, {'less' if less else 'farther'} than that of any arm. Are they in "
            f"{'m, or cm' if less else 'mm'}? Write the unit into the names, such as x_m."
        )
    for what, sizes in (("positions", where), ("angles", angles)):
        norms = np.linalg.norm(sizes, axis=1)
        order = np.argsort(norms)
        ratio = norms[order][1:] / np.maximum(norms[order][:-1], 1e-12)
        ratio[: _GROUP - 1] = ratio[len(ratio) - _GROUP + 1 :] = 0
        at = int(np.argmax(ratio))
        if ratio[at] > _APART:
            small = order[: at + 1]
            raise IksamplesError(
                f"{path}: the {what} are of two sizes, {ratio[at]:.3g} times apart; are units "
                f"mixed? The small ones: {recording.table.listed(small)}."
            )
    enough = 3 * (recording.joints.shape[1] + 1)
    if len(recording) < enough:
        yield (
            f"odd records are told by those near by, which takes {enough} of them at least; there "
            f"are {len(recording)}."
        )
    kinds: list[tuple[Sequence[str], Floats, str]] = [
        (recording.inputs, where, "mm"),
        (np.array(recording.joint_names)[turns].tolist(), angles, "rad"),
    ]
    for called, values, unit in kinds:
        extent = np.ptp(values, axis=0)
        if extent.size and extent.max() > _UNLIKE[unit] * extent.min():
            few, much = (called[int(i)] for i in (extent.argmin(), extent.argmax()))
            yield (
                f"{few} extends over {extent.min():.3g} {unit} and {much} over {extent.max():.3g}: "
                "if that is not what you recorded, one is in another unit than its column says."
            )
    lever_mm = np.ptp(where, axis=0).max() / max(float(np.ptp(angles, axis=0).max()), 1e-12)
    if angles.size and not 0.05 < lever_mm / reach_mm < _FARTHEST:
        yield (
            f"the tool moves by {lever_mm:.3g} mm per radian and comes {reach_mm:.3g} mm from the "
            "base: if that is no arm like yours, a unit is not what its column says."
        )


def _words(factor: float) -> str:
    return _WORDS.get(factor) or _WORDS.get(1 / factor, "two units in one column")


def _doubts(
    recording: Recording,
    drawing: SerialChain | None,
    missed: Floats,
    far: Flags,
    reach: Callable[[Floats], Solution] | None,
) -> Iterator[str]:
    n = len(recording)
    if far.any():
        rows = np.flatnonzero(far)
        rows = rows[np.argsort(-missed[rows], kind="stable")]
        by = "the drawing puts it" if drawing is not None else "records of like joints have it"
        yield (
            f"{len(rows)} of {n} records have the tool much farther from where {by} than the rest "
            f"(median {np.median(missed):.3g} mm), {missed[rows[0]]:.3g} mm at most; kept, the "
            f"farthest first: {recording.table.listed(rows)}."
        )
    spread = float(np.median(np.ptp(recording.where_mm, axis=0)))
    if drawing is None and np.median(missed) > _LOOSE * spread:
        yield (
            f"positions hardly follow from the joints (half of them are {np.median(missed):.3g} mm "
            "off those of records near by, or more), so that odd ones cannot be told: is a joint's "
            "column missing, or are there few records?"
        )
    turn = recording.joints[:, recording.revolute]
    if reach is None:
        apart = np.linalg.norm(_off_neighbours(recording.x, turn, _FLOOR_RAD), axis=1)
        other, usual = apart > _bound(apart, _FLOOR_RAD), "those of records near by"
    else:
        there = reach(recording.x)
        apart = np.linalg.norm(turn - there.joints[:, recording.revolute], axis=1)
        other, usual = (apart > _FLOOR_RAD) & there.in_reach, "the study's"
    other &= ~far
    if other.any():
        yield (
            f"{np.sum(other)} of {n} records have joints far from {usual}: another branch of the "
            "inverse kinematics, or full turns; a network that learns both answers with something "
            f"between ({recording.table.listed(np.flatnonzero(other))})."
        )
    if drawing is not None:
        outside = ~drawing.within_limits(recording.joints)
        if outside.any():
            yield (
                f"{np.sum(outside)} of {n} records are outside the joint limits "
                f"({recording.table.listed(np.flatnonzero(outside))})."
            )
