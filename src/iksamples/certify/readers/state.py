"""A state dict as a network: which layers it has, and in which order."""

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.readers.checkpoint import Tensor
from iksamples.certify.readers.layers import FileNetwork, unscaled
from iksamples.errors import IksamplesError


_MOST_TRIED = 10_000
"""Partial orders that are looked at before the order counts as not known."""

Layer = tuple[NDArray, NDArray]


def network_of(
    state: Mapping[str, Any],
    activation: str | None,
    order: Sequence[str] | None,
    n_inputs: int,
    n_outputs: int,
) -> FileNetwork:
    """The network of a state dict of Linear layers (weights of shape (out, in)).

    The order is the only one in which layers fit together whose names differ by numbers alone are
    in the order of these numbers; else it has to be given.

    Args:
        state: Name -> tensor, as PyTorch names them.
        activation: ``relu`` or ``tanh``, which a state dict does not say.
        order: The layers in the order of use, if given.
        n_inputs: Values that go in.
        n_outputs: Values that come out.

    Raises:
        IksamplesError: It is not such a state dict, or its order is not known.
    """
    if activation not in ("relu", "tanh"):
        raise IksamplesError(
            "is a state dict, which does not say the activation between its layers; give "
            "--activation relu or --activation tanh (other activations cannot be certified)"
        )
    layers = _linear(state, named=order is not None)
    if order is None:
        names = _order(layers, n_inputs, n_outputs)
    else:
        names = list(order)
        if sorted(names) != sorted(layers):
            raise IksamplesError(
                f"has the layers {', '.join(layers)}; --layers has to name each of them once"
            )
        if not _fit(layers, names):
            raise IksamplesError(f"has layers that do not fit in this order: {_widths(layers)}")
    return FileNetwork(
        tuple(names),
        tuple(layers[name] for name in names),
        activation,
        unscaled(len(layers[names[0]][0])),
    )


def _linear(state: Mapping[str, Any], named: bool) -> dict[str, Layer]:
    """Weights (in, out) and biases of the layers."""
    layers: dict[str, Layer] = {}
    strange = []
    for key, value in state.items():
        name, _, part = key.rpartition(".")
        weight = state.get(f"{name}.weight" if name else "weight")
        shape = weight.shape if isinstance(weight, Tensor) else ()
        wanted = {"weight": shape, "bias": shape[:1]}.get(part)
        found = value.shape if isinstance(value, Tensor) else type(value).__name__
        if len(shape) != 2 or 0 in shape or found != wanted:
            strange.append(f"{key} {found}")
    if strange or not state:
        more = ", ..." if len(strange) > 3 else ""
        raise IksamplesError(
            f"has more than Linear layers: {', '.join(strange[:3])}{more}; a state dict does not "
            "say what they do, so export the network as ONNX"
        )
    for key, value in state.items():
        name, _, part = key.rpartition(".")
        if part == "bias":
            continue
        bias = state.get(f"{name}.bias" if name else "bias")
        if bias is None and not named:
            raise IksamplesError(
                f"has a layer '{name}' without bias, which may be an embedding; if it is Linear, "
                "give the layers in their order: --layers a,b,c"
            )
        weight = _array(key, value).T
        layers[name or "weight"] = (
            weight,
            np.zeros(weight.shape[1]) if bias is None else _array(f"{name}.bias", bias),
        )
    return layers


def _array(key: str, tensor: Tensor) -> NDArray:
    try:
        return tensor.array()
    except IksamplesError as error:
        raise IksamplesError(f"cannot be read: {key} {error}") from None


def _fit(layers: Mapping[str, Layer], names: Sequence[str]) -> bool:
    return all(len(layers[a][1]) == len(layers[b][0]) for a, b in pairwise(names))


def _widths(layers: Mapping[str, Layer]) -> str:
    return ", ".join(f"{name} ({len(w)} to {len(b)})" for name, (w, b) in layers.items())


def _order(layers: Mapping[str, Layer], n_inputs: int, n_outputs: int) -> list[str]:
    """The only order that the numbers in the names and the widths of the layers allow.

    Names that differ in nothing but numbers are in the order of these numbers.

    Raises:
        IksamplesError: There is none, or more than one.
    """
    numbers = {name: tuple(map(int, re.findall(r"\d+", name))) for name in layers}
    texts = {name: re.sub(r"\d+", "#", name) for name in layers}
    alike = sorted(layers, key=numbers.__getitem__)
    if len(set(texts.values())) == 1 and len(set(numbers.values())) == len(layers):
        if _fit(layers, alike):
            return alike
        raise IksamplesError(
            f"has layers that do not fit in the order of their names: {_widths(layers)}"
        )

    def may_follow(names: list[str], width: int) -> list[str]:
        left = [name for name in alike if name not in names]
        first = {texts[name]: numbers[name] for name in reversed(left)}
        return [n for n in left if len(layers[n][0]) == width and numbers[n] == first[texts[n]]]

    found: list[list[str]] = []
    tried = 0
    waiting: list[list[str]] = [[]]
    while waiting and len(found) < 2 and tried < _MOST_TRIED:
        tried += 1
        names = waiting.pop()
        width = len(layers[names[-1]][1]) if names else n_inputs
        if len(names) == len(layers) and width == n_outputs:
            found.append(names)
        waiting += [[*names, name] for name in may_follow(names, width)]
    if len(found) == 1 and not waiting:
        return found[0]
    if not found and not waiting:
        raise IksamplesError(
            f"has layers that lead in no order from {n_inputs} inputs to {n_outputs} outputs: "
            f"{_widths(layers)}"
        )
    raise IksamplesError(
        f"does not say the order of its layers {', '.join(layers)}; give it: --layers a,b,c"
    )
