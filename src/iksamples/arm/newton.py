"""Numeric inverse kinematics of any chain, followed from a home posture.

The tool is led in small steps along a straight line (its rotation along a geodesic) from where it
is at home to where it is wanted, and the joints follow by Newton's method. So the answer is a
function of what is wanted: the branch is that of the home posture as long as no singularity lies on
the way. An arm with more joints than it needs takes, of all joint values that do it, those nearest
to home: ``q <- q + d + J^+ (e - J d)`` with ``d = home - q`` is Newton's method with a Gauss-Newton
Hessian for that problem (Nocedal and Wright, *Numerical Optimization*, ch. 18).

Everything is batched over the points. Joints in mm and errors in rad are weighed against the others
by the arm's length.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.target import Target


STEP = 0.1
"""How far the tool is led at once: rad, and that fraction of the arm's length."""
CAP = 0.3
"""Largest change of a joint in one iteration [rad, or fractions of the arm's length]."""
ITERATIONS = 100
"""Newton steps at the end of the way before a point is given up."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Which of the tool's motions a target asks for.

    Attributes:
        positions: Which of x, y and z.
        turns: Directions in the base frame about which the tool's turn is asked for, as rows; None:
            the two across the tool's axis, which change with the joints.
    """

    positions: tuple[int, ...]
    turns: Floats | None


def length_mm(chain: SerialChain, home: ArrayLike) -> float:
    """The arm's length [mm]: root mean square distance of the tool from the revolute axes at home.

    It makes an angle comparable with a distance (the idea of a characteristic length: Angeles,
    *Fundamentals of Robotic Mechanical Systems*, sec. 5.8). 100 mm for an arm that only slides.
    """
    linear, angular = chain.jacobians(home)
    levers = np.linalg.norm(linear, axis=0)[np.linalg.norm(angular, axis=0) > 0]
    length = float(np.sqrt(np.mean(levers**2))) if levers.size else 0.0
    return length or 100.0


def follow(
    chain: SerialChain,
    target: Target,
    x: ArrayLike,
    home: ArrayLike,
    locked: tuple[int, ...] = (),
    start: ArrayLike | None = None,
) -> Floats:
    """Joint values that do what the inputs ask, followed from a home posture.

    Args:
        chain: The arm.
        target: What an input asks of the tool.
        x: Inputs [mm or rad], shape (points, inputs).
        home: The posture to stay near to [rad or mm], shape (joints,).
        locked: Joints that stay at home, by index.
        start: The joints to start from [rad or mm], shape (points, joints); None: home.

    Returns:
        Joint values [rad or mm], shape (points, joints); NaN where the iteration does not end.
    """
    x, home = np.asarray(x, float), np.asarray(home, float)
    joints = np.array(np.broadcast_to(home if start is None else start, (len(x), chain.n_joints)))
    length, rows = length_mm(chain, home), _rows(chain, target, home)
    weight = _weights(chain, length)
    free = _free(chain, locked)
    position, rotation = target.wanted(x)
    start_position, start_rotation = chain.pose(joints)
    travel = position - start_position
    turn = _turn(target, start_rotation, rotation)
    far = np.maximum(_norm(travel[:, list(rows.positions)]) / length, _norm(turn))
    n_steps = np.ceil(far / STEP).clip(1, 1000)

    active = np.arange(len(x))
    iteration = 0
    while active.size:
        iteration += 1
        done = np.minimum(iteration / n_steps[active], 1.0)[:, None]
        aim = np.where(done < 1, start_position[active] + done * travel[active], position[active])
        facing = np.where(
            done[..., None] < 1,
            _rotation(done * turn[active]) @ start_rotation[active],
            rotation[active],
        )
        error, jacobian = _linearised(chain, target, rows, joints[active], aim, facing, length)
        step = np.zeros_like(joints[active])
        step[:, free] = _step(
            (jacobian * weight)[..., free], error, ((home - joints[active]) / weight)[:, free]
        )
        largest = np.max(np.abs(step), axis=-1, keepdims=True)
        step *= np.minimum(1.0, CAP / np.maximum(largest, CAP))
        joints[active] += step * weight
        arrived = (done[:, 0] == 1) & (largest[:, 0] < 1e-12)
        given_up = (iteration > n_steps[active] + ITERATIONS) | ~np.isfinite(largest[:, 0])
        joints[active[given_up & ~arrived]] = np.nan
        active = active[~(arrived | given_up)]
    return joints


def task_jacobian_mm(
    chain: SerialChain,
    target: Target,
    joints: ArrayLike,
    home: ArrayLike,
    locked: tuple[int, ...] = (),
) -> Floats:
    """Jacobian of what is asked for, with angles times the arm's length.

    Args:
        chain: The arm.
        target: What an input asks of the tool.
        joints: Joint values [rad or mm], shape (points, joints).
        home: The home posture [rad or mm], shape (joints,).
        locked: Joints that stay at home, by index; they have no column.

    Returns:
        ``J`` [mm/rad], shape (points, rows, free joints): as many rows as the arm can be asked for,
        and a prismatic joint's column times the arm's length.
    """
    q = np.asarray(joints, float)
    length = length_mm(chain, home)
    rows = _rows(chain, target, np.asarray(home, float))
    position, rotation = chain.pose(q)
    jacobian = _linearised(chain, target, rows, q, position, rotation, length)[1]
    return (jacobian * _weights(chain, length))[..., _free(chain, locked)] * length


