"""The answer in sentences. Each says what is certified, measured or extrapolated, and how sure."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from iksamples.answer.answer import Confidence, Size, VariantAnswer
from iksamples.study import NETWORK, Study
from iksamples.text import (
    allowed,
    described,
    described_on,
    domain,
    listed,
    millimetres,
    percent,
    percent_down,
    placed,
    plain_millimetres,
    several,
    trial,
    whole,
)


_ASKED = {
    "mean": "For a mean error of at most {limit} over {place}",
    "p95": "For 95 % of {place} within {limit}",
    "p99": "For 99 % of {place} within {limit}",
    "proved": "For every point of {place} within {limit}",
    "worst": "For all {points} measured {along} {place} within {limit}",
}
_REASONS = 5
"""Why proofs failed is told of so many methods and reasons."""
_SURE = ", with {sure} that at least {share} of {trials} succeed"
_SURE_OF_BEST = ", with {sure} that the best of {k} trainings succeeds at least {share} of the time"
_CLAUSES = {
    "answered": "{what} needs {n} ({evidence}: {bound})",
    "nominal": "{what} needs none",
    "more-seeds": "for {what}, {trials} cannot tell ({seeds} might do)",
    "extrapolated": "{what} needs more than {largest} (extrapolated: {n})",
    "open": "{what} needs more than {largest}",
}
_ANSWERED = {
    "by chance": "With {samples}, {met}. The required share of {trials} is within {bound} "
    "({evidence}).",
    "nominal": "It needs no samples; its error is {bound} ({evidence}).",
    "other": "With {samples} the error is {bound} ({evidence}), without chance.",
}
_MORE_SEEDS = (
    "More {trials} succeeded than required, but {n} cannot make sure of it: if the share "
    "stays as it is, {seeds} would ({setting}). Take fresh ones ({fresh}): adding some until it "
    "holds would spoil the confidence."
)
_SEEDS = {
    "setting": ("training.seeds", "samples.recorded.subsets"),
    "fresh": ("training.first_seed", "samples.seed"),
}
"""Settings of a training or an arm, and of an order of records."""
_EXTRAPOLATED = (
    "Extrapolated, not tried: {n}. The laws fitted to its learning curve come down to {limit} "
    "between {low} and {high}, if it goes on as it has."
)
_REFUSED = "How many it takes cannot be said: {reason}. Record more first, for example {n}."


def headline(
    study: Study, variants: Sequence[VariantAnswer], confidence: Confidence, region_share: float
) -> str:
    """What is required, the variant that needs fewest samples, and what others need.

    Of an arm that is its drawing, the drawing's inverse is a reference, and recommended to nobody
    who asks for samples.
    """
    real = trial(study) != "training"
    candidates = [one for one in variants if one.kind != "nominal" or real] or list(variants)
    answered = [one for one in candidates if one.found]
    answered.sort(
        key=lambda one: (
            one.n_samples,
            not one.shown.certified,
            one.kind != "network",
            one.shown.tolerance_bound_mm,
        )
    )
    best = answered[:1]
    # Then the best network, the best that is proved, the study's own, the best without chance.
    others = [
        *[one for one in answered if one.kind == "network"][:1],
        *[one for one in answered if one.shown.certified and not best[0].shown.certified][:1],
        *[one for one in variants if one.method == NETWORK][:1],
        *[one for one in answered if one.kind != "network"][:1],
    ]
    rest = [one for i, one in enumerate(others) if one not in best and one not in others[:i]]
    lead = [
        f"{_samples(one.shown)}{placed(study, one.design) if one.n_samples else ''} and "
        f"{described(study, one.method)} ({_evidence(study, one.shown)}: {_bound(one.shown)})"
        for one in best
    ]
    clauses = [_clause(study, one) for one in rest or ([] if best else candidates[:1])]
    return f"{_asked(study, variants, confidence, region_share)}: {'; '.join(lead + clauses)}."


def failures(study: Study, variants: Sequence[VariantAnswer]) -> list[str]:
    """How many combinations of method and samples have a result, and why others have none.

    Returns:
        That, and a line for each that has none, or not of every training; nothing where all have.
    """
    every = [(one, size) for one in variants for size in one.sizes]
    lines = [
        f"{one.method}, {size.label}: {size.why}"
        if size.n_failed == size.n_seeds
        else f"{one.method}, {size.label}: {size.n_failed} of "
        f"{several(size.n_seeds, trial(study))} without one: {size.why}"
        for one, size in every
        if size.n_failed
    ]
    whole = sum(not size.n_failed for _, size in every)
    what = "combinations of method and samples have a result"
    some = sum(0 < size.n_failed < size.n_seeds for _, size in every)
    also = f", {some} more not of every {trial(study)}" if some else ""
    return [f"{whole} of {len(every)} {what}{also}.", *lines] if lines else []


def unproved(runs: pd.DataFrame) -> list[str]:
    """How many worst errors are proved, and why others are not, though a proof was tried.

    Args:
        runs: Rows of the study's tidy table (``collect.read_runs``).

    Returns:
        That, and a line per method and reason, the most frequent five; nothing where none failed.
    """
    tried = runs[runs["verified"] | runs["unproved"].ne("")]
    lost = tried[tried["unproved"].ne("")]
    lines = []
    for (method, why), rows in lost.groupby(["method", "unproved"], sort=False):
        labels = list(rows["label"].unique())
        asked = (tried["method"].eq(str(method)) & tried["label"].isin(labels)).sum()
        lines.append((len(rows), f"{method}, {listed(labels)}: {len(rows)} of {asked}: {why}"))
    lines.sort(key=lambda one: -one[0])
    told = [line for _, line in lines[:_REASONS]]
    if more := sum(n for n, _ in lines[_REASONS:]):
        told.append(f"{several(more, 'other')} for reasons of their own")
    return (
        [f"Proved: {len(tried) - len(lost)} of {len(tried)} worst errors.", *told] if told else []
    )


def of_itself(study: Study, rows: pd.DataFrame) -> list[str]:
    """What a method that knows how sure it is says of its errors, and whether that holds.

    Args:
        study: The study.
        rows: Its outcomes (``collect.outcomes``) with one number of samples.
    """
    wish = study.tolerance
    if study.arm is None or wish.of != "worst" or wish.angle_deg:
        return []
    said = rows["confident_mm"].to_numpy(float)
    if not np.isfinite(said).all():
        return []
    held = int(np.sum(rows["attained_mm"].to_numpy(float) <= said))
    return [
        "The samples alone say how large the worst error may be, with 95 % confidence: "
        f"{millimetres(float(np.median(said)))} in the median; it holds on {held} of "
        f"{several(len(said), 'arm')}."
    ]


def told(study: Study, one: VariantAnswer, confidence: Confidence) -> list[str]:
    """One variant's answer, and by how much the size below it fails; or why there is none."""
    size, beyond = one.shown, one.extrapolation
    lines = []
    if one.found:
        by_chance = size.success_rate_lcb is not None
        kind = "by chance" if by_chance else "nominal" if one.kind == "nominal" else "other"
        lines.append(
            _ANSWERED[kind].format(
                samples=_samples(size),
                met=_met(study, size, confidence),
                trials=f"{trial(study)}s",
                bound=_bound(size),
                evidence=_evidence(study, size),
            )
        )
        if one.kind != "nominal":
            smaller = one.smaller
            fails = _failing(study, smaller, confidence) if smaller else ""
            lines.append(f"One size below fails: {fails}." if fails else "Fewer were not tried.")
    elif one.kind == "nominal":
        lines.append(f"It fails, and no samples change it: {_failing(study, size, confidence)}.")
    else:
        lines.append(f"The most samples tried fail: {_failing(study, size, confidence)}.")
    if one.seeds_needed:
        n, seeds = whole(size.n_seeds), whole(one.seeds_needed)
        named = {key: both[study.samples.recorded is not None] for key, both in _SEEDS.items()}
        lines.append(_MORE_SEEDS.format(trials=f"{trial(study)}s", n=n, seeds=seeds, **named))
    elif beyond and beyond.needed:
        lines.append(
            _EXTRAPOLATED.format(
                n=several(beyond.record_next, "sample"),
                limit=allowed(study.tolerance),
                low=whole(np.floor(beyond.needed.low)),
                high=whole(np.ceil(beyond.needed.high)),
            )
        )
    elif beyond:
        n = several(beyond.record_next, "sample")
        lines.append(_REFUSED.format(reason=beyond.reason, n=n))
    below = one.sizes[: one.sizes.index(size)] if one.found else one.sizes
    lucky = [smaller for smaller in below if smaller.meets]
    if lucky:
        which = " and ".join(whole(smaller.n_samples) for smaller in lucky)
        lines.append(f"{which} samples meet it as well, but a larger size does not: not counted.")
    if size.n_undecided:
        lines.append(
            f"With {_samples(size)} "
            f"{several(size.n_undecided, trial(study))} counted as failed may succeed: the search "
            "for the certificate ended too early to tell."
        )
    return lines


