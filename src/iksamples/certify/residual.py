"""How far the arm misses over a box: the network's enclosure sent through the forward kinematics.

The residual is ``y(x) = position(f(x)) - x`` on the compared coordinates. Its linear part
``J A - I`` is formed before any absolute value is taken: both halves are large and nearly cancel.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.enclosure import (
    Expansion,
    corners,
    expand,
    half_of_corners,
    mirrored,
    pairs,
)
from iksamples.certify.jets import Linkage, bending_mm, cubic_remainder_mm
from iksamples.certify.layers import Layers
from iksamples.certify.rounding import search_slack_mm
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CACHE = 400_000
"""Values of the largest array of one piece of work."""
_SLACK = 64.0
"""How many roundings of the plain evaluation the search allows itself. Generous, not proved: the
checker is the proof."""


@dataclass(frozen=True)
class Comparison:
    """Which coordinates of the tip are meant to equal which inputs of the network.

    A network of more inputs than coordinates (a pose, a redundancy parameter) is compared on some
    of its inputs; a planar arm on two coordinates of its tip.

    Attributes:
        coordinates: Coordinates of the tip's position (0 is x).
        inputs: The network's input that each of them is compared with.
    """

    coordinates: tuple[int, ...]
    inputs: tuple[int, ...]

    @classmethod
    def default(cls, n_inputs: int) -> "Comparison":
        """The first coordinates with the first inputs."""
        n = min(n_inputs, 3)
        return cls(tuple(range(n)), tuple(range(n)))

    def check(self, n_inputs: int) -> None:
        """Raises an IksamplesError unless the tip and that many inputs can be compared so."""
        if not (
            0 < len(self.coordinates) == len(self.inputs)
            and all(0 <= i < 3 for i in self.coordinates)
            and all(0 <= i < n_inputs for i in self.inputs)
        ):
            raise IksamplesError(
                f"cannot compare coordinates {self.coordinates} of the tip with inputs "
                f"{self.inputs} of a network that has {n_inputs}."
            )


@dataclass(frozen=True, eq=False)
class Residual:
    """The residual over boxes; ``s`` in [-1, 1]^d runs through the box.

    ``y(s)`` is ``centre + linear s + quadratic (s s)`` plus the noise plus a remainder.

    Attributes:
        centre_mm: Shape (boxes, coordinates).
        linear_mm: Shape (boxes, d, coordinates).
        quadratic_mm: Factors of the products ``pairs(d)``, shape (boxes, pairs, coordinates).
        noise_mm: One row per symbol of the network's enclosure, shape (boxes, symbols,
            coordinates).
        reach: Reach of the symbols at the corners (``enclosure.Expansion``), shape (boxes, corners,
            symbols).
        one_sided: Whether the symbols lean to one side.
        remainder_mm: Norm of the remainder at the corners of the box, convex in s, shape
            (boxes, corners).
        most_mm: No residual over a box is larger, by the arm's reach alone, shape (boxes,).
        weight_mm: How much is lost to the extent of the box along each axis, roughly; says which
            axis is worth splitting, shape (boxes, d).
    """

    centre_mm: Floats
    linear_mm: Floats
    quadratic_mm: Floats
    noise_mm: Floats
    reach: Floats
    one_sided: bool
    remainder_mm: Floats
    most_mm: Floats
    weight_mm: Floats

    def largest(self, targets_mm: Floats | None = None) -> tuple[Floats, Ints]:
        """Upper bounds of ``|y|``, and the corner where each is taken.

        A square lies in [0, 1] whatever ``s`` is. Everything else is affine in each coordinate of
        ``s`` alone, or noise whose reach is convex. The largest norm, which is the largest of
        ``n . y`` over unit vectors n, is then convex in each coordinate alone, so its maximum over
        the box is at a corner.

        Args:
            targets_mm: Something multilinear to subtract, given at the corners, shape (boxes,
                corners, coordinates).
        """
        d = self.linear_mm.shape[1]
        squares, mixed = self.quadratic_mm[:, :d], self.quadratic_mm[:, d:]
        middle = self.centre_mm + 0.5 * squares.sum(axis=1)
        at_corners = corner_products(d) @ np.concatenate([self.linear_mm, mixed], axis=1)
        reach = 0.5 * np.abs(squares).sum(axis=1)[:, None]
        if self.noise_mm.shape[1]:
            reach = reach + self.reach @ np.abs(self.noise_mm)
            if self.one_sided:
                middle -= self.noise_mm.sum(axis=1)
                at_corners += self.reach @ self.noise_mm
        at_corners += middle[:, None]
        if targets_mm is not None:
            at_corners -= targets_mm
        reach = reach + np.abs(at_corners)
        upper = np.sqrt(np.einsum("bvk,bvk->bv", reach, reach)) + self.remainder_mm
        upper = np.where(np.isnan(upper), np.inf, upper)  # what overflowed says nothing
        worst = upper.argmax(axis=1)
        return upper[np.arange(len(upper)), worst], worst


class ErrorOverBoxes:
    """The position errors of stacked networks on an arm, at points and over boxes."""

    def __init__(
        self,
        network: StackedMLP,
        chain: SerialChain,
        region: Region,
        compare: Comparison | None = None,
    ) -> None:
        """Checks that everything fits together.

        Args:
            network: Stacked networks.
            chain: The arm.
            region: The inputs that it is about.
            compare: What is compared; ``Comparison.default`` if None.

        Raises:
            IksamplesError: The network, the arm, the region and what is compared do not fit
                together.
        """
        self.layers = Layers.of(network)
        self.linkage = Linkage.of(chain)
        self.region = region
        if region.n_inputs != self.layers.n_inputs:
            raise IksamplesError(
                f"the box needs {self.layers.n_inputs} lower and {self.layers.n_inputs} upper "
                f"limits, one per input of the network; got {region.n_inputs} of either."
            )
        self.compare = compare or Comparison.default(self.layers.n_inputs)
        if self.layers.n_outputs != self.linkage.n_joints:
            raise IksamplesError(
                f"the network answers {self.layers.n_outputs} joint values, the arm has "
                f"{self.linkage.n_joints} joints."
            )
        self.compare.check(self.layers.n_inputs)
        self.slack_mm = _SLACK * search_slack_mm(self.layers, self.linkage, region)

    @property
    def n_networks(self) -> int:
        """Number of stacked networks."""
        return self.layers.n_networks

    @np.errstate(all="ignore")
    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Errors [mm] at single points, shape (points,)."""
        reached = self.linkage.position_mm(self.layers.predict(points_mm, which))
        miss = reached[:, self.compare.coordinates] - points_mm[:, self.compare.inputs]
        values = np.sqrt(np.einsum("pk,pk->p", miss, miss))
        return np.where(np.isfinite(values), values, 0.0)  # what overflows shows nothing

    @np.errstate(all="ignore")
    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds [mm] of the errors over boxes.

        Args:
            which: The network that each box is for, shape (boxes,).
            centre_mm: Centres of the boxes, shape (boxes, d).
            radius_mm: Their half edges, shape (boxes, d).

        Returns:
            The bounds; the corner of each box where its bound is taken; how much is lost to its
            extent along each axis. Shapes (boxes,), (boxes, 1, d), (boxes, d).
        """
        upper, worst, weight = (
            np.empty(len(which)),
            np.empty(len(which), int),
            np.empty_like(radius_mm),
        )
        # Pieces that stay in the cache: the largest arrays hold a value per corner and neuron.
        neurons = sum(matrix.shape[2] for matrix in self.layers.weights)
        step = max(64, _CACHE // (2 ** centre_mm.shape[1] * neurons))
        for first in range(0, len(which), step):
            some = slice(first, first + step)
            residual = self.residual(which[some], centre_mm[some], radius_mm[some])
            largest, worst[some] = residual.largest()
            upper[some] = np.fmin(largest + self.slack_mm[which[some]], residual.most_mm)
            weight[some] = residual.weight_mm
        corner = centre_mm + corners(centre_mm.shape[1])[worst] * radius_mm
        return upper, corner[:, None], weight

    @np.errstate(all="ignore")
    def residual(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats, minus_identity: bool = True
    ) -> Residual:
        """Encloses the residual over boxes.

        Args:
            which: The network that each box is for, shape (boxes,).
            centre_mm: Centres of the boxes, shape (boxes, d).
            radius_mm: Their half edges, shape (boxes, d).
            minus_identity: Whether the inputs are subtracted (else it is the tip's position).
        """
        d = centre_mm.shape[1]
        first, second = pairs(d)
        joints = expand(self.layers, which, centre_mm, radius_mm)
        position, jacobian, hessian = self.linkage.jets(joints.centre)
        rows = list(self.compare.coordinates)
        if rows != [0, 1, 2]:
            position, jacobian, hessian = position[rows], jacobian[rows], hessian[rows]

        # The jets leave the axis of the coordinates in front, the polynomials have it last.
        gradient = jacobian.transpose(1, 2, 0)
        centre, linear = position.T, joints.linear @ gradient
        if minus_identity:
            inputs = list(self.compare.inputs)
            centre = centre - centre_mm[:, inputs]
            linear[:, inputs, range(len(inputs))] -= radius_mm[:, inputs]
        across = joints.linear.transpose(0, 2, 1)
        bent = (joints.linear @ (hessian @ across)).transpose(1, 2, 3, 0)
        quadratic = bent[:, first, second]
        quadratic[:, d:] += bent[:, second[d:], first[d:]]
        if joints.quadratic.shape[1]:
            quadratic += joints.quadratic @ gradient
        noise = joints.noise @ gradient
        bends = np.abs(quadratic).sum(axis=2)
        weight = (joints.shares @ np.abs(noise).sum(axis=2)[:, :, None])[:, :, 0]
        weight += bends @ _axes_of_pairs(d)

        # Changes of the angles: the linear part corner by corner (opposite corners have opposite
        # changes, so half of them do), everything else at its largest.
        sums = self.linkage.angle_sums.T
        turns = self.linkage.turns(np.abs(half_of_corners(d) @ (joints.linear @ sums)))
        small_turns = self.linkage.turns(_largest(joints.quadratic, joints.noise, sums))[:, None]
        lengths = self.linkage.lengths_mm(joints.centre)[:, None]
        shifts: Floats | float = 0.0
        small_shifts: Floats | float = 0.0
        if self.linkage.slides_at_all:
            shifts = self.linkage.shifts_mm(np.abs(half_of_corners(d) @ joints.linear))
            small_shifts = self.linkage.shifts_mm(_largest(joints.quadratic, joints.noise))[:, None]
        remainder = bending_mm(lengths, turns, small_turns, shifts, small_shifts)
        remainder += cubic_remainder_mm(lengths, turns + small_turns, shifts + small_shifts)
        weight += self._blame(joints.linear, lengths, remainder, radius_mm)
        return Residual(
            centre,
            linear,
            quadratic,
            noise,
            joints.reach,
            joints.one_sided,
            mirrored(remainder),
            self._most_mm(joints, which, centre_mm, radius_mm),
            weight,
        )

    def _most_mm(
        self, joints: Expansion, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> Floats:
        """How far the tip can be from the inputs whatever the network answers, shape (boxes,).

        What no joint turns is in one place, the rest no farther from there than it is long; only
        where joints slide it matters by how much.
        """
        inputs, linkage = list(self.compare.inputs), self.linkage
        vectors = linkage.vectors_at(joints.centre)
        fixed = vectors[:, 0, list(self.compare.coordinates)]
        apart = np.abs(fixed - centre_mm[:, inputs]) + np.abs(radius_mm[:, inputs])
        most = np.sqrt(np.einsum("bk,bk->b", apart, apart))
        most += np.linalg.norm(vectors[:, 1:], axis=2).sum(axis=1)
        if linkage.slides_at_all:
            change = np.abs(joints.linear).sum(axis=1) + _largest(joints.quadratic, joints.noise)
            most += change @ np.linalg.norm(linkage.slides, axis=2).sum(axis=0)
            most += self.slack_mm[which]
        return np.where(np.isnan(most), np.inf, most * (1.0 + 1e-12))

    def _blame(
        self, linear: Floats, lengths_mm: Floats, remainder_mm: Floats, radius_mm: Floats
    ) -> Floats:
        """Which edges the remainder is due to, roughly, shape (boxes, d)."""
        # By how far each edge alone turns the vectors, weighted as in the cubic remainder.
        turns = self.linkage.turns(np.abs(linear @ self.linkage.angle_sums.T))
        whole = turns.sum(axis=1, keepdims=True)
        due = (turns * (lengths_mm * whole**2)).sum(axis=2)
        # Any edge may be to blame for what is not linear, so every edge is halved in the end.
        edges = radius_mm / (self.region.upper_corner - self.region.lower_corner)
        due /= np.maximum(due.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        due += 0.2 * edges / edges.sum(axis=1, keepdims=True)
        return remainder_mm.max(axis=1)[:, None] * due


@lru_cache(maxsize=16)
def corner_products(d: int) -> Floats:
    """The coordinates of the corners and their mixed products, shape (2^d, d (d + 1) / 2)."""
    at = corners(d)
    first, second = pairs(d)
    return np.concatenate([at, at[:, first[d:]] * at[:, second[d:]]], axis=1)


@lru_cache(maxsize=16)
def _axes_of_pairs(d: int) -> Floats:
    """The axes that each of ``pairs(d)`` is made of, half each, shape (pairs, d)."""
    first, second = pairs(d)
    return 0.5 * (np.eye(d)[first] + np.eye(d)[second])


def _largest(quadratic: Floats, noise: Floats, matrix: Floats | None = None) -> Floats:
    """Largest absolute value of everything that is not linear, shape (boxes, values)."""
    total = np.zeros((len(noise), noise.shape[2]))
    for rows in (quadratic, noise):
        if rows.shape[1]:
            total += np.abs(rows if matrix is None else rows @ matrix).sum(axis=1)
    return total
