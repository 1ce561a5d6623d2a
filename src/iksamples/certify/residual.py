"""How far the arm misses over a box: the network's enclosure sent through the forward kinematics.

The residual is ``y(x) = position(f(x)) - x`` on the compared coordinates, or how far a tool axis is
from where it should point (``compared``). Its linear part ``J A - I`` is formed before any absolute
value is taken: both halves are large and nearly cancel.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.compared import Compared, Measure, angle_rad, compared
from iksamples.certify.enclosure import (
    Expansion,
    corners,
    pairs,
)
from iksamples.certify.jets import Linkage, largest_bend
from iksamples.certify.layers import Layers
from iksamples.certify.rounding import search_slack
from iksamples.certify.table import Table
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
        mean_reach: At least the mean of the reach over the box, shape (boxes, 1, symbols); no row
            where it was not asked for, as with the next mean.
        one_sided: Whether the symbols lean to one side.
        remainder_mm: Norm of the remainder at the corners of the box, convex in s, shape
            (boxes, corners).
        mean_remainder_mm: At least its mean over the box, shape (boxes, 1).
        most_mm: No residual over a box is larger, by the arm's reach alone, shape (boxes,).
        weight_mm: How much is lost to the extent of the box along each axis, roughly; says which
            axis is worth splitting, shape (boxes, d).
    """

    centre_mm: Floats
    linear_mm: Floats
    quadratic_mm: Floats
    noise_mm: Floats
    reach: Floats
    mean_reach: Floats
    one_sided: bool
    remainder_mm: Floats
    mean_remainder_mm: Floats
    most_mm: Floats
    weight_mm: Floats

    def at_corners(self) -> Floats:
        """What ``|y|`` can be at most at the corners, whose largest bounds it, (boxes, corners).

        Not a number where something overflowed, which says nothing.

        A square lies in [0, 1] whatever ``s`` is. Everything else is affine in each coordinate of
        ``s`` alone, or noise whose reach is convex. The largest norm, which is the largest of
        ``n . y`` over unit vectors n, is then convex in each coordinate alone, so its maximum over
        the box is at a corner. So is that of the root of the sum of several squared.
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
        reach = reach + np.abs(at_corners)
        return np.array(np.sqrt(np.einsum("bvk,bvk->bv", reach, reach)) + self.remainder_mm)

    def largest(self) -> Floats:
        """Upper bounds of ``|y|``, shape (boxes,)."""
        return np.array(self.at_corners().max(axis=1))


class ErrorOverBoxes:
    """The errors of networks, or of a look-up table, on an arm: at points and over boxes."""

    def __init__(
        self,
        answers: StackedMLP | Table,
        chain: SerialChain,
        region: Region,
        target: Target | None = None,
        measure: Measure = "position",
    ) -> None:
        """Checks that everything fits together.

        Args:
            answers: Stacked networks, or a look-up table.
            chain: The arm.
            region: The inputs that it is about.
            target: What is asked of the tool; ``compared.target_of`` the inputs if None.
            measure: ``"position"`` [mm] or ``"angle"`` [rad].

        Raises:
            IksamplesError: The network, the arm, the region and the target do not fit together.
        """
        self.answers = answers if isinstance(answers, Table) else Layers.of(answers)
        inputs = self.answers.n_inputs
        if region.n_inputs != inputs:
            raise IksamplesError(
                f"the box needs {inputs} lower and {inputs} upper limits, one per input of the "
                f"network; got {region.n_inputs} of either."
            )
        self.region = self.answers.pieces(region)
        self.extent = region.upper_corner - region.lower_corner
        self.measure = measure
        items = compared(chain, target, measure, inputs, self.answers.n_outputs)
        self.vectors = [
            _Carried(item, Linkage.of(item.chain), Linkage.of(item.goal) if item.goal else None)
            for item in items
        ]
        self.apart_slack = _SLACK * search_slack(self.answers, items, region)

    @property
    def n_networks(self) -> int:
        """Number of stacked networks."""
        return self.answers.n_networks

    @property
    def slack(self) -> Floats:
        """How far rounding may put a value off [mm or rad], by network, shape (networks,)."""
        return self._measured(self.apart_slack)

    @np.errstate(all="ignore")
    def values(self, which: Ints, points: Floats) -> Floats:
        """At least the errors [mm or rad] at single points, shape (points,)."""
        joints = self.answers.predict(points, which)
        squares = 0.0
        for vector in self.vectors:
            miss = vector.miss(joints, points)
            squares = squares + np.einsum("pk,pk->p", miss, miss)
        apart = np.maximum(np.sqrt(squares) - self.apart_slack[which], 0.0)
        return self._measured(np.where(np.isfinite(apart), apart, 0.0))  # overflow shows nothing

    @np.errstate(all="ignore")
    def upper_bounds(
        self, which: Ints, centre: Floats, radius: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds [mm or rad] of the errors over boxes.

        Args:
            which: The network that each box is for, shape (boxes,).
            centre: Centres of the boxes, shape (boxes, d).
            radius: Their half edges, shape (boxes, d).

        Returns:
            The bounds; the corner of each box where its bound is taken; how much is lost to its
            extent along each axis. Shapes (boxes,), (boxes, 1, d), (boxes, d).
        """
        upper, worst, weight = (
            np.empty(len(which)),
            np.empty(len(which), int),
            np.empty_like(radius),
        )
        # Pieces that stay in the cache: the largest arrays hold a value per corner and symbol.
        step = max(64, _CACHE // (2 ** centre.shape[1] * self.answers.n_symbols))
        for first in range(0, len(which), step):
            some = slice(first, first + step)
            parts = self.residuals(which[some], centre[some], radius[some])
            corner, most = parts[0].at_corners(), parts[0].most_mm
            if len(parts) > 1:
                corner = np.sqrt(sum(part.at_corners() ** 2 for part in parts))
                most = np.sqrt(sum(part.most_mm**2 for part in parts))
            worst[some] = corner.argmax(axis=1)
            # Of what is not a number, fmin takes the other: the arm's reach.
            apart = np.fmin(corner.max(axis=1) + self.apart_slack[which[some]], most)
            upper[some] = self._measured(apart)
            weight[some] = sum(part.weight_mm for part in parts)
        corners_at = centre + corners(centre.shape[1])[worst] * radius
        return upper, corners_at[:, None], weight

    @np.errstate(all="ignore")
    def residuals(
        self, which: Ints, centre: Floats, radius: Floats, average: bool = False
    ) -> list[Residual]:
        """Encloses the residual of each vector over boxes.

        Args:
            which: The network that each box is for, shape (boxes,).
            centre: Centres of the boxes, shape (boxes, d).
            radius: Their half edges, shape (boxes, d).
            average: Whether means over the boxes are asked for.
        """
        joints = self.answers.expand(which, centre, radius, average)
        first = self.vectors[0]
        driven = first.driven(joints, centre, radius)  # the same for all of them
        edges = radius / self.extent
        # A slide's reach is only known as well as the network's answer is.
        blur = self.apart_slack[which] if first.linkage.slides_at_all else 0.0
        return [v.residual(driven, centre, radius, edges, blur) for v in self.vectors]

    def _measured(self, apart: Floats) -> Floats:
        return apart if self.measure == "position" else angle_rad(apart, len(self.vectors))


@dataclass(frozen=True, eq=False)
class _Carried:
    """A compared vector, and the chain that carries it taken apart."""

    item: Compared
    linkage: Linkage
    goal: Linkage | None

    def miss(self, joints: Floats, points: Floats) -> Floats:
        """The residual at points, shape (points, rows)."""
        item = self.item
        if item.angles or len(item.outputs) < joints.shape[1]:
            joints = np.concatenate([-points[:, item.angles], joints[:, item.outputs]], axis=1)
        reached = self.linkage.position_mm(joints)[:, item.rows]
        wanted = points[:, item.inputs]
        return reached - (self.goal.position_mm(wanted) if self.goal else wanted)

    def driven(self, joints: Expansion, centre: Floats, radius: Floats) -> Expansion:
        """The chain's joints over boxes: the opposites of some inputs, then some outputs."""
        ahead, outputs = list(self.item.angles), list(self.item.outputs)
        if not ahead and len(outputs) == joints.centre.shape[1]:
            return joints
        inputs = np.zeros((*radius.shape, len(ahead)))
        inputs[:, ahead, range(len(ahead))] = -radius[:, ahead]

        def behind_nothing(rows: Floats) -> Floats:
            nothing = np.zeros((*rows.shape[:2], len(ahead)))
            return np.concatenate([nothing, rows[:, :, outputs]], axis=2)

        return replace(
            joints,
            centre=np.concatenate([-centre[:, ahead], joints.centre[:, outputs]], axis=1),
            linear=np.concatenate([inputs, joints.linear[:, :, outputs]], axis=2),
            quadratic=behind_nothing(joints.quadratic),
            noise=behind_nothing(joints.noise),
        )

    def residual(
        self,
        joints: Expansion,
        centre: Floats,
        radius: Floats,
        edges: Floats,
        blur: Floats | float,
    ) -> Residual:
        """Encloses the residual over boxes.

        Args:
            joints: The chain's joints.
            centre: Centres of the boxes, shape (boxes, d).
            radius: Their half edges, shape (boxes, d).
            edges: Those as shares of the region's, shape (boxes, d).
            blur: How far rounding may put the tip off.
        """
        rows, inputs = list(self.item.rows), list(self.item.inputs)
        straight = joints.centre, joints.linear
        middle, linear, quadratic, gradient = self.linkage.second_order(*straight, rows)
        if joints.quadratic.shape[1]:
            quadratic += joints.quadratic @ gradient
        noise = joints.noise @ gradient
        remainder, mean, blame = self.linkage.left_out(joints, edges)

        asked, along = centre[:, inputs], np.zeros((*radius.shape, len(inputs)))
        along[:, inputs, range(len(inputs))] = radius[:, inputs]
        if self.goal:
            exact = np.zeros((len(asked), 0, len(inputs)))
            goal = replace(joints, centre=asked, linear=along, quadratic=exact, noise=exact)
            asked, along, bent, _ = self.goal.second_order(asked, along, rows)
            quadratic -= bent
            beyond, mean_beyond, due = self.goal.left_out(goal, edges)
            remainder, mean, blame = remainder + beyond, mean + mean_beyond, blame + due
        weight = (joints.shares @ np.abs(noise).sum(axis=2)[:, :, None])[:, :, 0]
        weight += np.abs(quadratic).sum(axis=2) @ _axes_of_pairs(radius.shape[1])
        return Residual(
            middle - asked,
            linear - along,
            quadratic,
            noise,
            joints.reach,
            joints.mean_reach,
            joints.one_sided,
            remainder,
            mean,
            self._most_mm(joints, centre, radius) + blur,
            weight + blame,
        )

    def _most_mm(self, joints: Expansion, centre: Floats, radius: Floats) -> Floats:
        """How large the residual can be whatever the network answers, shape (boxes,).

        What no joint turns is in one place, the rest no farther from there than it is long; only
        where joints slide it matters by how much.
        """
        item, linkage = self.item, self.linkage
        vectors = linkage.vectors_at(joints.centre)
        fixed = vectors[:, 0, list(item.rows)]
        goal, wide = centre[:, list(item.inputs)], radius[:, list(item.inputs)]
        turned = np.linalg.norm(vectors[:, 1:], axis=2).sum(axis=1)
        if self.goal:
            goal, wide = self.goal.vectors_mm[:1], np.zeros(3)
            turned = turned + np.linalg.norm(self.goal.vectors_mm[1:], axis=1).sum()
        apart = np.abs(fixed - goal) + wide + 1e-12 * (np.abs(fixed) + np.abs(goal))
        most = np.sqrt(np.einsum("bk,bk->b", apart, apart)) + turned
        if linkage.slides_at_all:
            change = np.abs(joints.linear).sum(axis=1)
            change += largest_bend(joints.quadratic, joints.noise)
            most = most + change @ np.linalg.norm(linkage.slides, axis=2).sum(axis=0)
        most = np.broadcast_to(most, (len(centre),))
        return np.where(np.isnan(most), np.inf, most * (1.0 + 1e-12))


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
