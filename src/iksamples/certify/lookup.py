"""The certified worst case of a look-up table: multilinear interpolation, cell by cell.

In a cell the table's joint values are affine along each axis, so over any box inside it they are
known from the box's corners. They are sent through the forward kinematics to second order with a
bound of the rest, as a network's are, and boxes are halved until upper and lower bound meet.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.certify.jets import Linkage, bending_mm, cubic_remainder_mm
from iksamples.errors import IksamplesError
from iksamples.methods import multilinear
from iksamples.methods.tensor import tensor_grid
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study


Ints = NDArray[np.int64]

_CORNERS: Floats = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""The corners of [-1, 1]^3; the first is the lower one, the last the upper one."""
_ROUNDING = 2.0**-53
_SLACK = 256.0
"""How many roundings of the plain evaluation are allowed for. Generous, not proved."""
_BATCH = 4096
_TRIED = 256
"""Boxes of a round, the most promising ones, at which the error itself is evaluated."""


@dataclass(frozen=True, eq=False)
class TableCertificate:
    """A certified worst-case position error of a look-up table over the workspace.

    Attributes:
        lower_mm: An error that is taken, at ``argmax_mm`` [mm].
        upper_mm: No position of the workspace has a larger error [mm].
        argmax_mm: Where the largest known error is [mm], shape (3,).
        cells: Cells of the table.
        boxes: Boxes bounded.
        seconds: Time spent.
        complete: Whether upper and lower met to the tolerance. ``upper_mm`` holds in any case.
    """

    lower_mm: float
    upper_mm: float
    argmax_mm: Floats
    cells: int
    boxes: int
    seconds: float
    complete: bool


def certify_table(
    study: Study,
    chain: SerialChain,
    samples: SampleSet,
    *,
    rtol: float = 1e-3,
    max_boxes: int = 1_000_000,
) -> TableCertificate:
    """The largest position error of the multilinear table over the study's workspace, enclosed.

    Starts from the cells. In each round every box is bounded, those that cannot exceed the largest
    error known by more than the tolerance are closed, and the others are halved along the axis
    that moves the tip most.

    Args:
        study: The study.
        chain: Its arm.
        samples: A full grid; cells at its edge reach as far as the workspace does.
        rtol: The search ends once upper <= (1 + rtol) lower.
        max_boxes: No further round begins once so many boxes are bounded.

    Raises:
        NotApplicableError: The samples are no full grid.
        IksamplesError: The table has a joint value that is not finite.
    """
    began = time.perf_counter()
    cells = TableCells.of(study, chain, samples)
    which = np.arange(len(cells.low_mm))
    centre = np.full(cells.low_mm.shape, 0.5)
    radius = centre.copy()
    best, argmax, closed, boxes = -np.inf, cells.low_mm[0], -np.inf, 0
    while True:
        batches = (slice(i, i + _BATCH) for i in range(0, len(which), _BATCH))
        parts = [cells.upper_bounds_mm(which[i], centre[i], radius[i]) for i in batches]
        bound, corner, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        boxes += len(which)

        top = np.argsort(bound)[-_TRIED:]
        tried = np.concatenate([which[top], which[top]])
        shares = np.concatenate([centre[top], corner[top]])
        values = cells.errors_mm(tried, shares)
        first = int(values.argmax())
        if values[first] > best:
            best = float(values[first])
            argmax = cells.position_mm(tried[first : first + 1], shares[first : first + 1])[0]

        threshold = (1.0 + rtol) * best + 2.0 * cells.slack_mm
        still = bound > threshold
        closed = max(closed, bound[~still].max(initial=-np.inf))
        if not still.any() or boxes >= max_boxes:
            break
        which, centre, radius, weight = (part[still] for part in (which, centre, radius, weight))
        step = np.zeros_like(radius)
        rows = np.arange(len(which)), weight.argmax(axis=1)
        step[rows] = 0.5 * radius[rows]
        which, radius = np.concatenate([which, which]), np.concatenate([radius - step] * 2)
        centre = np.concatenate([centre - step, centre + step])

    upper = float(max(closed, bound[still].max(initial=-np.inf), best))
    return TableCertificate(
        max(best - cells.slack_mm, 0.0),
        upper,
        argmax,
        len(cells.low_mm),
        boxes,
        time.perf_counter() - began,
        upper <= threshold,
    )


