"""The answer in sentences. Each says what is certified, measured or extrapolated, and how sure."""

from iksamples.sizing.answer import Below, Cause, Rung, Status
from iksamples.sizing.beyond import Beyond
from iksamples.sizing.words import (
    described,
    millimetres,
    percent,
    percent_down,
    plain_millimetres,
    several,
    whole,
)
from iksamples.study import Study


def evidence(study: Study, n_points: int, certified: bool) -> str:
    """``certified``, or how it was measured."""
    if certified:
        return "certified"
    return f"measured at {_points(study, n_points)}, not certified"


def wish(study: Study, any_certified: bool, by_chance: bool, n_points: int) -> str:
    """What is asked for, as the head of a sentence."""
    tolerance = study.tolerance
    at_most = plain_millimetres(tolerance.error_mm)
    path = None if tolerance.where == "workspace" else tolerance.where
    place = f"the path {path}" if path else "the workspace"
    if tolerance.of == "worst":
        if any_certified:
            text = f"For every point of {place} within {at_most}"
        else:
            points = _points(study, n_points)
            text = f"For all {points} measured {'along' if path else 'in'} {place} within {at_most}"
    elif tolerance.of == "mean":
        text = f"For a mean error of at most {at_most} over {place}"
    else:
        text = f"For {tolerance.of[1:]} % of {place} within {at_most}"
    if not by_chance:
        return text
    sure, share = percent(tolerance.confidence), percent(tolerance.success_share)
    if tolerance.best_of == 1:
        return f"{text}, with {sure} confidence that at least {share} of trainings succeed"
    return (
        f"{text}, with {sure} confidence that the best of {tolerance.best_of} trainings succeeds "
        f"at least {share} of the time"
    )


def lead(study: Study, name: str, rung: Rung, n_points: int) -> str:
    """The clause of the method that the headline recommends."""
    subject, proof = described(study, name), _proof(study, rung, n_points)
    both = f"{subject[:-1]}; {proof})" if subject.endswith(")") else f"{subject} ({proof})"
    return f"{several(rung.n_samples, 'sample')} and {both}"


def clause(
    study: Study,
    name: str,
    status: Status,
    rung: Rung,
    beyond: Beyond | None,
    seeds: int | None,
    n_points: int,
) -> str:
    """The clause of any other method.

    Args:
        study: The study.
        name: The method.
        status: Its status.
        rung: The answer's rung, or else the largest.
        beyond: What the curves say.
        seeds: Trainings that would settle it, where that is the problem.
        n_points: Points measured.
    """
    subject = described(study, name)
    if study.all_methods[name].kind == "analytic" and status == "answered":
        return f"{subject} needs none"
    if status == "answered":
        return f"{subject} needs {whole(rung.n_samples)} ({_proof(study, rung, n_points)})"
    if status == "more-seeds":
        many = f", at least {whole(seeds)}" if seeds else ""
        return f"{subject} takes more trainings than {rung.n_seeds} to tell{many}"
    if status == "unreachable":
        return f"with {subject} it is not reachable, however many samples (by its learning curve)"
    more = f"{subject} needs more than {whole(rung.n_samples)}"
    if status == "extrapolated" and beyond and beyond.n_samples:
        return f"{more} (extrapolated: {whole(beyond.n_samples)})"
    return more


def answered(
    study: Study, rung: Rung, below: Below | None, smaller: Rung | None, n_points: int
) -> list[str]:
    """Sentences on an answer that lies on the ladder, and on the rung below."""
    lines = [f"{_count(study, rung)}; {_kept(study, rung, n_points)}."]
    if below is None or smaller is None:
        lines.append("Fewer samples were not tried.")
    elif below.short is None:
        excess = "" if below.excess_mm is None else f", {millimetres(below.excess_mm)} too much"
        lines.append(
            f"One rung below, with {several(smaller.n_samples, 'sample')}, the error is "
            f"{_shown(smaller.error_worst_mm)}{excess}."
        )
    else:
        lines.append(f"One rung below it fails: {_failing(study, smaller)}.")
    return lines


