"""Samples as a tensor grid: what the methods that work axis by axis need."""

from dataclasses import dataclass

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.methods.predictor import NotApplicableError
from iksamples.samples.dataset import SampleSet


MOST_INPUTS = 4
"""Inputs of a grid that is worth its samples: with five, two points per axis are 32 of them."""
_SAME = 1e-9
"""Coordinates nearer than this share of the samples' extent are one coordinate."""


@dataclass(frozen=True, eq=False)
class TensorGrid:
    """Samples at every crossing of some coordinates, however they are spaced.

    Attributes:
        axes: The coordinates along each axis, increasing [mm or rad].
        joints: Joint values at the crossings [rad or mm], shape (m_1, ..., m_d, joints).
    """

    axes: tuple[Floats, ...]
    joints: Floats


def tensor_grid(samples: SampleSet, kind: str) -> TensorGrid:
    """Sorts samples, in whatever order, into the grid they lie on.

    Args:
        samples: The samples.
        kind: The method that asks, for the message.

    Raises:
        NotApplicableError: There are too many inputs, or the samples are no full grid: some are
            masked, or they are scattered.
    """
    d = samples.x.shape[1]
    if d > MOST_INPUTS:
        raise NotApplicableError(
            f"{kind}: interpolates in 2 to {MOST_INPUTS} inputs, and there are {d}. Use rbf or "
            "gaussian-process."
        )
    axes, places = [], []
    for x in samples.x.T:
        values = np.unique(x)
        axis = values[np.diff(values, prepend=-np.inf) > _SAME * np.ptp(x)]
        axes.append(axis)
        places.append(np.searchsorted(axis, x, side="right") - 1)
    shape = tuple(len(axis) for axis in axes)
    n = samples.n_samples
    # As many samples as crossings, and no two at the same one: then each has its own.
    full = np.prod(shape, dtype=float) == n and len(np.unique(places, axis=1).T) == n
    if not full:
        crossings = " x ".join(str(m) for m in shape)
        why = (
            f"{samples.n_masked} grid points are masked"
            if samples.n_masked
            else f"{n} samples on {crossings} coordinates"
        )
        raise NotApplicableError(
            f"{kind}: needs a sample at every crossing of a grid, and {samples.label} is no full "
            f"grid ({why}). Use rbf or gaussian-process on these samples, or a grid in a workspace "
            "that the arm can reach all of."
        )
    joints = np.empty((*shape, samples.joints.shape[1]))
    joints[tuple(places)] = samples.joints
    return TensorGrid(tuple(axes), joints)
