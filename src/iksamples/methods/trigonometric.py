"""A model of the arm that knows only that its joints turn; it needs no drawing."""

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats
from iksamples.methods.predictor import NotApplicableError, Single
from iksamples.samples.dataset import SampleSet
from iksamples.task import Task


MOST_JOINTS = 4
"""Moving joints: with five, the model has 243 numbers for each coordinate of the tool."""
ARRIVED_MM = 1e-6
"""An answer puts the model's tool within this of where it is asked to be [mm]."""
_RIDGES = np.logspace(-24, 1, 101)
_CAP_RAD = 0.3
_ITERATIONS = 100


def fit(task: Task, samples: SampleSet) -> Single:
    """Answers with the joints that are right for ``x = K phi(q)``, found by Newton's method.

    Where the tool of an arm of n revolute joints is, is linear in the 3^n products of 1, cos(q_i)
    and sin(q_i) (Ulbrich, Ruiz de Angulo, Asfour, Torras and Dillmann, "Kinematic Bezier maps",
    *IEEE Trans. SMC-B* 42, 2012): 27 noiseless samples of three joints make it exact. K is fitted
    by ridge regression. Newton's method starts at the nearest sample, whose branch it stays on; NaN
    where it does not arrive.

    Raises:
        NotApplicableError: A joint slides, the orientation is asked for, or the joints that move
            in the samples are more than four, or other in number than the inputs.
    """
    moving = np.flatnonzero(np.ptp(samples.joints, axis=0) > 1e-9)
    units = [task.q.units[i] for i in moving]
    if task.turns or "mm" in units or not len(task.x) == len(moving) <= MOST_JOINTS:
        raise NotApplicableError(
            f"trigonometric: for at most {MOST_JOINTS} revolute joints that place the tool, as "
            f"many as there are inputs, with its orientation free; here {len(moving)} joints move "
            f"({units.count('mm')} slide) and the inputs are {', '.join(task.x.names)}. Use "
            "calibrated or residual."
        )
    q = samples.joints[:, moving]
    model = ridge(products(q), samples.x)

    def answer(x: Floats) -> Floats:
        from scipy.spatial import KDTree

        _, nearest = KDTree(samples.x).query(x)
        joints = samples.joints[nearest].copy()
        joints[:, moving] = _solved(model, x, q[nearest])
        return joints

    return Single(answer)


def products(q: Floats) -> Floats:
    """Products of 1, cos(q_i) or sin(q_i) of each joint, shape (n, joints) to (n, 3^joints)."""
    found = np.ones((len(q), 1))
    for value in q.T:
        own = np.stack([np.ones_like(value), np.cos(value), np.sin(value)], axis=-1)
        found = (found[:, :, None] * own[:, None]).reshape(len(q), -1)
    return found


def ridge(features: Floats, targets: Floats) -> Floats:
    """Ridge regression without intercept, with the ridge of largest evidence.

    The weights are taken for normal about zero, the noise likewise; both variances follow from the
    samples (Bishop, *Pattern Recognition and Machine Learning*, sec. 3.5).

    Args:
        features: Shape (n, features).
        targets: Shape (n, d).

    Returns:
        Weights, shape (features, d).
    """
    left, values, right = np.linalg.svd(features, full_matrices=False)
    seen = left.T @ targets
    unseen = float(np.sum(targets**2) - np.sum(seen**2))
    n, d = targets.shape
    best, found = -np.inf, np.empty(0)
    for own in _RIDGES * values[0] ** 2:
        variances = values**2 + own
        squares = np.sum(seen**2 / variances[:, None]) + max(unseen, 0.0) / own
        others = (n - len(values)) * np.log(own)
        evidence = -n * d * np.log(squares) - d * (np.log(variances).sum() + others)
        if evidence > best:
            best, found = evidence, right.T @ (seen * (values / variances)[:, None])
    return found


def _solved(model: Floats, x: Floats, start: Floats) -> Floats:
    """Joints that the model has at some inputs, by Newton's method from a start; NaN if none."""
    q, n_joints = start.copy(), start.shape[1]
    tensor = model.reshape((3,) * n_joints + (-1,))
    for _ in range(_ITERATIONS):
        cos, sin, one = np.cos(q), np.sin(q), np.ones_like(q)
        values = np.stack([one, cos, sin], axis=-1)
        slopes = np.stack([0 * one, -sin, cos], axis=-1)
        off = x - _contracted(tensor, values)
        if np.max(np.abs(off)) < ARRIVED_MM / 1e3:
            break
        jacobian = np.stack(
            [
                _contracted(tensor, np.where(np.arange(n_joints)[:, None] == i, slopes, values))
                for i in range(n_joints)
            ],
            axis=-1,
        )
        step = (np.linalg.pinv(jacobian) @ off[..., None])[..., 0]
        largest = np.max(np.abs(step), axis=-1, keepdims=True)
        q += step * np.minimum(1.0, _CAP_RAD / np.maximum(largest, _CAP_RAD))
    q[np.linalg.norm(x - products(q) @ model, axis=-1) > ARRIVED_MM] = np.nan
    return q


def _contracted(tensor: Floats, factors: NDArray[np.float64]) -> Floats:
    """The model's value for one factor of three numbers per joint, shape (points, d)."""
    found = np.broadcast_to(tensor, (len(factors), *tensor.shape))
    for i in range(factors.shape[1]):
        found = np.einsum("pa...,pa->p...", found, factors[:, i])
    return found
