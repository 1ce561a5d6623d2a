"""The network as one function in C99."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from iksamples.export.plain import PlainNetwork


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
    # Names of joints and studies may hold anything.
    comment = [line.replace("*/", "* /").replace("/*", "/ *") for line in comment]
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
