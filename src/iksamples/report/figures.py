"""How every figure of the report looks, and the one function that draws lines by hue and panel."""

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

from iksamples.study import Study


# The recordings use the same three: target red, network blue, training points black.
TARGET = "#d62728"
NETWORK = "#1f5fc4"
SAMPLE = "#14171a"
PAPER = "#6b7178"
ESTIMATE = "#b4690e"
VALIDATION = "#0f8a6d"
# Of middling lightness, so that they stand out on a light and on a dark page.
COLOURS = ("#d9822b", "#2a9d8f", "#b05fc4", "#c8443c", "#7f8c2a", "#4a90d9", "#c2578e", "#8d6e5a")
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.6)), (0, (1.2, 1.2)))
INK = "#24292f"
MUTED = "#59626b"
RULE = "#d9dee3"
PANEL = "#ffffff"

PAPER_LINE: dict[str, Any] = {"color": PAPER, "ls": "--", "lw": 1.0, "marker": "D", "ms": 4}
"""How the paper's own numbers are drawn."""

# In the page each colour is a CSS variable, so that a dark theme and print can change it.
_CSS_NAMES = {
    TARGET: "target",
    NETWORK: "network",
    SAMPLE: "sample",
    PAPER: "paper",
    ESTIMATE: "estimate",
    VALIDATION: "validation",
    INK: "ink",
    MUTED: "muted",
    RULE: "rule",
    PANEL: "panel",
}
_RC: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 5,
    "axes.labelsize": 8.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.handlelength": 1.8,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "path.simplify": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "iksamples",
}


def panels(
    rows: int, columns: int, height_in: float, width_in: float = 9.2, **layout: Any
) -> tuple[Figure, Sequence[Sequence[Axes]]]:
    """An empty figure, as wide as the page if not said otherwise.

    Args:
        rows: Rows of axes.
        columns: Columns of axes.
        height_in: Height of the figure [in].
        width_in: Width of the figure [in]; the page shows an inch as 100 pixels.
        **layout: Margins and gaps, and what ``Figure.subplots`` takes.

    Returns:
        The figure and its axes as rows of columns.
    """
    margins = {"left": 0.08, "right": 0.985, "bottom": 0.13, "top": 0.92}
    gaps = ("left", "right", "bottom", "top", "wspace", "hspace", "width_ratios")
    grid = margins | {key: layout.pop(key) for key in gaps if key in layout}
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(width_in, height_in))
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False, gridspec_kw=grid, **layout)
    return figure, axes.tolist()


def styled(function: Any) -> Any:
    """Lets a drawing function work under the report's style."""
    return matplotlib.rc_context(_RC)(function)


def number_ticks(axes: Axes, which: str, ticks: Sequence[float]) -> None:
    """Logarithmic axis with plain numbers at the given places and nothing between."""
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def decades(low: float, high: float, steps: Sequence[float] = (1, 2, 5)) -> list[float]:
    """Round numbers on a logarithmic axis from below ``low`` to above ``high``."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [float(f"{step * 10.0**power:.6g}") for power in powers for step in steps]
    return [tick for tick in ticks if low / 1.001 <= tick <= high * 1.001]


@styled
def png(figure: Figure, path: Path) -> None:
    """Writes a PNG on white whose bytes depend on the drawing alone."""
    figure.savefig(path, format="png", dpi=110, facecolor="white", metadata={"Software": None})


@styled
def svg(figure: Figure, name: str, label: str, tips: Mapping[str, Sequence[str]]) -> str:
    """The figure as an ``<svg>`` element for a page that holds several.

    Args:
        figure: The drawing.
        name: Put before every identifier, since identifiers of two drawings collide.
        label: Read out in place of the picture.
        tips: Group (``set_gid``) -> a line for each of its marks, in drawing order.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'xlink:href="#', f'href="#{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r' xmlns:xlink="[^"]*"', "", text)
    # A hundredth of a point is finer than any screen.
    text = re.sub(
        r' (?:d|x|y|points)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m.group()), text
    )
    for colour, css in _CSS_NAMES.items():
        text = text.replace(colour, f"var(--{css})")
    head = re.search(r'viewBox="[^"]*"', text)
    assert head is not None
    text = re.sub(
        r"<svg[^>]*>",
        f'<svg xmlns="http://www.w3.org/2000/svg" {head.group()} role="img" '
        f'aria-label="{escape(label)}" style="max-width: {figure.get_figwidth() * 100:.0f}px">',
        text,
        count=1,
    )
    for group, lines in tips.items():
        text = _with_tips(text, f"{name}-{group}", lines)
    return text


