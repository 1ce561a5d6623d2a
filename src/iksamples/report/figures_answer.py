"""Drawings that compare methods: samples needed against tolerance, and errors against samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from iksamples.report import style
from iksamples.report.data import ReportData
from iksamples.report.statistics import median_interval
from iksamples.study import NETWORK, Study


QUANTITIES = {"mean_mm": "mean error [mm]", "worst_mm": "worst error [mm]"}
"""What the errors are drawn of, over the workspace, and how the axis calls it."""

# Of middling lightness, so that they stand out on a light and on a dark page.
_COLOURS = ("#d9822b", "#2a9d8f", "#b05fc4", "#c8443c", "#7f8c2a", "#4a90d9", "#c2578e", "#8d6e5a")
_DASHES: tuple[Any, ...] = ("-", (0, (4, 1.6)), (0, (1.2, 1.2)))
_COLUMNS = 3


def looks(study: Study) -> dict[str, dict[str, Any]]:
    """How each method's line looks in every figure of the report.

    The study's own network is blue, a look-up table a thick line in the colour of the text, since
    it is what everything else has to beat.
    """
    found: dict[str, dict[str, Any]] = {}
    others = 0
    for name, method in study.all_methods.items():
        if name == NETWORK:
            found[name] = {"color": style.NETWORK, "lw": 1.9, "zorder": 4}
        elif method.kind == "multilinear":
            found[name] = {"color": style.SAMPLE, "lw": 2.3, "zorder": 5}
        else:
            found[name] = {
                "color": _COLOURS[others % len(_COLOURS)],
                "lw": 1.4,
                "ls": _DASHES[(others // len(_COLOURS)) % len(_DASHES)],
                "zorder": 3,
            }
            others += 1
    return found


def legend_name(study: Study, method: str) -> str:
    """What a legend calls a method."""
    if method == NETWORK:
        return "the study’s network"
    is_table = study.all_methods[method].kind == "multilinear"
    return "look-up table (baseline)" if is_table else method


@dataclass(frozen=True)
class Lines:
    """What the lines of a comparison are, and what its panels.

    Samples of one design: a line per method, in one panel. Of several: a panel per method, and a
    line per design, since those are then what is to be compared.

    Attributes:
        column: Column that tells the lines apart, ``method`` or ``design``.
        names: Its values, a line each.
        labels: What the legend calls them.
        looks: How each is drawn.
        across: The other column.
        panels: Its values, a panel each.
        titles: What the panels are called.
    """

    column: str
    names: list[str]
    labels: list[str]
    looks: dict[str, dict[str, Any]]
    across: str
    panels: list[str]
    titles: list[str]

    def rows(self, table: pd.DataFrame, panel: str, name: str) -> pd.DataFrame:
        """The rows of a table that a line in a panel is drawn from."""
        return table[(table[self.across] == panel) & (table[self.column] == name)]


def learned(study: Study, table: pd.DataFrame) -> pd.DataFrame:
    """The rows of a table that are not of the exact inverse."""
    exact = [name for name, method in study.all_methods.items() if method.kind == "analytic"]
    return table[~table["method"].isin(exact)]


def lines_of(study: Study, table: pd.DataFrame) -> Lines:
    """The lines for a table with the columns method and design."""
    methods = [name for name in study.all_methods if _in(table, "method", name)]
    designs = [str(name) for name in study.samples.designs if _in(table, "design", name)]
    names = [legend_name(study, name) for name in methods]
    if len(study.samples.designs) == 1:
        return Lines("method", methods, names, looks(study), "design", designs, designs)
    return Lines("design", designs, designs, _design_looks(designs), "method", methods, names)


@style.styled
def samples_needed(data: ReportData, table: pd.DataFrame) -> Figure:
    """Samples needed against tolerance: a line per method, or per design in panels of methods."""
    study = data.study
    table = learned(study, table)
    lines = lines_of(study, table)
    figure, flat = _panels(lines.titles, len(lines.names))
    low, high = table["tolerance_mm"].min(), table["tolerance_mm"].max()
    wish = study.tolerance.error_mm
    low, high = min(low, wish) / 1.15, max(high, wish) * 1.15
    shown = table[table["n_samples"].notna()]
    ladder = sorted(float(n) for n in data.table["n_samples"].unique())
    top = max([*shown["n_samples"], *data.table["n_samples"]])
    bottom = min([*shown["n_samples"], *data.table["n_samples"]])
    for axis, panel in zip(flat, lines.panels, strict=True):
        for name in lines.names:
            rows = lines.rows(shown, panel, name)
            _stairs(axis, rows.sort_values("tolerance_mm"), lines.looks[name])
        axis.axvline(wish, color=style.TARGET, lw=1, ls=(0, (1, 1.5)), zorder=1)
        axis.annotate(
            f"asked for: {wish:g} mm",
            (wish, 1),
            (-4, -2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            ha="right",
            va="top",
            color=style.TARGET,
            fontsize=7.5,
        )
        style.number_ticks(axis, "x", style.decades(low, high, _steps(low, high)))
        axis.set_xlim(low, high)
        sizes = [*ladder, *style.decades(1.5 * ladder[-1], top)]
        style.number_ticks(axis, "y", _thinned(sizes, bottom, top))
        axis.set_ylim(bottom / 1.3, top * 1.3)
        error = error_words(study)
        axis.set_xlabel(f"tolerance [mm], {error}" if len(flat) == 1 else "tolerance [mm]")
        axis.set_ylabel("samples needed n")
    _legend(figure, lines)
    return figure


@style.styled
def errors_of_methods(data: ReportData, quantities: Sequence[str]) -> Figure:
    """Errors over the workspace against the number of samples, as ``Lines`` says.

    Args:
        data: The report's data.
        quantities: Columns of ``ReportData.every_error``, one panel each for every panel of
            ``Lines``.
    """
    table = learned(data.study, data.every_error)
    lines = lines_of(data.study, table)
    many = len(quantities) > 1
    panels = [(q, panel) for panel in lines.panels for q in quantities]
    titles = [_quantity_name(q) for q in quantities] if many else lines.titles
    figure, flat = _panels(titles, len(lines.names))
    values = table[list(quantities)].to_numpy()
    low, high = float(np.min(values[values > 0])) / 1.3, float(np.max(values)) * 1.3
    sizes = sorted(table["n_samples"].unique())
    for axis, (quantity, panel) in zip(flat, panels, strict=True):
        for name in lines.names:
            rows = lines.rows(table, panel, name)
            if len(rows):
                _medians(axis, rows, quantity, lines.looks[name])
        style.number_ticks(axis, "x", _thinned([float(n) for n in sizes], sizes[0], sizes[-1]))
        axis.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
        style.number_ticks(axis, "y", style.decades(low, high, _steps(low, high)))
        axis.set_ylim(low, high)
        axis.set_xlabel("number of samples n")
        axis.set_ylabel(QUANTITIES[quantity])
    _legend(figure, lines)
    return figure


def _quantity_name(quantity: str) -> str:
    return QUANTITIES[quantity].split(" [")[0].capitalize()


def _design_looks(designs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The first design in the colour of the text: the others are held against it."""
    found: dict[str, dict[str, Any]] = {designs[0]: {"color": style.SAMPLE, "lw": 2.3, "zorder": 5}}
    for design, colour in zip(designs[1:], _COLOURS, strict=False):
        found[design] = {"color": colour, "lw": 1.5, "zorder": 3}
    return found