def floor_told(study: Study, median_mm: float, worst_mm: float) -> str:
    """What no number of samples can beat, and whether that is too much already.

    Args:
        study: The study, with an ``arm`` section.
        median_mm: The error of an arm's own inverse that the tolerance is about, median arm [mm].
        worst_mm: The same of the worst arm [mm].
    """
    n = several(len(study.arms), "simulated arm")
    if not worst_mm:
        return f"Repeatability of the {n}: exact."
    text = (
        f"Repeatability of the {n}: knowing it exactly, the median arm is off by "
        f"{millimetres(median_mm)} and the worst by {millimetres(worst_mm)} (play and steps of "
        "the joints, measured), which no number of samples can beat."
    )
    limit = study.tolerance.error_mm
    if median_mm > limit:
        text += f" That is more than the {plain_millimetres(limit)} asked for."
    return text


def _over(study: Study, region_share: float) -> str:
    """What everything is over: the workspace, what the arm can use of it, or records."""
    if study.samples.recorded:
        return "what was held out"
    share = "" if region_share == 1 else f" ({percent_down(region_share)} of the box)"
    return domain(region_share) + share


def _asked(
    study: Study, variants: Sequence[VariantAnswer], confidence: Confidence, region_share: float
) -> str:
    """What is required, as the head of a sentence."""
    tolerance = study.tolerance
    proved = tolerance.of == "worst" and any(one.shown.certified for one in variants)
    path = tolerance.where != "workspace"
    text = _ASKED["proved" if proved else tolerance.of].format(
        limit=allowed(tolerance),
        place=f"the path {tolerance.where}" if path else _over(study, region_share),
        points=_points(study, variants[0].shown),
        along="along" if path else "in",
    )
    if not confidence.n_variants:
        return text
    sure = _SURE if tolerance.best_of == 1 else _SURE_OF_BEST
    return text + sure.format(
        sure=_confidence(study, confidence),
        share=percent(tolerance.success_share),
        trials=f"{trial(study)}s",
        k=tolerance.best_of,
    )


