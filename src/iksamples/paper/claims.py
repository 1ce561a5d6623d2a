"""What the paper claims (arXiv 2605.23583), and what holds: each verdict computed from data.

One function per claim. It is given numbers and returns a row: the claim, where the paper makes it,
the verdict and the number or counter-example behind it. ``judge_claims`` collects the rows for the
evidence of a study. A claim that is not contradicted holds as far as it was tested, no further.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.paper import equations as paper
from iksamples.paper.equations import Evidence, GridEvidence
from iksamples.stats import Interval


Verdict = Literal["holds", "does not hold", "holds in part", "cannot be tested"]

RELIABLE_N = 125
"""Up to so many samples the paper calls its estimate reliable, and beyond them the error constant
(abstract, Section 5)."""
_LEARNT_SHARE = 0.05
"""An error at the trained points below this share of the worst one counts as next to none."""
_NEAR = 0.1
"""So near to a midpoint, in spacings, counts as at it."""
_MOST, _HARDLY = 0.9, 0.1
_ROUNDING_MM = 0.005
"""Table 1 is printed to a hundredth of a millimetre."""


@dataclass(frozen=True)
class Claim:
    """A row of the page.

    Attributes:
        claim: What the paper says.
        where: Where it does.
        verdict: Whether it holds.
        evidence: The number or the counter-example.
    """

    claim: str
    where: str
    verdict: Verdict
    evidence: str


def judge_claims(evidence: Evidence) -> list[Claim]:
    """Every claim, in the order of the paper."""
    grids = evidence.grids
    return [
        squares_inequality(),
        lemma_1_bounds(grids),
        trained_points_are_exact(grids),
        midpoint_is_worst(grids),
        half_spacing_covers(grids),
        output_weights_bound_slopes(grids),
        jacobian_at_most_one(evidence.row_sums_mm, evidence.row_sums_by_range, evidence.scale_mm),
        average_weight_is_the_networks(evidence),
        equation_25_bounds(evidence),
        estimate_reliable(evidence),
        error_saturates(evidence),
        error_follows_the_square(evidence.floors_mm, evidence.tails_mm, evidence.misfits),
        best_number(evidence),
    ]


def squares_inequality(
    pairs: Iterable[tuple[float, float]] = ((3.0, 1.0), (1.0, 0.0), (2.0, -1.0)),
) -> Claim:
    """The step of Lemma 1's proof between squared norms, tried on numbers."""
    tried = [(a, b, abs(a * a - b * b), (a - b) ** 2) for a, b in pairs]
    broken = [row for row in tried if row[2] > row[3]]
    if broken:
        a, b, left, right = broken[0]
        text = (
            f"|{a:g}² − {_bracketed(b)}²| = {left:g} is more than |{a:g} − {_bracketed(b)}|² = "
            f"{right:g}. The triangle inequality is about norms, not their squares."
        )
    else:
        text = f"Not contradicted by {len(tried)} pairs of numbers."
    return Claim(
        "| |a|² − |b|² | ≤ |a − b|² “by the triangle inequality”",
        "proof of Lemma 1",
        "does not hold" if broken else "holds",
        text,
    )


def lemma_1_bounds(grids: Sequence[GridEvidence]) -> Claim:
    """Lemma 1 with Lemma 2's gamma and the true distance to the nearest sample, at every point."""
    squared = [float(np.mean(grid.lemma_1_squared)) for grid in grids]
    plain = [float(np.mean(grid.lemma_1_mm)) for grid in grids]
    broken = (max(squared) > 0) + (max(plain) > 0)
    verdict: tuple[Verdict, ...] = ("holds", "holds in part", "does not hold")
    return Claim(
        "e ≤ (γ² + 1) |ΔX|² bounds the error at every point (γ of Lemma 2)",
        "Lemma 1, Eq. 6",
        verdict[broken],
        f"Exceeded on {_shares(squared)} of the workspace if e is the squared, normalised error, "
        f"and on {_shares(plain)} if it is a length as in Table 1 (means per grid). At a trained "
        "point the bound is 0 and the error is not.",
    )


