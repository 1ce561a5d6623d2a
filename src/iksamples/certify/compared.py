"""What a certificate is about: which vectors the arm carries, and what each is held against.

For a position it is the tool centre point, held against inputs. An angle is one between unit
vectors, so it is the position error of a chain that only turns: with
``R(x) = Rz(yaw) Ry(pitch) Rx(roll) R_ref`` wanted and ``R(q)`` reached,

    | Rx(-roll) Ry(-pitch) Rz(-yaw) R(q) e_k  -  R_ref e_k |

is how far apart the tips of two tool axes are, and the inputs are further revolute joints in front
of the arm's. Turns about parallel axes add up there before anything is bounded. For the tool's axis
alone (k = z) this length is ``2 sin(angle / 2)``; over the three of them the root of the sum of the
squares is the Frobenius norm of the difference of two rotations, ``2 sqrt(2) sin(angle / 2)``,
which grows with the geodesic angle from 0 to pi (Huynh, *J. Math. Imaging Vis.* 35, 2009).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import COORDINATES, Target
from iksamples.errors import IksamplesError


Floats = NDArray[np.float64]
Measure = Literal["position", "angle"]

LARGEST_ANGLE = float(np.nextafter(np.pi, 4.0))


@dataclass(frozen=True, eq=False)
class Compared:
    """A vector at the end of a chain, and what it is held against.

    Attributes:
        chain: What carries it: the arm, or a chain of its turns alone.
        angles: The inputs whose opposites are the chain's first joints [rad].
        outputs: The network's outputs that are its other joints.
        rows: Which of the vector's coordinates count.
        inputs: The inputs that they are held against; empty where it is ``wanted``.
        wanted: What they are held against where it is no input, shape (rows,).
    """

    chain: SerialChain
    angles: tuple[int, ...]
    outputs: tuple[int, ...]
    rows: tuple[int, ...]
    inputs: tuple[int, ...]
    wanted: Floats

    def behind(self) -> SerialChain:
        """The chain without the inputs in front.

        Turns in front of a chain change no length, and so nothing of what rounding does behind.
        """
        ahead = len(self.angles)
        return replace(
            self.chain,
            joint_names=self.chain.joint_names[ahead:],
            joint_kinds=self.chain.joint_kinds[ahead:],
            axes=self.chain.axes[ahead:],
            points_mm=self.chain.points_mm[ahead:],
            lower=self.chain.lower[ahead:],
            upper=self.chain.upper[ahead:],
        )


def target_of(n_inputs: int) -> Target:
    """What is asked where nobody says: x, y, z, roll, pitch, yaw, as many as there are inputs."""
    return Target(COORDINATES[:n_inputs], "fixed" if n_inputs > 3 else "free")


def compared(
    chain: SerialChain, target: Target, measure: Measure, n_inputs: int, n_outputs: int
) -> list[Compared]:
    """The vectors whose errors make up a measure: the root of the sum of their squares does.

    Args:
        chain: The arm.
        target: What is asked of the tool.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].
        n_inputs: Inputs of the network.
        n_outputs: Outputs of the network.

    Raises:
        IksamplesError: The arm, the target and the network do not fit together.
    """
    if n_outputs != chain.n_joints:
        raise IksamplesError(
            f"the network answers {n_outputs} joint values, the arm has {chain.n_joints} joints."
        )
    if n_inputs != len(target.coordinates):
        raise IksamplesError(
            f"the network has {n_inputs} inputs, and {len(target.coordinates)} coordinates of the "
            f"tool are asked for ({', '.join(target.coordinates)})."
        )
    positions = target.positions
    if measure == "position":
        inputs = tuple(range(len(positions)))
        every = tuple(range(n_outputs))
        return [Compared(chain, (), every, positions, inputs, np.zeros(len(positions)))]
    if target.orientation == "free":
        raise IksamplesError("nothing is asked of the tool's orientation, so it has no error.")
    first = [k for k, name in enumerate(target.coordinates) if name in COORDINATES[3:]]
    turning = [i for i, kind in enumerate(chain.joint_kinds) if kind == "revolute"]
    axes = [np.eye(3)[COORDINATES.index(target.coordinates[k]) - 3] for k in first]
    names = (*(target.coordinates[k] for k in first), *(chain.joint_names[i] for i in turning))
    turns = SerialChain(
        names,
        tuple("revolute" for _ in names),
        np.array([*axes, *chain.axes[turning]]).reshape(-1, 3),
        np.zeros((len(names), 3)),
        np.zeros(3),
        np.full(len(names), -np.inf),
        np.full(len(names), np.inf),
    )
    return [
        Compared(
            replace(turns, tip_mm=chain.tip_rotation[:, k]),
            tuple(first),
            tuple(turning),
            (0, 1, 2),
            (),
            target.reference_rotation[:, k],
        )
        for k in ((2,) if target.orientation == "axis" else (0, 1, 2))
    ]


def angle_rad(apart: Floats | float, vectors: int) -> Floats:
    """The angle that belongs to a distance: of one pair of axes, or of all three pairs together.

    Args:
        apart: Root of the sum of the squared distances, at least 0.
        vectors: One pair or three.
    """
    share = np.asarray(apart) / (2.0 if vectors == 1 else 2.0 * np.sqrt(2.0))
    # Half a turn is a little more than the number for it.
    return np.where(share < 1.0, 2.0 * np.arcsin(np.minimum(share, 1.0)), LARGEST_ANGLE)
