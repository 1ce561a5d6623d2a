"""What is learned: from which inputs to which joints, on which arm, over which region.

Everything after the study file works on a ``Task``: it knows no x, y and z of its own, no number of
joints and no unit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain, Unit, roll_pitch_yaw
from iksamples.arm.inverse import Solution, jumps, solve
from iksamples.arm.load import load_arm
from iksamples.arm.real import RealArm, deviated
from iksamples.arm.target import Target
from iksamples.errors import IksamplesError
from iksamples.region import Region
from iksamples.study import Arm, Asked, Expected, Robot, Study


T = TypeVar("T")

_LINKS, _PLAY = 10, 11
"""Streams of an arm's generator, beside the seed."""
_LATTICE_POINTS = 36_000
"""Points, about, at which a workspace is tried: 33 along each of three sides."""
_MOST_CELLS = 32
"""Cells along a side of a workspace, at most."""


@dataclass(frozen=True, eq=False)
class Space:
    """Named coordinates with units and limits: what is asked of the tool, or the joints.

    Attributes:
        names: One name per coordinate, such as ``x``, or a joint's.
        units: ``"mm"`` or ``"rad"``, one per coordinate.
        lower: Lower limits in these units, shape (coordinates,).
        upper: Upper limits, likewise.
    """

    names: tuple[str, ...]
    units: tuple[Unit, ...]
    lower: Floats
    upper: Floats

    def __len__(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    @property
    def lengths(self) -> NDArray[np.bool_]:
        """Which coordinates are lengths, shape (coordinates,); the others are angles."""
        return np.array([unit == "mm" for unit in self.units])

    @property
    def as_lengths(self) -> Floats:
        """What makes coordinates lengths that can be compared [1 or mm/rad], shape (coordinates,).

        One for a length; the longest angle's range counts as much as the longest length's.
        """
        range_, lengths = self.upper - self.lower, self.lengths
        if lengths.all():
            return np.ones(len(self))
        return np.where(lengths, 1.0, range_[lengths].max() / range_[~lengths].max())

    def columns(self, prefix: str = "") -> list[str]:
        """Names of a table's columns, each with its unit: ``x_mm``, ``q_elbow_rad``."""
        return [f"{prefix}{name}_{unit}" for name, unit in zip(self.names, self.units, strict=True)]


@dataclass(frozen=True, eq=False)
class Task:
    """What is learned.

    Attributes:
        x: The inputs; its limits are the workspace's.
        q: The joints, with the drawing's limits.
        target: What an input asks of the tool.
        drawing: The nominal arm, which methods may use.
        region: The usable part of the workspace: the one domain of sampling, of evaluation and of
            certificates.
        reach: The drawing's joint values on the study's branch for inputs of shape (points, d),
            and whether they can be used.
        arm_of: The arm itself of a seed, on which errors are measured: the drawing, or in a study
            with an ``arm`` section one that differs from it.
        expected: What may be expected of that difference; None: there is none.
    """

    x: Space
    q: Space
    target: Target
    drawing: SerialChain
    region: Region
    reach: Callable[[ArrayLike], Solution]
    arm_of: Callable[[int], SerialChain | RealArm]
    expected: Expected | None = None

    @property
    def region_share(self) -> float:
        """The region's share of the workspace's volume."""
        return self.region.volume / float(np.prod(self.x.upper - self.x.lower))

    def chain_of(self, seed: int) -> SerialChain:
        """The links of a seed's arm, as they are."""
        arm = self.arm_of(seed)
        return arm.chain if isinstance(arm, RealArm) else arm

    def positions_mm(self, x: ArrayLike) -> Floats:
        """Where inputs want the tool, to be drawn [mm], shape (..., 3)."""
        return self.target.wanted(x)[0]

    @property
    def turns(self) -> bool:
        """Whether the tool's orientation is asked for as well."""
        return self.target.orientation != "free"


def study_task(study: Study, region: Region | None = None) -> Task:
    """The task that a study sets.

    Args:
        study: The study.
        region: Its region, where that is known already, as from its samples.

    Raises:
        IksamplesError: The arm's file or a setting is wrong, or none of the workspace can be used.
    """
    chain = study_chain(study)
    box = study.workspace
    home = _home(study.robot, chain)
    target = _target(study.task, chain, home)
    x = Space(target.coordinates, target.units, np.array(box.lower), np.array(box.upper))
    q = Space(chain.joint_names, chain.joint_units, chain.lower, chain.upper)

    def label(points: ArrayLike) -> Solution:
        return solve(
            chain,
            target,
            points,
            method=study.robot.inverse,
            elbow=study.robot.elbow,
            home=home,
            locked=study.robot.locked,
            min_singular_value_mm=box.min_singular_value_mm,
        )

    if region is None and study.samples.unreachable == "mask":
        region = usable_region(x, label)
    region = region or Region.box(x.lower, x.upper)
    if study.arm is None:
        return Task(x, q, target, chain, region, label, lambda _: chain)
    return Task(x, q, target, chain, region, label, _arms(study.arm, chain), study.arm.expectation)


def _arms(settings: Arm, drawing: SerialChain) -> Callable[[int], SerialChain | RealArm]:
    """The simulated arms by their seed, each drawn from a generator of its own."""
    spread = np.repeat([settings.deviation_mm, settings.deviation_rad], 3)

    @cache
    def arm(seed: int) -> SerialChain | RealArm:
        generator = np.random.default_rng([seed, _LINKS])
        chain = deviated(drawing, spread * generator.standard_normal((drawing.n_joints + 1, 6)))
        if settings.is_chain:
            return chain
        return RealArm(
            chain,
            settings.payload_kg,
            settings.stiffness_nm_per_rad or np.inf,
            settings.backlash_rad,
            settings.encoder_step_rad,
            (seed, _PLAY),
        )

    return arm


def study_chain(study: Study) -> SerialChain:
    """The study's arm, with its tool and the study's joint limits.

    Raises:
        IksamplesError: The arm's file or a setting of ``robot`` is wrong.
    """
    robot = study.robot
    chain = load_arm(robot.urdf, robot.base_link, robot.tip_link)
    limits = _by_joint(chain, "limits", robot.limits_rad, robot.limits_mm)
    return chain.with_limits(limits).with_tool(robot.tool_offset_mm)


def _by_joint(
    chain: SerialChain, key: str, of_angles: dict[str, T], of_lengths: dict[str, T]
) -> dict[str, T]:
    """Settings by joint, of whichever unit.

    Raises:
        IksamplesError: A name is no joint of that unit.
    """
    for unit, named in (("rad", of_angles), ("mm", of_lengths)):
        for name in named:
            units = dict(zip(chain.joint_names, chain.joint_units, strict=True))
            if units.get(name) != unit:
                known = [joint for joint, own in units.items() if own == unit]
                raise IksamplesError(
                    f"robot.{key}_{unit}: no joint '{name}' in {unit}; there "
                    + (f"are {', '.join(known)}." if known else "is none.")
                )
    return {**of_angles, **of_lengths}


def _home(robot: Robot, chain: SerialChain) -> Floats | None:
    """The home posture [rad or mm], shape (joints,); None where the study names none."""
    values = _by_joint(chain, "home", robot.home_rad, robot.home_mm)
    if not values:
        return None
    middle = (chain.lower + chain.upper) / 2
    return np.array(
        [values.get(name, own) for name, own in zip(chain.joint_names, middle, strict=True)]
    )


def _target(asked: Asked, chain: SerialChain, home: Floats | None) -> Target:
    """What an input asks of the tool.

    Raises:
        IksamplesError: The inputs are none that can be asked for, or the orientation hangs on a
            home posture that is not given.
    """
    inputs: tuple[str, ...] = tuple(asked.inputs)
    # What is no input stays as it is there; of a planar arm it is the plane.
    at = chain.forward_mm(np.zeros(chain.n_joints) if home is None else home)
    if asked.orientation == "free":
        return Target(inputs, reference_position_mm=at)
    if asked.reference_rpy_rad is not None:
        rotation = roll_pitch_yaw(asked.reference_rpy_rad)
    elif home is not None:
        rotation = chain.rotation(home)
    else:
        raise IksamplesError(
            "task.orientation: how is the tool to be turned? Give task.reference_rpy_rad or a home "
            "posture (robot.home_rad)."
        )
    return Target(inputs, asked.orientation, rotation, at)


def usable_region(x: Space, label: Callable[[ArrayLike], Solution]) -> Region:
    """The part of a workspace that an arm can use, as boxes.

    The workspace is cut into cells, 16 along each of three sides; those of whose corners, middles
    of edges and faces, and centre every one can be used are kept, and merged where they make up
    boxes.

    Args:
        x: The inputs with the workspace's limits.
        label: Says which inputs can be used.

    Raises:
        IksamplesError: No cell can be used.
    """
    d = len(x)
    n = max(2, min(_MOST_CELLS, int((_LATTICE_POINTS ** (1 / d) - 1) / 2)))
    sides = [np.linspace(*limits, 2 * n + 1) for limits in zip(x.lower, x.upper, strict=True)]
    lattice = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, d)
    found = label(lattice)
    shape = (2 * n + 1,) * d
    usable = found.usable
    if found.home is not None and not usable.all():
        # On the far sides of what the arm cannot pass, labels may be on two branches.
        usable = usable & ~jumps(found, shape)
    usable = usable.reshape(shape)
    for axis in range(d):
        first, middle, last = (
            np.take(usable, range(start, start + 2 * n - 1, 2), axis) for start in (0, 1, 2)
        )
        usable = np.logical_and(first, middle) & last
    if not usable.any():
        bad = int(np.flatnonzero(~found.usable)[0])
        raise IksamplesError(
            f"The workspace: the arm can use no part of it; {found.why_not(bad)}. "
            f"{found.where_to_go()}: move the box there."
        )
    lower, upper = (
        np.stack([side[2 * ends[:, i]] for i, side in enumerate(sides)], axis=1)
        for ends in merged(usable)
    )
    return Region(lower, upper)


def merged(cells: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells of a lattice merged into boxes that do not overlap.

    Each box grows from the first cell that is in none yet, along the last axis first.

    Args:
        cells: Whether each cell is to be covered, shape (n_1, .., n_d).

    Returns:
        First cell of each box and the one after its last, shape (boxes, d).
    """
    left = cells.copy()
    firsts, lasts = [], []
    while left.any():
        first = np.unravel_index(int(left.argmax()), left.shape)
        box = [slice(i, i + 1) for i in first]
        for axis in reversed(range(left.ndim)):
            while box[axis].stop < left.shape[axis]:
                ahead = [*box]
                ahead[axis] = slice(box[axis].stop, box[axis].stop + 1)
                if not left[tuple(ahead)].all():
                    break
                box[axis] = slice(box[axis].start, box[axis].stop + 1)
        left[tuple(box)] = False
        firsts.append([side.start for side in box])
        lasts.append([side.stop for side in box])
    return np.array(firsts, np.int64), np.array(lasts, np.int64)