def _with_tips(text: str, group: str, lines: Sequence[str]) -> str:
    """Hangs a line on every mark (``<use>``) of a group."""
    start = text.index(f'id="{group}"')
    end = start
    pieces = [text[:start]]
    marks = re.compile(r"<use ")
    at = start
    for line in lines:
        match = marks.search(text, at)
        if match is None:
            raise ValueError(f"{group}: more lines than marks")
        pieces.append(text[at : match.start()] + f'<use data-tip="{escape(line)}" ')
        at = end = match.end()
    return "".join(pieces) + text[end:]


Look = Mapping[str, Any]

_COLUMNS = 3
_BAND = 0.25, 0.75
_DOTS_APART = 0.06
_SHOWN = 1e-6
"""Share of the largest value at which a logarithmic axis ends; what lies below is rounding."""


class Drawing(NamedTuple):
    """A figure, and for each group of its marks a line of text per mark, shown when pointed at."""

    figure: Figure
    tips: Mapping[str, Sequence[str]]


@styled
def lines(
    table: pd.DataFrame,
    x: str,
    y: str,
    looks: Mapping[str, Look],
    xlabel: str,
    ylabel: str,
    *,
    hue: str = "line",
    panel: str = "",
    tolerance: float | None = None,
    asked: float | None = None,
    linear: str = "",
) -> Drawing:
    """Lines over x: the median of y, with the middle half of its values as a band.

    Args:
        table: In long form, a row per value. A column ``low`` and ``high`` takes the place of the
            band where it is not NaN, a column ``tip`` draws every row as a mark with that text, and
            a column ``dash`` holds line styles of stretches of a line.
        x: Column of the horizontal axis.
        y: Column of the vertical axis.
        looks: How each line is drawn (what ``Axes.plot`` takes), by its name, in this order.
        xlabel: Title of the horizontal axes.
        ylabel: Title of the vertical axes.
        hue: Column that tells the lines apart.
        panel: Column that tells the panels apart, in their order; empty: one panel.
        tolerance: The tolerance as a value of y, a dotted line across.
        asked: The same as a value of x, a dotted line upright.
        linear: ``x``, ``y`` or both, for axes that are not logarithmic.
    """
    table = table[np.isfinite(table[y])]
    titles = list(dict.fromkeys(table[panel])) if panel else [""]
    names = [name for name in looks if (table[hue] == name).any()]
    figure, axes = _panels(titles, len(names) + (tolerance is not None or asked is not None))
    tips: dict[str, list[str]] = {}
    drawn = [pd.Series([tolerance], dtype=float)]
    for i, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        part = table[table[panel] == title] if panel else table
        for name in names:
            rows = part[part[hue] == name]
            if not rows.empty:
                drawn += _line(axis, rows, x, y, looks[name])
                if "tip" in rows and rows["tip"].notna().all():
                    group = f"marks-{i}-{names.index(name)}"
                    tips[group] = _marks(axis, rows, x, y, looks[name], group)
                    drawn.append(rows[y])
        for value, draw in ((tolerance, axis.axhline), (asked, axis.axvline)):
            if value is not None:
                draw(value, color=TARGET, lw=1, ls=(0, (1, 1.5)), zorder=1)
        axis.set_title(str(title)[:1].upper() + str(title)[1:])
        if axis.xaxis.get_tick_params()["labelbottom"]:
            axis.set_xlabel(xlabel)
    scale(axes, "x", pd.concat([table[x], pd.Series([asked], dtype=float)]), linear)
    scale(axes, "y", pd.concat(drawn), linear)
    for axis in axes[:: _columns(len(axes))]:
        axis.set_ylabel(ylabel)
    handles = [Line2D([], [], **dict(looks[name])) for name in names]
    if tolerance is not None or asked is not None:
        handles.append(Line2D([], [], color=TARGET, lw=1, ls=(0, (1, 1.5))))
        names.append("tolerance asked for")
    figure.legend(handles, names, loc="lower center", ncols=min(4, len(names)), borderaxespad=0.1)
    return Drawing(figure, tips)


