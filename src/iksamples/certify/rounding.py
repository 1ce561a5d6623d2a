"""What rounding can do to the tip, bounded in advance: a running error analysis over boxes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.compared import Compared, Measure, angle_rad, compared
from iksamples.certify.jets import Linkage
from iksamples.certify.layers import Layers
from iksamples.certify.table import Table
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BOXES = 512
"""Boxes that a region is cut into, about, for the bound of what single precision does."""
_BATCH = 1024


@dataclass(frozen=True)
class Format:
    """A floating-point format of IEEE 754.

    Attributes:
        unit: Half the distance from 1 to the next number.
        tiny: Distance of the smallest numbers from each other.
        largest: The largest number.
    """

    unit: float
    tiny: float
    largest: float


FLOAT32 = Format(2.0**-24, 2.0**-149, float(np.finfo(np.float32).max))
FLOAT64 = Format(2.0**-53, 2.0**-1074, float(np.finfo(np.float64).max))


def inference_slack(
    network: StackedMLP,
    chain: SerialChain,
    region: Region,
    target: Target | None = None,
    measure: Measure = "position",
) -> Floats:
    """What to add to a certificate where the network itself is evaluated in float32.

    Args:
        network: Stacked networks.
        chain: The arm, whose forward kinematics is the real arm's and not rounded.
        region: The inputs that it is about.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].

    Returns:
        One bound per network [mm or rad], shape (networks,); infinite where a position's format
        overflows.
    """
    layers = Layers.of(network)
    items = compared(chain, target, measure, layers.n_inputs, layers.n_outputs)
    arms = [Linkage.of(item.behind) for item in items]
    n, d = region.lower.shape
    per_axis = max(1, int((_BOXES / n) ** (1.0 / d) + 1e-9))
    share = (np.indices((per_axis,) * d).reshape(d, -1).T + 0.5) / per_axis
    size = region.upper - region.lower
    centre = (region.lower[:, None] + size[:, None] * share).reshape(-1, d)
    radius = np.repeat(size * (0.5 / per_axis), len(share), axis=0)
    # Centre and radius are rounded themselves.
    radius = radius * (1.0 + 1e-9) + 1e-12 * np.abs(centre)
    slack = np.zeros(layers.n_networks)
    for row in range(layers.n_networks):
        for first in range(0, len(centre), _BATCH):
            some = slice(first, first + _BATCH)
            which = np.full(len(centre[some]), row)
            box = which, centre[some], radius[some], FLOAT32
            squares = sum(
                rounding_mm(layers, arm, item.outputs, *box) ** 2
                for arm, item in zip(arms, items, strict=True)
            )
            slack[row] = max(slack[row], float(np.sqrt(squares).max()))
    return slack if measure == "position" else angle_rad(slack, len(items))


def stored_slack(
    network: StackedMLP,
    chain: SerialChain,
    region: Region,
    target: Target | None = None,
    measure: Measure = "position",
) -> Floats:
    """What half a last place of every stored float64 number can do to the tool.

    Args:
        network: Stacked networks, whose numbers are rounded from others.
        chain: The arm.
        region: The inputs that it is about.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].

    Returns:
        One bound per network [mm or rad], shape (networks,).
    """
    layers = Layers.of(network)
    items = compared(chain, target, measure, layers.n_inputs, layers.n_outputs)
    slack = search_slack(layers, items, region)
    return slack if measure == "position" else angle_rad(slack, len(items))


def search_slack(answers: Layers | Table, items: list[Compared], region: Region) -> Floats:
    """What rounding does where the search evaluates networks and arm in float64, shape (networks,).

    Args:
        answers: The networks, or a look-up table.
        items: What is compared; the root of the sum of the squares is bounded.
        region: The inputs that it is about.
    """
    lower, upper = region.lower_corner, region.upper_corner
    n = answers.n_networks
    centre, radius = np.tile(0.5 * (lower + upper), (n, 1)), np.tile(0.5 * (upper - lower), (n, 1))
    squares = np.zeros(n)
    for item in items:
        arm = Linkage.of(item.behind)
        if isinstance(answers, Table):
            slack = answers.rounding_mm(arm, list(item.outputs), region)
        else:
            box = np.arange(n), centre, radius, FLOAT64
            slack = rounding_mm(answers, arm, item.outputs, *box, arm_too=True)
        squares = squares + slack**2
    return np.sqrt(squares)


def rounding_mm(
    layers: Layers,
    linkage: Linkage,
    outputs: tuple[int, ...],
    which: Ints,
    centre: Floats,
    radius: Floats,
    form: Format,
    *,
    arm_too: bool = False,
) -> Floats:
    """Bounds over boxes how far the tip is off where the networks' answers are computed plainly.

    Standard model (Higham, *Accuracy and Stability of Numerical Algorithms*, ch. 2 and 3): an
    operation is exact but for a relative error of ``unit`` and, where it underflows, an absolute
    one of ``tiny``; a sum of k products in any order is off by at most ``k unit / (1 - k unit)``
    times the sum of absolute values. Inputs, offset and scale are rounded to the format first, tanh
    is right to four roundings.

    Each layer's own error d reaches the tip by the rest of the network and the arm, whose slope
    over the box is known to within a ball: ``|G d| <= |C| |d| + R |d|``. This is far less than the
    product of all absolute values, since the weights' signs and the arm's directions are kept.

    Args:
        layers: The networks.
        linkage: The arm.
        outputs: The outputs that are its joints.
        which: The network that each box is for, shape (boxes,).
        centre: Centres, shape (boxes, d).
        radius: Half edges, shape (boxes, d).
        form: The format.
        arm_too: Whether the forward kinematics is computed in the format, too. The bound is then
            the product of absolute values, which costs less and is enough for double precision.

    Returns:
        Bounds [mm], shape (boxes,); infinite where something may overflow.
    """
    with np.errstate(all="ignore"):  # what overflows is infinite in the end
        ends, offset, scale = np.abs(centre) + radius, layers.offset, np.abs(layers.scale)
        size = np.abs(centre - offset) + radius
        # Three rounded inputs, a difference, a quotient; 1 + 8 unit covers products of roundings.
        error = form.unit * (1 + 8 * form.unit) * (ends + np.abs(offset) + 4.0 * size) / scale
        error = error + 4.0 * form.tiny * (1.0 + 1.0 / scale)
        middle, half = (centre - offset) / layers.scale, radius / scale
        own, slopes, largest = [error], [], np.zeros(len(which))
        for depth in range(len(layers.weights)):
            weight, bias = layers.weight(depth, which), layers.bias(depth, which)
            absolute = np.abs(weight)
            terms = weight.shape[1] + 2
            gamma = terms * form.unit / (1.0 - terms * form.unit)
            top = np.abs(middle) + half + error
            sums = _times(top, absolute) + np.abs(bias)
            fresh = gamma * sums + terms * form.tiny
            if depth and layers.activation == "tanh":
                fresh = fresh + 4.0 * form.unit * _times(top, absolute)
            own.append(fresh)
            error = _times(error, absolute) + fresh
            largest = np.maximum(largest, (sums + error).max(axis=1))
            middle, half = _times(middle, weight) + bias, _times(half, absolute)
            if depth < len(layers.weights) - 1:
                # Twice the error, since the range itself is computed.
                slope, spread, middle, half = _bend(layers.activation, middle, half, 2.0 * error)
                error = error * (slope + spread)
                slopes.append((slope, spread))

        joints = list(outputs)
        ranges = (np.abs(middle) + half + error)[:, joints]
        simply = np.sum(linkage.levers_mm(ranges) * error[:, joints], axis=1)
        if arm_too:
            size = linkage.reach_mm(ranges) + ends.max(axis=1)
            total = simply + 32.0 * max(linkage.n_joints, 1) * form.unit * size
        else:
            along, beside = np.zeros((*middle.shape, 3)), np.zeros(middle.shape)
            along[:, joints], beside[:, joints] = _arm_slope(
                linkage, middle[:, joints], (half + error)[:, joints]
            )
            total = np.fmin(_carried(layers, which, along, beside, own, slopes), simply)
        total = total * (1.0 + 1e-9)
        return np.where((largest < form.largest) & np.isfinite(total), total, np.inf)


def _carried(
    layers: Layers,
    which: Ints,
    along: Floats,
    beside: Floats,
    own: list[Floats],
    slopes: list[tuple[Floats, Floats]],
) -> Floats:
    """What the layers' own errors do to the tip [mm], each sent through all that follows it.

    Args:
        layers: The networks.
        which: The network that each box is for.
        along: The arm's slope: centres of its rows, shape (boxes, outputs, 3).
        beside: Their radii, shape (boxes, outputs).
        own: The input's error and each layer's, shape (boxes, width).
        slopes: Each activation's slope over the box, as middle and half width.
    """
    total = np.zeros(len(which))
    for depth in reversed(range(len(layers.weights) + 1)):
        part = np.einsum("bi,bik->bk", own[depth], np.abs(along))
        total += np.sqrt(np.einsum("bk,bk->b", part, part)) + np.sum(beside * own[depth], axis=1)
        if depth == 0:
            break
        weight = layers.weight(depth - 1, which)
        along, beside = weight @ along, (np.abs(weight) @ beside[:, :, None])[:, :, 0]
        if depth > 1:
            slope, spread = slopes[depth - 2]
            length = np.sqrt(np.einsum("bik,bik->bi", along, along))
            beside = spread * length + (slope + spread) * beside
            along = slope[:, :, None] * along
    return total


def _times(rows: Floats, weight: Floats) -> Floats:
    """Rows (boxes, in) times weights of shape (boxes or 1, in, out)."""
    return rows @ weight[0] if len(weight) == 1 else (rows[:, None] @ weight)[:, 0]


def _bend(
    activation: str, middle: Floats, half: Floats, error: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """An activation's slope over ranges, as middle and half width, and its values, likewise."""
    low, high = middle - half - error, middle + half + error
    if activation == "relu":
        steepest, flattest = (high > 0).astype(float), (low >= 0).astype(float)
        low, high = np.maximum(low, 0.0), np.maximum(high, 0.0)
    else:
        near = np.where((low <= 0) & (high >= 0), 0.0, np.minimum(np.abs(low), np.abs(high)))
        steepest = 1.0 - np.tanh(near) ** 2
        flattest = 1.0 - np.tanh(np.maximum(np.abs(low), np.abs(high))) ** 2
        low, high = np.tanh(low), np.tanh(high)
    slope, spread = 0.5 * (steepest + flattest), 0.5 * (steepest - flattest)
    return slope, spread, 0.5 * (low + high), 0.5 * (high - low)


def _arm_slope(linkage: Linkage, joints: Floats, change: Floats) -> tuple[Floats, Floats]:
    """The arm's Jacobian over boxes of joint values: rows within balls.

    Args:
        linkage: The arm.
        joints: Middles [rad or mm], shape (boxes, joints).
        change: Half widths, likewise.

    Returns:
        Centres, shape (boxes, joints, 3); radii, shape (boxes, joints).
    """
    levers = linkage.levers_mm(np.abs(joints) + change)
    turns, n = linkage.revolute, linkage.n_joints
    # |d^2 p / dq_i dq_j|: what is behind both, of two revolute joints; one where a joint slides
    # behind one that turns; else nothing.
    later = np.maximum(np.arange(n)[:, None], np.arange(n))
    both = turns[:, None] & turns
    slid = np.triu(turns[:, None] & ~turns, 1)
    bends = np.where(both, levers[:, later], (slid | slid.T).astype(float))
    radius = (bends @ change[:, :, None])[:, :, 0]
    _, jacobian, _ = linkage.jets(joints)
    wide = ~(radius < levers)
    centre = np.where(wide[:, :, None], 0.0, jacobian.transpose(1, 2, 0))
    return centre, np.where(wide, levers, radius)