def trained_points_are_exact(grids: Sequence[GridEvidence]) -> Claim:
    """The largest error at a trained point beside the worst one anywhere."""
    known = [
        grid
        for grid in grids
        if np.isfinite(grid.sup_mm).all() and np.isfinite(grid.at_samples_mm).all()
    ]
    claim = "“The trained points are very close to the exact IK solutions”, however few"
    where = "proof of Lemma 1; Section 3"
    if not known:
        why = "No certified worst case to compare with, or not every sample was trained on."
        return Claim(claim, where, "cannot be tested", why)
    shares = [float(np.median(grid.at_samples_mm / grid.sup_mm)) for grid in known]
    errors = [float(np.median(grid.at_samples_mm)) for grid in known]
    means = [float(np.median(grid.at_samples_mean_mm)) for grid in known]
    exact = [share <= _LEARNT_SHARE for share in shares]
    return Claim(
        claim,
        where,
        _all_or_some(exact),
        f"The largest error at a trained point is {_span(errors, 2)} mm (median over seeds, per "
        f"grid), {_shares(shares)} of the certified worst case; the mean over them is "
        f"{_span(means, 2)} mm.",
    )


def midpoint_is_worst(grids: Sequence[GridEvidence]) -> Claim:
    """Where the worst point lies in its grid cell."""
    places = [grid.argmax for grid in grids if len(grid.argmax)]
    claim = "The error is largest at the middle point between trained points"
    where = "Section 3, before Eq. 24"
    if not places:
        return Claim(claim, where, "cannot be tested", "No certificate says where the worst is.")
    inside = np.concatenate(places)
    offset = np.abs(inside - np.round(inside))  # 0 at a node's coordinate, 1/2 between two
    off_middle = np.minimum(offset, 0.5 - offset)
    middle = (off_middle <= _NEAR).all(axis=1) & (offset > 0.5 - _NEAR).any(axis=1)
    sample = (offset <= 1e-3).all(axis=1)
    corner = np.concatenate([_at_corner(grid) for grid in grids if len(grid.argmax)])
    share = float(middle.mean())
    verdict: Verdict = (
        "holds" if share >= _MOST else "does not hold" if share <= _HARDLY else "holds in part"
    )
    return Claim(
        claim,
        where,
        verdict,
        f"Of {len(inside)} networks {int(middle.sum())} have their worst point within {_NEAR:g} d "
        f"of the middle of an edge, face or cell; {int(sample.sum())} have it at a sample, "
        f"{int(corner.sum())} of these at a corner of the workspace.",
    )


def half_spacing_covers(grids: Sequence[GridEvidence]) -> Claim:
    """The true covering radius of the grids in spacings."""
    ratios = [grid.fill_mm / grid.spacing_mm for grid in grids]
    holds = max(ratios) <= 0.5 * (1 + 1e-9)
    return Claim(
        "No point is farther from its nearest sample than |ΔX| = d/2",
        "Eq. 24",
        "holds" if holds else "does not hold",
        f"The farthest point is {_span(ratios, 3)} d away (√3/2 = 0.866 is the middle of a cell), "
        f"so |ΔX|² is {_span([4 * ratio**2 for ratio in ratios], 2)} times as large.",
    )


def output_weights_bound_slopes(grids: Sequence[GridEvidence]) -> Claim:
    """Slopes found in the networks beside the largest weight of their output layer."""
    slope = np.concatenate([grid.slope for grid in grids])
    weight = np.concatenate([grid.output_weight for grid in grids])
    above = slope > weight
    worst = int(np.argmax(slope - weight))
    text = f"{int(above.sum())} of {len(slope)} networks have a larger slope"
    if above.any():
        text += (
            f"; one has |∂q/∂x| = {slope[worst]:.2f} rad where no output weight is larger than "
            f"{weight[worst]:.2f}. The first layer’s weights and the sum over neurons are left out"
        )
    return Claim(
        "|∂q/∂x| is at most a weight of the output layer",
        "Lemma 2, Eq. 17 and 18",
        "does not hold" if above.any() else "holds",
        f"{text}.",
    )


