"""The answer in sentences. Each says what is certified, measured or extrapolated, and how sure."""

import math

from iksamples.answer.answer import Rung
from iksamples.answer.beyond import Beyond, is_random
from iksamples.answer.curves import NEVER
from iksamples.answer.finding import Finding
from iksamples.answer.words import (
    described,
    millimetres,
    percent,
    percent_down,
    placed,
    plain_millimetres,
    several,
    whole,
)
from iksamples.evaluation.paths import count_waypoints
from iksamples.samples.record import N_CORNERS
from iksamples.study import NETWORK, Study


def headline(study: Study, findings: list[Finding]) -> str:
    """The wish, the variant that needs fewest samples, the study's own network, and the best other.

    The exact inverse is a reference and recommended to nobody who asks for samples.
    """
    candidates = [one for one in findings if _kind(study, one) != "analytic"] or findings
    answered = [one for one in candidates if one.status == "answered"]
    answered.sort(
        key=lambda one: (one.n_samples, not _certified(one), _kind(study, one) != "network")
    )
    best = answered[:1]
    networks = [one for one in answered if _kind(study, one) == "network"]
    own = [one for one in findings if one.variant.method == NETWORK]
    rest = [one for one in answered if _kind(study, one) != "network"]
    # Who wants a proof, and not a measurement, is told what that takes.
    proved = [one for one in answered if _certified(one) and not _certified(best[0])]
    others: list[Finding] = []
    for one in (*networks[:1], *proved[:1], *own[:1], *rest[:1]):
        if one not in (*best, *others):
            others.append(one)
    clauses = [_lead(study, one) for one in best]
    clauses += [_clause(study, one) for one in others or ([] if best else candidates[:1])]
    return f"{_wish(study, findings)}: {'; '.join(clauses)}."


def told(study: Study, one: Finding) -> list[str]:
    """One variant's answer, and by how much the rung below it fails; or why there is none."""
    lines = _answered(study, one) if one.status == "answered" else _not_answered(study, one)
    return lines + _luck(one.rungs, one.found) + _undecided(one.shown)


def points_measured(study: Study) -> int:
    """Points at which the error that the tolerance is about is measured."""
    where = study.tolerance.where
    if where == "workspace":
        return study.evaluation.cube_points + N_CORNERS
    return count_waypoints(study.evaluation.paths[where])


def _wish(study: Study, findings: list[Finding]) -> str:
    """What is asked for, as the head of a sentence."""
    tolerance = study.tolerance
    at_most = plain_millimetres(tolerance.error_mm)
    path = tolerance.where != "workspace"
    place = f"the path {tolerance.where}" if path else "the workspace"
    if tolerance.of == "mean":
        text = f"For a mean error of at most {at_most} over {place}"
    elif tolerance.of != "worst":
        text = f"For {tolerance.of[1:]} % of {place} within {at_most}"
    elif any(_certified(one) for one in findings):
        text = f"For every point of {place} within {at_most}"
    else:
        along = "along" if path else "in"
        text = f"For all {_points(study)} measured {along} {place} within {at_most}"
    if not any(is_random(study, one.variant.method) for one in findings):
        return text
    sure, share = percent(tolerance.confidence), percent(tolerance.success_share)
    if tolerance.best_of == 1:
        return f"{text}, with {sure} confidence that at least {share} of trainings succeed"
    return (
        f"{text}, with {sure} confidence that the best of {tolerance.best_of} trainings succeeds "
        f"at least {share} of the time"
    )


def _lead(study: Study, one: Finding) -> str:
    """The clause of the variant that the headline recommends."""
    subject, proof = described(study, one.variant.method), _proof(study, one.shown)
    both = f"{subject[:-1]}; {proof})" if subject.endswith(")") else f"{subject} ({proof})"
    n = several(one.shown.n_samples, "sample")
    return f"{n}{placed(study, one.variant.design)} and {both}"


def _clause(study: Study, one: Finding) -> str:
    """The clause of any other variant."""
    method, rung = one.variant.method, one.shown
    subject = described(study, method) + placed(study, one.variant.design)
    if one.status == "answered":
        if _kind(study, one) == "analytic":
            return f"{subject} needs none"
        return f"{subject} needs {whole(rung.n_samples)} ({_proof(study, rung)})"
    if one.status == "more-seeds":
        few = f"{several(rung.n_seeds, 'training')} cannot tell"
        return f"for {subject}, {few} ({whole(one.seeds or 0)} might do)"
    if one.status == "unreachable":
        return f"with {subject} it is not reachable, however many samples (by its learning curve)"
    more = f"{subject} needs more than {whole(rung.n_samples)}"
    if one.status == "extrapolated" and one.n_samples:
        return f"{more} (extrapolated: {whole(one.n_samples)})"
    return more


def _answered(study: Study, one: Finding) -> list[str]:
    """An answer that lies on the ladder, and the rung below it."""
    rung, below = one.shown, one.smaller
    proof = _evidence(study, rung)
    head = f"With {several(rung.n_samples, 'sample')}"
    if _kind(study, one) == "analytic":
        return [f"It needs no samples; its error is {_shown(rung.kept_mm)} ({proof})."]
    if rung.success_lower is None:
        lines = [f"{head} the error is {_shown(rung.kept_mm)} ({proof}); nothing in it is chance."]
    else:
        lines = [
            f"{head} {_met(study, rung)}. As sure as wished, it keeps to {_shown(rung.kept_mm)} "
            f"({proof})."
        ]
    if below is None:
        return [*lines, "Fewer samples were not tried."]
    return [*lines, f"One rung below it fails: {_failing(study, below)}."]


