"""What the report says of the answer: samples needed, fresh trainings, methods compared."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from iksamples.answer.sentences import unproved
from iksamples.report import figures
from iksamples.report.data import ReportData
from iksamples.report.markdown import code, number, percent
from iksamples.report.run import differing
from iksamples.study import NETWORK
from iksamples.text import described_on, known, millimetres


_SHARE = "Error, % of that network's"
_DASHES: dict[str, Any] = {"proved": "-", "measured": (0, (4, 1.6)), "extrapolated": (0, (1, 1.4))}

_AMOUNTS: dict[str, tuple[str, dict[str, Any]]] = {
    "proved": ("", {"marker": "o", "ms": 8, "color": figures.NETWORK}),
    "measured": ("", {"marker": "o", "ms": 8, "color": figures.NETWORK, "mfc": "none", "mew": 1.8}),
    "extrapolated": ("about ", {"marker": "D", "ms": 6, "color": figures.ESTIMATE, "mfc": "none"}),
    "not enough": ("more than ", {"marker": ">", "ms": 8, "color": figures.MUTED}),
}
"""How a number of samples is known: what stands before it, and its mark."""


def answer(data: ReportData) -> dict[str, Any]:
    """How many samples each method needs, and how the answer fared with fresh trainings."""
    found = data.answer
    if found is None:
        return {}
    methods, sizes = [], []
    for one in found.variants:
        head: dict[str, Any] = {"Method": code(one.method), **_design(data, one.design)}
        tried = one.shown
        lowest = tried.success_rate_lcb
        methods.append(
            head
            # A row per design would say the same of a method again and again.
            | (
                {}
                if data.several_designs
                else {"What it is": described_on(data.study, one.method, one.design)}
            )
            | {
                "Samples needed": _needed(data, one),
                "Error [mm]": tried.tolerance_bound_mm,
                "Shown by": "proof" if tried.certified else "measurement",
                f"{data.trial.capitalize()}s that meet it": "deterministic"
                if lowest is None
                else f"{tried.n_met} of {tried.n_seeds}"
                + (f", so at least {percent(lowest, 1, 'down')}" if lowest else ""),
            }
        )
        sizes += [
            head
            | {
                "Samples": size.n_samples,
                f"{data.trial.capitalize()}s": size.n_seeds,
                "Meet it": size.n_met,
                "Share at least [%]": _scaled(size.success_rate_lcb, 100),
                "Error bound [mm]": size.tolerance_bound_mm,
                "Best [mm]": size.error_best_mm,
                "Median [mm]": size.error_median_mm,
                "Worst [mm]": size.error_worst_mm,
                "Proved": size.n_certified,
            }
            for size in one.sizes
        ]
    return {
        "methods": pd.DataFrame(methods, dtype=object),
        "sizes": pd.DataFrame(sizes, dtype=object),
        "amounts": _amounts_drawing(data),
        "drawing": _needed_drawing(data),
        "fresh": pd.DataFrame(_fresh(data), dtype=object),
        "unproved": unproved(data.workspace),
    }


def comparisons(data: ReportData) -> dict[str, Any]:
    """Every method and design against the study's own network, seed by seed."""
    compared = data.answer.comparisons if data.answer else []
    finite = np.isfinite([one.ratio.value for one in compared])
    if not finite.any():
        return {}
    rows = [
        {
            "method": one.method,
            "design": one.design,
            "other": one.other,
            "on": one.other_design,
            "n": one.n_samples,
            "ratio": one.ratio,
        }
        for one in compared
    ]
    keys = ["method", "design", "other", "on"]
    table = pd.DataFrame(rows, dtype=object)
    largest, wide = [], []
    for names, of_pair in table.groupby(keys, sort=False):
        pair = dict(zip(keys, map(str, names), strict=True))
        head = {"Method": code(pair["method"]), **_design(data, pair["design"])}
        head["against"] = code(pair["other"])
        if data.several_designs:
            head["on"] = pair["on"]
        last = of_pair.iloc[-1]
        largest.append(head | {"Samples": last["n"], _SHARE: _ratio(last["ratio"])})
        cells = {
            str(n): _clear(ratio) for n, ratio in zip(of_pair["n"], of_pair["ratio"], strict=True)
        }
        wide.append(head | {str(n): cells.get(str(n), "") for n in sorted(table["n"].unique())})
    settings = {
        name: method.model_dump(mode="json")
        for name, method in data.study.all_methods.items()
        if method.kind == "network"
    }
    changes = [
        {"Method": code(name), "Differs in": setting, "Own network": ours, "Here": theirs}
        for name in settings
        for setting, ours, theirs in differing(settings[NETWORK], settings[name])
    ]
    return {
        "largest": pd.DataFrame(largest, dtype=object),
        "wide": pd.DataFrame(wide, dtype=object),
        "changes": pd.DataFrame(changes, dtype=object),
        "infinite": not finite.all(),
    }


def _needed(data: ReportData, one: Any) -> Markup | str:
    if not data.learns[one.method]:
        return "none"
    if one.status == "answered":
        return Markup(f"**{one.n_samples}**")
    if one.status == "extrapolated":
        return f"about {one.n_samples}, extrapolated"
    few = f", too few {data.trial}s" if one.status == "more-seeds" else ""
    return f"more than {one.shown.n_samples}{few}"


def _scaled(value: float | None, by: float) -> float | None:
    return None if value is None else by * value