def jacobian_at_most_one(row_sums_mm: Floats, by_range: Floats, scale_mm: float) -> Claim:
    """The arm's own Jacobian over the workspace, normalised in two ways."""
    by_length = row_sums_mm / scale_mm
    lowest, highest = (
        [float(pick(values)) for values in (by_length, by_range)] for pick in (np.min, np.max)
    )
    kept = [top <= 1 for top in highest]
    return Claim(
        "|∂g/∂Q| is at most 1 “due to the normalization”",
        "Eq. 19",
        _all_or_some(kept),
        f"Over the workspace it is {lowest[0]:.2f} to {highest[0]:.2f} with positions divided by "
        f"{scale_mm:g} mm, above 1 at {_percent(float(np.mean(by_length > 1)))} of the points; "
        f"{lowest[1]:.2f} to {highest[1]:.2f} with each joint divided by its range, too "
        f"({_percent(float(np.mean(by_range > 1)))}).",
    )


def average_weight_is_the_networks(evidence: Evidence) -> Claim:
    """Whether one constant gives the paper's estimates, and whether it is the networks' average."""
    n, estimate = evidence.paper_n, evidence.paper_estimate_mm
    scale = evidence.paper_scale_mm
    low = paper.average_weight_of(estimate - _ROUNDING_MM, n, scale)
    high = paper.average_weight_of(estimate + _ROUNDING_MM, n, scale)
    later = n > n.min()
    lowest, highest = float(np.max(low[later])), float(np.min(high[later]))
    one_constant = lowest <= highest
    constant = 0.5 * (lowest + highest)
    meant = {
        name: [float(np.mean(grid.average_weight[name])) for grid in evidence.grids]
        for name in evidence.names
    }
    matching = [
        name
        for name in evidence.names
        if all(
            np.min(grid.average_weight[name]) <= constant <= np.max(grid.average_weight[name])
            for grid in evidence.grids
        )
    ]
    listed = ", ".join(
        f"{_span(values, 2)} ({evidence.names[name]})" for name, values in meant.items()
    )
    if one_constant:
        text = (
            f"One constant, w̄ = {constant:.3f}, gives the paper’s column for n = "
            f"{int(n[later].min())} to {int(n.max())} to the last digit (w̄ = "
            f"{float(paper.average_weight_of(estimate, n, scale)[~later][0]):.3f} for n = "
            f"{int(n.min())}), though these networks differ."
        )
    else:
        text = "No one constant gives the paper’s column."
    return Claim(
        "w̄ is the average weight “found from trained functions empirically”",
        "Eq. 22, Section 3",
        "holds" if matching else "does not hold",
        f"{text} The networks here average {listed}.",
    )


def equation_25_bounds(evidence: Evidence) -> Claim:
    """Eq. 25 beside the error everywhere, for each meaning of the average weight."""
    parts, bounding = [], []
    for name, words in evidence.names.items():
        grids = evidence.grids
        above = [float(np.mean(grid.above[name])) for grid in grids]
        beyond = np.concatenate([grid.sup_mm > grid.estimate_mm[name] for grid in grids])
        below_mean = sum(
            bool(grid.estimate_mm[name].mean() < grid.error_mm.mean()) for grid in grids
        )
        bounding.append(max(above) == 0 and not beyond.any())
        parts.append(
            f"{words}: below the mean error at {below_mean} of {len(grids)} grids, exceeded on "
            f"{_shares(above)} of the workspace, and by {int(beyond.sum())} of {len(beyond)} "
            "worst cases"
        )
    # Any one meaning may be the one that was meant.
    return Claim(
        "Eq. 25 is an upper bound of the error",
        "Eq. 25; abstract",
        "holds in part" if any(bounding) and not all(bounding) else _all_or_some(bounding),
        f"With w̄ the {'; the '.join(parts)}.",
    )


def estimate_reliable(evidence: Evidence) -> Claim:
    """The estimate beside the mean error up to 125 samples, in the paper's table and here."""
    few = evidence.paper_n <= RELIABLE_N
    theirs = (evidence.paper_estimate_mm >= evidence.paper_error_mm)[few].tolist()
    small = [grid for grid in evidence.grids if grid.n <= RELIABLE_N]
    ours = [
        bool(grid.estimate_mm[evidence.chosen].mean() >= grid.error_mm.mean()) for grid in small
    ]
    text = f"In the paper’s own table it covers the mean error at {sum(theirs)} of {len(theirs)}"
    if ours:
        text += f" such sizes, here (w̄ the {evidence.names[evidence.chosen]}) at {sum(ours)} of "
        text += f"{len(ours)}"
    return Claim(
        f"The estimate is reliable for n ≤ {RELIABLE_N}",
        "abstract; Section 6",
        _all_or_some([*theirs, *ours]),
        f"{text}.",
    )


