"""A network as a file has it, and how its user feeds it and reads its answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from iksamples.certify.readers.exact import Floats, Numbers, plus, times, to_floats
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


@dataclass(frozen=True, eq=False)
class Scaling:
    """A map of each value by itself.

    Attributes:
        offset: What is subtracted before (inputs) or added after (outputs), shape (values,).
        scale: What is divided by before, or multiplied by after, shape (values,).
    """

    offset: Numbers
    scale: Numbers


@dataclass(frozen=True, eq=False)
class FileNetwork:
    """``W_L act(... act(W_1 (x - offset) / scale + b_1) ...) + b_L``, without rounding.

    Attributes:
        names: What the file calls each layer.
        layers: Weights, shape (in, out), and biases, shape (out,), of each layer.
        activation: What is between the layers.
        inputs: What is done to the inputs before the first layer.
        scaled_twice: Whether ``inputs`` stands for more than one difference and one quotient.
    """

    names: tuple[str, ...]
    layers: tuple[tuple[Numbers, Numbers], ...]
    activation: str
    inputs: Scaling
    scaled_twice: bool = False

    @property
    def folded(self) -> bool:
        """Whether the file or its user does in more operations what these layers do."""
        return self.scaled_twice or any(
            numbers.dtype == object for layer in self.layers for numbers in layer
        )

    @property
    def n_inputs(self) -> int:
        """Values that go in."""
        return len(self.layers[0][0])

    @property
    def n_outputs(self) -> int:
        """Values that come out."""
        return len(self.layers[-1][1])

    def fed(self, first: Scaling) -> "FileNetwork":
        """The same network after ``(x - offset) / scale``."""
        own = self.inputs
        return replace(
            self,
            inputs=Scaling(
                plus(first.offset, times(first.scale, own.offset)), times(first.scale, own.scale)
            ),
            scaled_twice=self.scaled_twice
            or bool(np.any(own.offset != 0) or np.any(own.scale != 1)),
        )

    def answering(self, then: Scaling) -> "FileNetwork":
        """The same network before ``scale y + offset``."""
        weight, bias = self.layers[-1]
        last = times(weight, then.scale), plus(times(bias, then.scale), then.offset)
        return replace(self, layers=(*self.layers[:-1], last))

    def stacked(self) -> tuple[StackedMLP, bool]:
        """The network to certify, and whether it is this one to the last bit.

        Where it is not, every number is off by at most half a unit in its last place.

        Raises:
            IksamplesError: A number is not finite or beyond float64, or a scale is zero.
        """
        offset, same = to_floats(self.inputs.offset)
        scale, scale_same = to_floats(self.inputs.scale)
        same = same and scale_same
        if not (np.isfinite(offset).all() and np.isfinite(scale).all()):
            raise IksamplesError("is fed with an offset or a scale that is not finite")
        if not (scale != 0).all():
            raise IksamplesError("has a scale of zero")
        weights: list[Floats] = []
        biases: list[Floats] = []
        for name, (weight, bias) in zip(self.names, self.layers, strict=True):
            for numbers, kept in ((weight, weights), (bias, biases)):
                floats, exact = to_floats(numbers)
                if not np.isfinite(floats).all():
                    raise IksamplesError(
                        f"has a weight or bias in layer '{name}' that is not finite, so there is "
                        "no worst case; the training has diverged"
                    )
                kept.append(floats[None])
                same = same and exact
        network = StackedMLP(tuple(weights), tuple(biases), self.activation, offset, scale, (0,))
        return network, same

    def in_words(self) -> str:
        """The layers in the order in which they are used."""
        parts = [f"{self.n_inputs} inputs"]
        for depth, (name, (_, bias)) in enumerate(zip(self.names, self.layers, strict=True)):
            parts.append(f"{name} ({len(bias)})")
            if depth + 1 < len(self.layers):
                parts.append(self.activation)
        return ", ".join([*parts, f"{self.n_outputs} outputs"])


def unscaled(n: int) -> Scaling:
    """The map that changes nothing."""
    return Scaling(np.zeros(n), np.ones(n))


# 40 digits: what is left out is far below the rounding of the product.
_RAD_PER_DEG = Fraction("3.141592653589793238462643383279502884197") / 180
_UNITS = {
    "rad": ("rad", Fraction(1)),
    "deg": ("rad", _RAD_PER_DEG),
    "mm": ("mm", Fraction(1)),
    "m": ("mm", Fraction(1000)),
}
"""Units by name: the one used here, and how many of it they are."""


def fed_as(
    ours: Sequence[str], units: Sequence[str], offset_mm: Floats | None, scale_mm: Floats | None
) -> Scaling | None:
    """What is done to an input [mm or rad] before the network gets it; None if nothing is.

    Args:
        ours: Unit of each coordinate of the box: ``mm`` or ``rad``.
        units: What the network takes: at most one of ``mm``, ``m`` (mm if none) and at most one
            of ``rad``, ``deg`` (rad if none).
        offset_mm: What is subtracted first [mm or rad], shape (in,); zero if None.
        scale_mm: What it is divided by then [mm or rad], shape (in,).

    Raises:
        IksamplesError: The options contradict each other, or are of another number.
    """
    things = {"mm": "length", "rad": "angle"}
    unit_of = _of_ours("--input-unit", units, ours, "no {} is among the inputs", things)
    if units and scale_mm is not None:
        raise IksamplesError(
            "--scale-mm says already what the network takes (the inputs divided by it); leave "
            "out --input-unit."
        )
    if np.all(unit_of == 1) and offset_mm is None and scale_mm is None:
        return None
    n_inputs = len(ours)
    offset = np.zeros(n_inputs) if offset_mm is None else offset_mm
    scale = unit_of if scale_mm is None else scale_mm
    _require_count("--offset-mm", offset, n_inputs, "coordinate of the box")
    if scale_mm is not None:
        _require_count("--scale-mm", scale, n_inputs, "coordinate of the box")
    if not np.all(scale):
        raise IksamplesError("--scale-mm has a zero; positions cannot be divided by it.")
    return Scaling(offset, scale)


def read_as(
    ours: Sequence[str],
    units: Sequence[str],
    offset: Floats | None,
    scale: Floats | None,
) -> Scaling | None:
    """What makes joint values [rad, mm] of the network's answer; None if nothing is done.

    The answer is multiplied by the scale, the offset is added, and the sum is in ``units``.

    Args:
        ours: Unit of each joint: ``mm`` or ``rad``.
        units: At most one of ``rad``, ``deg`` (revolute joints; rad if none) and at most one of
            ``mm``, ``m`` (prismatic joints; mm if none).
        offset: One value per joint, or None.
        scale: One value per joint, or None.

    Raises:
        IksamplesError: A unit is unknown or of no joint, or something is of another number.
    """
    things = {"mm": "prismatic joint", "rad": "revolute joint"}
    unit_of = _of_ours("--output-unit", units, ours, "the arm has no {}", things)
    if offset is None and scale is None and np.all(unit_of == 1):
        return None
    n = len(ours)
    offset = np.zeros(n) if offset is None else offset
    scale = np.ones(n) if scale is None else scale
    _require_count("--output-offset", offset, n, "joint of the arm")
    _require_count("--output-scale", scale, n, "joint of the arm")
    return Scaling(times(offset, unit_of), times(scale, unit_of))


def _of_ours(
    option: str, units: Sequence[str], ours: Sequence[str], none: str, things: dict[str, str]
) -> Numbers:
    """How many mm or rad the unit of each value is, shape (values,)."""
    found: dict[str, Fraction] = {}
    for unit in units:
        if unit not in _UNITS:
            raise IksamplesError(f"{option} {unit}: give {', '.join(_UNITS)}.")
        kind, factor = _UNITS[unit]
        if kind not in ours:
            raise IksamplesError(f"{option} {unit}: {none.format(things[kind])}.")
        if kind in found:
            raise IksamplesError(f"{option}: two units of {things[kind]}s; give one.")
        found[kind] = factor
    return np.array([found.get(kind, Fraction(1)) for kind in ours], object)


def _require_count(option: str, values: Floats, n: int, of: str) -> None:
    if values.shape != (n,):
        raise IksamplesError(f"{option} has {len(values)} numbers; one per {of} is needed: {n}.")
    if not np.isfinite(values).all():
        raise IksamplesError(f"{option} has a number that is not finite.")
