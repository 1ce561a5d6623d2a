"""A network as it is written out: float32 steps between units, as an ONNX graph and as C."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iksamples.columns import UNITS
from iksamples.errors import IksamplesError, one_line
from iksamples.network import StackedMLP
from iksamples.task import Space


if TYPE_CHECKING:
    from onnx import ModelProto


Weights = NDArray[np.float32]


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
        output_units: At most one of ``rad``, ``deg`` and one of ``mm``, ``m``, as ``read_as`` has
            checked.

    Raises:
        IksamplesError: The inputs' unit is unknown, or a number is too large for float32.
    """
    if input_unit not in ("mm", "m"):
        raise IksamplesError(f"--input-unit {input_unit}: give mm or m.")
    given = [input_unit if unit == "mm" else unit for unit in x.units]
    asked = [next((one for one in output_units if one in UNITS[unit]), unit) for unit in q.units]
    with np.errstate(over="ignore"):
        numbers = PlainNetwork(
            tuple(
                (weight[0].astype(np.float32), bias[0].astype(np.float32))
                for weight, bias in zip(network.weights, network.biases, strict=True)
            ),
            network.activation,
            np.array([UNITS[a][b] for a, b in zip(x.units, given, strict=True)], np.float32),
            network.offset.astype(np.float32),
            network.scale.astype(np.float32),
            np.array([1 / UNITS[a][b] for a, b in zip(q.units, asked, strict=True)], np.float32),
            tuple(zip(x.names, given, strict=True)),
            tuple(zip(q.names, asked, strict=True)),
        )
    if not (np.isfinite(numbers.offset).all() and np.isfinite(numbers.scale).all()):
        raise IksamplesError("the network's scaling is too large for float32.")
    return numbers


_OPSET, _IR = 17, 8
"""Old enough for the runtimes of the last years."""

INPUT, OUTPUT = "position", "joints"


def onnx_model(network: PlainNetwork, about: dict[str, str]) -> "ModelProto":
    """The graph: a batch of inputs, shape (batch, in), to joint values, shape (batch, joints).

    Args:
        network: The network.
        about: What goes into the file's metadata, by key.
    """
    from onnx import TensorProto, helper, numpy_helper

    steps: list[tuple[str, list[tuple[str, np.ndarray]]]] = []
    if np.any(network.to_ours != 1):
        steps.append(("Mul", [("millimetres", network.to_ours)]))
    steps += [("Sub", [("offset", network.offset)]), ("Div", [("scale", network.scale)])]
    for depth, (weight, bias) in enumerate(network.layers):
        if depth:
            steps.append(({"relu": "Relu", "tanh": "Tanh"}[network.activation], []))
        steps.append(("Gemm", [(f"weight{depth}", weight), (f"bias{depth}", bias)]))
    if np.any(network.from_ours != 1):
        steps.append(("Mul", [("unit", network.from_ours)]))

    nodes, constants, value = [], [], INPUT
    for k, (kind, operands) in enumerate(steps):
        after = OUTPUT if k == len(steps) - 1 else f"value{k}"
        nodes.append(helper.make_node(kind, [value, *(name for name, _ in operands)], [after]))
        constants += [numpy_helper.from_array(array, name) for name, array in operands]
        value = after
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", len(columns)])
        for name, columns in ((INPUT, network.inputs), (OUTPUT, network.outputs))
    ]
    graph = helper.make_graph(nodes, "inverse_kinematics", ends[:1], ends[1:], constants)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR
    )
    model.producer_name = "iksamples"
    units = {"inputs": network.inputs, "outputs": network.outputs}
    named = {key: ", ".join(f"{a} [{b}]" for a, b in columns) for key, columns in units.items()}
    helper.set_model_props(model, named | about)
    return model


def c_source(network: PlainNetwork, about: Sequence[str]) -> str:
    """A file with ``void ik(const float x[], float q[])``; of the C library it uses tanhf at most.

    Args:
        network: The network.
        about: Lines of the comment that it begins with.
    """
    inputs, outputs = len(network.inputs), len(network.outputs)
    comment = list(about)
    for name, columns in (("x", network.inputs), ("q", network.outputs)):
        comment += [f"{name}[{k}]: {of} [{unit}]" for k, (of, unit) in enumerate(columns)]
    # Names of joints and files may hold anything.
    comment = [one_line(line).replace("*/", "* /").replace("/*", "/ *") for line in comment]
    lines = ["/*", *(f" * {line}".rstrip() for line in comment), " */", ""]
    if network.activation == "tanh" and len(network.layers) > 1:
        lines += ["#include <math.h>", ""]
    lines += [f"void ik(const float x[{inputs}], float q[{outputs}])", "{"]
    for depth, (weight, bias) in enumerate(network.layers):
        rows = ",\n".join(f"        {_numbers(row)}" for row in weight.T)
        lines.append(
            f"    static const float w{depth}[{weight.shape[1]}][{weight.shape[0]}] = {{\n{rows}}};"
        )
        lines.append(f"    static const float b{depth}[{len(bias)}] = {_numbers(bias)};")
    lines += [f"    float v0[{inputs}];", ""]
    for k in range(inputs):
        given = f"x[{k}]"
        if network.to_ours[k] != 1:
            given += f" * {_number(network.to_ours[k])}"
        offset, scale = _number(network.offset[k]), _number(network.scale[k])
        lines.append(f"    v0[{k}] = ({given} - {offset}) / {scale};")
    for depth, (weight, _) in enumerate(network.layers):
        last = depth == len(network.layers) - 1
        width, n = weight.shape
        lines += [] if last else [f"    float v{depth + 1}[{n}];"]
        value = "sum"
        if not last:
            value = "tanhf(sum)" if network.activation == "tanh" else "sum < 0.0f ? 0.0f : sum"
        target = "q" if last else f"v{depth + 1}"
        lines += [
            f"    for (int i = 0; i < {n}; i++) {{",
            f"        float sum = b{depth}[i];",
            f"        for (int j = 0; j < {width}; j++)",
            f"            sum += w{depth}[i][j] * v{depth}[j];",
            f"        {target}[i] = {value};",
            "    }",
        ]
    lines += [
        f"    q[{k}] *= {_number(factor)};"
        for k, factor in enumerate(network.from_ours)
        if factor != 1
    ]
    return "\n".join([*lines, "}", ""])


def _numbers(values: NDArray[np.float32]) -> str:
    return "{" + ", ".join(_number(value) for value in values) + "}"


def _number(value: np.float32) -> str:
    """A literal that reads back as the same float."""
    text = np.format_float_scientific(value, unique=True, trim="0")
    return f"{text}f"