def error_saturates(evidence: Evidence) -> Claim:
    """Whether the error still falls where the paper says it does not."""
    n, error = evidence.paper_n, evidence.paper_error_mm
    at = int(np.argmin(np.abs(n - RELIABLE_N)))
    text = (
        f"In the paper’s own table it falls by {_percent(1 - error[-1] / error[at])} from "
        f"{int(n[at])} to {int(n[-1])} samples. A constant e/d is no saturation but a fall in "
        "proportion to d"
    )
    claim = "The error saturates beyond 64 or 125 samples"
    where = "abstract; Sections 1, 5"
    fall = evidence.fall
    if fall is None or not np.isfinite(fall.low):
        return Claim(claim, where, "cannot be tested", f"{text}. Too few grids or seeds here.")
    few, many = evidence.fall_n
    verdict: Verdict = "does not hold" if fall.low > 0 else "cannot be tested"
    if fall.high <= _HARDLY:
        verdict = "holds"
    return Claim(
        claim,
        where,
        verdict,
        f"{text}. Here it falls by {_percent(fall.value)} from {few} to {many} (95 % interval "
        f"{_percent(fall.low)} to {_percent(fall.high)}).",
    )


def error_follows_the_square(
    floors_mm: Mapping[str, Interval], tails_mm: Mapping[str, float], misfits: Mapping[str, float]
) -> Claim:
    """Eq. 25 goes to zero as 1/(m - 1)^2; whether the errors do, or stay above a floor."""
    claim = "The error falls as 1/(m − 1)², to nothing"
    where = "Eq. 25"
    known = {name: floor for name, floor in floors_mm.items() if np.isfinite(floor.low)}
    if not known:
        return Claim(claim, where, "cannot be tested", "Too few grids or seeds for a fit.")
    parts = [
        f"{name}: a = {floor.value:.2f} mm (95 % interval {floor.low:.2f} to {floor.high:.2f}), "
        f"b = {tails_mm[name]:.1f} mm, off by up to {_percent(misfits[name])}"
        for name, floor in known.items()
    ]
    return Claim(
        claim,
        where,
        _all_or_some([floor.low <= 0 for floor in known.values()]),
        f"Fitted e = a + b/(m − 1)²; {'; '.join(parts)}. As far as this law goes, the floor a "
        "stays, however many samples.",
    )


def best_number(evidence: Evidence) -> Claim:
    """Where e/d is smallest, and why that is no optimum."""
    m = np.round(np.cbrt(evidence.paper_n))
    theirs = evidence.paper_error_mm * (m - 1) / evidence.paper_scale_mm
    ours = [float(grid.error_mm.mean()) / grid.spacing_mm for grid in evidence.grids]
    return Claim(
        "125 samples (abstract) or 64 (Sections 5, 6) are the best number, by e/d",
        "abstract; Sections 5, 6",
        "cannot be tested",
        f"e/d is smallest at {int(evidence.paper_n[np.argmin(theirs)])} samples in the paper’s "
        f"table and at {evidence.grids[int(np.argmin(ours))].n} here, but it holds no cost of a "
        "sample, so it cannot say what is best.",
    )


def _at_corner(grid: GridEvidence) -> np.ndarray:
    ends = np.minimum(grid.argmax, grid.m - 1 - grid.argmax)
    return np.all(np.abs(ends) <= 1e-3, axis=1)


def _all_or_some(kept: Sequence[bool]) -> Verdict:
    if all(kept):
        return "holds"
    return "holds in part" if any(kept) else "does not hold"


def _percent(share: float) -> str:
    value = 100 * share
    digits = 0 if abs(value) >= 10 or value == 0 else 1 if abs(value) >= 1 else 2
    return f"{value:.{digits}f} %".replace("-", "−")


def _shares(values: Sequence[float]) -> str:
    low, high = _percent(min(values)), _percent(max(values))
    return low if low == high else f"{low.removesuffix(' %')} to {high}"


def _span(values: Sequence[float], digits: int) -> str:
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return (low if low == high else f"{low} to {high}").replace("-", "−")


def _bracketed(value: float) -> str:
    return f"{value:g}" if value >= 0 else f"(−{-value:g})"
