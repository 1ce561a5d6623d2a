"""Drawing of what is proved about the networks' errors."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from iksamples.arm.chain import Floats
from iksamples.evaluation.errors import CUBE
from iksamples.report import style
from iksamples.report.data import ReportData


@style.styled
def certified(data: ReportData, rows: dict[int, pd.DataFrame]) -> Figure:
    """Certified worst case and mean, the largest error tested, and the paper's estimate.

    Args:
        data: The report's data.
        rows: Certificates of the study's network, by number of samples.
    """
    figure, axes = style.panels(1, 1, 3.6, bottom=0.14, top=0.97, right=0.78)
    axis = axes[0][0]
    grids = [grid for grid in data.grids if grid.n in rows]
    n = np.array([grid.n for grid in grids], float)
    name = f"estimate_{data.study.bounds.average_weight}_mm"
    upper = [rows[grid.n]["sup_upper_mm"].to_numpy(float) for grid in grids]
    for size, values in zip(n, upper, strict=True):
        axis.scatter(_beside(size, len(values)), values, s=9, color=style.NETWORK, alpha=0.25, lw=0)
    low_mean, high_mean = (
        [float(rows[grid.n][f"mean_{end}_mm"].median()) for grid in grids]
        for end in ("lower", "upper")
    )
    axis.fill_between(n, low_mean, high_mean, color=style.VALIDATION, alpha=0.3, lw=0)
    lines = (
        ("certified worst case", [np.median(v) for v in upper], style.NETWORK, "o", "-"),
        (
            "largest of the points tested",
            [grid.seed_errors(CUBE, "error_max_mm").median() for grid in grids],
            style.MUTED,
            "",
            ":",
        ),
        (
            "certified mean",
            [0.5 * (low + high) for low, high in zip(low_mean, high_mean, strict=True)],
            style.VALIDATION,
            "o",
            "-",
        ),
        (
            "paper’s “upper bound”, Eq. 25",
            [g.bounds[name].mean() for g in grids],
            style.ESTIMATE,
            "s",
            "--",
        ),
    )
    everything = [value for values in upper for value in values]
    for label, heights, colour, marker, dashes in lines:
        axis.plot(n, heights, color=colour, marker=marker or None, ms=4, ls=dashes, label=label)
        everything += [float(height) for height in heights]
    low, high = min(everything) / 1.25, max(everything) * 1.25
    style.number_ticks(axis, "y", style.decades(low, high, (1, 2, 5)))
    axis.set_ylim(low, high)
    style.number_ticks(axis, "x", n.tolist())
    axis.set_xlim(n[0] / 1.3, n[-1] * 1.3)
    axis.set_xlabel("number of samples n")
    axis.set_ylabel("error over the workspace [mm]")
    figure.legend(*axis.get_legend_handles_labels(), loc="center right", borderaxespad=0.2)
    return figure


def _beside(n: float, count: int) -> Floats:
    """Places of a group's marks, side by side around n."""
    return n * np.exp(np.linspace(-0.06, 0.06, count) if count > 1 else np.zeros(1))
