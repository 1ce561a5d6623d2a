"""Words the sections share: names of things in this study, and numbers with their units."""

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd

from iksamples.report.data import ReportData
from iksamples.study import DoubleRectangle, Study, Training


ACTIVATION_NAMES = {"relu": "ReLU", "tanh": "tanh"}
"""Activations as people write them."""


def mm(value: float, digits: int = 2) -> str:
    """A length in millimetres."""
    return f"{value:.{digits}f} mm"


def minus(text: str) -> str:
    """Hyphens in front of digits as minus signs."""
    return re.sub(r"-(?=[\d.])", "−", text)


def count(n: int, thing: str) -> str:
    """A number of things: ``1 seed``, ``20 seeds``."""
    return f"{thousands(n)} {thing}{'' if n == 1 else 's'}"


def thousands(n: float) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{n:,.0f}".replace(",", "\u202f")


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent."""
    return minus(f"{100 * share:.{digits}f} %")


def span(values: Sequence[float], digits: int, unit: str = "") -> str:
    """Lowest to highest; a single number where both print alike."""
    low, high = f"{np.min(values):.{digits}f}", f"{np.max(values):.{digits}f}"
    tail = f" {unit}" if unit else ""
    return minus(f"{low}{tail}" if low == high else f"{low} to {high}{tail}")


def budget(training: Training) -> str:
    """How long a network is trained: ``500 epochs``, ``32 000 steps at every size``."""
    if training.steps:
        return f"{count(training.steps, 'step')} at every size"
    return count(training.epochs, "epoch")


def ratio_cells(pairs: pd.DataFrame) -> dict[int, str]:
    """What ``compare`` found at each number of samples, in per cent.

    Bold where the interval leaves out 100 %.
    """
    cells = {}
    for n, ratio, low, high in pairs[["n_samples", "ratio", "ratio_low", "ratio_high"]].to_numpy():
        text = f"{100 * ratio:.0f}"
        cells[int(n)] = f"**{text}**" if high < 1 or low > 1 else text
    return cells


def joined(items: Sequence[str], last: str = "and") -> str:
    """``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {last} {items[-1]}"


def path_name(data: ReportData, path: str) -> str:
    """What the text calls a path."""
    shape = data.study.evaluation.paths[path]
    if sum(other.shape == shape.shape for other in data.study.evaluation.paths.values()) > 1:
        return f"the path “{path}”"
    return "the double rectangle" if isinstance(shape, DoubleRectangle) else "the heart"


def box_size(study: Study) -> str:
    """Sides of the workspace."""
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)
    if np.ptp(sides) == 0:
        return f"{sides[0]:g} mm cube"
    return " × ".join(f"{side:g}" for side in sides) + " mm box"


def box_ranges(study: Study) -> str:
    """Ranges of the workspace: ``x 20 to 80, ...``."""
    box = study.workspace
    return ", ".join(
        f"{axis} {low:g} to {high:g}"
        for axis, low, high in zip("xyz", box.lower_mm, box.upper_mm, strict=True)
    )


def seeds(data: ReportData) -> str:
    """How many networks a grid's numbers are taken over."""
    numbers = sorted({len(grid.members) for grid in data.grids})
    return (
        count(numbers[0], "seed") if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]} seeds"
    )


def seeds_mean(data: ReportData) -> str:
    """What a mean over seeds is taken over."""
    return "a single seed" if one_seed(data) else f"mean of {seeds(data)}"


def one_seed(data: ReportData) -> bool:
    """Whether there is nothing to average over."""
    return all(len(grid.members) == 1 for grid in data.grids)


def shown_network(data: ReportData) -> str:
    """Which of a grid's networks a picture shows."""
    return "" if one_seed(data) else f"; of {seeds(data)}, the one with the median mean error"


def grid_name(m: int, n: int) -> str:
    """``5³ = 125``, or how many points of the grid are left of it."""
    power = f"{m}³"
    return f"{power} = {n}" if n == m**3 else f"{power}, {n} usable"


def power_of(symbol: str, exponent: float) -> str:
    """A power with its exponent raised."""
    return f"{symbol}^{minus(f'{exponent:.2f}')}^"


def typeset(text: str) -> str:
    """Plain text of the answer, with the report's apostrophes, minus signs and raised exponents."""
    raised = re.sub(r"\^(-?\w+)", r"^\1^", text.replace("'", "’"))
    return re.sub(r"(?<=\s)-(?=\s)|(?<=\^)-(?=\w)", "−", _minus_signs(raised))


def _minus_signs(text: str) -> str:
    """Negative numbers with minus signs; hyphens between words and digits stay."""
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)
