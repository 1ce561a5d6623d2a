"""How every figure of the report looks, and how it becomes SVG in the page or a PNG beside it."""

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator


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
    margins = {"left": 0.07, "right": 0.985, "bottom": 0.13, "top": 0.92}
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
    import numpy as np

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
