"""What rounding can do to the tip, bounded in advance."""

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.jets import Linkage
from iksamples.certify.layers import Layers
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]

FLOAT64 = 2.0**-53
FLOAT32 = 2.0**-24


def inference_slack_mm(network: StackedMLP, chain: SerialChain, region: Region) -> Floats:
    """What to add to a certificate where the network itself is evaluated in float32.

    Args:
        network: Stacked networks.
        chain: The arm, whose forward kinematics is the real arm's and not rounded.
        region: The inputs that it is about.

    Returns:
        One bound per network [mm], shape (networks,).
    """
    return rounding_slack_mm(Layers.of(network), Linkage.of(chain), region, FLOAT32)


def rounding_slack_mm(layers: Layers, linkage: Linkage, region: Region, unit: float) -> Floats:
    """A-priori bound of what rounding does to the tip when the network is evaluated plainly.

    Standard model: every operation is exact but for a relative error of ``unit``; a sum of k terms
    in any order is off by at most ``k unit / (1 - k unit)`` times the sum of absolute values
    (Higham, *Accuracy and Stability of Numerical Algorithms*, ch. 3). Inputs, offset and scale are
    rounded to the format first. tanh is taken to be right to four roundings.

    Args:
        layers: The networks.
        linkage: The arm, evaluated in float64.
        region: The inputs that it is about.
        unit: Half the distance from 1 to the next number: 2^-24 for float32, 2^-53 for float64.

    Returns:
        One bound per network [mm], shape (networks,).
    """
    lower_mm, upper_mm = region.lower_corner, region.upper_corner
    ends = np.maximum(np.abs(lower_mm), np.abs(upper_mm))
    offset, scale = np.abs(layers.offset_mm), np.abs(layers.scale_mm)
    # Three rounded inputs, a difference and a quotient; 1 + 8 unit covers products of roundings.
    size = np.maximum(np.abs(lower_mm - layers.offset_mm), np.abs(upper_mm - layers.offset_mm))
    error = unit * (1 + 8 * unit) * (ends + offset + 4.0 * size) / scale
    value = size / scale
    values = np.broadcast_to(value, (layers.n_networks, 1, len(value)))
    errors = np.broadcast_to(error, values.shape)
    for depth, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        terms = weight.shape[1] + 2
        gamma = terms * unit / (1.0 - terms * unit)
        absolute = np.abs(weight)
        values = values @ absolute + np.abs(bias)[:, None]
        errors = (errors @ absolute) * (1.0 + gamma) + gamma * values
        if depth < len(layers.weights) - 1 and layers.activation == "tanh":
            values = np.minimum(values, 1.0)
            errors = errors + 4.0 * unit
    ranges, errors = values[:, 0], errors[:, 0]
    slack = np.empty(layers.n_networks)
    for row in range(layers.n_networks):
        levers = linkage.levers_mm(ranges[row] + errors[row])
        arithmetic = 32.0 * linkage.n_joints * FLOAT64
        tip = np.linalg.norm(linkage.vectors_mm[0]) + levers @ np.where(
            linkage.revolute, 1.0, ranges[row]
        )
        slack[row] = levers @ errors[row] + arithmetic * (tip + np.abs(ends).max())
    return slack
