"""Recording samples: a design, the joints there on every arm, and fresh points beside them."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.arm.inverse import Solution, followed, require_usable_lattice
from iksamples.arm.real import RealArm, rotation_of
from iksamples.calibration.design import CANDIDATES, optimal
from iksamples.calibration.worst import Measured, unmeasured
from iksamples.errors import IksamplesError
from iksamples.region import Region
from iksamples.samples import designs
from iksamples.samples.dataset import SampleSet
from iksamples.study import TENSOR, Arm, Design, Study
from iksamples.task import Task


ADAPTIVE: Design = "adaptive"
"""The design that only training can place (``answer.adaptive``)."""

# Streams of the study's generator: fresh points of different use are independent of each other.
_FRESH_STREAM = {"validation": 1, "test": 2}
_DESIGN_STREAM = {name: 100 + i for i, name in enumerate(get_args(Design))}
_MAX_DRAWS = 1000
_REGION_POINTS = 4096
_LATTICE_POINTS = 2200


def record_samples(study: Study, task: Task, design: Design, n: int) -> SampleSet:
    """Samples of the task's region, placed by a design.

    Args:
        study: The study.
        task: Its task.
        design: How the points are placed.
        n: How many are wanted; a grid takes the nearest number that it can.

    Raises:
        IksamplesError: The arm cannot use a point of the design and the study does not mask it,
            too few points are left, or the design is the adaptive one.
    """
    return samples_at(study, task, design, n, _place(study, task, design, n))


def samples_at(study: Study, task: Task, design: Design, n: int, x: Floats) -> SampleSet:
    """Samples at given inputs, less those that the arm cannot use.

    Args:
        study: The study.
        task: Its task.
        design: What placed the inputs.
        n: How many were wanted.
        x: Inputs [mm or rad], shape (points, d).

    Raises:
        IksamplesError: As ``record_samples``.
    """
    label = sample_label(study, design, n)
    answer = task.reach(x)
    if study.samples.unreachable == "error":
        answer.require_usable(
            f"{label} of the workspace",
            "Move the workspace, widen robot.limits_rad, or set samples.unreachable: mask.",
        )
    kept = answer.usable & task.region.contains(x)
    n_kept = int(np.sum(kept))
    if n_kept < 2 or np.any(np.ptp(x[kept], axis=0) == 0):
        raise IksamplesError(
            f"{label} of the workspace: only {n_kept} of {len(x)} points can be used, too few "
            "to span it. Move the workspace or drop this size."
        )
    wanted = int(np.prod(study.grid_shape(n))) if design in TENSOR else n
    samples = sample_set(
        study,
        task,
        label,
        design,
        x[kept],
        answer.joints[kept],
        grid=study.grid_shape(n) if design == "grid" else None,
        n_masked=wanted - n_kept,
    )
    return on_arms(study, task, samples)


def sample_set(
    study: Study,
    task: Task,
    label: str,
    design: str,
    x: Floats,
    joints: Floats,
    *,
    grid: tuple[int, ...] | None = None,
    n_masked: int = 0,
) -> SampleSet:
    """Samples that are recorded already, with fresh points beside them.

    Args:
        study: The study.
        task: Its task.
        label: Name of the set.
        design: What placed the inputs.
        x: Inputs [mm or rad], shape (n, d), that differ along every axis.
        joints: Joint values there [rad or mm], shape (n, joints).
        grid: Points along each axis where they are of an even grid of the whole workspace.
        n_masked: Points left out.
    """
    spacing = fill = np.nan
    lengths = task.x.lengths
    if grid:
        steps = designs.grid_spacing(task.x.lower, task.x.upper, grid)
        spacing = float(steps[lengths].max())
    if lengths.all():
        if grid and not n_masked:
            fill = float(np.linalg.norm(steps) / 2)
        else:
            fill = designs.fill_distance(x, region_points(task.region, _REGION_POINTS))
    return SampleSet(
        label,
        design,
        task.x,
        task.q,
        task.region,
        x,
        joints,
        *_fresh(study, task, len(x), "validation"),
        *_fresh(study, task, len(x), "test"),
        *normalisation(study.samples.normalisation, x),
        spacing,
        fill,
        n_masked,
    )


def grid_samples(study: Study, task: Task, points_per_axis: int) -> SampleSet:
    """Samples on an even grid with so many points along each axis; see ``record_samples``."""
    return record_samples(study, task, "grid", points_per_axis ** len(task.x))


def sample_label(study: Study, design: Design, n: int) -> str:
    """Name of a set of samples: ``grid5`` (5 points per axis), ``grid4x3x3``, ``sobol125``."""
    if design not in TENSOR:
        return f"{design}{n}"
    shape = study.grid_shape(n)
    return f"{design}{shape[0] if len(set(shape)) == 1 else 'x'.join(map(str, shape))}"


def _place(study: Study, task: Task, design: Design, n: int) -> Floats:
    """Inputs of a design; those of a random design that the arm cannot use are redrawn."""
    if design == ADAPTIVE:
        raise IksamplesError(
            f"{sample_label(study, design, n)}: adaptive samples follow from networks that "
            "are trained on the way, so they cannot be placed in one step. Make them with "
            "iksamples.answer.adaptive."
        )
    box = task.x.lower, task.x.upper
    generator = np.random.default_rng([study.samples.seed, _DESIGN_STREAM[design], n])
    if design == "grid":
        return designs.full_grid(*box, study.grid_shape(n))
    if design == "chebyshev":
        return designs.chebyshev_grid(*box, study.grid_shape(n))
    if design == "sobol":
        return _sobol(task.region, n, generator)
    if design == "latin":
        return designs.latin_hypercube(*box, n, generator)
    if design == "optimal":
        return _optimal(task, n, lambda k: designs.uniform(*box, k, generator))
    if design == "uniform":
        return _usable(task, n, lambda k: designs.uniform(*box, k, generator))
    return _usable(task, n, lambda k: _from_joints(task, k, generator))


def _from_joints(task: Task, n: int, generator: np.random.Generator) -> Floats:
    """Where the tool is at joint values drawn uniformly inside their limits, as inputs.

    Recorded like that the samples are dense where the arm is slow (Duka 2014 samples so). Inputs
    of another branch of the inverse kinematics are labelled on the study's own. Angles among the
    inputs are drawn uniformly.
    """
    low, high = task.drawing.lower, task.drawing.upper
    joints = low + (high - low) * generator.random((n, task.drawing.n_joints))
    positions = task.drawing.forward_mm(joints)[:, list(task.target.positions)]
    angles = slice(positions.shape[1], len(task.x))
    turned = designs.uniform(task.x.lower[angles], task.x.upper[angles], n, generator)
    return np.concatenate([positions, turned], axis=1)


def _optimal(task: Task, n: int, draw: Callable[[int], Floats]) -> Floats:
    """The drawn inputs that tell most about the drawing, all together, shape (n, d)."""
    x = _usable(task, max(CANDIDATES, 2 * n), draw)
    before = unmeasured(task)
    informs = Measured.of(task).informs(before, task.reach(x).joints)
    return x[optimal(before, informs, n)]


def _usable(task: Task, n: int, draw: Callable[[int], Floats]) -> Floats:
    """The first n drawn inputs that lie in the region and that the arm can use, shape (n, d).

    Raises:
        IksamplesError: Hardly any can be used.
    """
    found = np.empty((0, len(task.x)))
    for _ in range(_MAX_DRAWS):
        x = draw(max(64, 4 * n))
        x = x[task.region.contains(x)]
        found = np.concatenate([found, x[task.reach(x).usable]])
        if len(found) >= n:
            return found[:n]
    raise IksamplesError(
        f"The workspace: of the points drawn only {len(found)} of the {n} needed can be used. "
        "Move it, or widen robot.limits_rad."
    )


def _sobol(region: Region, n: int, generator: np.random.Generator) -> Floats:
    """The first n points of a Sobol sequence that lie in a region, shape (n, d)."""
    box = region.lower_corner, region.upper_corner
    share = region.volume / float(np.prod(box[1] - box[0]))
    # More than a share of the sequence falls short of by chance, if any does.
    laid = n if region.n_boxes == 1 else int(2 * n / share) + 64
    x = designs.sobol(*box, laid, generator)
    return x[region.contains(x)][:n]


def require_workspace(study: Study, task: Task) -> None:
    """Stops where part of the workspace cannot be used and the study does not mask it.

    Raises:
        IksamplesError: Names a point that cannot be used, and why.
    """
    if study.samples.unreachable == "error":
        m = max(2, int(_LATTICE_POINTS ** (1 / len(task.x)) + 1e-9))
        lattice = designs.full_grid(task.x.lower, task.x.upper, m)
        require_usable_lattice(
            task.reach(lattice),
            list(np.linspace(task.x.lower, task.x.upper, m).T),
            "The workspace",
            "Move it, or set samples.unreachable: mask.",
        )


def region_points(region: Region, n: int) -> Floats:
    """Points spread over a region, the same for every set of samples.

    Args:
        region: The region.
        n: Number of Sobol points, to which the corners of the region's largest box are added.

    Returns:
        Inputs [mm or rad], shape (n + 2^d, d).
    """
    largest = int(np.argmax(region.shares))
    corners = designs.full_grid(region.lower[largest], region.upper[largest], 2)
    return np.concatenate([corners, _sobol(region, n, np.random.default_rng(0))])


def normalisation(kind: str, x: Floats) -> tuple[Floats, Floats]:
    """Offset and scale [mm or rad] of the inputs' min-max scaling."""
    low, high = x.min(axis=0), x.max(axis=0)
    if kind == "unit":
        return low, high - low
    if kind == "symmetric":
        return (low + high) / 2, (high - low) / 2
    return np.zeros_like(low), np.ones_like(low)


