"""The trained networks as plain arrays: what every later step reads, without torch."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.errors import IksamplesError, in_a_line
from iksamples.files import checked, require_plain


Floats = NDArray[np.float64]
Weights = NDArray[np.floating]  # float32 where trained here

ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
}
"""Activation name -> function on arrays."""

_POINTS, _NEURONS = 2**14, 2**22
"""Points of a network, and values of its widest layer, that are worked out at once."""


@dataclass(frozen=True, eq=False)
class StackedMLP:
    """Networks of one shape that differ by seed, stacked along a leading axis.

    An input is normalised, ``(x - offset) / scale``, and sent through dense layers with an
    activation between them; the last layer is linear and gives joint values (paper, Eq. 9 and 10).

    Attributes:
        weights: One array per layer, shape (seeds, in, out).
        biases: One array per layer, shape (seeds, out).
        activation: Key of ``ACTIVATIONS``.
        offset: What the normalisation subtracts [mm or rad], shape (in,).
        scale: What the normalisation divides by [mm or rad], shape (in,).
        seeds: The seed of each stacked network.
    """

    weights: tuple[Weights, ...]
    biases: tuple[Weights, ...]
    activation: str
    offset: Floats
    scale: Floats
    seeds: tuple[int, ...]

    @property
    def n_seeds(self) -> int:
        """Number of stacked networks."""
        return len(self.seeds)

    def predict(self, x: ArrayLike) -> Floats:
        """Joint values that the networks answer with, evaluated in float64.

        Args:
            x: Inputs [mm or rad], shape (points, in).

        Returns:
            Joint values [rad or mm], shape (seeds, points, joints).
        """
        x = np.asarray(x, float)
        points = [slice(i, i + _POINTS) for i in range(0, len(x), _POINTS)] or [slice(0)]
        widest = max(bias.shape[1] for bias in self.biases)
        n_rows = max(1, _NEURONS // (widest * min(_POINTS, len(x) or 1)))
        answers = np.empty((self.n_seeds, len(x), self.biases[-1].shape[1]))
        for first in range(0, self.n_seeds, n_rows):
            rows = slice(first, first + n_rows)
            weights = [weight[rows].astype(float) for weight in self.weights]
            biases = [bias[rows].astype(float)[:, None, :] for bias in self.biases]
            for some in points:
                hidden = (x[some] - self.offset) / self.scale
                for depth, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
                    hidden = hidden @ weight + bias
                    if depth < len(weights) - 1:
                        hidden = ACTIVATIONS[self.activation](hidden)
                answers[rows, some] = hidden
        return answers

    def select(self, rows: ArrayLike) -> Self:
        """The networks in the given rows of the stack, in that order."""
        index = np.atleast_1d(np.asarray(rows, int))
        return replace(
            self,
            weights=tuple(weight[index] for weight in self.weights),
            biases=tuple(bias[index] for bias in self.biases),
            seeds=tuple(self.seeds[i] for i in index),
        )

    def finite_rows(self) -> list[int]:
        """The rows of the stack whose weights are all finite."""
        layers = (*self.weights, *self.biases)
        return [k for k in range(self.n_seeds) if all(np.isfinite(a[k]).all() for a in layers)]

    def save(self, path: str | Path) -> None:
        """Writes the stack as a safetensors file, which runs no code when it is loaded."""
        tensors = {"offset": self.offset, "scale": self.scale}
        tensors |= layer_tensors(self.weights, self.biases)
        write_tensors(path, tensors, {"activation": self.activation, "seeds": list(self.seeds)})

    @classmethod
    def load(cls, path: str | Path) -> "StackedMLP":
        """Reads what ``save`` wrote.

        Raises:
            IksamplesError: The file cannot be read or holds no such stack.
        """
        tensors, header = read_tensors(path)
        try:
            network = cls(
                *layers_of(tensors),
                header["activation"],
                tensors["offset"],
                tensors["scale"],
                tuple(header["seeds"]),
            )
            network.require_sound()
        except (KeyError, TypeError, ValueError):
            raise IksamplesError(f"{path}: not a file of trained networks.") from None
        return network

    def require_sound(self) -> None:
        """Stops where the arrays do not fit together.

        Raises:
            ValueError: They do not.
        """
        widths = [len(self.offset), *(bias.shape[-1] for bias in self.biases)]
        shapes = [(self.n_seeds, *ends) for ends in pairwise(widths)]
        sound = (
            [weight.shape for weight in self.weights] == shapes
            and [bias.shape for bias in self.biases] == [(self.n_seeds, n) for n in widths[1:]]
            and self.offset.shape == self.scale.shape == (widths[0],)
            and all(array.dtype.kind == "f" for array in (*self.weights, *self.biases))
            and all(array.dtype.kind == "f" for array in (self.offset, self.scale))
            and all(isinstance(seed, int) for seed in self.seeds)
            and self.activation in ACTIVATIONS
            and min(self.n_seeds, *widths) > 0
        )
        if not (sound and len(self.weights)):
            raise ValueError


def layer_tensors(weights: Sequence[NDArray], biases: Sequence[NDArray]) -> dict[str, NDArray]:
    """The layers of networks, stacked in whatever way, by the names that they have in a file."""
    return {
        f"layers.{depth}.{part}": np.ascontiguousarray(array)
        for depth, layer in enumerate(zip(weights, biases, strict=True))
        for part, array in zip(("weight", "bias"), layer, strict=True)
    }


def layers_of(tensors: dict[str, NDArray]) -> tuple[tuple[Weights, ...], tuple[Weights, ...]]:
    """The weights and the biases among the tensors of a file, ``layer_tensors`` undone."""
    depths = range(sum(key.endswith(".weight") for key in tensors))
    weights, biases = (
        tuple(tensors[f"layers.{depth}.{part}"] for depth in depths) for part in ("weight", "bias")
    )
    return weights, biases


def write_tensors(path: str | Path, tensors: dict[str, NDArray], header: dict[str, Any]) -> None:
    """Writes named arrays and a JSON header as a safetensors file, the same bytes every time."""
    from safetensors.numpy import save

    # One entry: the format keeps several in no order of its own. Its own writer, `save_file`, would
    # leave a file under a name of its own after a kill.
    Path(path).write_bytes(save(tensors, {"iksamples": json.dumps(header)}))


def read_tensors(path: str | Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Reads what ``write_tensors`` wrote.

    Raises:
        IksamplesError: The file cannot be read or was not written by iksamples.
    """
    from safetensors import SafetensorError, safe_open

    try:
        require_plain(path)
        with safe_open(str(checked(path)), framework="numpy") as file:
            header = json.loads(file.metadata()["iksamples"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise IksamplesError(
            f"{path}: not a file of trained networks ({in_a_line(error)})."
        ) from None
    return tensors, header