@figures.styled
def _amounts_drawing(data: ReportData) -> figures.Drawing | None:
    """The samples that each method needs, fewest first, for who looks once."""
    assert data.answer is not None
    rows = []
    for one in data.answer.variants:
        how = "proved" if one.shown.certified else "measured"
        if one.status != "answered":
            how = "extrapolated" if one.status == "extrapolated" else "not enough"
        n = one.shown.n_samples if how == "not enough" else one.n_samples
        line = f"{one.method}, {one.design}" if data.several_designs else one.method
        if data.study.arm:
            line = known(data.study, one.method)
        if data.learns[one.method]:
            rows.append((how == "not enough", n, line, how))
        elif data.study.arm:
            bound_mm = one.shown.tolerance_bound_mm
            off = f"too few {data.trial}s to say how far off"
            if np.isfinite(bound_mm):
                off = f"off by up to {millimetres(bound_mm)}"
            rows.append((False, 0, line, f"none: {off}"))
    if not rows:
        return None
    rows.sort(key=lambda row: row[:2])
    lines = [part for *_, line, _ in rows for part in line.split("\n")]
    longest = max(map(len, lines))
    height, width = 1.0 + 0.27 * len(rows) + 0.12 * (len(lines) - len(rows)), 8.2
    figure, [[axis]] = figures.panels(
        1, 1, height, width, left=(0.3 + 0.06 * longest) / width, right=0.97,
        bottom=0.8 / height, top=1 - 0.12 / height,
    )  # fmt: skip
    for how, (sign, look) in _AMOUNTS.items():
        places = [(row[1], y) for y, row in enumerate(rows) if row[3] == how]
        if places:
            axis.plot(*zip(*places, strict=True), ls="", label=how, clip_on=False, **look)
        for n, y in places:
            axis.annotate(
                f"{sign}{n}", (n, y), (9, 0), textcoords="offset points", va="center", weight="bold"
            )
    for y, (_, n, _, how) in enumerate(rows):
        if not n:  # no place on a logarithmic axis
            axis.annotate(how, (0.01, y), xycoords=("axes fraction", "data"), va="center")
    sizes = [data.compared["n_samples"], pd.Series([n for _, n, *_ in rows if n])]
    figures.scale([axis], "x", pd.concat(sizes), "")
    low, high = axis.get_xlim()
    axis.set_xlim(right=high * (high / low) ** 0.3)  # room for the last number
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.set_yticks(range(len(rows)), [line for *_, line, _ in rows])
    wish = data.answer.tolerance
    what = {"worst": "worst", "mean": "mean"}.get(wish.of, wish.of)
    angle = f" and {wish.angle_deg:g}°" if wish.angle_deg else ""
    axis.set_xlabel(f"samples for a {what} error of at most {wish.error_mm:g} mm{angle}")
    figure.legend(loc="lower center", ncols=len(_AMOUNTS), borderaxespad=0.1)
    return figures.Drawing(figure, {})


def _needed_drawing(data: ReportData) -> figures.Drawing | None:
    table = data.samples_needed
    table = table[table["method"].map(data.learns)] if len(table) else table
    if table.empty:
        return None
    how = np.where(table["certified"].astype(bool), "proved", "measured")
    how = np.where(table["status"] == "extrapolated", "extrapolated", how)
    table = table.assign(dash=[_DASHES[str(one)] for one in how])
    # Each stretch of a line ends where the next begins.
    keys = ["method", "design"]
    table = table.sort_values([*keys, "tolerance_mm"], kind="stable")
    before = table.groupby(keys)["dash"].shift()
    turns = table[before.notna() & (before != table["dash"])]
    table = pd.concat([table, turns.assign(dash=before[turns.index])])
    table = table.sort_values("tolerance_mm", kind="stable")
    hue, panel = ("design", "method") if data.several_designs else ("method", "")
    stairs = {
        name: {**look, "marker": "", "drawstyle": "steps-post"}
        for name, look in figures.looks(data.study).items()
    }
    return figures.lines(
        table, "tolerance_mm", "n_samples", stairs, "tolerance [mm]", "samples needed",
        hue=hue, panel=panel, asked=data.study.tolerance.error_mm,
    )  # fmt: skip


def _fresh(data: ReportData) -> Iterator[dict[str, Any]]:
    """How often trainings that had no part in the answer meet the tolerance."""
    for one in data.fresh:
        for what, rate in {"the answer": one.at, "one size below": one.below}.items():
            if rate is not None:
                share = rate.success
                yield {
                    "Method": code(one.method),
                    **_design(data, one.design),
                    "Size": what,
                    "Samples": rate.n_samples,
                    f"Fresh {data.trial}s": rate.n_seeds,
                    "Meet it": rate.n_met,
                    "Share [%]": 100 * share.value,
                    "95 % interval [%]": f"{100 * share.low:.1f} to {100 * share.high:.1f}",
                }


def _design(data: ReportData, design: str) -> dict[str, str]:
    """A cell that says how the samples are placed, in studies that place them in several ways."""
    return {"Samples placed": design} if data.several_designs else {}


def _ratio(ratio: Any) -> str:
    """A ratio in per cent with its interval; a dash where an error is not finite."""
    if not np.isfinite(ratio.value):
        return "–"
    digits = 0 if ratio.value > 0.1 else 1
    shown = number(100 * ratio.value, digits)
    if not ratio.known:
        return shown
    return f"{shown} ({number(100 * ratio.low, digits)} to {number(100 * ratio.high, digits)})"


def _clear(ratio: Any) -> Markup | str:
    """A ratio in per cent, bold where its interval leaves out 100 %."""
    shown = _ratio(ratio).split(" (")[0]
    return Markup(f"**{shown}**") if ratio.known and not ratio.low <= 1 <= ratio.high else shown
