"""A network as it is written out: float32 steps from one unit to another."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.task import Space


Weights = NDArray[np.float32]

_PER_UNIT = {"mm": 1.0, "rad": 1.0, "m": 1e-3, "deg": 180.0 / np.pi}
_OURS = {"mm": "mm", "m": "mm", "rad": "rad", "deg": "rad"}


@dataclass(frozen=True, eq=False)
class PlainNetwork:
    """``(W_L act(... act(W_1 (x to_mm - offset) / scale + b_1) ...) + b_L) from_rad``, in float32.

    Attributes:
        layers: Weights, shape (in, out), and biases, shape (out,).
        activation: ``relu`` or ``tanh``.
        to_ours: What an input is multiplied by first: 1000 for metres, else 1, shape (in,).
        offset: What is subtracted then [mm or rad], shape (in,).
        scale: What it is divided by then [mm or rad], shape (in,).
        from_ours: What an answer is multiplied by: 180 / pi for degrees, 0.001 for metres, else 1.
        inputs: Name and unit of each input.
        outputs: Name and unit of each output.
    """

    layers: tuple[tuple[Weights, Weights], ...]
    activation: str
    to_ours: Weights
    offset: Weights
    scale: Weights
    from_ours: Weights
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]


def plain_network(
    network: StackedMLP, x: Space, q: Space, input_unit: str, output_units: Sequence[str]
) -> PlainNetwork:
    """One network as it is written out.

    Args:
        network: A stack of one.
        x: Its inputs.
        q: Its joints.
        input_unit: ``mm`` or ``m`` for lengths among the inputs; angles are in rad.
        output_units: At most one of ``rad``, ``deg`` and one of ``mm``, ``m``.

    Raises:
        IksamplesError: A unit is unknown, or a number is too large for float32.
    """
    if input_unit not in ("mm", "m"):
        raise IksamplesError(f"--input-unit {input_unit}: give mm or m.")
    unknown = [unit for unit in output_units if unit not in _OURS]
    if unknown:
        raise IksamplesError(f"--output-unit {unknown[0]}: give {', '.join(_OURS)}.")
    wanted = {_OURS[unit]: unit for unit in output_units}
    given = [input_unit if unit == "mm" else unit for unit in x.units]
    asked = [wanted.get(unit, unit) for unit in q.units]
    with np.errstate(over="ignore"):
        numbers = PlainNetwork(
            tuple(
                (weight[0].astype(np.float32), bias[0].astype(np.float32))
                for weight, bias in zip(network.weights, network.biases, strict=True)
            ),
            network.activation,
            np.array([1000.0 if unit == "m" else 1.0 for unit in given], np.float32),
            network.offset_mm.astype(np.float32),
            network.scale_mm.astype(np.float32),
            np.array([_PER_UNIT[unit] for unit in asked], np.float32),
            tuple(zip(x.names, given, strict=True)),
            tuple(zip(q.names, asked, strict=True)),
        )
    if not (np.isfinite(numbers.offset).all() and np.isfinite(numbers.scale).all()):
        raise IksamplesError("the network's scaling is too large for float32.")
    return numbers
