"""Recording in rounds: are the poses had so far enough, and if not, which come next?"""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cache

from iksamples.arm.chain import Floats
from iksamples.calibration.design import in_order, optimal
from iksamples.calibration.known import Fitted
from iksamples.calibration.worst import worst_mm


MOST = 60
"""Poses of a round, at most; with so many real arms have met their own repeatability."""
AIM = 0.97
"""A round is to end this far within the tolerance: the drawing, once fitted, moves a little."""
_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class Round:
    """What to do next.

    Attributes:
        stop: The tolerance is kept, with the confidence.
        worst_mm: Worst error that is not exceeded with the confidence, as things stand [mm].
        chosen: Candidates to record, as indices; none where to stop.
        expected_mm: The same once they are recorded [mm].
    """

    stop: bool
    worst_mm: float
    chosen: list[int]
    expected_mm: float


def next_round(
    fitted: Fitted,
    informs: Floats,
    judged: Floats,
    tolerance_mm: float,
    confidence: float = 0.95,
    most: int = MOST,
) -> Round:
    """Stop, or the fewest poses that are expected to be enough.

    What is judged is the posterior, all samples given: to have looked before does not bias it, so
    the confidence holds whenever one stops, over arms and noise as they are expected (Berger and
    Wolpert, *The Likelihood Principle*, sec. 4.2). docs/calibration.md has how often it held.

    Args:
        fitted: What the samples had so far say.
        informs: ``Measured.informs`` of the poses that may be recorded.
        judged: ``worst.judged_effects``.
        tolerance_mm: Worst error allowed [mm].
        confidence: That it is kept where the answer is to stop.
        most: Poses of the round, at most: as many are chosen where none are enough.
    """
    now = worst_mm(fitted, judged, confidence)
    if now <= tolerance_mm:
        return Round(True, now, [], now)

    def expected(chosen: list[int]) -> float:
        return worst_mm(fitted.expecting(informs[chosen]), judged, confidence, _DRAWS)

    @cache
    def best(k: int) -> list[int]:
        return min(order[:k], optimal(fitted, informs, k, judged), key=expected)

    def enough(chosen: list[int]) -> bool:
        return expected(chosen) <= AIM * tolerance_mm

    order = in_order(fitted, informs, min(most, len(informs)))
    k = 1 + bisect_left(range(1, len(order)), True, key=lambda k: enough(order[:k]))
    # Exchanged for one another, fewer may be enough.
    k = 1 + bisect_left(range(1, k), True, key=lambda k: enough(best(k)))
    chosen = best(k)
    then = worst_mm(fitted.expecting(informs[chosen]), judged, confidence)
    return Round(False, now, chosen, then)
