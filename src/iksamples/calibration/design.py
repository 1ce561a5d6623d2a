"""Which poses tell most about an arm: optimal designs for fitting its drawing.

The posterior's covariance does not depend on what will be measured, only on where; so poses can be
chosen, and what they will give can be said, before one is recorded (Atkinson, Donev and Tobias,
*Optimum Experimental Designs, with SAS*, ch. 10, 12 and 18). D-optimal poses leave the least volume
of what the deviations may be, G-optimal ones the least of the largest variance of the tool's
position over the postures that count.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.calibration.known import Fitted
from iksamples.errors import IksamplesError


CANDIDATES = 400
"""Poses out of which some are chosen."""
_NEWTON_STEPS = 60
_THERE_MM = 1e-6
_CAP = 0.3
_DRAWS = 20


def in_order(fitted: Fitted, informs: Floats, k: int) -> list[int]:
    """The candidates to record, one by one, each the best for D beside those before it.

    Args:
        fitted: What is known of the arm.
        informs: ``Measured.informs`` of the candidates, shape (candidates, rows, parameters).
        k: How many.

    Returns:
        Their indices.

    Raises:
        IksamplesError: There are fewer candidates.
    """
    if k > len(informs):
        raise IksamplesError(f"{k} poses out of {len(informs)} to choose from; ask for fewer.")
    rows = informs @ fitted.root
    chosen: list[int] = []
    while len(chosen) < k:
        scores = _open(rows, _covariance(rows[chosen]))
        scores[chosen] = np.inf
        chosen.append(int(np.argmin(scores)))
    return chosen


def optimal(fitted: Fitted, informs: Floats, k: int, judged: Floats | None = None) -> list[int]:
    """The candidates to record that are best all together: those ``in_order``, then exchanged.

    Args:
        fitted: As ``in_order``.
        informs: As ``in_order``.
        k: How many.
        judged: ``worst.judged_effects``, over which G is made least, shape (points, 3,
            parameters); None: D is.

    Raises:
        IksamplesError: There are fewer candidates.
    """
    chosen = in_order(fitted, informs, k)
    # In the coordinates in which the present posterior's covariance is one.
    rows = informs @ fitted.root
    some = None if judged is None else judged @ fitted.root
    for i in range(k):
        others = chosen[:i] + chosen[i + 1 :]
        covariance = _covariance(rows[others])
        scores = _open(rows, covariance) if some is None else _variances(rows, some, covariance)
        scores[others] = np.inf
        chosen[i] = int(np.argmin(scores))
    return chosen


def in_points(
    fitted: Fitted, informs: Sequence[Floats], counts: Sequence[int]
) -> list[NDArray[np.intp]]:
    """Postures with the tool held in points that nobody measured: best for D all together.

    Of a point's postures only their differences tell anything. So each is weighed by how far it
    is from the mean of that point's others, and exchanged for another of the same point as long
    as one tells more. A distance of points that is known is left out: it tells little beside them.

    Args:
        fitted: As ``in_order``.
        informs: For each point, as ``in_order`` has it: the postures that can be recorded there.
        counts: How many of each are to be recorded, at least two.

    Returns:
        Their indices, point by point.
    """
    rows = [some @ fitted.root for some in informs]
    chosen = [np.arange(k) for k in counts]
    centred = [own[some] - own[some].mean(axis=0) for own, some in zip(rows, chosen, strict=True)]
    better = True
    while better:
        better = False
        for at, (own, some) in enumerate(zip(rows, chosen, strict=True)):
            for i in range(len(some)):
                others = own[np.delete(some, i)]
                mean = others.mean(axis=0)
                centred[at] = others - mean
                # With one more the squares about the mean grow by this share of its own.
                new = np.sqrt(len(others) / len(some)) * (own - mean)
                scores = _open(new, _covariance(np.concatenate(centred)))
                scores[np.delete(some, i)] = np.inf
                best = int(np.argmin(scores))
                if scores[best] < scores[some[i]] - 1e-9:
                    some[i], better = best, True
            centred[at] = own[some] - own[some].mean(axis=0)
    return chosen


def _open(rows: Floats, covariance: Floats) -> Floats:
    """Minus the information that each candidate adds to what is known [nats], twice over."""
    own = rows @ covariance @ np.swapaxes(rows, 1, 2)
    return np.asarray(-np.linalg.slogdet(np.eye(rows.shape[1]) + own)[1])


def _variances(rows: Floats, judged: Floats, covariance: Floats) -> Floats:
    """The largest variance of the tool's position once each candidate is there as well."""
    n, r, p = rows.shape
    own = np.eye(r) + rows @ covariance @ np.swapaxes(rows, 1, 2)
    whitened = np.linalg.solve(np.linalg.cholesky(own), rows)
    before = judged @ covariance
    variance = np.einsum("mip,mip->m", before, judged)
    seen = (before.reshape(-1, p) @ whitened.reshape(-1, p).T).reshape(len(judged), -1, n, r)
    return np.asarray(np.max(variance[:, None] - np.sum(seen**2, axis=(1, 3)), axis=0))


