"""What a learning curve says, in lines for a terminal: answer, sizes, and what comes next."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from iksamples.answer.answer import Size, VariantAnswer
from iksamples.answer.assess import answer
from iksamples.answer.collect import outcomes
from iksamples.recorded.learn import Learned
from iksamples.stats import share_lower
from iksamples.study import Study, Tolerance
from iksamples.text import percent, percent_down, several, whole


if TYPE_CHECKING:
    import pandas as pd

_HEAD = ("n", "runs", "within", "at least", "best", "median", "worst", "bound")


def told(study: Study, found: Learned, judged: bool) -> list[str]:
    """What records say, in lines.

    Args:
        study: The study.
        found: What was learned from them.
        judged: Whether there is a tolerance to hold it against.
    """
    lines = [f"{study.recording.path}: {found.head}"]
    lines += [f"Note: {doubt}" for doubt in found.doubts]
    lines += [f"Left out: {name}: {why}" for name, why in found.left_out.items()]
    what = {"worst": "the worst record", "mean": "the mean"}.get(
        study.tolerance.of, f"{study.tolerance.of[1:]} % of the records"
    )
    if judged:
        lines.append(
            f"For {asked(study.tolerance, 'mm', 'orders')}, {what} of those held out in each:"
        )
    answered = answer(study, outcomes(study, found.runs))
    lines += answered.failures
    for one in answered.variants:
        own = found.judged[found.judged["method"] == one.method]
        lines += ["", f"{one.method} ({one.description})"]
        if judged:
            lines += [f"  {verdict(one, 'orders')} {_of_records(study, one, own)}"]
        lines += sizes_table(one.sizes, "mm", judged)
        joints = own[own["n_samples"] == one.sizes[-1].n_samples]["joint_deg"]
        if joints.notna().any():
            lines.append(
                f"  With {one.sizes[-1].n_samples} samples the joint that is off farthest is off "
                f"by {number(float(joints.median()))} deg, median over records held out."
            )
        if judged and one.kind != "nominal":
            lines += [f"  {line}" for line in beyond(one)]
    return lines


def _of_records(study: Study, one: VariantAnswer, own: "pd.DataFrame") -> str:
    """How many records are within the tolerance when others are learned from; each counts once."""
    size = one.shown
    rows = own[own["n_samples"] == size.n_samples]
    middle = rows.groupby("record")["error_mm"].median()
    met = int((middle <= study.tolerance.error_mm).sum())
    confidence = study.tolerance.confidence
    lower = share_lower(met, len(middle), confidence)
    return (
        f"With {several(size.n_samples, 'sample')} {met} of {len(middle)} records held out are "
        f"within: at least {percent_down(lower)} of such places, with {percent(confidence)} "
        "confidence."
    )


def verdict(one: VariantAnswer, runs: str) -> str:
    """How many samples one method needs, in a sentence.

    Args:
        one: Its answer.
        runs: What there are several of at each size, such as ``runs``.
    """
    largest = whole(one.sizes[-1].n_samples)
    if not one.sizes[-1].n_samples:
        return "it needs no samples." if one.found else "it fails, and no samples change that."
    if one.found:
        below = one.smaller
        less = f"; {whole(below.n_samples)} do not" if below else "; fewer were not tried"
        return f"{several(one.found.n_samples, 'sample')} will do{less}."
    if one.status == "more-seeds":
        return (
            f"at {largest} samples more {runs} are within than have to be, but too few to be sure; "
            f"{several(one.seeds_needed or 0, runs.removesuffix('s'))} would tell, all of them new"
            f"{' (--subsets, and another --seed)' if runs == 'orders' else ''}."
        )
    return f"more than {largest} samples."


def asked(tolerance: Tolerance, unit: str, runs: str) -> str:
    """What is required: ``at least 80 % of runs within 2 mm, with 95 % confidence``."""
    who = runs if tolerance.best_of == 1 else f"times that {tolerance.best_of} {runs} are made"
    limit = f"{tolerance.error_mm:g} {unit}".rstrip()
    share, sure = percent(tolerance.success_share), percent(tolerance.confidence)
    return f"at least {share} of {who} within {limit}, with {sure} confidence"


def sizes_table(sizes: list[Size], unit: str, judged: bool) -> list[str]:
    """A line for each size, below one of names.

    Args:
        sizes: Sizes, fewest samples first.
        unit: Unit of the errors; empty: none is known.
        judged: Whether there is a tolerance that they were held against.
    """
    in_unit = f" [{unit}]" if unit else ""
    head = [f"{name}{in_unit}" if name in _HEAD[4:] else name for name in _HEAD]
    rows = [head]
    for size in sizes:
        lower = size.success_rate_lcb
        errors = size.error_best_mm, size.error_median_mm, size.error_worst_mm
        rows.append(
            [
                whole(size.n_samples),
                whole(size.n_seeds),
                whole(size.n_met),
                "" if lower is None else percent_down(lower),
                *(number(value) for value in errors),
                number(size.tolerance_bound_mm, math.ceil),
            ]
        )
    kept = [i for i in range(len(_HEAD)) if judged or i not in (2, 3)]
    widths = [max(len(row[i]) for row in rows) for i in kept]
    return [
        "  " + "  ".join(row[i].rjust(wide) for i, wide in zip(kept, widths, strict=True))
        for row in rows
    ]


def beyond(one: VariantAnswer) -> list[str]:
    """How the learning curve looks, and what it says beyond the sizes there are."""
    lines = []
    if one.curve:
        slowly = ", ever more slowly" if one.curve.convex else ", but not ever more slowly"
        lines.append(
            f"Learning curve: it falls from each size to the next{slowly}."
            if one.curve.monotone
            else "Learning curve: a larger size has a larger error than a smaller one."
        )
    if one.found:
        lines.append("Next: nothing more has to be recorded.")
    elif one.extrapolation:
        far = one.extrapolation
        n = whole(far.record_next)
        lines.append(
            f"Extrapolated, not tried: between {whole(math.floor(far.needed.low))} and "
            f"{whole(math.ceil(far.needed.high))} samples, if it goes on as it has. Next: record "
            f"until there are {n}, and ask again."
            if far.needed
            else f"Not extrapolated: {far.reason}. Next: record until there are {n}, and ask again."
        )
    return lines


def number(value: float, way: Callable[[float], float] = round) -> str:
    """A number with three figures."""
    if not math.isfinite(value):
        return "none"
    if value == 0:
        return "0"
    step = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    # What is a whole number of steps but for rounding stays where it is.
    return f"{way(round(value / step, 6)) * step:.3g}"
