"""The region of inputs: the one domain of samples, measured errors and certificates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.errors import IksamplesError


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Region:
    """A finite union of closed boxes that do not overlap; they may share faces.

    A whole workspace is one box. The part of a workspace that an arm can use is many: lattice
    cells, merged where they share whole faces.

    Attributes:
        lower: Lower corners, in the units of the inputs, shape (boxes, d).
        upper: Upper corners, likewise.

    Raises:
        IksamplesError: There is no box, a box is empty or not finite, or two boxes overlap.
    """

    lower: Floats
    upper: Floats

    def __post_init__(self) -> None:
        """Checks the boxes; keeps them as float64 that nobody can write to."""
        for name in ("lower", "upper"):
            corner = np.array(getattr(self, name), np.float64)
            corner.flags.writeable = False
            object.__setattr__(self, name, corner)
        if self.lower.ndim != 2 or not self.lower.size or self.lower.shape != self.upper.shape:
            raise IksamplesError(
                "the box needs one lower and one upper limit per input; got limits of shape "
                f"{self.lower.shape} and {self.upper.shape}."
            )
        sound = np.isfinite(self.lower) & np.isfinite(self.upper) & (self.lower < self.upper)
        if not sound.all():
            row = int(np.flatnonzero(~sound.all(axis=1))[0])
            raise IksamplesError(
                f"the box from {self.lower[row].tolist()} to {self.upper[row].tolist()} is empty; "
                "every upper limit must be finite and greater than the lower one."
            )
        for row in range(1, len(self.lower)):
            over = (self.lower[row] < self.upper[:row]) & (self.lower[:row] < self.upper[row])
            if over.all(axis=1).any():
                other = int(np.flatnonzero(over.all(axis=1))[0])
                raise IksamplesError(
                    "two boxes of a region overlap: "
                    f"{self.lower[other].tolist()} to {self.upper[other].tolist()} and "
                    f"{self.lower[row].tolist()} to {self.upper[row].tolist()}."
                )

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> "Region":
        """One box.

        Args:
            lower: Lower corner, shape (d,).
            upper: Upper corner, shape (d,).

        Raises:
            IksamplesError: The box is empty, inverted or not finite.
        """
        return cls(np.asarray(lower, float)[None], np.asarray(upper, float)[None])

    @property
    def n_boxes(self) -> int:
        """Number of boxes."""
        return len(self.lower)

    @property
    def n_inputs(self) -> int:
        """Number of inputs, d."""
        return self.lower.shape[1]

    @property
    def lower_corner(self) -> Floats:
        """Lower corner of the smallest box around the region, shape (d,)."""
        return np.array(self.lower.min(axis=0))

    @property
    def upper_corner(self) -> Floats:
        """Upper corner of the smallest box around the region, shape (d,)."""
        return np.array(self.upper.max(axis=0))

    @property
    def volume(self) -> float:
        """Volume, in the product of the inputs' units."""
        return float(np.prod(self.upper - self.lower, axis=1).sum())

    @property
    def shares(self) -> Floats:
        """Each box's share of the volume, shape (boxes,)."""
        return np.array(np.prod(self.upper - self.lower, axis=1) / self.volume)

    def cut(self, places: list[Floats]) -> "Region":
        """The same region in smaller boxes, cut at some places along each axis.

        Args:
            places: Increasing coordinates for each axis; those outside a box do not cut it.
        """
        lower, upper = self.lower, self.upper
        for axis, coordinates in enumerate(places):
            ends: list[Floats] = []
            for low, high in zip(lower, upper, strict=True):
                inside = coordinates[(coordinates > low[axis]) & (coordinates < high[axis])]
                edges = np.concatenate([low[axis : axis + 1], inside, high[axis : axis + 1]])
                box = np.tile([low, high], (len(edges) - 1, 1, 1))
                box[:, 0, axis], box[:, 1, axis] = edges[:-1], edges[1:]
                ends.append(box)
            pieces = np.concatenate(ends)
            lower, upper = pieces[:, 0], pieces[:, 1]
        return Region(lower, upper)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points are in the region, faces included.

        Args:
            points: Shape (..., d).

        Returns:
            Shape (...).

        Raises:
            ValueError: The points have another number of coordinates.
        """
        x = np.asarray(points, float)
        if x.shape[-1:] != (self.n_inputs,):
            raise ValueError(f"expected {self.n_inputs} coordinates last, got shape {x.shape}")
        inside = np.zeros(x.shape[:-1], bool)
        for low, high in zip(self.lower, self.upper, strict=True):
            inside |= np.all((x >= low) & (x <= high), axis=-1)
        return inside
