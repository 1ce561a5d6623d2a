"""Look-up tables: multilinear interpolation, known exactly over a box inside a cell."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.enclosure import Expansion, corners, pairs
from iksamples.certify.jets import Linkage
from iksamples.errors import IksamplesError
from iksamples.region import Region


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Table:
    """Joint values at the crossings of a grid, and between them by multilinear interpolation.

    Beyond the outermost nodes the outermost cells go on.

    Attributes:
        axes: The nodes along each input [mm or rad], increasing.
        joints: Joint values at the crossings [rad or mm], shape (m_1, .., m_d, joints).

    Raises:
        IksamplesError: A joint value is not finite, or there are fewer than two nodes on an axis.
    """

    axes: tuple[Floats, ...]
    joints: Floats

    def __post_init__(self) -> None:
        """Refuses what is no table."""
        shape = tuple(len(axis) for axis in self.axes)
        if self.joints.shape[:-1] != shape or min(shape) < 2:
            raise IksamplesError(f"a table of {shape} nodes has {self.joints.shape[:-1]} values.")
        if not np.isfinite(self.joints).all():
            raise IksamplesError("a joint value of the table is not finite; it has no worst case.")

    @property
    def n_networks(self) -> int:
        """A table is one."""
        return 1

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.axes)

    @property
    def n_outputs(self) -> int:
        """Number of joints."""
        return self.joints.shape[-1]

    @property
    def n_symbols(self) -> int:
        """Noise symbols of an enclosure: the products of three coordinates and more."""
        return 2**self.n_inputs

    def pieces(self, region: Region) -> Region:
        """A region cut along the table's inner nodes: each box lies in one cell."""
        return region.cut([axis[1:-1] for axis in self.axes])

    def predict(self, points: Floats, which: Ints) -> Floats:
        """Joint values at points, shape (points, joints); ``which`` says nothing."""
        return self._at(self.cells(points), points[:, None])[:, 0]

    def expand(self, which: Ints, centre: Floats, radius: Floats, average: bool) -> Expansion:
        """Encloses the answers over boxes, each inside a cell: exactly, up to products of two.

        Args:
            which: Says nothing.
            centre: Centres, shape (boxes, d).
            radius: Half edges, shape (boxes, d).
            average: Whether means over the boxes are asked for.
        """
        batch, d = centre.shape
        signs = corners(d)
        at = self._at(self.cells(centre), centre[:, None] + signs * radius[:, None])

        def factor(axes: tuple[int, ...]) -> Floats:
            """Of the product of some coordinates of s: its mean against the corners' values."""
            return np.einsum("v,bvn->bn", np.prod(signs[:, list(axes)], axis=1), at) / len(signs)

        higher = [axes for k in range(3, d + 1) for axes in combinations(range(d), k)]
        first, second = pairs(d)
        squares = np.zeros((batch, d, self.n_outputs))
        mixed = [factor((a, b)) for a, b in zip(first[d:], second[d:], strict=True)]
        noise = [factor(axes) for axes in higher]
        shares = np.array([[(a in axes) / len(axes) for axes in higher] for a in range(d)])
        return Expansion(
            at.mean(axis=1),
            np.stack([factor((a,)) for a in range(d)], axis=1),
            np.concatenate([squares, np.stack(mixed, axis=1)], axis=1) if mixed else squares,
            np.stack(noise, axis=1) if noise else np.zeros((batch, 0, self.n_outputs)),
            np.ones((batch, len(signs), len(higher))),
            np.ones((batch, int(average), len(higher))),
            False,
            np.broadcast_to(shares.reshape(d, len(higher)), (batch, d, len(higher))),
        )

    def rounding_mm(self, linkage: Linkage, outputs: list[int], region: Region) -> Floats:
        """What rounding may add to the tip's error where the table is evaluated, shape (1,)."""
        ends = np.array([region.lower_corner, region.upper_corner])
        stretch, digits = 1.0, 4.0
        for axis, (low, high) in zip(self.axes, ends.T, strict=True):
            # Beyond the nodes weights exceed one; far from the origin shares lose digits.
            first, last = axis[1] - axis[0], axis[-1] - axis[-2]
            beyond = max((axis[0] - low) / first, (high - axis[-1]) / last, 0.0)
            stretch *= 1.0 + 2.0 * beyond
            digits += 2.0 * max(np.abs(axis).max(), abs(low), abs(high)) / np.diff(axis).min()
        largest = stretch * np.abs(self.joints).reshape(-1, self.n_outputs).max(axis=0)[outputs]
        off = linkage.levers_mm(largest) @ largest * digits
        size = off + 32.0 * linkage.n_joints * (linkage.reach_mm(largest) + np.abs(ends).max())
        return np.array([2.0**-53 * size])

    def cells(self, points: Floats) -> Ints:
        """The cell that each point is in, shape (points, d)."""
        return np.stack(
            [
                np.searchsorted(axis[1:-1], points[:, i], side="right")
                for i, axis in enumerate(self.axes)
            ],
            axis=1,
        )

    def _at(self, cells: Ints, points: Floats) -> Floats:
        """Joint values at points (cells, points, d) by the polynomials of some cells."""
        values = self.corner_values(cells)[:, None]
        for i, axis in enumerate(self.axes):
            low, high = axis[cells[:, i]], axis[cells[:, i] + 1]
            share = (points[..., i] - low[:, None]) / (high - low)[:, None]
            share = share.reshape(*share.shape, *[1] * (values.ndim - 3))
            values = values[:, :, 0] + share * (values[:, :, 1] - values[:, :, 0])
        return values

    def corner_values(self, cells: Ints) -> Floats:
        """Joint values at the corners of cells, shape (cells, 2, .., 2, joints)."""
        d = self.n_inputs
        steps = np.indices((2,) * d)
        index = tuple(cells[:, i].reshape(-1, *[1] * d) + steps[i] for i in range(d))
        return self.joints[index]