def not_answered(
    study: Study, status: Status, rung: Rung, beyond: Beyond | None, seeds: int | None
) -> list[str]:
    """Sentences on a tolerance that the ladder does not meet.

    Args:
        study: The study.
        status: The method's status.
        rung: The largest rung.
        beyond: What the curves say.
        seeds: Trainings that would settle it, where that is the problem.
    """
    if rung.success_lower is None:
        lines = [
            f"With {several(rung.n_samples, 'sample')}, the most tried, the error is "
            f"{_shown(rung.error_worst_mm)}."
        ]
    else:
        lines = [f"The most samples tried fail: {_failing(study, rung)}."]
    if status == "more-seeds" and seeds:
        lines.append(
            f"{rung.n_met} of {rung.n_seeds} is too few trainings to be this sure: at the share "
            f"seen, at least {whole(seeds)} are needed (training.seeds)."
        )
    if beyond is None:
        return lines
    tolerance = study.tolerance
    if status == "unreachable" and beyond.curve:
        floor = beyond.curve.floor_mm
        lines.append(
            "Not reachable with this method, however many samples: its learning curve levels off "
            f"at {millimetres(floor.value)} (95 % interval {millimetres(floor.low)} to "
            f"{millimetres(floor.high)}), above {plain_millimetres(tolerance.error_mm)}. "
            f"{_test_of(beyond)}"
        )
    elif status == "extrapolated" and beyond.curve and beyond.n_samples:
        needed = beyond.curve.needed(tolerance.error_mm, tolerance.confidence)
        grid = f", a grid of {beyond.points_per_axis} per axis" if beyond.points_per_axis else ""
        sure = (
            f"no more than {whole(needed.upper)} with {percent(tolerance.confidence)} confidence"
            if beyond.curve.floor_mm.known
            else "no interval, since nothing scatters"
        )
        lines.append(
            f"Extrapolated, not tried: {several(beyond.n_samples, 'sample')}{grid}. The learning "
            f"curve comes down to the tolerance at {whole(needed.n_samples)} ({sure}, if the curve "
            f"goes on as it has). {_test_of(beyond)}"
        )
    elif status == "open" and beyond.reason:
        lines.append(f"How many it would take cannot be said: {beyond.reason}.")
    return lines


def luck(numbers: list[int], largest_failing: int) -> list[str]:
    """A sentence on rungs that meet the wish though a larger one does not."""
    if not numbers:
        return []
    which = " and ".join(whole(n) for n in numbers)
    does = "meets" if len(numbers) == 1 else "meet"
    return [
        f"{which} {does} the wish, but {whole(largest_failing)} does not, so "
        f"{'it is' if len(numbers) == 1 else 'they are'} not counted."
    ]


def undecided(rung: Rung) -> list[str]:
    """A sentence on certificates that stopped before they could tell."""
    if not rung.n_undecided:
        return []
    return [
        f"With {several(rung.n_samples, 'sample')}, {several(rung.n_undecided, 'training')} "
        "counted as failed may succeed: the search for the certificate stopped too early to tell."
    ]


def reasons(causes: list[Cause]) -> list[str]:
    """The causes, one sentence each."""
    return [cause.text for cause in causes]


def _points(study: Study, n_points: int) -> str:
    return several(n_points, "point" if study.tolerance.where == "workspace" else "waypoint")


def _proof(study: Study, rung: Rung, n_points: int) -> str:
    """The tolerance that a rung would even meet, and what shows it: ``certified: 1.60 mm``."""
    certified = rung.n_certified == rung.n_seeds
    return f"{evidence(study, n_points, certified)}: {_shown(rung.kept_mm)}"


def _count(study: Study, rung: Rung) -> str:
    """How many trainings meet it, and what follows for all."""
    tolerance = study.tolerance
    head = f"With {several(rung.n_samples, 'sample')}"
    if rung.success_lower is None:
        return f"{head} it meets the tolerance (no training, so nothing is left to chance)"
    lower, sure = percent_down(rung.success_lower), percent(tolerance.confidence)
    met = f"{head} {rung.n_met} of {rung.n_seeds} trainings meet it"
    if tolerance.best_of == 1:
        return f"{met}: with {sure} confidence at least {lower} of all trainings do"
    return (
        f"{met}: with {sure} confidence the best of {tolerance.best_of} does at least {lower} of "
        "the time"
    )


def _kept(study: Study, rung: Rung, n_points: int) -> str:
    """The tolerance that the rung would even meet."""
    certified = evidence(study, n_points, rung.n_certified == rung.n_seeds)
    if rung.success_lower is None:
        return f"the error is {_shown(rung.kept_mm)} ({certified})"
    kept = f"{_shown(rung.kept_mm)} would still be met ({certified})"
    return f"at the share and confidence wished, {kept}"


def _failing(study: Study, rung: Rung) -> str:
    """How far a rung is from the wish."""
    tolerance = study.tolerance
    lower = percent_down(rung.success_lower or 0)
    success = "at least" if tolerance.best_of == 1 else f"best of {tolerance.best_of}: at least"
    text = (
        f"with {several(rung.n_samples, 'sample')} {rung.n_met} of {rung.n_seeds} trainings meet it"
        f" ({success} {lower} with {percent(tolerance.confidence)} confidence, wished "
        f"{percent(tolerance.success_share)})"
    )
    if rung.kept_mm is not None and rung.kept_mm > tolerance.error_mm:
        excess = rung.kept_mm - tolerance.error_mm
        text += (
            f"; what it meets as wished is {_shown(rung.kept_mm)}, {millimetres(excess)} too much"
        )
    return text


def _shown(error_mm: float | None) -> str:
    return "infinite" if error_mm is None else millimetres(error_mm)


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
        f"A test of it ({law}): fitted without the {whole(held_out.n_samples)} samples, it is "
        f"{much} too {way} there."
    )