def _confidence(study: Study, confidence: Confidence) -> str:
    """``95 % confidence``, and for how many variants at once."""
    text = f"{percent(confidence.together)} confidence"
    if confidence.n_variants == 1:
        return text
    all_of_them = "both" if confidence.n_variants == 2 else f"all {confidence.n_variants}"
    what = "variants of networks" if trial(study) == "training" else "methods"
    return f"{text} for {all_of_them} {what} together"


def _clause(study: Study, one: VariantAnswer) -> str:
    """The clause of a variant that is not the best."""
    size = one.shown
    status = "nominal" if one.found and one.kind == "nominal" else one.status
    return _CLAUSES[status].format(
        what=described_on(study, one.method, one.design),
        n=whole(one.n_samples or 0),
        largest=whole(size.n_samples),
        evidence=_evidence(study, size),
        bound=_bound(size),
        trials=several(size.n_seeds, trial(study)),
        seeds=whole(one.seeds_needed or 0),
    )


def _met(study: Study, size: Size, confidence: Confidence) -> str:
    """How many trainings succeeded, and what follows for all."""
    met = f"{size.n_met} of {several(size.n_seeds, trial(study))} succeed"
    if not size.success_rate_lcb:
        return met
    best_of = study.tolerance.best_of
    who = f"of {trial(study)}s do" if best_of == 1 else f"of the time the best of {best_of} does"
    lower = percent_down(size.success_rate_lcb)
    return f"{met}; with {_confidence(study, confidence)} at least {lower} {who}"


def _failing(study: Study, size: Size, confidence: Confidence) -> str:
    """How far a size is from what is required."""
    excess_mm = round(size.tolerance_bound_mm - study.tolerance.error_mm, 9)
    much = f", {millimetres(excess_mm)} too much" if np.isfinite(excess_mm) else ""
    samples = _samples(size)
    if size.success_rate_lcb is None:
        return f"with {samples} the error is {_bound(size)}{much}"
    share = percent(study.tolerance.success_share)
    text = f"with {samples}, {_met(study, size, confidence)}, where {share} are required"
    return f"{text}; the required share is within {_bound(size)}{much}" if much else text


def _evidence(study: Study, size: Size) -> str:
    """``certified``, or how it was measured."""
    return "certified" if size.certified else f"measured at {_points(study, size)}, not certified"


def _samples(size: Size) -> str:
    return several(size.n_samples, "sample") if size.n_samples else "no samples"


def _points(study: Study, size: Size) -> str:
    word = "point" if study.tolerance.where == "workspace" else "waypoint"
    if study.samples.recorded:
        word = "record"
    return several(size.n_points, word)


def _bound(size: Size) -> str:
    bound_mm = size.tolerance_bound_mm
    return millimetres(bound_mm) if np.isfinite(bound_mm) else "not finite"
