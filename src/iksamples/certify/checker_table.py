"""The checker's own enclosure of a look-up table, in ball arithmetic."""

from itertools import combinations

import numpy as np

from iksamples.certify.balls import UNIT, Ball, stack, up
from iksamples.certify.checker_network import Terms, corners, mixed_pairs
from iksamples.certify.table import Table
from iksamples.errors import IksamplesError


class CheckedTable:
    """A look-up table whose nodes and joint values are known exactly."""

    def __init__(self, table: Table) -> None:
        """Refuses what is no table.

        Raises:
            IksamplesError: Nodes do not increase, or a number is not finite.
        """
        self.axes = [np.array(axis, np.float64) for axis in table.axes]
        self.joints = np.array(table.joints, np.float64)
        if not (
            self.joints.shape[:-1] == tuple(len(axis) for axis in self.axes)
            and np.isfinite(self.joints).all()
            and all(np.isfinite(axis).all() and (np.diff(axis) > 0).all() for axis in self.axes)
            and min(self.joints.shape[:-1]) > 1
        ):
            raise IksamplesError("the checker knows only finite tables on increasing nodes.")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.axes)

    @property
    def n_outputs(self) -> int:
        """Number of joints."""
        return self.joints.shape[-1]

    def answer(self, positions: Ball) -> Ball:
        """Joint values at points, shape (points, joints)."""
        return self.terms(positions, Ball.of(np.zeros(positions.shape))).centre

    def terms(self, centre: Ball, half: Ball) -> Terms:
        """The table over leaves: in each a polynomial that is linear in every variable.

        Each leaf lies in one cell, since regions are cut at the nodes; where rounding hides in
        which, it gets NaN, which proves nothing. Products of up to two variables are kept; those of
        more are noise, of a factor that is known exactly at the corners.
        """
        leaves, d = centre.shape
        cells = [
            np.searchsorted(axis[1:-1], centre.mid[:, i], side="right")
            for i, axis in enumerate(self.axes)
        ]
        for i, axis in enumerate(self.axes):
            edges = np.concatenate([[-np.inf], axis[1:-1], [np.inf]])
            exact = centre.rad[:, i] == 0
            low = np.where(exact, centre.mid[:, i], centre[:, i].lower())
            high = np.where(exact, centre.mid[:, i], centre[:, i].upper())
            lost = (low < edges[cells[i]]) | (high > edges[cells[i] + 1])
            half = Ball(np.where(lost[:, None], np.nan, half.mid), half.rad)
        index = tuple(cells[i].reshape(-1, *[1] * d) + np.indices((2,) * d)[i] for i in range(d))
        polynomial: dict[tuple[int, ...], Ball] = {(): Ball.of(self.joints[index])}
        for i, axis in enumerate(self.axes):
            low, high = axis[cells[i]], axis[cells[i] + 1]
            length = Ball.of(high) - low
            mid = 1.0 / length.mid
            inverse = Ball(mid, up(8.0 * UNIT * np.abs(mid)))  # the length is right to UNIT
            start, slope = (centre[:, i] - low) * inverse, half[:, i] * inverse
            grown: dict[tuple[int, ...], Ball] = {}
            for variables, values in polynomial.items():
                apart = values[:, 1] - values[:, 0]
                shape = (-1, *[1] * (len(apart.shape) - 1))
                begin, along = (
                    Ball(b.mid.reshape(shape), b.rad.reshape(shape)) for b in (start, slope)
                )
                grown[variables] = values[:, 0] + begin * apart
                grown[(*variables, i)] = along * apart
            polynomial = grown

        nothing = Ball.of(np.zeros((leaves, 0, self.n_outputs)))
        higher = [v for k in range(3, d + 1) for v in combinations(range(d), k)]
        pairs = mixed_pairs(d)
        signs = corners(d)
        known = np.array([[np.prod(s[list(v)]) for v in higher] for s in signs])
        known = np.broadcast_to(known.reshape(len(signs), -1), (leaves, len(signs), len(higher)))
        return Terms(
            polynomial[()],
            stack([polynomial[(i,)] for i in range(d)], 1),
            Ball.of(np.zeros((leaves, d, self.n_outputs))),
            stack([polynomial[pair] for pair in pairs], 1) if pairs else nothing,
            stack([polynomial[v] for v in higher], 1) if higher else nothing,
            np.ones((leaves, len(higher))),
            known,
            known,
        )
