"""What a certificate is about: which vectors the arm carries, and what each is held against.

For a position it is the tool centre point, held against inputs. An angle is one between unit
vectors: with ``R(x) = Rz(yaw) Ry(pitch) Rx(roll) R_ref`` wanted and ``R(q)`` reached,

    | R(q) e_k  -  R(x) e_k |

is how far apart the tips of two tool axes are, each carried by a chain that only turns. For the
tool's axis alone (k = z) this length is ``2 sin(angle / 2)``; over the three of them the root of
the sum of the squares is the Frobenius norm of the difference of two rotations,
``2 sqrt(2) sin(angle / 2)``, which grows with the geodesic angle from 0 to pi (Huynh, *J. Math.
Imaging Vis.* 35, 2009).

The length is the same where both are turned back by what is asked, which puts the inputs in front
of the arm's joints. Turns about parallel axes add up there before anything is bounded, so that
nothing is lost where all axes are parallel, as a SCARA's; elsewhere two short chains leave out less
than one long one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import COORDINATES, Target
from iksamples.errors import IksamplesError


Floats = NDArray[np.float64]
Measure = Literal["position", "angle"]

PARALLEL = 1e-12
"""Sine of the angle between two axes below which they count as parallel. What that leaves out
drowns in the search's rounding slack, and the checker counts it."""
LARGEST_ANGLE = float(np.nextafter(np.pi, 4.0))


@dataclass(frozen=True, eq=False)
class Compared:
    """A vector at the end of a chain, and what it is held against.

    Attributes:
        chain: What carries it: the arm, or a chain of its turns alone.
        behind: The same without the inputs in front. Turns in front of a chain change no length,
            and so nothing of what rounding does behind.
        angles: The inputs whose opposites are the chain's first joints [rad].
        outputs: The network's outputs that are its other joints.
        rows: Which of the vector's coordinates count.
        inputs: The inputs that they are held against, or that are the joints of ``goal``.
        goal: What carries the vector that it is held against; None where the inputs are that.
    """

    chain: SerialChain
    behind: SerialChain
    angles: tuple[int, ...]
    outputs: tuple[int, ...]
    rows: tuple[int, ...]
    inputs: tuple[int, ...]
    goal: SerialChain | None = None


def target_of(n_inputs: int) -> Target:
    """What is asked where nobody says: x, y, z, roll, pitch, yaw, as many as there are inputs."""
    return Target(COORDINATES[:n_inputs], "fixed" if n_inputs > 3 else "free")


def compared(
    chain: SerialChain, target: Target | None, measure: Measure, n_inputs: int, n_outputs: int
) -> list[Compared]:
    """The vectors whose errors make up a measure: the root of the sum of their squares does.

    Args:
        chain: The arm.
        target: What is asked of the tool; ``target_of`` the inputs if None.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].
        n_inputs: Inputs of the network.
        n_outputs: Outputs of the network.

    Raises:
        IksamplesError: The arm, the target and the network do not fit together.
    """
    target = target or target_of(n_inputs)
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
        return [Compared(chain, chain, (), every, positions, inputs)]
    if target.orientation == "free":
        raise IksamplesError("nothing is asked of the tool's orientation, so it has no error.")
    # The outermost turn first: about z, then y, then x.
    asked = [k for k, name in enumerate(target.coordinates) if name in COORDINATES[3:]][::-1]
    about = [np.eye(3)[COORDINATES.index(target.coordinates[k]) - 3] for k in asked]
    turning = [i for i, kind in enumerate(chain.joint_kinds) if kind == "revolute"]
    axes = [*about, *chain.axes[turning]]
    parallel = bool(asked) and np.linalg.norm(np.cross(axes[0], axes), axis=1).max() <= PARALLEL
    own = axes[len(asked) :]
    return [
        Compared(
            _turns(axes if parallel else own, chain.tip_rotation[:, k]),
            _turns(own, chain.tip_rotation[:, k]),
            tuple(asked) if parallel else (),
            tuple(turning),
            (0, 1, 2),
            () if parallel else tuple(asked),
            _turns([] if parallel else about, target.reference_rotation[:, k]),
        )
        for k in ((2,) if target.orientation == "axis" else (0, 1, 2))
    ]


def _turns(axes: list[Floats], vector: Floats) -> SerialChain:
    """A chain that turns a vector about axes through the origin."""
    n = len(axes)
    return SerialChain(
        tuple(f"turn {i}" for i in range(n)),
        tuple("revolute" for _ in axes),
        np.array(axes).reshape(n, 3),
        np.zeros((n, 3)),
        vector,
        np.full(n, -np.inf),
        np.full(n, np.inf),
    )


def angle_rad(apart: Floats | float, vectors: int) -> Floats:
    """The angle that belongs to a distance: of one pair of axes, or of all three pairs together.

    Args:
        apart: Root of the sum of the squared distances, at least 0.
        vectors: One pair or three.
    """
    share = np.asarray(apart) / (2.0 if vectors == 1 else 2.0 * np.sqrt(2.0))
    # Half a turn is a little more than the number for it.
    return np.where(share < 1.0, 2.0 * np.arcsin(np.minimum(share, 1.0)), LARGEST_ANGLE)
