"""Recording samples: a design's positions, the joint values there, and fresh points beside them."""

from collections.abc import Callable
from typing import get_args

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.workspace import reach
from iksamples.errors import IksamplesError
from iksamples.samples import designs
from iksamples.samples.dataset import AXES, SampleSet
from iksamples.study import Design, Study


ADAPTIVE: Design = "adaptive"
"""The design that only training can place (``answer.adaptive``)."""

# Streams of the study's generator: fresh points of different use are independent of each other.
_FRESH_STREAM = {"validation": 1, "test": 2}
_DESIGN_STREAM = {name: 100 + i for i, name in enumerate(get_args(Design))}
_MAX_DRAWS = 1000
_REGION_POINTS = 4096
N_CORNERS = 2 ** len(AXES)
"""Corners of the workspace, which ``region_points`` adds to its Sobol points."""

_LATTICE = 13


def record_samples(
    study: Study, chain: SerialChain, design: Design, points_per_axis: int
) -> SampleSet:
    """Samples of the study's workspace, placed by a design.

    Args:
        study: The study.
        chain: Its arm.
        design: How the points are placed.
        points_per_axis: m; there are m^3 points.

    Raises:
        IksamplesError: The arm cannot use a point of the design and the study does not mask it,
            too few points are left, or the design is the adaptive one.
    """
    points = _place(study, chain, design, points_per_axis)
    return samples_at(study, chain, design, points_per_axis, points)


def samples_at(
    study: Study, chain: SerialChain, design: Design, points_per_axis: int, points: Floats
) -> SampleSet:
    """Samples at given positions.

    Args:
        study: The study.
        chain: Its arm.
        design: What placed the positions.
        points_per_axis: m of the design; it was to place m^3 points.
        points: Positions [mm], shape (points, 3).

    Raises:
        IksamplesError: As ``record_samples``.
    """
    box = study.workspace
    n_wanted = points_per_axis ** len(AXES)
    label = sample_label(design, points_per_axis)
    answer = reach(study, chain, points)
    if study.samples.unreachable == "error":
        answer.require_usable(
            f"{label} of the workspace",
            "Move the workspace, widen robot.limits_rad, or set samples.unreachable: mask.",
        )
    kept = answer.usable
    n = int(np.sum(kept))
    if n < 2 or np.any(np.ptp(points[kept], axis=0) == 0):
        raise IksamplesError(
            f"{label} of the workspace: only {n} of {len(points)} points can be used, too few "
            "to span it. Move the workspace or drop this size."
        )
    whole_grid = design == "grid" and n == n_wanted
    sides = box.lower_mm, box.upper_mm, points_per_axis
    return sample_set(
        study,
        chain,
        label,
        design,
        points_per_axis,
        points[kept],
        answer.joints[kept],
        spacing_mm=designs.grid_spacing_mm(*sides) if design == "grid" else np.nan,
        fill_distance_mm=designs.grid_fill_distance_mm(*sides) if whole_grid else None,
        n_masked=n_wanted - n,
    )


def sample_set(
    study: Study,
    chain: SerialChain,
    label: str,
    design: str,
    points_per_axis: int,
    positions_mm: Floats,
    joints: Floats,
    *,
    spacing_mm: float = np.nan,
    fill_distance_mm: float | None = None,
    n_masked: int = 0,
) -> SampleSet:
    """Samples that are recorded already, with fresh points beside them.

    Args:
        study: The study.
        chain: Its arm.
        label: Name of the set.
        design: What placed the positions.
        points_per_axis: m of the design.
        positions_mm: Positions [mm], shape (n, 3), that differ along every axis.
        joints: Joint values there [rad], shape (n, joints).
        spacing_mm: Distance between neighbours of an even grid [mm].
        fill_distance_mm: Fill distance [mm]; None: measured.
        n_masked: Points left out.
    """
    n = len(positions_mm)
    if fill_distance_mm is None:
        region = region_points(study, chain, _REGION_POINTS)
        fill_distance_mm = designs.fill_distance_mm(positions_mm, region)
    return SampleSet(
        label,
        design,
        points_per_axis,
        chain.joint_names,
        positions_mm,
        joints,
        *_fresh(study, chain, n, "validation"),
        *_fresh(study, chain, n, "test"),
        *_normalisation(study.samples.normalisation, positions_mm),
        spacing_mm,
        fill_distance_mm,
        n_masked,
    )


def grid_samples(study: Study, chain: SerialChain, points_per_axis: int) -> SampleSet:
    """Samples on an even grid of the study's workspace; see ``record_samples``."""
    return record_samples(study, chain, "grid", points_per_axis)


def sample_label(design: Design, points_per_axis: int) -> str:
    """Name of a set of samples: ``grid5`` for 5 points per axis, ``sobol125`` for 125 points."""
    tensor = design in ("grid", "chebyshev")
    return f"{design}{points_per_axis if tensor else points_per_axis ** len(AXES)}"


