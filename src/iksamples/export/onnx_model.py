"""The network as an ONNX graph, scaling inside."""

from typing import TYPE_CHECKING

import numpy as np

from iksamples.export.plain import PlainNetwork


if TYPE_CHECKING:
    from onnx import ModelProto

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
