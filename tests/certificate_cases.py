"""Random chains and networks for the certificates, and the plainest code that evaluates them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import COORDINATES
from iksamples.certify.checker import Claim, Verification, verify
from iksamples.certify.search import Certificate, certify_stack
from iksamples.network import StackedMLP


@dataclass(frozen=True)
class Along:
    """A target of positions alone, also of fewer than two: an arm along a line."""

    positions: tuple[int, ...]
    n_inputs: int
    orientation: str = "free"

    @property
    def coordinates(self):
        """A name for each input."""
        return tuple("abcdef"[: self.n_inputs])


ONE = Along((0,), 1)
"""One input, and the tip's x."""


def make_chain(kinds, axes, points, tip) -> SerialChain:
    """A chain from its joints: "R" or "P" each, axes, points on them, and the tip."""
    n = len(kinds)
    axes = np.array(axes, float)
    return SerialChain(
        tuple(f"j{i}" for i in range(n)),
        tuple("revolute" if kind == "R" else "prismatic" for kind in kinds),
        axes / np.linalg.norm(axes, axis=1, keepdims=True),
        np.array(points, float),
        np.array(tip, float),
        np.full(n, -np.pi),
        np.full(n, np.pi),
    )


def random_chain(rng, kinds) -> SerialChain:
    """A chain with axes that are often parallel to the ones before, either way round."""
    axes, points, point = [], [], np.zeros(3)
    for i in range(len(kinds)):
        if i and rng.random() < 0.5:
            axes.append(axes[-1] * rng.choice([-1.0, 1.0]))
        elif rng.random() < 0.5:
            axes.append(np.eye(3)[rng.integers(3)])
        else:
            axes.append(rng.normal(size=3))
        point = point + rng.uniform(-60, 60, 3)
        points.append(point)
    return make_chain(kinds, axes, points, point + rng.uniform(-60, 60, 3))


def planar(lengths) -> SerialChain:
    """Links in the plane z = 0, stretched along x, all axes along z."""
    ends = np.cumsum([0.0, *lengths])
    points = [(x, 0, 0) for x in ends[:-1]]
    return make_chain("R" * len(lengths), [(0, 0, 1)] * len(lengths), points, (ends[-1], 0, 0))


def random_network(rng, sizes, activation, n=1, spread=1.0, lower=None, upper=None):
    """Networks with normal weights; positions of the box are normalised to [0, 1]."""
    weights = tuple(
        (spread * rng.normal(size=(n, a, b)) / np.sqrt(a)).astype(np.float32)
        for a, b in pairwise(sizes)
    )
    biases = tuple((0.3 * rng.normal(size=(n, b))).astype(np.float32) for b in sizes[1:])
    lower = np.zeros(sizes[0]) if lower is None else np.asarray(lower, float)
    upper = np.ones(sizes[0]) if upper is None else np.asarray(upper, float)
    return StackedMLP(weights, biases, activation, lower, upper - lower, tuple(range(n)))


def linear_network(matrix, bias) -> StackedMLP:
    """One linear layer: joints = position @ matrix + bias, nothing normalised."""
    matrix = np.asarray(matrix, np.float32)
    return StackedMLP(
        (matrix[None],),
        (np.asarray(bias, np.float32)[None],),
        "relu",
        np.zeros(len(matrix)),
        np.ones(len(matrix)),
        (0,),
    )


def plain_tip(chain, joints):
    """The tip from 4 x 4 matrices, one pose at a time."""
    tips = []
    for pose in np.atleast_2d(joints):
        frame = np.eye(4)
        for kind, axis, point, value in zip(
            chain.joint_kinds, chain.axes, chain.points_mm, pose, strict=True
        ):
            step = np.eye(4)
            if kind == "prismatic":
                step[:3, 3] = value * axis
            else:
                x, y, z = axis
                skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                turn = np.eye(3) + np.sin(value) * skew + (1 - np.cos(value)) * skew @ skew
                step[:3, :3], step[:3, 3] = turn, point - turn @ point
            frame = frame @ step
        tips.append(frame[:3, :3] @ chain.tip_mm + frame[:3, 3])
    return np.array(tips)


def plain_rotation(chain, joints):
    """Rotations of the tool, a product of SciPy's rotations about the joints' axes."""
    total = Rotation.identity(len(joints))
    for kind, axis, value in zip(chain.joint_kinds, chain.axes, joints.T, strict=True):
        if kind == "revolute":
            total = total * Rotation.from_rotvec(value[:, None] * axis)
    return total * Rotation.from_matrix(chain.tip_rotation)


def turned_away(chain, target, joints, points):
    """Angles [rad] between what joint values reach and what inputs ask for."""
    angles = np.zeros((len(points), 3))
    for k, name in enumerate(target.coordinates):
        if name in COORDINATES[3:]:
            angles[:, COORDINATES.index(name) - 3] = points[:, k]
    a = plain_rotation(chain, joints)
    b = Rotation.from_euler("xyz", angles) * Rotation.from_matrix(target.reference_rotation)
    if target.orientation == "fixed":
        return (a.inv() * b).magnitude()
    first, second = a.apply([0, 0, 1]), b.apply([0, 0, 1])
    cross = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(cross, np.sum(first * second, axis=1))


def plain_answer(network, row, points):
    """The network's answers, layer by layer."""
    hidden = (np.asarray(points, float) - network.offset) / network.scale
    last = len(network.weights) - 1
    for depth in range(last + 1):
        hidden = np.einsum("pi,io->po", hidden, np.float64(network.weights[depth][row]))
        hidden = hidden + np.float64(network.biases[depth][row])
        if depth < last:
            hidden = np.tanh(hidden) if network.activation == "tanh" else hidden * (hidden > 0)
    return hidden


def points_in(rng, lower, upper, n):
    """Points of a box, half of them pressed onto faces, and its corners."""
    d = len(lower)
    share = rng.random((n, d))
    share[: n // 2] = np.where(
        rng.random((n // 2, d)) < 0.5, np.round(share[: n // 2]), share[: n // 2]
    )
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    return lower + (upper - lower) * np.concatenate([share, corners])


def check(certificate, network, row, chain, region, **changed) -> Verification:
    """What the checker says of a certificate's bounds; parts of the claim may be changed."""
    claim = {
        "network": network, "row": row, "chain": chain, "region": region,
        "upper": certificate.upper, "lower": certificate.lower, "argmax": certificate.argmax,
    }  # fmt: skip
    return verify(Claim(**{**claim, **changed}), certificate.leaves)


def certify_sup(network, row, chain, region, **how) -> Certificate:
    """The certificate of one network of a stack."""
    [certificate] = certify_stack(network.select([row]), chain, region, **how)
    return certificate
