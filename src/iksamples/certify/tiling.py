"""Whether boxes tile the unit box, exactly."""

import numpy as np
from numpy.typing import NDArray


Floats = NDArray[np.float64]

_BITS = 52


def tiles_unit_box(lower: Floats, upper: Floats) -> bool:
    """Whether boxes with binary-fraction corners fill the unit box without overlap.

    Everything is integer arithmetic in units of 2^-52. A cell is cut at its midpoint along the
    first axis along which no box straddles the cut, its boxes are dealt to the halves, and so on; a
    cell that has one box left must be that box. Any tiling made by repeated halving passes, and
    nothing passes that is not a tiling: no cell is ever left without a box.

    Args:
        lower: Lower corners, shape (boxes, d).
        upper: Upper corners, shape (boxes, d).
    """
    if lower.ndim != 2 or lower.shape != upper.shape or not lower.size:
        return False
    whole = 2**_BITS
    low, high = _integers(lower), _integers(upper)
    if low is None or high is None:
        return False
    if not ((low >= 0) & (low < high) & (high <= whole)).all():
        return False

    n, d = low.shape
    cell = np.zeros(n, int)  # the cell that each box is in; the cells' corners follow
    cell_low, cell_high = np.zeros((1, d), int), np.full((1, d), whole)
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
