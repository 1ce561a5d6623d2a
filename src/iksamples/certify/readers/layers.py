"""A network as a file has it: layers with one activation between them, and exact maps around."""

from dataclasses import dataclass, replace

import numpy as np

from iksamples.certify.readers.exact import (
    Floats,
    Numbers,
    plus,
    times,
    to_floats,
)
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