def _weights(chain: SerialChain, length: float) -> Floats:
    """What one unit of the iteration is of each joint: 1 rad, or the arm's length in mm."""
    return np.where(np.array(chain.joint_units) == "mm", length, 1.0)


def _free(chain: SerialChain, locked: tuple[int, ...]) -> list[int]:
    return [i for i in range(chain.n_joints) if i not in locked]


def _rows(chain: SerialChain, target: Target, home: Floats) -> _Rows:
    """An arm whose axes are parallel turns its tool about them alone."""
    if target.orientation == "free":
        return _Rows(target.positions, np.zeros((0, 3)))
    axes = chain.axes[np.array(chain.joint_kinds) == "revolute"]
    parallel = len(axes) > 0 and bool(np.all(_norm(np.cross(axes, axes[0])) < 1e-9))
    if target.orientation == "fixed":
        return _Rows(target.positions, axes[:1] if parallel else np.eye(3))
    if not parallel:
        return _Rows(target.positions, None)
    along = _norm(np.cross(chain.rotation(home)[:, 2], axes[0])) < 1e-9
    return _Rows(target.positions, axes[:0] if along else axes[:1])


def _linearised(
    chain: SerialChain,
    target: Target,
    rows: _Rows,
    joints: Floats,
    position: Floats,
    rotation: Floats,
    length: float,
) -> tuple[Floats, Floats]:
    """What is missing, in arm lengths and rad, shape (points, rows), and its Jacobian."""
    now_position, now_rotation = chain.pose(joints)
    linear, angular = chain.jacobians(joints)
    chosen = list(rows.positions)
    error = (position - now_position)[:, chosen] / length
    jacobian = linear[:, chosen] / length
    if rows.turns is not None and not len(rows.turns):
        return error, jacobian
    turn = _turn(target, now_rotation, rotation)
    turns = (
        np.swapaxes(now_rotation, -1, -2)[:, :2]
        if rows.turns is None
        else np.broadcast_to(rows.turns, (len(joints), *rows.turns.shape))
    )
    return (
        np.concatenate([error, (turns @ turn[..., None])[..., 0]], axis=-1),
        np.concatenate([jacobian, turns @ angular], axis=-2),
    )


def _step(jacobian: Floats, error: Floats, to_home: Floats) -> Floats:
    """Newton's step, towards home where the arm has joints to spare."""
    n_rows, n_joints = jacobian.shape[-2:]
    transposed = np.swapaxes(jacobian, -1, -2)
    if n_rows < n_joints:
        normal, wanted = jacobian @ transposed, error - _times(jacobian, to_home)
        return to_home + _times(transposed, _solve(normal, wanted))
    if n_rows == n_joints:
        return _solve(jacobian, error)
    return _solve(transposed @ jacobian, _times(transposed, error))


def _solve(matrix: Floats, right: Floats) -> Floats:
    """Solves a batch of systems, damped by a rounding error, so that a singular one stops none."""
    size = np.linalg.norm(matrix, axis=(-1, -2), keepdims=True) + np.finfo(float).tiny
    damped = matrix + 1e-15 * size * np.eye(matrix.shape[-1])
    return np.linalg.solve(damped, right[..., None])[..., 0].astype(float)


def _times(matrix: Floats, vector: Floats) -> Floats:
    return (matrix @ vector[..., None])[..., 0]


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(vectors, axis=-1), float)


def _turn(target: Target, now: Floats, wanted: Floats) -> Floats:
    """The turn still to be made, as rotation vectors in the base frame [rad], shape (..., 3)."""
    if target.orientation == "free":
        return np.zeros(now.shape[:-1])
    if target.orientation == "axis":
        a, b = now[..., 2], wanted[..., 2]
        cross, cosine = np.cross(a, b), np.sum(a * b, axis=-1, keepdims=True)
    else:
        between = wanted @ np.swapaxes(now, -1, -2)
        cross = np.stack(
            [
                between[..., 2, 1] - between[..., 1, 2],
                between[..., 0, 2] - between[..., 2, 0],
                between[..., 1, 0] - between[..., 0, 1],
            ],
            axis=-1,
        )  # fmt: skip
        cross, cosine = cross / 2, (np.trace(between, axis1=-2, axis2=-1)[..., None] - 1) / 2
    sine = np.linalg.norm(cross, axis=-1, keepdims=True)
    return cross * np.where(sine > 0, np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1), 1)


def _rotation(vectors: Floats) -> Floats:
    """Rotation matrices of rotation vectors [rad], shape (..., 3): Rodrigues' formula."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack(
        [np.stack(row, axis=-1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], axis=-2
    )
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * (cross @ cross)
