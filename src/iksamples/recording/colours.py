"""Colours that mean the same in the recordings and in MLflow's charts."""

import numpy as np


Colour = tuple[int, int, int]

RED: Colour = (214, 39, 40)
BLACK: Colour = (0, 0, 0)
GREY: Colour = (150, 150, 150)
ORANGE: Colour = (214, 110, 10)
_LIGHT_BLUE, _DARK_BLUE = np.array([140, 200, 255]), np.array([10, 40, 140])


def blues(n: int) -> list[Colour]:
    """Colours of n grids, from few samples (light) to many (dark)."""
    shades = _LIGHT_BLUE + np.linspace(0, 1, n)[:, None] * (_DARK_BLUE - _LIGHT_BLUE)
    return [(int(red), int(green), int(blue)) for red, green, blue in shades]
