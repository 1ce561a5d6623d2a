"""Lines: the one function that draws errors, bounds and losses, by hue and panel."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from iksamples.report import style
from iksamples.study import Study


Look = Mapping[str, Any]

_COLUMNS = 3
_BAND = 0.25, 0.75
_DOTS_APART = 0.06


class Drawing(NamedTuple):
    """A figure, and for each group of its marks a line of text per mark, shown when pointed at."""

    figure: Figure
    tips: Mapping[str, Sequence[str]]


@style.styled
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
    for i, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        part = table[table[panel] == title] if panel else table
        for name in names:
            rows = part[part[hue] == name]
            if not rows.empty:
                _line(axis, rows, x, y, looks[name])
                if "tip" in rows and rows["tip"].notna().all():
                    group = f"marks-{i}-{names.index(name)}"
                    tips[group] = _marks(axis, rows, x, y, looks[name], group)
        for value, draw in ((tolerance, axis.axhline), (asked, axis.axvline)):
            if value is not None:
                draw(value, color=style.TARGET, lw=1, ls=(0, (1, 1.5)), zorder=1)
        axis.set_title(str(title)[:1].upper() + str(title)[1:])
        if axis.xaxis.get_tick_params()["labelbottom"]:
            axis.set_xlabel(xlabel)
    _scale(axes, "x", pd.concat([table[x], pd.Series([asked], dtype=float)]), linear)
    ends = [table[column] for column in ("low", "high") if column in table]
    _scale(axes, "y", pd.concat([table[y], *ends, pd.Series([tolerance], dtype=float)]), linear)
    for axis in axes[::_COLUMNS] if len(axes) > _COLUMNS else axes[:1]:
        axis.set_ylabel(ylabel)
    handles = [Line2D([], [], **dict(looks[name])) for name in names]
    if tolerance is not None or asked is not None:
        handles.append(Line2D([], [], color=style.TARGET, lw=1, ls=(0, (1, 1.5))))
        names.append("tolerance asked for")
    figure.legend(handles, names, loc="lower center", ncols=min(4, len(names)), borderaxespad=0.1)
    return Drawing(figure, tips)


def colours(names: Sequence[str]) -> dict[str, Look]:
    """A look for each line: the first in blue, the others in colours that tell them apart."""
    first, others = {"color": style.NETWORK, "lw": 1.9, "zorder": 4}, len(style.COLOURS)
    return {
        name: {
            "color": style.COLOURS[(i - 1) % others],
            "ls": style.DASHES[(i - 1) // others % len(style.DASHES)],
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


def _line(axis: Axes, rows: pd.DataFrame, x: str, y: str, look: Look) -> None:
    """Median and band of a line, stretch by stretch where its dashes change."""
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


def _marks(axis: Axes, rows: pd.DataFrame, x: str, y: str, look: Look, group: str) -> list[str]:
    """Every row as a faint mark, those of one x side by side."""
    rows = rows.sort_values(x, kind="stable")
    place, size = rows.groupby(x).cumcount(), rows.groupby(x)[x].transform("size")
    beside = np.exp(_DOTS_APART * (2 * (place + 0.5) / size - 1))
    marks = axis.scatter(rows[x] * beside, rows[y], s=10, color=look["color"], alpha=0.3, lw=0)
    marks.set_gid(group)
    return list(rows["tip"])


def _panels(titles: Sequence[str], n_lines: int) -> tuple[Figure, list[Axes]]:
    columns = min(_COLUMNS, len(titles))
    rows = -(-len(titles) // columns)
    legend = 0.24 * -(-n_lines // 4)
    height = rows * (3.2 if columns < _COLUMNS else 2.6) + legend
    figure, axes = style.panels(
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


def _scale(axes: Sequence[Axes], which: str, values: "pd.Series[float]", linear: str) -> None:
    """Limits around the values; a logarithmic axis has its numbers at round or at given places."""
    limit = "set_xlim" if which == "x" else "set_ylim"
    if which in linear:
        for axis in axes:
            getattr(axis, limit)(0, float(values.max()) * 1.05)
        return
    values = values[values > 0]
    low, high = float(values.min()) / 1.2, float(values.max()) * 1.2
    given = sorted(values.unique())
    wide = np.log10(high / low) > 2.2
    ticks = style.decades(low, high, (1,) if wide else (1, 2, 5))
    ticks = given if which == "x" and len(given) <= 12 else ticks
    for axis in axes:
        columns = min(_COLUMNS, len(axes)) if which == "x" else 1
        style.number_ticks(axis, which, _with_room(ticks, low, high, 0.02 + 0.03 * columns))
        getattr(axis, limit)(low, high)


def _with_room(ticks: Sequence[float], low: float, high: float, share: float) -> list[float]:
    """The ticks that have this share of the axis for a label, the largest among them."""
    room, kept = share * np.log(high / low), list(ticks[-1:])
    for tick in reversed(ticks):
        if np.log(kept[-1] / tick) > room:
            kept.append(tick)
    return kept[::-1]
