"""The networks to certify, checked and in float64."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.enclosure import Expansion, expand
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Layers:
    """Networks of one shape in float64, checked, and scaled so that no size is extreme.

    Attributes:
        weights: One array per layer, shape (networks, in, out).
        biases: One array per layer, shape (networks, out).
        activation: ``"relu"`` or ``"tanh"``.
        offset: What the normalisation subtracts [mm or rad], shape (in,).
        scale: What the normalisation divides by [mm or rad], shape (in,).
    """

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]
    activation: str
    offset: Floats
    scale: Floats

    @classmethod
    def of(cls, network: StackedMLP) -> "Layers":
        """Reads a stack.

        Raises:
            IksamplesError: The activation is unknown, the layers do not fit together, or a number
                is not finite.
        """
        if network.activation not in ("relu", "tanh"):
            raise IksamplesError(
                f"cannot certify a network with activation '{network.activation}'; "
                "known are relu and tanh."
            )
        layers = cls(
            tuple(np.asarray(weight, float) for weight in network.weights),
            tuple(np.asarray(bias, float) for bias in network.biases),
            network.activation,
            np.asarray(network.offset, float),
            np.asarray(network.scale, float),
        )
        width = len(layers.offset)
        for depth, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
            if weight.shape[1] != width or weight.shape[::2] != bias.shape:
                raise IksamplesError(
                    f"layer {depth} of the network does not fit: {weight.shape[1:]} weights, "
                    f"{bias.shape[1:]} biases, {width} inputs."
                )
            width = weight.shape[2]
            for row in range(len(weight)):
                if not (np.isfinite(weight[row]).all() and np.isfinite(bias[row]).all()):
                    raise IksamplesError(
                        f"network {row} of the stack has a weight or bias that is not finite in "
                        f"layer {depth}; a diverged network has no worst case."
                    )
        if layers.scale.shape != layers.offset.shape or not (
            np.isfinite(layers.offset).all()
            and np.isfinite(layers.scale).all()
            and (layers.scale != 0).all()
        ):
            raise IksamplesError("the network's normalisation (offset, scale) is not finite.")
        return layers._balanced() if layers.activation == "relu" else layers

    def _balanced(self) -> "Layers":
        """The same function with the largest number into each ReLU neuron between 1/2 and 1.

        What is taken off is put on behind the neuron: max(0, z) = 2^e max(0, 2^-e z). Powers of two
        change no digit; a neuron of which they would (numbers so small that they vanish) stays.
        """
        weights, biases = list(self.weights), list(self.biases)
        for depth in range(len(weights) - 1):
            into, bias, out = weights[depth], biases[depth], weights[depth + 1]
            size = np.maximum(np.abs(into).max(axis=1), np.abs(bias))
            power = np.frexp(size)[1]
            for _ in range(2):
                with np.errstate(over="ignore", under="ignore"):
                    scaled = (
                        np.ldexp(into, -power[:, None]),
                        np.ldexp(bias, -power),
                        np.ldexp(out, power[:, :, None]),
                    )
                    same = (
                        (np.ldexp(scaled[0], power[:, None]) == into).all(axis=1)
                        & (np.ldexp(scaled[1], power) == bias)
                        & (np.ldexp(scaled[2], -power[:, :, None]) == out).all(axis=2)
                    )
                if same.all():
                    break
                power = np.where(same, power, 0)
            weights[depth], biases[depth], weights[depth + 1] = scaled
        return replace(self, weights=tuple(weights), biases=tuple(biases))

    @property
    def n_networks(self) -> int:
        """Number of stacked networks."""
        return self.weights[0].shape[0]

    @property
    def n_inputs(self) -> int:
        """Width of the input."""
        return self.weights[0].shape[1]

    @property
    def n_outputs(self) -> int:
        """Width of the output."""
        return self.weights[-1].shape[2]

    @property
    def n_symbols(self) -> int:
        """Number of neurons: noise symbols of an enclosure, at most."""
        return sum(weight.shape[2] for weight in self.weights)

    def pieces(self, region: Region) -> Region:
        """A network has no seams."""
        return region

    def expand(self, which: Ints, centre: Floats, radius: Floats, average: bool) -> Expansion:
        """Encloses the networks' answers over boxes (``enclosure.expand``)."""
        return expand(self, which, centre, radius, average)

    def predict(self, x: Floats, which: Ints) -> Floats:
        """Joint values at single points.

        Args:
            x: Inputs [mm or rad], shape (points, in).
            which: The network that each point is for, shape (points,).

        Returns:
            Joint values [rad or mm], shape (points, joints).
        """
        hidden = ((x - self.offset) / self.scale)[:, None, :]
        for depth in range(len(self.weights)):
            hidden = self.through(hidden, depth, which)
            hidden[:, 0] += self.bias(depth, which)
            if depth < len(self.weights) - 1:
                hidden = np.maximum(hidden, 0.0) if self.activation == "relu" else np.tanh(hidden)
        return hidden[:, 0]

    def through(self, rows: Floats, depth: int, which: Ints) -> Floats:
        """Rows (batch, rows, in) times the weights of a layer."""
        weight = self.weights[depth]
        if len(weight) == 1:
            batch, count, width = rows.shape
            return (rows.reshape(-1, width) @ weight[0]).reshape(batch, count, -1)
        return rows @ weight[which]

    def weight(self, depth: int, which: Ints) -> Floats:
        """Weights of a layer for each item of a batch, shape (batch or 1, in, out)."""
        weight = self.weights[depth]
        return weight if len(weight) == 1 else weight[which]

    def bias(self, depth: int, which: Ints) -> Floats:
        """Biases of a layer for each item of a batch, shape (batch or 1, out)."""
        bias = self.biases[depth]
        return bias if len(bias) == 1 else bias[which]