def _fresh(study: Study, task: Task, n: int, role: str) -> tuple[Floats, Floats]:
    """Fresh points for a role: inputs and joint values."""
    held_out = study.training.held_out
    share = held_out.validation_share if role == "validation" else held_out.test_share
    if held_out.source == "grid" or share == 0:
        return np.empty((0, len(task.x))), np.empty((0, len(task.q)))
    wanted = max(int(np.ceil(share * n)), held_out.at_least)
    generator = np.random.default_rng([study.samples.seed, _FRESH_STREAM[role], n])
    box = task.x.lower, task.x.upper
    x = _usable(task, wanted, lambda k: designs.uniform(*box, k, generator))
    return x, task.reach(x).joints


_NOISE, _PLAY = 20, 30
"""Streams of an arm's generator, beside the seed, for each role of a point."""


def on_arms(study: Study, task: Task, samples: SampleSet) -> SampleSet:
    """The samples as each of the study's arms records them; in most studies, as they are.

    The tool is brought to each input by what is measured, so it really is there but for the
    measurement's noise, and the encoders are read.

    Args:
        study: The study; its seeds say which arms, its ``arm`` section how well is measured.
        task: Its task.
        samples: The samples as the drawing has them.

    Raises:
        IksamplesError: An arm cannot get to a sample.
    """
    if study.arm is None:
        return samples
    parts = (samples.x, samples.validation_x, samples.test_x)
    drawn = [task.reach(x) for x in parts if len(x)]
    recorded = [
        np.concatenate(
            [_recorded(task, study.arm, seed, role, one) for role, one in enumerate(drawn)]
        )
        for seed in study.arms
    ]
    for seed, joints in zip(study.arms, recorded, strict=True):
        lost = np.flatnonzero(~np.isfinite(joints).all(axis=1))
        if lost.size:
            at = ", ".join(f"{value:g}" for value in samples.inputs[lost[0]])
            raise IksamplesError(
                f"{samples.label}: the arm of seed {seed} cannot get to ({at}), so it differs too "
                "much from its drawing; make arm.deviation_mm, arm.deviation_rad or the workspace "
                "smaller."
            )
    return replace(samples, arms=study.arms, arm_joints=np.stack(recorded))


def _recorded(task: Task, settings: Arm, seed: int, role: int, drawn: Solution) -> Floats:
    """What the encoders of a seed's arm read, shape (points, joints)."""
    position, rotation = task.target.wanted(drawn.x)
    # Drawn point by point, so that a longer list of points begins like a shorter one.
    noise = np.random.default_rng([seed, _NOISE + role]).standard_normal((len(drawn.x), 6))
    position = position + settings.noise_mm * noise[:, :3]
    rotation = rotation_of(settings.noise_rad * noise[:, 3:]) @ rotation
    arm = task.arm_of(seed)
    actual = followed(drawn, task.chain_of(seed), (position, rotation))
    if isinstance(arm, RealArm):
        return replace(arm, seed=(seed, _PLAY + role)).read(actual)
    return actual
