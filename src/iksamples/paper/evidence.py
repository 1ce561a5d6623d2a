"""What a study found that the paper's claims are held against."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from iksamples.arm.chain import Floats
from iksamples.stats import Interval


AVERAGE_NAMES = {
    "mean": "mean of w",
    "mean_abs": "mean of |w|",
    "rms": "rms of w",
    "max_abs": "largest |w|",
}
"""Meanings of the paper's average weight, in words."""


@dataclass(frozen=True, eq=False)
class GridEvidence:
    """What was found for the networks of one grid; arrays have one value per seed.

    Attributes:
        m: Points per axis.
        n: Samples.
        spacing_mm: Distance d between neighbours [mm].
        fill_mm: Largest distance from a point of the workspace to its nearest sample [mm].
        error_mm: Mean error along the paper's kind of path [mm].
        estimate_mm: Eq. 25 for each meaning of the average weight [mm].
        average_weight: The average weights themselves [-].
        above: Share of the workspace whose error exceeds Eq. 25, for each meaning.
        lemma_1_squared: Share that exceeds Lemma 1, read as a bound on the squared error.
        lemma_1_mm: The same, multiplied by a length once as the paper's table does.
        output_weight: Largest |w| of the output layer [rad]; Eq. 18 leaves out the bars, which
            would make its bound smaller, or negative.
        slope: Largest |dq/dx| found [rad].
        at_samples_mm: Largest error at a trained point [mm].
        at_samples_mean_mm: Mean error over the trained points [mm].
        sup_mm: Certified upper bound of the error over the workspace [mm]; NaN: not certified.
        argmax: Where the largest known error is, in spacings from the grid's lower corner, shape
            (seeds, 3).
    """

    m: int
    n: int
    spacing_mm: float
    fill_mm: float
    error_mm: Floats
    estimate_mm: Mapping[str, Floats]
    average_weight: Mapping[str, Floats]
    above: Mapping[str, Floats]
    lemma_1_squared: Floats
    lemma_1_mm: Floats
    output_weight: Floats
    slope: Floats
    at_samples_mm: Floats
    at_samples_mean_mm: Floats
    sup_mm: Floats
    argmax: Floats


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything the claims are held against.

    Attributes:
        grids: One entry per grid, fewest samples first.
        chosen: Which average weight the study takes for the paper's.
        names: What the averages are called.
        row_sums_mm: Largest absolute row sum of dg/dQ [mm/rad] at points of the workspace.
        row_sums_by_range: The same with joints divided by their range and positions by the side of
            the workspace [-].
        scale_mm: The length that normalises positions [mm].
        fall: By which share the error falls from ``fall_n[0]`` to ``fall_n[1]`` samples; None: the
            study has only one grid.
        fall_n: Those numbers of samples.
        paper_n: n of the paper's Table 1.
        paper_error_mm: Its errors [mm].
        paper_estimate_mm: Its estimates [mm].
        paper_scale_mm: Side of the cube behind its spacings [mm].
        floors_mm: Floor a of e = a + b / (m - 1)^2 for "the paper’s column" and "here" [mm].
        tails_mm: Their b [mm].
        misfits: By which share the fitted law is off its data at most.
    """

    grids: Sequence[GridEvidence]
    chosen: str
    names: Mapping[str, str]
    row_sums_mm: Floats
    row_sums_by_range: Floats
    scale_mm: float
    fall: Interval | None
    fall_n: tuple[int, int]
    paper_n: Floats
    paper_error_mm: Floats
    paper_estimate_mm: Floats
    paper_scale_mm: float
    floors_mm: Mapping[str, Interval]
    tails_mm: Mapping[str, float]
    misfits: Mapping[str, float]
