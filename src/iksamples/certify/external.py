"""Networks from elsewhere: our own files, plain PyTorch state dicts, and ONNX where installed."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]


def load_network(
    path: str | Path,
    *,
    activation: str | None = None,
    offset_mm: ArrayLike | None = None,
    scale_mm: ArrayLike | None = None,
) -> StackedMLP:
    """Reads networks to certify; no code of the file is run.

    Args:
        path: ``.safetensors`` (ours, or a state dict), ``.pt`` or ``.pth`` (a state dict of Linear
            layers with one activation between them) or ``.onnx``.
        activation: ``relu`` or ``tanh``; needed for a state dict, which does not say.
        offset_mm: What is subtracted from a position before the first layer [mm], shape (in,);
            zero if None. Our own files and ONNX say it themselves.
        scale_mm: What it is divided by then [mm], shape (in,); one if None.

    Returns:
        The networks; one of seed 0 unless the file is ours.

    Raises:
        IksamplesError: The file cannot be read or holds anything but such a network.
    """
    path = Path(path)
    if not path.is_file():
        raise IksamplesError(f"{path}: no such file.")
    if path.suffix == ".onnx":
        return _from_onnx(path)
    if path.suffix == ".safetensors":
        if _is_ours(path):
            return StackedMLP.load(path)
        state = _safetensors_state(path)
    elif path.suffix in (".pt", ".pth"):
        state = _torch_state(path)
    else:
        raise IksamplesError(
            f"{path}: unknown kind of file; give a .safetensors, .pt, .pth or .onnx file."
        )
    if activation not in ("relu", "tanh"):
        raise IksamplesError(
            f"{path}: a state dict does not say which activation is between its layers; "
            "name relu or tanh."
        )
    layers = _linear_layers(state, path)
    n_inputs = layers[0][0].shape[0]
    return _network(
        layers,
        activation,
        np.zeros(n_inputs) if offset_mm is None else np.asarray(offset_mm, float),
        np.ones(n_inputs) if scale_mm is None else np.asarray(scale_mm, float),
        path,
    )


def _network(
    layers: list[tuple[NDArray, NDArray]],
    activation: str,
    offset_mm: Floats,
    scale_mm: Floats,
    path: Path,
) -> StackedMLP:
    """One network as a stack, once its layers fit together."""
    width = layers[0][0].shape[0]
    if offset_mm.shape != (width,) or scale_mm.shape != (width,):
        raise IksamplesError(
            f"{path}: the network has {width} inputs; offset and scale need a value for each."
        )
    for weight, bias in layers:
        if weight.shape[0] != width or bias.shape != weight.shape[1:]:
            raise IksamplesError(
                f"{path}: a layer of shape {weight.shape} with {bias.shape} biases does not fit "
                f"the {width} values before it."
            )
        width = weight.shape[1]
    return StackedMLP(
        tuple(weight[None] for weight, _ in layers),
        tuple(bias[None] for _, bias in layers),
        activation,
        offset_mm,
        scale_mm,
        (0,),
    )


def _is_ours(path: Path) -> bool:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            return "iksamples" in (file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise IksamplesError(f"{path}: not a safetensors file ({error}).") from None


def _safetensors_state(path: Path) -> dict[str, NDArray]:
    from safetensors.torch import load_file  # knows the short float formats too

    return {key: _plain(value) for key, value in load_file(str(path)).items()}


def _torch_state(path: Path) -> dict[str, NDArray]:
    import pickle

    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError) as error:
        reason = str(error).split("\n")[0]
        raise IksamplesError(
            f"{path}: not a plain state dict ({reason}). Save model.state_dict(), not the model."
        ) from None
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(
        isinstance(value, torch.Tensor) for value in content.values()
    ):
        raise IksamplesError(f"{path}: not a state dict; save model.state_dict().")
    return {str(key): _plain(value) for key, value in content.items()}


def _plain(tensor: Any) -> NDArray:
    """A tensor as an array; formats shorter than float32 are exact in it."""
    import torch

    return (tensor if tensor.dtype == torch.float64 else tensor.float()).detach().numpy()


def _linear_layers(state: Mapping[str, NDArray], path: Path) -> list[tuple[NDArray, NDArray]]:
    """Weights (in, out) and biases of the linear layers, in the order of the model.

    PyTorch keeps a state dict in the order of the model; a file that sorts its names is put into
    the order of the numbers in them.
    """
    names = [key.removesuffix(".weight") for key in state if key.endswith(".weight")]
    others = [
        key
        for key in state
        if key.removesuffix(".weight") not in names and key.removesuffix(".bias") not in names
    ]
    if not names or others or any(state[f"{name}.weight"].ndim != 2 for name in names):
        strange = others or [n for n in names if state[f"{n}.weight"].ndim != 2] or ["nothing"]
        raise IksamplesError(
            f"{path}: not only linear layers ({', '.join(strange[:3])}); a network of Linear, ReLU "
            "or Tanh layers is needed."
        )
    if list(state) == sorted(state):
        names.sort(key=_natural)
    layers = []
    for name in names:
        weight = state[f"{name}.weight"].T
        bias = state.get(f"{name}.bias")
        layers.append((weight, np.zeros(weight.shape[1], weight.dtype) if bias is None else bias))
    return layers


def _natural(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in name.split(".")]


def _from_onnx(path: Path) -> StackedMLP:
    """A chain of Sub, Div, Gemm or MatMul and Add, and one kind of activation.

    Raises:
        IksamplesError: The ``onnx`` package is missing, or the graph is of another shape.
    """
    try:
        onnx = import_module("onnx")  # not a dependency, so not a plain import
        numpy_helper = import_module("onnx.numpy_helper")
    except ImportError:
        raise IksamplesError(
            f"{path}: reading ONNX needs the onnx package (pip install onnx)."
        ) from None
    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:
        # The parser raises its own kinds, not exported by the package.
        raise IksamplesError(f"{path}: not an ONNX file ({error}).") from None
    constants = {item.name: numpy_helper.to_array(item) for item in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            constants[node.output[0]] = numpy_helper.to_array(node.attribute[0].t)
    return _from_nodes(
        [
            (
                node.op_type,
                [name for name in node.input if name not in constants],
                [(k, constants[name]) for k, name in enumerate(node.input) if name in constants],
                node.output[0],
                {item.name: item for item in node.attribute},
            )
            for node in graph.node
            if node.op_type != "Constant"
        ],
        path,
    )


def _from_nodes(nodes: list[tuple[str, list[str], list, str, dict]], path: Path) -> StackedMLP:
    """The network of a chain of operations."""
    layers: list[tuple[NDArray, NDArray]] = []
    activations: list[str] = []
    offset: Floats | None = None
    scale: Floats | None = None
    value: str | None = None

    def refuse(what: str) -> IksamplesError:
        return IksamplesError(
            f"{path}: {what}; a chain of (Sub, Div,) Gemm or MatMul + Add, and Relu or Tanh is "
            "needed."
        )

    for kind, inputs, constants, output, attributes in nodes:
        if len(inputs) != 1 or (value is not None and inputs[0] != value):
            raise refuse("the graph is not a chain")
        value = output
        fresh = not layers and not activations
        if kind in ("Identity", "Cast") or (kind == "Flatten" and fresh):
            continue
        if kind in ("Sub", "Div") and fresh and constants and constants[0][0] == 1:
            number = np.asarray(constants[0][1], float).reshape(-1)
            if kind == "Sub" and offset is None and scale is None:
                offset = number
            elif kind == "Div" and scale is None:
                scale = number
            else:
                raise refuse(f"more than one {kind} before the first layer")
        elif kind in ("Gemm", "MatMul") and constants and constants[0][0] == 1:
            if len(layers) != len(activations):
                raise refuse("two linear layers without an activation between them")
            weight = constants[0][1]
            if kind == "Gemm":
                plain = all(
                    name not in attributes or attributes[name].f == 1.0
                    for name in ("alpha", "beta")
                ) and not ("transA" in attributes and attributes["transA"].i)
                if not plain:
                    raise refuse("a Gemm with a factor or a transposed input")
                weight = weight.T if "transB" in attributes and attributes["transB"].i else weight
            bias = constants[1][1] if len(constants) > 1 else np.zeros(weight.shape[1], "float32")
            layers.append((weight, np.asarray(bias).reshape(-1)))
        elif kind == "Add" and constants and len(layers) == len(activations) + 1:
            weight, bias = layers[-1]
            if np.any(bias):
                raise refuse("a layer with two biases")
            layers[-1] = (weight, np.asarray(constants[0][1]).reshape(-1))
        elif kind in ("Relu", "Tanh") and len(layers) == len(activations) + 1:
            activations.append(kind.lower())
        else:
            raise refuse(f"an operation {kind} that is not supported here")
    if not layers or len(layers) != len(activations) + 1 or len(set(activations)) > 1:
        raise refuse("no linear layer at the end, or different activations")
    width = layers[0][0].shape[0]
    ones = np.ones(width)
    return _network(
        layers,
        activations[0] if activations else "relu",
        (np.zeros(width) if offset is None else offset) * ones,
        (ones if scale is None else scale) * ones,
        path,
    )
