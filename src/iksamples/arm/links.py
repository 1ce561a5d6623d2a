"""From the joints that a file describes, one after the other, to the chain they make."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from iksamples.arm.chain import MM_PER_M, Floats, JointKind, SerialChain
from iksamples.errors import IksamplesError


Kind = Literal["revolute", "continuous", "prismatic", "fixed"]
MOST_METRES = 1e4
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of a file, and how it sits between its neighbours.

    Attributes:
        name: Its name.
        kind: How it moves.
        before: From the previous frame to the one in which the axis is given, shape (4, 4) [m].
        axis: The axis there, not zero, shape (3,).
        after: From there, with the joint at zero, to the next frame, shape (4, 4) [m].
        limits: Lower and upper [rad or m]; None: the file gives none.
    """

    name: str
    kind: Kind
    before: Floats
    axis: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    after: Floats = field(default_factory=lambda: np.eye(4))
    limits: tuple[float, float] | None = None


def assemble(joints: Iterable[Joint]) -> SerialChain:
    """The chain of some joints, in their order from the base to the tool.

    Fixed joints are folded in. A continuous joint gets the limits -pi and pi; one without limits
    gets infinite ones.

    Raises:
        IksamplesError: No joint moves the tool, or a joint's limits leave it no room.
    """
    frame = np.eye(4)  # in the base frame, all joints at zero
    names: list[str] = []
    kinds: list[JointKind] = []
    axes, points, limits = [], [], []
    for joint in joints:
        far = max(np.abs(joint.before[:3, 3]).max(), np.abs(joint.after[:3, 3]).max())
        if far > MOST_METRES:
            raise IksamplesError(
                f"joint '{joint.name}' lies {far:g} m from the one before; lengths are in metres."
            )
        frame = frame @ joint.before
        if joint.kind != "fixed":
            names.append(joint.name)
            kinds.append("prismatic" if joint.kind == "prismatic" else "revolute")
            axis = frame[:3, :3] @ joint.axis
            axes.append(axis / np.linalg.norm(axis))
            points.append(frame[:3, 3] * MM_PER_M)
            limits.append(_limits(joint))
        frame = frame @ joint.after
    if not names:
        raise IksamplesError("no moving joint between the base and the tool.")
    lower, upper = np.array(limits).T
    chain = SerialChain(
        tuple(names),
        tuple(kinds),
        np.array(axes),
        np.array(points),
        frame[:3, 3] * MM_PER_M,
        lower,
        upper,
        frame[:3, :3],
    )
    if np.abs(chain.jacobian_mm(np.zeros(len(names)))).max() < 1e-9:
        raise IksamplesError(
            "the arm has no length: the tool lies on the axis of every joint, so none moves it."
        )
    return chain


def _limits(joint: Joint) -> tuple[float, float]:
    if joint.kind == "continuous":
        return -np.pi, np.pi
    if joint.limits is None:
        return -np.inf, np.inf
    lower, upper = joint.limits
    if lower >= upper:
        fault = "swapped" if lower > upper else "equal, so that it cannot move"
        raise IksamplesError(
            f"joint '{joint.name}': its limits are {fault} (lower {lower:g}, upper {upper:g})."
        )
    unit = MM_PER_M if joint.kind == "prismatic" else 1.0
    return lower * unit, upper * unit


def number(text: str, what: str) -> float:
    """A finite decimal number.

    Args:
        text: The text.
        what: What it is, for the message.

    Raises:
        IksamplesError: It is no number, or not finite.
    """
    if "$" in text:
        raise IksamplesError(f"{what} is '{text}': expand the xacro first (xacro in > out.urdf).")
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or "_" in text:
        raise IksamplesError(f"{what} is '{text}', not a finite number.")
    return value