def _covariance(rows: Floats) -> Floats:
    flat = rows.reshape(-1, rows.shape[-1])
    return np.asarray(np.linalg.inv(np.eye(flat.shape[1]) + flat.T @ flat), float)


def postures(
    chain: SerialChain,
    n: int,
    generator: np.random.Generator,
    positions: tuple[int, ...] = (0, 1, 2),
    places_mm: Floats | None = None,
) -> Floats:
    """Postures all over the joint space, inside the limits, with the tool in some places.

    Args:
        chain: The arm as drawn.
        n: How many.
        generator: Draws them.
        positions: Which of x, y and z the places say, as 0, 1, 2.
        places_mm: Where the tool may be [mm], shape (any, positions); None: anywhere.

    Returns:
        Joint values [rad or mm], shape (n, joints).

    Raises:
        IksamplesError: Hardly any posture has its tool there.
    """
    found = np.empty((0, chain.n_joints))
    for _ in range(_DRAWS):
        joints = generator.uniform(chain.lower, chain.upper, (2 * n, chain.n_joints))
        if places_mm is not None:
            x = generator.choice(places_mm, len(joints))
            joints = _brought(chain, joints, list(positions), x)
        found = np.concatenate([found, joints[chain.within_limits(joints)]])
        if len(found) >= n:
            return found[:n]
    raise IksamplesError(
        f"The workspace: of {_DRAWS * 2 * n} postures only {len(found)} have the tool there and "
        "are inside the joint limits. Move it, or widen the limits."
    )


def _brought(chain: SerialChain, joints: Floats, axes: list[int], x: Floats) -> Floats:
    """The postures near to some that have the tool in some points; NaN where none is found."""
    weight = np.where(chain.revolute, 1.0, 100.0)
    joints, left = joints.copy(), np.arange(len(joints))
    for _ in range(_NEWTON_STEPS):
        off = x[left] - chain.forward_mm(joints[left])[:, axes]
        far = np.abs(off).max(axis=1) >= _THERE_MM
        left, off = left[far], off[far, :, None]
        if not len(left):
            break
        jacobian = chain.jacobian_mm(joints[left])[:, axes]
        step = (np.linalg.pinv(jacobian, rcond=1e-6) @ off)[..., 0]
        largest = np.max(np.abs(step / weight), axis=1, keepdims=True)
        joints[left] += step * np.minimum(1.0, _CAP / np.maximum(largest, _CAP))
    joints[left] = np.nan
    return joints


def tour(joints: Floats, start: Floats) -> NDArray[np.intp]:
    """The order in which to visit some postures: the shortest way through the joint space, about.

    From neighbour to nearest neighbour, then 2-opt: a stretch is turned round as long as that is
    shorter (Croes, *Operations Research* 6, 1958). The way ends at the last posture.

    Args:
        joints: The postures, in units that can be compared, shape (poses, joints).
        start: Where the arm is before, shape (joints,).

    Returns:
        Their indices, shape (poses,).
    """
    at = np.concatenate([start[None], joints])
    apart = np.linalg.norm(at[:, None] - at, axis=-1)
    order, left = [0], set(range(1, len(at)))
    while left:
        order.append(min(left, key=lambda j: apart[order[-1], j]))
        left.remove(order[-1])
    shorter = True
    while shorter:
        shorter = False
        for i in range(1, len(order)):
            for j in range(i + 1, len(order)):
                before, first, last = order[i - 1], order[i], order[j]
                gain = apart[before, first] - apart[before, last]
                if j + 1 < len(order):
                    gain += apart[last, order[j + 1]] - apart[first, order[j + 1]]
                if gain > 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    shorter = True
    return np.array(order[1:]) - 1
