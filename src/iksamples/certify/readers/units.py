"""How a network's user feeds it and reads its answer: units, offsets and scales."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.readers.exact import times
from iksamples.certify.readers.layers import Scaling
from iksamples.errors import IksamplesError


Floats = NDArray[np.float64]

# 40 digits: what is left out is far below the rounding of the product.
_RAD_PER_DEG = Fraction("3.141592653589793238462643383279502884197") / 180
_FACTORS = {
    "rad": ("revolute", Fraction(1)),
    "deg": ("revolute", _RAD_PER_DEG),
    "mm": ("prismatic", Fraction(1)),
    "m": ("prismatic", Fraction(1000)),
}


def fed_as(
    kinds: Sequence[str], unit: str | None, offset_mm: Floats | None, scale_mm: Floats | None
) -> Scaling | None:
    """What is done to a position [mm] before the network gets it; None if nothing is.

    Args:
        kinds: Unit of each coordinate of the box: ``mm`` if it is a length.
        unit: ``mm`` or ``m``: what the network takes; mm if None.
        offset_mm: What is subtracted first [mm], shape (in,); zero if None.
        scale_mm: What it is divided by then [mm], shape (in,).

    Raises:
        IksamplesError: The options contradict each other, or are of another number.
    """
    if unit not in (None, "mm", "m"):
        raise IksamplesError(f"--input-unit {unit}: give mm or m.")
    if unit is not None and scale_mm is not None:
        raise IksamplesError(
            "--scale-mm says already what the network takes (millimetres divided by it); leave "
            "out --input-unit."
        )
    if unit in (None, "mm") and offset_mm is None and scale_mm is None:
        return None
    n_inputs = len(kinds)
    offset = np.zeros(n_inputs) if offset_mm is None else offset_mm
    scale = np.ones(n_inputs) if scale_mm is None else scale_mm
    if unit == "m":
        scale = np.array([1000.0 if kind == "mm" else 1.0 for kind in kinds])
    _require_count("--offset-mm", offset, n_inputs, "coordinate of the box")
    _require_count("--scale-mm", scale, n_inputs, "coordinate of the box")
    if not np.all(scale):
        raise IksamplesError("--scale-mm has a zero; positions cannot be divided by it.")
    return Scaling(offset, scale)


def read_as(
    joint_kinds: Sequence[str],
    units: Sequence[str],
    offset: Floats | None,
    scale: Floats | None,
) -> Scaling | None:
    """What makes joint values [rad, mm] of the network's answer; None if nothing is done.

    The answer is multiplied by the scale, the offset is added, and the sum is in ``units``.

    Args:
        joint_kinds: ``revolute`` or ``prismatic``, by joint.
        units: At most one of ``rad``, ``deg`` (revolute joints; rad if none) and at most one of
            ``mm``, ``m`` (prismatic joints; mm if none).
        offset: One value per joint, or None.
        scale: One value per joint, or None.

    Raises:
        IksamplesError: A unit is unknown or of no joint, or something is of another number.
    """
    unknown = [unit for unit in units if unit not in _FACTORS]
    if unknown:
        raise IksamplesError(f"--output-unit {unknown[0]}: give {', '.join(_FACTORS)}.")
    factors: dict[str, Fraction] = {}
    for unit in units:
        kind, factor = _FACTORS[unit]
        if kind not in joint_kinds:
            raise IksamplesError(f"--output-unit {unit}: the arm has no {kind} joint.")
        if kind in factors:
            raise IksamplesError(f"--output-unit: two units of {kind} joints; give one.")
        factors[kind] = factor
    if offset is None and scale is None and all(factor == 1 for factor in factors.values()):
        return None
    n = len(joint_kinds)
    offset = np.zeros(n) if offset is None else offset
    scale = np.ones(n) if scale is None else scale
    _require_count("--output-offset", offset, n, "joint of the arm")
    _require_count("--output-scale", scale, n, "joint of the arm")
    unit_of = np.array([factors.get(kind, Fraction(1)) for kind in joint_kinds], object)
    return Scaling(times(offset, unit_of), times(scale, unit_of))


def _require_count(option: str, values: Floats, n: int, of: str) -> None:
    if values.shape != (n,):
        raise IksamplesError(f"{option} has {len(values)} numbers; one per {of} is needed: {n}.")
    if not np.isfinite(values).all():
        raise IksamplesError(f"{option} has a number that is not finite.")