def _not_answered(study: Study, one: Finding) -> list[str]:
    """A tolerance that the ladder does not meet."""
    rung, beyond, tolerance = one.shown, one.beyond, study.tolerance
    verdict = "cannot be confirmed" if one.status == "more-seeds" else "fail"
    lines = [f"The most samples tried {verdict}: {_failing(study, rung)}."]
    if one.status == "more-seeds":
        lines.append(
            "The share that succeeded is larger than wished, but "
            f"{several(rung.n_seeds, 'training')} cannot make sure of it: if it stays as it is, "
            f"{whole(one.seeds or 0)} would be enough (training.seeds); fresh seeds, and not "
            "seeds added until it holds, keep the confidence what it says."
        )
    if beyond is None or one.status == "more-seeds":
        return lines
    if one.status == "unreachable" and beyond.curve:
        level = beyond.curve.level_mm
        lines.append(
            f"Not reachable with this method, however many samples: by its learning curve even "
            f"{whole(NEVER)} times the most tried leave {millimetres(level.value)} (95 % interval "
            f"{millimetres(level.low)} to {millimetres(level.high)}) where "
            f"{plain_millimetres(tolerance.error_mm)} are wished. {_test_of(beyond)}"
        )
    elif one.status == "extrapolated" and beyond.curve and beyond.n_samples:
        needed = beyond.curve.needed(tolerance.error_mm, tolerance.confidence)
        sure = "if it goes on as it has"
        if beyond.curve.floor_mm.known:
            most = whole(math.ceil(needed.upper))
            sure = f"with {percent(tolerance.confidence)} confidence at no more than {most}, {sure}"
        lines.append(
            f"Extrapolated, not tried: {several(beyond.n_samples, 'sample')}. The learning "
            f"curve comes down to the tolerance at {whole(math.ceil(needed.n_samples))} ({sure}). "
            f"{_test_of(beyond)}"
        )
    else:
        lines.append(f"How many it would take cannot be said: {beyond.reason}.")
    return lines


def _luck(rungs: list[Rung], found: Rung | None) -> list[str]:
    """Rungs that meet the wish though a larger one does not."""
    below = rungs[: rungs.index(found)] if found else rungs
    lucky = [rung for rung in below if rung.meets]
    if not lucky:
        return []
    larger = next(rung for rung in reversed(below) if not rung.meets)
    which = " and ".join(whole(rung.n_samples) for rung in lucky)
    return [
        f"{which} samples meet the wish as well, but {whole(larger.n_samples)} do not, so that is "
        "not counted."
    ]


def _undecided(rung: Rung) -> list[str]:
    """Certificates that stopped before they could tell."""
    if not rung.n_undecided:
        return []
    return [
        f"With {several(rung.n_samples, 'sample')} {several(rung.n_undecided, 'training')} "
        "counted as failed may succeed: the search for the certificate ended too early to tell."
    ]


def _kind(study: Study, one: Finding) -> str:
    return study.all_methods[one.variant.method].kind


def _certified(one: Finding) -> bool:
    return one.shown.n_certified == one.shown.n_seeds


def _points(study: Study) -> str:
    word = "point" if study.tolerance.where == "workspace" else "waypoint"
    return several(points_measured(study), word)


def _evidence(study: Study, rung: Rung) -> str:
    """``certified``, or how it was measured."""
    if rung.n_certified < rung.n_seeds:
        return f"measured at {_points(study)}, not certified"
    return "certified"


def _proof(study: Study, rung: Rung) -> str:
    """The tolerance that a rung would even meet, and what shows it: ``certified: 1.60 mm``."""
    return f"{_evidence(study, rung)}: {_shown(rung.kept_mm)}"


def _met(study: Study, rung: Rung) -> str:
    """How many trainings succeeded, and what follows for all."""
    tolerance = study.tolerance
    lower, sure = percent_down(rung.success_lower or 0), percent(tolerance.confidence)
    met = f"{rung.n_met} of {several(rung.n_seeds, 'training')} succeed"
    if not rung.n_met:
        return met
    if tolerance.best_of == 1:
        return f"{met}; with {sure} confidence at least {lower} of all trainings do"
    best = f"the best of {tolerance.best_of} does at least {lower} of the time"
    return f"{met}; with {sure} confidence {best}"


def _failing(study: Study, rung: Rung) -> str:
    """How far a rung is from the wish."""
    tolerance = study.tolerance
    head = f"with {several(rung.n_samples, 'sample')}"
    excess = "" if rung.kept_mm is None else millimetres(rung.kept_mm - tolerance.error_mm)
    if rung.success_lower is None:
        much = f", {excess} too much" if excess else ""
        return f"{head} the error is {_shown(rung.kept_mm)}{much}"
    text = f"{head} {_met(study, rung)}, where {percent(tolerance.success_share)} are wished"
    if rung.kept_mm is None:
        return text
    return f"{text}. As sure as wished, it keeps to {millimetres(rung.kept_mm)}, {excess} too much"


def _shown(error_mm: float | None) -> str:
    return "not finite" if error_mm is None else millimetres(error_mm)


def _test_of(beyond: Beyond) -> str:
    """How well the curve did on the rung that was held out."""
    curve = beyond.curve
    if curve is None or curve.held_out is None:
        return ""
    held_out = curve.held_out
    much = percent(abs(held_out.relative_error))
    way = "high" if held_out.relative_error > 0 else "low"
    law = "a + b n^-c" if curve.law == "power" else "a + b / (m - 1)^2"
    return (
        f"A test of the curve ({law}): fitted without the {whole(held_out.n_samples)} samples, it "
        f"is {much} too {way} there."
    )