def colours(names: Sequence[str]) -> dict[str, Look]:
    """A look for each line: the first in blue, the others in colours that tell them apart."""
    first, others = {"color": NETWORK, "lw": 1.9, "zorder": 4}, len(COLOURS)
    return {
        name: {
            "color": COLOURS[(i - 1) % others],
            "ls": DASHES[(i - 1) // others % len(DASHES)],
            "lw": 1.4,
            "zorder": 3,
        }
        if i
        else first
        for i, name in enumerate(names)
    }


def looks(study: Study) -> dict[str, Look]:
    """How the lines of a comparison are drawn: one per method, or per design where it has more."""
    designs = list(map(str, study.samples.designs))
    return colours(designs if len(designs) > 1 else list(study.all_methods))


def _line(axis: Axes, rows: pd.DataFrame, x: str, y: str, look: Look) -> list["pd.Series[float]"]:
    """Draws median and band of a line, stretch by stretch where its dashes change.

    Returns:
        What was drawn, which a single seed's outlier is not.
    """
    drawn = []
    stretches = (
        rows.groupby("dash", sort=False) if "dash" in rows else [(look.get("ls", "-"), rows)]
    )
    for dash, stretch in stretches:
        by_x = stretch.groupby(x)
        middle = by_x[y].median()
        few: dict[str, Any] = {"marker": "o", "ms": 3} if len(middle) <= 15 else {}
        axis.plot(middle.index, middle, **few | dict(look) | {"ls": dash})
        if "low" in stretch and stretch["low"].notna().any():
            low, high = by_x["low"].min(), by_x["high"].max()
        else:
            low, high = by_x[y].quantile(_BAND[0]), by_x[y].quantile(_BAND[1])
        axis.fill_between(middle.index, low, high, color=look["color"], alpha=0.15, lw=0, zorder=2)
        drawn += [middle, low, high]
    return drawn


def _marks(axis: Axes, rows: pd.DataFrame, x: str, y: str, look: Look, group: str) -> list[str]:
    """Every row as a faint mark, those of one x side by side."""
    rows = rows.sort_values(x, kind="stable")
    place, size = rows.groupby(x).cumcount(), rows.groupby(x)[x].transform("size")
    beside = np.exp(_DOTS_APART * (2 * (place + 0.5) / size - 1))
    marks = axis.scatter(rows[x] * beside, rows[y], s=10, color=look["color"], alpha=0.3, lw=0)
    marks.set_gid(group)
    return list(rows["tip"])


def _panels(titles: Sequence[str], n_lines: int) -> tuple[Figure, list[Axes]]:
    columns = _columns(len(titles))
    rows = -(-len(titles) // columns)
    legend = 0.24 * -(-n_lines // 4)
    height = rows * (3.2 if columns < _COLUMNS else 2.6) + legend
    figure, axes = panels(
        rows,
        columns,
        height,
        sharex=True,
        sharey=True,
        bottom=(0.55 + legend) / height,
        top=1 - 0.3 / height,
        wspace=0.08,
        hspace=0.4,
    )
    flat = [axis for row in axes for axis in row]
    for i, axis in enumerate(flat):
        axis.set_visible(i < len(titles))
        axis.tick_params(labelbottom=i + columns >= len(titles))
    return figure, flat[: len(titles)]


def _columns(n_panels: int) -> int:
    return 2 if n_panels == 4 else min(_COLUMNS, n_panels)


def scale(axes: Sequence[Axes], which: str, values: "pd.Series[float]", linear: str) -> None:
    """Limits around the values; a logarithmic axis has its numbers at round or at given places."""
    limit = "set_xlim" if which == "x" else "set_ylim"
    if which in linear:
        for axis in axes:
            getattr(axis, limit)(0, float(values.max()) * 1.05)
        return
    values = values[values > 0]
    high = float(values.max()) * 1.2
    low = max(float(values.min()) / 1.2, _SHOWN * high)
    given = sorted(values.unique())
    wide = np.log10(high / low) > 2.2
    ticks = decades(low, high, (1,) if wide else (1, 2, 5))
    ticks = ticks[:: 1 + len(ticks) // 13]
    ticks = given if which == "x" and len(given) <= 12 else ticks
    for axis in axes:
        columns = _columns(len(axes)) if which == "x" else 1
        number_ticks(axis, which, _with_room(ticks, low, high, 0.02 + 0.03 * columns))
        getattr(axis, limit)(low, high)


def _with_room(ticks: Sequence[float], low: float, high: float, share: float) -> list[float]:
    """The ticks that have this share of the axis for a label, the largest among them."""
    room, kept = share * np.log(high / low), list(ticks[-1:])
    for tick in reversed(ticks):
        if np.log(kept[-1] / tick) > room:
            kept.append(tick)
    return kept[::-1]