def _place(study: Study, chain: SerialChain, design: Design, points_per_axis: int) -> Floats:
    """Positions of a design [mm]; those of a random design that the arm cannot use are redrawn."""
    if design == ADAPTIVE:
        raise IksamplesError(
            f"{sample_label(design, points_per_axis)}: adaptive samples follow from networks that "
            "are trained on the way, so they cannot be placed in one step. Make them with "
            "iksamples.answer.adaptive."
        )
    box = study.workspace.lower_mm, study.workspace.upper_mm
    n = points_per_axis ** len(AXES)
    generator = np.random.default_rng([study.samples.seed, _DESIGN_STREAM[design], n])
    if design == "grid":
        return designs.full_grid(*box, points_per_axis)
    if design == "chebyshev":
        return designs.chebyshev_grid(*box, points_per_axis)
    if design == "sobol":
        return designs.sobol(*box, n, generator)
    if design == "latin":
        return designs.latin_hypercube(*box, n, generator)
    if design == "uniform":
        return _usable(study, chain, n, lambda k: designs.uniform(*box, k, generator))
    return _usable(study, chain, n, lambda k: _from_joints(study, chain, k, generator))


def _from_joints(
    study: Study, chain: SerialChain, n: int, generator: np.random.Generator
) -> Floats:
    """Where the tool is at joint values drawn uniformly inside their limits, if in the workspace.

    Recorded like that the samples are dense where the arm is slow (Duka 2014 samples so). Positions
    of another branch of the inverse kinematics are labelled on the study's own.
    """
    joints = chain.lower + (chain.upper - chain.lower) * generator.random((n, chain.n_joints))
    positions = chain.forward_mm(joints)
    box = study.workspace
    inside = np.all((positions >= box.lower_mm) & (positions <= box.upper_mm), axis=-1)
    return positions[inside]


def _usable(study: Study, chain: SerialChain, n: int, draw: Callable[[int], Floats]) -> Floats:
    """The first n drawn positions that the arm can use [mm], shape (n, 3).

    Raises:
        IksamplesError: Hardly any can be used.
    """
    found = np.empty((0, len(AXES)))
    for _ in range(_MAX_DRAWS):
        points = draw(max(64, 4 * n))
        found = np.concatenate([found, points[reach(study, chain, points).usable]])
        if len(found) >= n:
            return found[:n]
    raise IksamplesError(
        f"The workspace: of the points drawn only {len(found)} of the {n} needed can be used. "
        "Move it, or widen robot.limits_rad."
    )


def require_workspace(study: Study, chain: SerialChain) -> None:
    """Stops where part of the workspace cannot be used and the study does not mask it.

    Raises:
        IksamplesError: Names a point that cannot be used, and why.
    """
    if study.samples.unreachable == "error":
        box = study.workspace
        lattice = designs.full_grid(box.lower_mm, box.upper_mm, _LATTICE)
        reach(study, chain, lattice).require_usable(
            "The workspace", "Move it, or set samples.unreachable: mask."
        )


def region_points(study: Study, chain: SerialChain, n: int) -> Floats:
    """Points spread over the usable part of the workspace, the same for every grid.

    Args:
        study: The study.
        chain: Its arm.
        n: Number of Sobol points in the box; the box's eight corners are added, and points the arm
            cannot use are left out.

    Returns:
        Positions [mm], shape (at most n + 8, 3).
    """
    box = study.workspace
    points = np.concatenate(
        [
            designs.full_grid(box.lower_mm, box.upper_mm, 2),
            designs.sobol(box.lower_mm, box.upper_mm, n, np.random.default_rng(0)),
        ]
    )
    answer = reach(study, chain, points)
    if study.samples.unreachable == "error":
        answer.require_usable("The workspace", "Move it, or set samples.unreachable: mask.")
    return points[answer.usable]


def _normalisation(kind: str, positions_mm: Floats) -> tuple[Floats, Floats]:
    """Offset and scale [mm] of the inputs' min-max scaling."""
    low, high = positions_mm.min(axis=0), positions_mm.max(axis=0)
    if kind == "unit":
        return low, high - low
    if kind == "symmetric":
        return (low + high) / 2, (high - low) / 2
    return np.zeros_like(low), np.ones_like(low)


def _fresh(study: Study, chain: SerialChain, n: int, role: str) -> tuple[Floats, Floats]:
    """Fresh points for a role: positions [mm] and joint values [rad]."""
    held_out = study.training.held_out
    share = held_out.validation_share if role == "validation" else held_out.test_share
    if held_out.source == "grid" or share == 0:
        return np.empty((0, 3)), np.empty((0, chain.n_joints))
    wanted = max(int(np.ceil(share * n)), held_out.at_least)
    generator = np.random.default_rng([study.samples.seed, _FRESH_STREAM[role], n])
    box = study.workspace.lower_mm, study.workspace.upper_mm
    positions = _usable(study, chain, wanted, lambda k: designs.uniform(*box, k, generator))
    return positions, reach(study, chain, positions).joints
