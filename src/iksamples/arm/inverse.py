"""Inverse kinematics on one branch: the joints that label an input, and if they can be used."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.solvers import Elbow, Follower, fits_yaw_pitch_pitch, yaw_pitch_pitch
from iksamples.arm.target import Target
from iksamples.errors import IksamplesError


Flags = NDArray[np.bool_]
Method = Literal["auto", "yaw-pitch-pitch", "newton"]

POSITION_MM = 1e-6
"""A label puts the tool within this of where it is wanted [mm]."""
ANGLE_RAD = 1e-9
"""A label turns the tool to within this of how it is wanted [rad]."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The joints that answer some inputs, and what can be said about each.

    Attributes:
        chain: The arm.
        target: What an input asks of the tool.
        x: The inputs [mm or rad], shape (points, inputs).
        home: The posture that the labels were followed from [rad or mm], shape (joints,); None:
            they are of a closed form.
        locked: Joints that stay at home, by index.
        joints: Joint values on the one branch [rad or mm], shape (points, joints); NaN out of
            reach.
        in_reach: The tool is where it is wanted, shape (points,).
        in_limits: In reach and inside the joint limits, shape (points,).
        smallest_singular_mm: Smallest singular value of the Jacobian of what is asked for [mm/rad]
            (`solvers.Follower.jacobian_mm`), 0 out of reach, shape (points,).
        singular: In reach, and that singular value is below the threshold, shape (points,).
    """

    chain: SerialChain
    target: Target
    x: Floats
    home: Floats | None
    locked: tuple[int, ...]
    joints: Floats
    in_reach: Flags
    in_limits: Flags
    smallest_singular_mm: Floats
    singular: Flags

    @property
    def usable(self) -> Flags:
        """In reach, inside the limits and not singular, shape (points,)."""
        return self.in_limits & ~self.singular

    @property
    def limit_distances(self) -> Floats:
        """How far each joint is inside its nearer limit [rad or mm], shape (points, joints)."""
        return np.minimum(self.joints - self.chain.lower, self.chain.upper - self.joints)

    def summary(self) -> dict[str, int]:
        """Number of points of each kind."""
        return {
            "points": len(self.x),
            "out_of_reach": int(np.sum(~self.in_reach)),
            "outside_joint_limits": int(np.sum(self.in_reach & ~self.in_limits)),
            "singular": int(np.sum(self.in_limits & self.singular)),
            "usable": int(np.sum(self.usable)),
        }

    def why_not(self, point: int) -> str:
        """In words, why a point is not usable."""
        where = _in_words(self.target, self.x[point])
        if not self.in_reach[point]:
            unsure = "" if self.home is None else ", or a singularity lies between it and home"
            return f"{where} is out of reach{unsure}"
        if not self.in_limits[point]:
            worst = int(np.argmin(self.limit_distances[point]))
            low, high, unit = (
                self.chain.lower[worst],
                self.chain.upper[worst],
                self.chain.joint_units[worst],
            )
            return (
                f"{where} needs {self.chain.joint_names[worst]} = "
                f"{self.joints[point, worst]:.3f} {unit}, outside its limits "
                f"[{low:.3f}, {high:.3f}]"
            )
        return f"{where} is singular"

    def where_to_go(self) -> str:
        """In words, where the arm has its tool: what helps where no part of a box can be used."""
        home = (self.chain.lower + self.chain.upper) / 2 if self.home is None else self.home
        posture = "With its joints amid their limits" if self.home is None else "At home"
        at = ", ".join(_plain(self.chain.forward_mm(home), 1))
        if self.target.orientation == "free":
            return f"{posture} the tool is at ({at}) mm"
        along = ", ".join(_plain(self.chain.rotation(home)[:, 2], 4))
        return f"{posture} the tool is at ({at}) mm with its z axis along ({along})"

    def require_usable(self, what: str, remedy: str) -> None:
        """Stops where a point is not usable.

        Args:
            what: What the points are, for the message.
            remedy: What the user can do.

        Raises:
            IksamplesError: Names the first such point, and why.
        """
        bad = np.flatnonzero(~self.usable)
        if bad.size:
            raise IksamplesError(
                f"{what}: {bad.size} of {len(self.x)} points cannot be used; "
                f"{self.why_not(int(bad[0]))}. {remedy}"
            )


def solve(
    chain: SerialChain,
    target: Target,
    x: ArrayLike,
    *,
    method: Method = "auto",
    elbow: Elbow | None = None,
    home: ArrayLike | None = None,
    locked: Sequence[str] = (),
    min_singular_value_mm: float = 0.0,
) -> Solution:
    """The joints that do what the inputs ask, on one branch: a function of the input.

    Args:
        chain: The arm.
        target: What an input asks of the tool.
        x: Inputs [mm or rad], shape (points, inputs).
        method: ``"yaw-pitch-pitch"``: that closed form, for positions alone; ``"newton"``: followed
            from home; ``"auto"``: the closed form where it applies.
        elbow: Branch of the closed form; None: as at home.
        home: The posture that names the branch [rad or mm], shape (joints,). The closed form does
            without; an arm with joints to spare stays as near to it as it can.
        locked: Joints that stay at home, by name.
        min_singular_value_mm: Threshold of `Solution.singular` [mm/rad].

    Raises:
        IksamplesError: The method does not fit, or home is missing or no posture to start from.
    """
    x = np.atleast_2d(np.asarray(x, float))
    for name in locked:
        if name not in chain.joint_names:
            raise IksamplesError(
                f"robot.locked: no joint '{name}'; the joints are {', '.join(chain.joint_names)}."
            )
    held = tuple(chain.joint_names.index(name) for name in locked)
    start = None if home is None else _checked_home(chain, home)
    plain = target.coordinates == ("x", "y", "z") and target.orientation == "free" and not held
    if method == "yaw-pitch-pitch" or (method == "auto" and plain and fits_yaw_pitch_pitch(chain)):
        if not plain:
            raise IksamplesError(
                "robot.inverse: 'yaw-pitch-pitch' places the tool at (x, y, z) with no joint "
                "locked; for anything else say newton."
            )
        start, joints = None, yaw_pitch_pitch(chain, x, elbow, start)
        in_reach = _arrived(chain, target, joints, x)
        singular_values = np.linalg.svd(chain.jacobian_mm(joints[in_reach]), compute_uv=False)
        smallest = singular_values[..., -1]
    else:
        if start is None:
            raise IksamplesError(
                "robot.home_rad: this arm's labels are followed from a home posture; give a value "
                f"for each of {', '.join(chain.joint_names)}, with the tool amid the workspace."
            )
        follower = Follower(chain, target, start, held)
        joints = follower.follow(x)
        in_reach = _arrived(chain, target, joints, x)
        in_reach[in_reach] = follower.same_side(joints[in_reach])
        smallest = follower.smallest_singular_mm(joints[in_reach])
    joints[~in_reach] = np.nan
    values = np.zeros(len(x))
    values[in_reach] = smallest
    return Solution(
        chain,
        target,
        x,
        start,
        held,
        joints,
        in_reach,
        in_reach & chain.within_limits(joints),
        values,
        in_reach & np.less(values, min_singular_value_mm),
    )


def jumps(solution: Solution, shape: Sequence[int]) -> Flags:
    """At which points of a lattice the joints jump to a usable neighbour along an axis.

    There the label of one is not found when the tool is led over from the other: both were followed
    from home, but on two sides of something that the arm cannot pass.

    Args:
        solution: Labels of a lattice, its last axis running fastest.
        shape: Points of the lattice along each axis.

    Returns:
        Shape (points,); False where a point is not usable itself.
    """
    index = np.arange(len(solution.x)).reshape(shape)
    pairs = np.concatenate(
        [
            np.stack([index.take(range(n - 1), axis), index.take(range(1, n), axis)], -1).reshape(
                -1, 2
            )
            for axis, n in enumerate(shape)
        ]
    )
    first, second = pairs[solution.usable[pairs].all(axis=-1)].T
    jumping = np.zeros(len(solution.x), bool)
    if first.size == 0:
        return jumping
    start, label = solution.joints[first], solution.joints[second]
    home = np.nanmean(solution.joints, axis=0) if solution.home is None else solution.home
    follower = Follower(solution.chain, solution.target, home, solution.locked)
    found = follower.follow(solution.x[second], start)
    # Along a branch both agree to rounding; a jump is no smaller than what the joints moved.
    torn = ~(_largest(found - label) <= 1e-3 * (1e-3 + _largest(label - start)))
    jumping[first[torn]] = jumping[second[torn]] = True
    return jumping


def followed(
    solution: Solution, chain: SerialChain, pose: tuple[Floats, Floats] | None = None
) -> Floats:
    """The joints with which an arm that is nearly the solution's own does the same.

    Newton's method goes on from each label, so the branch is the same. An arm that has too few
    joints to do what the first one happens to, as a SCARA that leans cannot hold its tool upright,
    comes as near as it can.

    Args:
        solution: Labels of some inputs.
        chain: The other arm, such as a fitted one.
        pose: Where its tool is to be [mm] and how turned, instead of what the inputs ask, shapes
            (points, 3) and (points, 3, 3).

    Returns:
        Joint values [rad or mm], shape (points, joints); NaN where the first arm, or this one, is
        out of reach.
    """
    joints, there = solution.joints.copy(), solution.in_reach
    if there.any():
        home = joints[there].mean(axis=0) if solution.home is None else solution.home
        follower = Follower(chain, solution.target, home, solution.locked)
        position, rotation = pose or solution.target.wanted(solution.x)
        joints[there] = follower.follow_pose(position[there], rotation[there], joints[there])
        if pose is None and follower.rank == len(follower.jacobian_mm(home[None])[0]):
            joints[~_arrived(chain, solution.target, joints, solution.x)] = np.nan
    return joints


def largest_usable_box(
    usable: ArrayLike, axes: Sequence[ArrayLike]
) -> tuple[Floats, Floats] | None:
    """The largest box whose lattice points are all usable.

    Args:
        usable: Whether each point of a lattice is usable, shape (n_1, ..., n_d).
        axes: The lattice's coordinates along each axis, ascending, of shape (n_i,).

    Returns:
        Lower and upper corner, the largest by volume in units of the whole lattice; None where no
        cell of the lattice is usable.
    """
    # Bad points up to each index, then, axis by axis, between each pair of indices.
    bad = np.asarray(~np.asarray(usable, bool), np.int64)
    share = np.ones(())
    ends = []
    for axis, ticks in enumerate(np.asarray(tick, float) for tick in axes):
        counts = np.moveaxis(bad, axis, 0).cumsum(axis=0)
        counts = np.concatenate([np.zeros_like(counts[:1]), counts])
        low, high = np.array(list(itertools.combinations(range(len(ticks)), 2))).T
        bad = np.moveaxis(counts[high + 1] - counts[low], 0, axis)
        share = np.multiply.outer(share, (ticks[high] - ticks[low]) / np.ptp(ticks))
        ends.append((ticks[low], ticks[high]))
    best = np.unravel_index(np.argmax(np.where(bad == 0, share, 0.0)), bad.shape)
    if bad[best]:
        return None
    corners = [(low[i], high[i]) for (low, high), i in zip(ends, best, strict=True)]
    return np.array([c[0] for c in corners]), np.array([c[1] for c in corners])


def require_usable_lattice(
    solution: Solution, axes: Sequence[ArrayLike], what: str, remedy: str
) -> None:
    """Stops where a point of a lattice is not usable, or where the joints jump between two.

    Args:
        solution: Labels of the lattice, its last axis running fastest.
        axes: The lattice's coordinates along each axis, ascending, of shape (n_i,).
        what: What the lattice covers, for the message.
        remedy: What the user can do.

    Raises:
        IksamplesError: Names the first such point and why, and the largest usable box inside.
    """
    shape = [len(np.asarray(axis)) for axis in axes]
    torn = jumps(solution, shape) if solution.home is not None else np.zeros(len(solution.x), bool)
    usable = solution.usable & ~torn
    if usable.all():
        return
    box = largest_usable_box(usable.reshape(shape), axes)
    if box:
        ends = zip(solution.target.coordinates, *box, solution.target.units, strict=True)
        sides = ", ".join(f"{name} {low:g} to {high:g} {unit}" for name, low, high, unit in ends)
        remedy = f"The largest usable box inside is {sides}. {remedy}"
    else:
        remedy = f"{solution.where_to_go()}: move the box there."
    solution.require_usable(what, remedy)
    first = _in_words(solution.target, solution.x[int(np.argmax(torn))])
    raise IksamplesError(
        f"{what}: the joints jump at {int(torn.sum())} of {len(torn)} points, first at {first}, to "
        f"a neighbour that the arm reaches from the other side of a singularity. {remedy}"
    )


def _checked_home(chain: SerialChain, home: ArrayLike) -> Floats:
    home = np.asarray(home, float)
    if home.shape != (chain.n_joints,) or not np.isfinite(home).all():
        raise IksamplesError(
            f"robot.home_rad: give one finite value for each of {', '.join(chain.joint_names)}."
        )
    if not chain.within_limits(home):
        worst = int(np.argmax(np.maximum(chain.lower - home, home - chain.upper)))
        value, unit = home[worst], chain.joint_units[worst]
        low, high = chain.lower[worst], chain.upper[worst]
        key, hint, ends = "home", "", np.radians([low, high])
        if unit == "rad" and low <= np.radians(value) <= high:
            hint = f" In degrees? {value:g} deg is {np.radians(value):.4g} rad."
        elif unit == "rad" and ends[0] <= value <= ends[1]:
            key, hint = (
                "limits",
                " In degrees? {:g} to {:g} deg is {:.4g} to {:.4g} rad.".format(low, high, *ends),
            )
        raise IksamplesError(
            f"robot.{key}_{unit}: {chain.joint_names[worst]} = {value:g} {unit} is outside its "
            f"limits [{low:.3f}, {high:.3f}].{hint}"
        )
    return home


def _arrived(chain: SerialChain, target: Target, joints: Floats, x: Floats) -> Flags:
    """Whether forward kinematics confirms each label."""
    arrived = target.position_error_mm(chain, joints, x) <= POSITION_MM
    if target.orientation != "free":
        arrived &= target.angle_error_rad(chain, joints, x) <= ANGLE_RAD
    return np.asarray(arrived)


def _largest(values: Floats) -> Floats:
    return np.max(np.abs(values), axis=-1)


def _plain(values: Floats, digits: int) -> list[str]:
    """Numbers with so many digits, and no -0.0."""
    return [f"{value:.{digits}f}" for value in values.round(digits) + 0.0]


def _in_words(target: Target, x: Floats) -> str:
    """An input as people read it: (100, 100, 70) mm, or with names where it holds angles."""
    if target.orientation == "free" and len(x) == 3:
        return "({:g}, {:g}, {:g}) mm".format(*x)
    parts = zip(target.coordinates, x, target.units, strict=True)
    return "(" + ", ".join(f"{name} {value:g} {unit}" for name, value, unit in parts) + ")"