@dataclass(frozen=True, eq=False)
class TableCells:
    """The cells of a table. Positions in a cell are given as shares of its edges, in [0, 1].

    Attributes:
        low_mm: Lower corners, shape (cells, 3).
        size_mm: Edges, shape (cells, 3).
        joints: Joint values at the corners, in the order of ``_CORNERS``, shape (cells, 8, joints).
        linkage: The arm.
        slack_mm: What rounding may add to an error [mm].
    """

    low_mm: Floats
    size_mm: Floats
    joints: Floats
    linkage: Linkage
    slack_mm: float

    @classmethod
    def of(cls, study: Study, chain: SerialChain, samples: SampleSet) -> "TableCells":
        """Cuts the workspace along the table's nodes.

        The outermost cells go on to the workspace's walls, or end there, as the table itself does.

        Raises:
            NotApplicableError: The samples are no full grid.
            IksamplesError: The table has a joint value that is not finite.
        """
        lower, upper = np.array(study.workspace.lower_mm), np.array(study.workspace.upper_mm)
        edges = []
        for i, nodes in enumerate(tensor_grid(samples, "multilinear").axes):
            # Not cut at the outermost nodes, beyond which the outermost cells go on.
            cuts = nodes[1:-1][(nodes[1:-1] > lower[i]) & (nodes[1:-1] < upper[i])]
            edges.append(np.concatenate([lower[i : i + 1], cuts, upper[i : i + 1]]))
        crossings = np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1)
        table = multilinear.fit(samples).predict(crossings.reshape(-1, 3))[0]
        if not np.isfinite(table).all():
            raise IksamplesError(
                f"{samples.label}: a joint value of the table is not finite; it has no worst case."
            )

        cells = np.indices([len(edge) - 1 for edge in edges]).reshape(3, -1).T
        at = tuple(np.moveaxis(cells[:, None] + (_CORNERS > 0), -1, 0))
        corners_mm = crossings[at]
        linkage = Linkage.of(chain)
        ranges = np.maximum(np.abs(table).max(axis=0), np.abs(samples.joints).max(axis=0))
        reach = np.linalg.norm(linkage.vectors_mm[0]) + linkage.levers_mm(ranges) @ (1.0 + ranges)
        size = reach + np.abs([lower, upper]).max()
        return cls(
            corners_mm[:, 0],
            corners_mm[:, -1] - corners_mm[:, 0],
            table.reshape(*crossings.shape[:-1], -1)[at],
            linkage,
            float(_SLACK * linkage.n_joints * _ROUNDING * size),
        )

    def position_mm(self, which: Ints, shares: Floats) -> Floats:
        """Positions [mm] of points of cells, shape (points, 3)."""
        return self.low_mm[which] + self.size_mm[which] * shares

    def errors_mm(self, which: Ints, shares: Floats) -> Floats:
        """Position errors [mm] at points of cells, shape (points,)."""
        reached = self.linkage.position_mm(self._answer(which, shares[:, None])[:, 0])
        return np.linalg.norm(reached - self.position_mm(which, shares), axis=-1)

    def upper_bounds_mm(
        self, which: Ints, centre: Floats, radius: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds of the errors over boxes.

        Args:
            which: The cell that each box is in, shape (boxes,).
            centre: Centres of the boxes, shape (boxes, 3).
            radius: Their half edges, shape (boxes, 3).

        Returns:
            The bounds [mm], shape (boxes,); the corner at which each is taken, shape (boxes, 3);
            how far the tip moves along each axis of the box [mm], shape (boxes, 3).
        """
        at = self._answer(which, centre[:, None] + _CORNERS * radius[:, None])
        middle = at.mean(axis=1)
        change = at - middle[:, None]
        linear = _CORNERS.T @ at / len(_CORNERS)
        straight = _CORNERS @ linear

        # To first order in the joints, and to second in their linear part, the miss is affine along
        # each axis but for squares, and a norm of such a thing is largest at a corner. A square is
        # 1 there, and anything in [0, 1] elsewhere.
        position, jacobian, hessian = self.linkage.jets(middle)
        gradient = jacobian.transpose(1, 2, 0)
        miss = (position.T - self.position_mm(which, centre))[:, None]
        miss = miss + change @ gradient - _CORNERS * (self.size_mm[which] * radius)[:, None]
        miss += np.einsum("bvi,kbij,bvj->bvk", straight, hessian, straight)
        squares = 0.5 * np.einsum("bai,kbij,baj->bak", linear, hessian, linear)
        miss -= squares.sum(axis=1)[:, None]
        farthest = np.linalg.norm(np.abs(miss) + np.abs(squares).sum(axis=1)[:, None], axis=-1)
        upper = farthest.max(axis=1) + self._remainder_mm(middle, straight, change - straight)
        corner = centre + _CORNERS[farthest.argmax(axis=1)] * radius
        return upper + self.slack_mm, corner, np.linalg.norm(linear @ gradient, axis=-1)

    def _remainder_mm(self, middle: Floats, straight: Floats, bent: Floats) -> Floats:
        """What is left out of the second order, and all beyond it [mm], shape (boxes,).

        Args:
            middle: Joint values at the boxes' centres, shape (boxes, joints).
            straight: The linear part's change of them at the corners, shape (boxes, 8, joints).
            bent: The other part's, likewise. Either's absolute value is largest at a corner.
        """
        linkage = self.linkage
        lengths = linkage.lengths_mm(middle)
        turns, small_turns = (
            linkage.turns(np.abs(part @ linkage.angle_sums.T).max(axis=1))
            for part in (straight, bent)
        )
        shifts, small_shifts = (
            linkage.shifts_mm(np.abs(part).max(axis=1)) for part in (straight, bent)
        )
        return bending_mm(lengths, turns, small_turns, shifts, small_shifts) + cubic_remainder_mm(
            lengths, turns + small_turns, shifts + small_shifts
        )

    def _answer(self, which: Ints, shares: Floats) -> Floats:
        """The table's joint values at points of cells, shape (cells, points, joints)."""
        along = shares[..., None, :]
        weights = np.where(_CORNERS > 0, along, 1.0 - along).prod(axis=-1)
        return weights @ self.joints[which]
