"""A drawing fitted to measured poses: least squares with a prior, and what it leaves uncertain.

The unknowns are the deviations of `arm.real`, a small motion before every joint and the tool.
They are more than can be told apart (a joint's zero and the next link's turn, the base and all that
follows); the prior, not a choice of fewer parameters, settles that: each deviation is normal about
zero, so that the fit is a ridge regression and its posterior, linearised at the fit, is normal
(Laplace; Bishop, *Pattern Recognition and Machine Learning*, sec. 3.5 and 4.4).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.real import deviated_pose
from iksamples.calibration.known import (
    FEWEST_FREEDOM,
    NOISE_MM,
    NOISE_RAD,
    SMALLEST_NOISE_MM,
    UNLIKELY_ARM,
    Fitted,
    Prior,
)
from iksamples.errors import IksamplesError
from iksamples.study import Assumed, Expected
from iksamples.task import Task


_ROUNDS = 50


Misses = Callable[[Floats], tuple[Floats, Floats, Floats, Floats]]
"""Deviations, shape (joints + 1, 6) -> positions that are missed [mm] and their derivatives by the
deviations, shapes (rows,) and (rows, parameters); then whatever else is, in standard deviations."""


def fit_arm(
    drawing: SerialChain,
    joints: ArrayLike,
    measured_mm: ArrayLike,
    *,
    prior: Prior,
    noise_mm: float | None,
    measured_rotation: ArrayLike | None = None,
    noise_rad: float | None = None,
    axis_only: bool = False,
) -> Fitted:
    """The drawing's deviations that explain measured positions (or poses) of the tool best.

    Args:
        drawing: The arm as drawn.
        joints: Joint values that were read [rad or mm], shape (poses, joints).
        measured_mm: Where the tool was then [mm], shape (poses, 3); NaN where not measured.
        prior: How far the arm may be from its drawing.
        noise_mm: Standard deviation of a measured coordinate [mm]; None: estimated.
        measured_rotation: How the tool was turned, shape (poses, 3, 3); None: not measured.
        noise_rad: Standard deviation of a component of the measured rotation [rad].
        axis_only: Of the rotation only the direction of the tool's z axis was measured.

    Raises:
        IksamplesError: The numbers are not such, or too few to estimate the noise from.
    """
    q, position = _checked(drawing, joints), np.asarray(measured_mm, float)
    if position.shape != (len(q), 3):
        raise IksamplesError(
            f"{len(q)} poses, but measured positions of shape {position.shape}; give three "
            "coordinates for each (NaN for one that was not measured)."
        )
    rotation = None if measured_rotation is None else np.asarray(measured_rotation, float)
    if rotation is not None and noise_rad is None:
        raise IksamplesError("The tool's rotation was measured, but not said how well (noise_rad).")
    measured = np.isfinite(position)

    def misses(rows: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        at, turned, linear, angular = deviated_pose(drawing, rows, q)
        off, by = (at - position)[measured], linear[measured]
        if rotation is None or noise_rad is None:
            return off, by, np.empty(0), np.empty((0, rows.size))
        turn, turn_by = _turned_off(turned, rotation, angular, axis_only)
        scale = max(noise_rad, SMALLEST_NOISE_MM / 1e3)
        return off, by, turn.ravel() / scale, turn_by.reshape(turn.size, -1) / scale

    fitted = _solve(drawing, prior, misses, noise_mm)
    residuals = np.where(measured, fitted.chain.forward_mm(q) - position, np.nan)
    return replace(fitted, residuals_mm=residuals)


class Recorded(Protocol):
    """Samples, as ``samples.dataset.SampleSet``: inputs (n, d) and joint values (n, joints)."""

    @property
    def x(self) -> Floats:
        """Where the tool was measured to be."""

    @property
    def joints(self) -> Floats:
        """What the encoders read there."""


def fit_samples(task: Task, samples: Recorded) -> Fitted:
    """The task's drawing fitted to samples, in which the tool was measured to be where asked.

    With the noise and the prior that the study expects; where the residuals are far beyond that
    noise, because the joints play or bend as well, with the noise that they show.

    Args:
        task: What is learned; only its drawing and what is expected of the arm are used.
        samples: What was recorded on one arm.
    """
    position, rotation = task.target.wanted(samples.x)
    unasked = [axis for axis in range(3) if axis not in task.target.positions]
    position[:, unasked] = np.nan
    prior, noise_mm, noise_rad = expectation(task.expected)

    def fitted(noise_mm: float | None) -> Fitted:
        return fit_arm(
            task.drawing,
            samples.joints,
            position,
            prior=prior,
            noise_mm=noise_mm,
            measured_rotation=rotation if task.turns else None,
            noise_rad=noise_rad,
            axis_only=task.target.orientation == "axis",
        )

    found = fitted(noise_mm)
    return found if found.noise_is_plausible else fitted(None)


def expectation(expected: Expected | None) -> tuple[Prior, float, float]:
    """A study's expectation of its arm; the usual one where it has none.

    Returns:
        The prior, and the noise of a coordinate [mm] and of a turn's component [rad].
    """
    if expected is None:
        return Prior(), NOISE_MM, NOISE_RAD
    moved = max(expected.deviation_mm or 0.0, SMALLEST_NOISE_MM)
    turned = max(expected.deviation_rad or 0.0, SMALLEST_NOISE_MM / 1e3)
    tool_mm = expected.tool_mm if isinstance(expected, Assumed) else None
    return Prior(moved, turned, tool_mm), expected.noise_mm or 0.0, expected.noise_rad or 0.0


def fit_sockets(
    drawing: SerialChain,
    groups: Sequence[ArrayLike],
    distances_mm: Sequence[tuple[int, int, float]] = (),
    *,
    prior: Prior,
    noise_mm: float | None,
    distance_noise_mm: float = 0.1,
) -> Fitted:
    """The same from postures with the tool held in points that nobody measured.

    Where the tool is in a group of postures is free: what counts is that it is the same point in
    all of them. So neither the base nor anything that moves all points alike can be found.

    Args:
        drawing: The arm as drawn, with the tool about where it is held.
        groups: Joint values of the postures of each point [rad or mm], shape (postures, joints).
        distances_mm: Known distances: a point's group, another's, and the distance [mm].
        prior: How far the arm may be from its drawing; ``tool_mm`` where the held point's place
            on the flange is not known well.
        noise_mm: Standard deviation of a coordinate of the held point [mm]; None: estimated.
        distance_noise_mm: Standard deviation of the distances [mm].

    Raises:
        IksamplesError: A group has less than two postures, or as ``fit_arm``.
    """
    sizes = [len(_checked(drawing, group)) for group in groups]
    if not sizes or min(sizes) < 2:
        raise IksamplesError(
            "A point in which the tool was held in fewer than two postures says nothing: leave it "
            "out, or record more postures there."
        )
    q = np.concatenate([_checked(drawing, group) for group in groups])
    ends = np.cumsum(sizes)[:-1]

    def misses(rows: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        at, _, linear, _ = deviated_pose(drawing, rows, q)
        parts = list(zip(np.split(at, ends), np.split(linear, ends), strict=True))
        centres = [(part.mean(axis=0), by.mean(axis=0)) for part, by in parts]
        # The best centre is the mean, whatever the deviations: they are left with the scatter.
        off = [part - own for (part, _), (own, _) in zip(parts, centres, strict=True)]
        off_by = [by - own for (_, by), (_, own) in zip(parts, centres, strict=True)]
        apart, apart_by = [np.empty(0)], [np.empty((0, rows.size))]
        for first, second, distance_mm in distances_mm:
            between = centres[first][0] - centres[second][0]
            length = float(np.linalg.norm(between))
            by = between @ (centres[first][1] - centres[second][1]) / max(length, 1e-9)
            apart.append(np.array([(length - distance_mm) / distance_noise_mm]))
            apart_by.append(by[None] / distance_noise_mm)
        return (
            np.concatenate(off).ravel(),
            np.concatenate(off_by).reshape(3 * len(q), -1),
            np.concatenate(apart),
            np.concatenate(apart_by),
        )

    fitted = _solve(drawing, prior, misses, noise_mm, taken=3 * len(sizes))
    at = np.split(fitted.chain.forward_mm(q), ends)
    residuals = np.concatenate([part - part.mean(axis=0) for part in at])
    centres = np.array([part.mean(axis=0) for part in at])
    return replace(fitted, residuals_mm=residuals, centres_mm=centres)


def _solve(
    drawing: SerialChain, prior: Prior, misses: Misses, noise_mm: float | None, taken: int = 0
) -> Fitted:
    """The most probable deviations, by Levenberg and Marquardt's method, and their posterior.

    A noise that is not given is the one of largest evidence: what is left of the squares by what
    the fit leaves of their number (MacKay, "Bayesian interpolation", *Neural Computation* 4, 1992).
    Likewise a prior that is too narrow for the deviations found is widened until it has room.

    Args:
        drawing: The arm as drawn.
        prior: How far the arm may be from it.
        misses: What is missed.
        noise_mm: Of the positions [mm].
        taken: Numbers that the points' own places take up of those positions.
    """
    from scipy.optimize import least_squares
    from scipy.stats import chi2

    sd = prior.deviations(drawing.n_joints)
    shape, scale = sd.shape, sd.ravel()
    if noise_mm is not None and not (np.isfinite(noise_mm) and noise_mm >= 0):
        raise IksamplesError(f"The noise, {noise_mm:g} mm, is none: say how well was measured.")
    noise = NOISE_MM if noise_mm is None else max(noise_mm, SMALLEST_NOISE_MM)
    unit = np.zeros(scale.size)

    @lru_cache(maxsize=1)  # the solver asks for misses and derivatives in turn
    def at(values: bytes) -> tuple[Floats, Floats, Floats, Floats]:
        return misses((np.frombuffer(values) * scale).reshape(shape))

    def missed(values: Floats) -> Floats:
        off, _, others, _ = at(values.tobytes())
        return np.concatenate([off / noise, others, values])

    def jacobian(values: Floats) -> Floats:
        _, by, _, others_by = at(values.tobytes())
        return np.concatenate([by * scale / noise, others_by * scale, np.eye(scale.size)])

    for _ in range(_ROUNDS):
        unit = least_squares(missed, unit, jacobian, method="lm", xtol=1e-12, ftol=1e-12).x
        rows = (unit * scale).reshape(shape)
        _, values, right = np.linalg.svd(jacobian(unit), full_matrices=False)
        off, by, _, _ = at(unit.tobytes())
        root = right.T / values
        told = scale.size - float(np.sum(root**2))  # deviations that the samples tell
        wide = float(unit @ unit) / max(told, 1e-9)
        settled = wide <= 1.02 or chi2.sf(unit @ unit, told) > UNLIKELY_ARM
        # The trace of the positions' part of the hat matrix: the numbers that the fit takes up.
        freedom = off.size - taken - float(np.sum((by * scale / noise @ root) ** 2))
        if noise_mm is None:
            if freedom < FEWEST_FREEDOM:
                raise IksamplesError(
                    f"{off.size} measured numbers are too few to tell how well they were measured; "
                    "record more poses, or say it (noise_mm)."
                )
            before, noise = noise, max(float(np.sqrt(off @ off / freedom)), SMALLEST_NOISE_MM)
            settled &= abs(noise - before) <= 1e-3 * noise
        if settled:
            break
        if wide > 1 and chi2.sf(unit @ unit, told) <= UNLIKELY_ARM:
            scale, unit = scale * np.sqrt(wide), unit / np.sqrt(wide)
            at.cache_clear()
    return Fitted(
        drawing,
        rows,
        scale[:, None] * root,
        noise,
        freedom,
        np.empty((0, 3)),
        noise_estimated=noise_mm is None,
    )


def _turned_off(
    turned: Floats, measured: Floats, angular: Floats, axis_only: bool
) -> tuple[Floats, Floats]:
    """By how much the tool is turned off what was measured [rad], and its derivatives.

    Rotation vectors in the base frame; of the axis alone, the two components across it.
    """
    from scipy.spatial.transform import Rotation

    if axis_only:
        across = np.swapaxes(measured[..., :2], -1, -2)
        axis = turned[..., 2]
        by = np.cross(np.swapaxes(angular, -1, -2), axis[..., None, :])
        return (across @ axis[..., None])[..., 0], across @ np.swapaxes(by, -1, -2)
    off = Rotation.from_matrix(turned @ np.swapaxes(measured, -1, -2)).as_rotvec()
    cross = np.cross(np.eye(3), off[..., None, :])
    # The left Jacobian's inverse, to the fourth order in what is off.
    return off, (np.eye(3) - cross / 2 + cross @ cross / 12) @ angular


def _checked(drawing: SerialChain, joints: ArrayLike) -> Floats:
    q = np.atleast_2d(np.asarray(joints, float))
    if q.shape[-1] != drawing.n_joints or not np.isfinite(q).all():
        raise IksamplesError(
            f"Joint values of shape {q.shape}: give {drawing.n_joints} finite ones for each pose."
        )
    return q
