"""Whether leaves tile the boxes of a region, exactly."""

import numpy as np
from numpy.typing import NDArray


Floats = NDArray[np.float64]

_BITS = 52


def tiles(part: NDArray, lower: NDArray, upper: NDArray, shape: tuple[int, int]) -> bool:
    """Whether leaves with binary-fraction corners fill the boxes of a region without overlap.

    Everything is integer arithmetic in units of 2^-52. A cell, to begin with a whole box, is cut at
    its midpoint along the first axis along which no leaf straddles the cut, its leaves are dealt to
    the halves, and so on; a cell that has one leaf left must be that leaf. Any tiling made by
    repeated halving passes, and nothing passes that is not a tiling: no cell is ever left without a
    leaf.

    Args:
        part: The box of the region that each leaf is a part of, integers of shape (leaves,).
        lower: Lower corners as shares of that box's edges, float64 of shape (leaves, d).
        upper: Upper corners, likewise.
        shape: Number of boxes of the region, and d.

    Returns:
        False also for anything but arrays of these shapes and types.
    """
    boxes, d = shape
    if not (
        all(type(array) is np.ndarray for array in (part, lower, upper))
        and part.ndim == 1
        and part.dtype == np.int64
        and lower.dtype == upper.dtype == np.float64
        and lower.shape == upper.shape == (len(part), d)
        and len(part)
        and ((part >= 0) & (part < boxes)).all()
    ):
        return False
    whole = 2**_BITS
    low, high = _integers(lower), _integers(upper)
    if low is None or high is None:
        return False
    if not ((low >= 0) & (low < high) & (high <= whole)).all():
        return False

    cell = part  # the cell that each leaf is in; the cells' corners follow
    cell_low, cell_high = np.zeros((boxes, d), int), np.full((boxes, d), whole)
    while True:
        counts = np.bincount(cell, minlength=len(cell_low))
        if (counts == 0).any():
            return False
        single = counts[cell] == 1
        exact = (low == cell_low[cell]) & (high == cell_high[cell])
        if not exact[single].all():
            return False
        low, high, cell = low[~single], high[~single], cell[~single]
        if not len(low):
            return True
        # Number the cells that are left anew.
        alive, cell = np.unique(cell, return_inverse=True)
        cell_low, cell_high = cell_low[alive], cell_high[alive]
        if ((cell_high - cell_low) % 2 != 0).any():
            return False
        middle = (cell_low + cell_high) // 2
        straddles = (low < middle[cell]) & (high > middle[cell])
        blocked = np.zeros((len(alive), d), bool)
        np.logical_or.at(blocked, cell, straddles)
        axis = blocked.argmin(axis=1)
        rows = np.arange(len(alive))
        if blocked[rows, axis].any():
            return False
        above = (low[np.arange(len(low)), axis[cell]] >= middle[cell, axis[cell]]).astype(int)
        cell_low, cell_high = np.repeat(cell_low, 2, axis=0), np.repeat(cell_high, 2, axis=0)
        cell_high[2 * rows, axis] = middle[rows, axis]
        cell_low[2 * rows + 1, axis] = middle[rows, axis]
        cell = 2 * cell + above


def _integers(shares: Floats) -> NDArray[np.int64] | None:
    """Shares of 1 as integers in units of 2^-52; None where one is not a multiple of that."""
    scaled = shares * 2.0**_BITS  # exact: a power of two
    if not np.isfinite(scaled).all() or (np.abs(scaled) > 2.0**_BITS).any():
        return None
    whole = scaled.astype(np.int64)
    return whole if (whole == scaled).all() else None