def _medians(axis: Axes, rows: pd.DataFrame, quantity: str, look: dict[str, Any]) -> None:
    """Median over the seeds, and its interval as a band."""
    sizes, values = rows["n_samples"].to_numpy(), rows[quantity].to_numpy(float)
    n = np.unique(sizes).astype(float)
    intervals = [median_interval(values[sizes == size]) for size in n]
    middle = np.array([one.value for one in intervals])
    axis.plot(n, middle, marker="o", ms=3, **look)
    known = np.array([one.known for one in intervals])
    if known.any():
        low, high = (np.array([getattr(one, end) for one in intervals]) for end in ("low", "high"))
        axis.fill_between(
            n[known], low[known], high[known], color=look["color"], alpha=0.14, lw=0, zorder=2
        )


def _stairs(axis: Axes, rows: pd.DataFrame, look: dict[str, Any]) -> None:
    """One line: solid where tried and certified, dashed where measured, dotted beyond."""
    if rows.empty:
        return
    t, n = rows["tolerance_mm"].to_numpy(float), rows["n_samples"].to_numpy(float)
    kind = np.where(
        rows["status"] == "extrapolated", 2, np.where(rows["certified"].astype(bool), 0, 1)
    )
    style_of: tuple[Any, ...] = ("-", (0, (4, 1.6)), (0, (1, 1.4)))
    starts = np.flatnonzero(np.diff(kind, prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(t)], strict=True):
        # To the next stretch's first point, so that a line has no gaps.
        part = slice(start, min(stop + 1, len(t)))
        steps = "default" if kind[start] == 2 else "steps-post"
        plain = {key: value for key, value in look.items() if key != "ls"}
        axis.plot(t[part], n[part], ls=style_of[kind[start]], drawstyle=steps, **plain)


def _panels(titles: Sequence[str], n_lines: int) -> tuple[Figure, list[Axes]]:
    columns = min(_COLUMNS, len(titles))
    rows = -(-len(titles) // columns)
    legend_rows = -(-n_lines // 4)
    height = rows * (3.3 if columns < _COLUMNS else 2.7) + 0.25 * legend_rows
    figure, axes = style.panels(
        rows,
        columns,
        height,
        bottom=(0.55 + 0.24 * legend_rows) / height,
        top=1 - 0.3 / height,
        wspace=0.25,
        hspace=0.5,
    )
    flat = [axis for row in axes for axis in row]
    for axis in flat[len(titles) :]:
        axis.set_visible(False)
    if len(titles) > 1:
        for axis, title in zip(flat, titles, strict=False):
            axis.set_title(f"{title[0].upper()}{title[1:]}")
    return figure, flat[: len(titles)]


def _legend(figure: Figure, lines: Lines) -> None:
    figure.legend(
        [Line2D([], [], **lines.looks[name]) for name in lines.names],
        lines.labels,
        loc="lower center",
        ncols=min(4, len(lines.names)),
        borderaxespad=0.1,
    )


def _in(table: pd.DataFrame, column: str, name: str) -> bool:
    return bool((table[column] == name).any())


def _steps(low: float, high: float) -> tuple[int, ...]:
    return (1,) if np.log10(high / low) > 2.2 else (1, 2, 5)


def _thinned(sizes: Sequence[float], low: float, high: float) -> list[float]:
    """The sizes that have room for a label, the largest among them."""
    room = 0.09 * np.log(high / low)
    kept: list[float] = []
    for size in reversed(sizes):
        if not kept or np.log(kept[-1] / size) > room:
            kept.append(size)
    return kept[::-1]


def error_words(study: Study) -> str:
    """What the study's tolerance is about: ``worst error over the workspace``."""
    tolerance = study.tolerance
    kind = {"worst": "worst error", "mean": "mean error"}.get(tolerance.of)
    where = "the workspace" if tolerance.where == "workspace" else f"path {tolerance.where}"
    return f"{kind or tolerance.of + ' of the error'} over {where}"
