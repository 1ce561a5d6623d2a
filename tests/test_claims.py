"""The verdicts on the paper's claims: they follow the data, either way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from iksamples.arm.load import load_arm
from iksamples.paper import claims
from iksamples.paper import equations as paper
from iksamples.paper.equations import Evidence, GridEvidence
from iksamples.stats import Interval


NAMES = {"mean": "mean of w", "max_abs": "largest |w|"}


def kind_grid(m: int, error_mm: float) -> GridEvidence:
    """A grid on which every claim of the paper is true."""
    d = 60.0 / (m - 1)
    ones = np.ones(6)
    return GridEvidence(
        m=m,
        n=m**3,
        spacing_mm=d,
        fill_mm=d / 2,
        error_mm=error_mm * ones,
        estimate_mm={name: 50 * ones for name in NAMES},
        average_weight={name: 0.146 + np.linspace(-0.01, 0.01, 6) for name in NAMES},
        above={name: 0 * ones for name in NAMES},
        lemma_1_squared=0 * ones,
        lemma_1_mm=0 * ones,
        output_weight=2 * ones,
        slope=ones,
        at_samples_mm=0.01 * ones,
        at_samples_mean_mm=0.005 * ones,
        sup_mm=40 * ones,
        argmax=np.full((6, 3), 0.5),
    )


@pytest.fixture
def kind() -> Evidence:
    n = np.array([8.0, 27.0, 64.0, 125.0, 216.0])
    return Evidence(
        grids=[kind_grid(2, 20.0), kind_grid(5, 2.0)],
        chosen="mean",
        names=NAMES,
        row_sums_mm=np.array([30.0, 59.0]),
        row_sums_by_range=np.array([0.4, 0.9]),
        scale_mm=60.0,
        fall=Interval(0.0, -0.1, 0.1),
        fall_n=(125, 216),
        paper_n=n,
        paper_error_mm=np.array([20.0, 5.0, 2.0, 1.0, 1.0]),
        paper_estimate_mm=paper.estimate_mm(0.15, n, 60.0),
        paper_scale_mm=60.0,
        floors_mm={"here": Interval(0.1, 0.0, 0.2)},
        tails_mm={"here": 20.0},
        misfits={"here": 0.1},
    )


def test_what_the_data_bear_out_holds(kind: Evidence) -> None:
    paper_column = replace(kind, paper_estimate_mm=paper.estimate_mm(0.146, kind.paper_n, 60.0))
    verdicts = [row.verdict for row in claims.judge_claims(paper_column)]
    # All but the false inequality and the best number, which no data can change.
    assert verdicts.pop(0) == "does not hold"
    assert verdicts.pop() == "cannot be tested"
    # 0.146 gives 1.48 mm at 125 samples, which covers the kind paper's 1.00 mm.
    assert verdicts == ["holds"] * 11


def test_the_inequality_between_squares() -> None:
    row = claims.squares_inequality()
    assert row.verdict == "does not hold"
    assert "|3² − 1²| = 8" in row.evidence
    assert row.evidence.count("4") == 1
    assert claims.squares_inequality([(1.0, 0.0), (2.0, -1.0)]).verdict == "holds"
    assert "(−3)" in claims.squares_inequality([(-4.0, -3.0)]).evidence


def changed(grid: GridEvidence, **what: object) -> list[GridEvidence]:
    return [grid, replace(grid, **what)]  # type: ignore[arg-type]


def test_verdicts_on_a_grid_change_with_its_numbers() -> None:
    grid = kind_grid(3, 5.0)
    six = np.ones(6)
    some = 0.02 * six
    assert claims.lemma_1_bounds(changed(grid, lemma_1_mm=some)).verdict == "holds in part"
    both = changed(grid, lemma_1_mm=some, lemma_1_squared=some)
    assert claims.lemma_1_bounds(both).verdict == "does not hold"
    far = changed(grid, fill_mm=np.sqrt(3) / 2 * 30.0)
    assert claims.half_spacing_covers(far).verdict == "does not hold"
    assert "0.866 d" in claims.half_spacing_covers(far).evidence
    steep = changed(grid, slope=np.array([1, 1, 1, 1, 1, 3.5]))
    row = claims.output_weights_bound_slopes(steep)
    assert row.verdict == "does not hold"
    assert "1 of 12 networks" in row.evidence
    assert "3.50 rad" in row.evidence
    unlearnt = changed(grid, at_samples_mm=10 * six)
    assert claims.trained_points_are_exact(unlearnt).verdict == "holds in part"
    assert claims.trained_points_are_exact(unlearnt[1:]).verdict == "does not hold"
    unknown = [replace(grid, sup_mm=np.nan * six, argmax=np.empty((0, 3)))]
    assert claims.trained_points_are_exact(unknown).verdict == "cannot be tested"
    assert claims.midpoint_is_worst(unknown).verdict == "cannot be tested"


@pytest.mark.parametrize(
    ("place", "verdict", "words"),
    [
        ((0.5, 1.5, 0.52), "holds", "6 have their worst point"),
        ((0.5, 0.0, 1.0), "holds", "0 have it at a sample"),
        ((0.25, 0.5, 0.5), "does not hold", "0 have it at a sample"),
        ((1.0, 1.0, 2.0), "does not hold", "6 have it at a sample, 0 of these"),
        ((0.0, 2.0, 2.0), "does not hold", "6 have it at a sample, 6 of these"),
    ],
)
def test_where_the_worst_point_is(place: tuple[float, ...], verdict: str, words: str) -> None:
    row = claims.midpoint_is_worst([replace(kind_grid(3, 5.0), argmax=np.tile(place, (6, 1)))])
    assert row.verdict == verdict
    assert words in row.evidence


def test_the_arms_jacobian_by_hand() -> None:
    """Home pose of the arm, worked out by hand: a row sum of 140 mm/rad."""
    chain = load_arm(Path(__file__).parents[1] / "config/robots/rrr70.urdf")
    jacobian = chain.jacobian_mm([np.pi / 2, -np.pi / 2, -np.pi / 2])
    sums = np.abs(jacobian).sum(axis=-1)
    assert sums.max() == pytest.approx(140)
    row = claims.jacobian_at_most_one(sums.max(keepdims=True), np.array([0.5]), 60.0)
    assert row.verdict == "holds in part"
    assert "2.33" in row.evidence
    assert claims.jacobian_at_most_one(np.array([61.0]), np.array([1.1]), 60.0).verdict == (
        "does not hold"
    )


def test_verdicts_on_the_estimate(kind: Evidence) -> None:
    few, many = kind.grids
    ones = np.ones(6)
    low = replace(
        many,
        estimate_mm={"mean": ones, "max_abs": 50 * ones},
        above={"mean": 0.4 * ones, "max_abs": 0 * ones},
    )
    part = claims.equation_25_bounds(replace(kind, grids=[few, low]))
    assert part.verdict == "holds in part"
    assert "mean of w: below the mean error at 1 of 2 grids" in part.evidence
    assert "by 6 of 12 worst cases" in part.evidence
    reliable = claims.estimate_reliable(replace(kind, grids=[few, low]))
    assert reliable.verdict == "holds in part"
    assert "at 4 of 4 such sizes, here (w̄ the mean of w) at 1 of 2" in reliable.evidence
    worst = [replace(grid, sup_mm=60 * ones) for grid in kind.grids]
    assert claims.equation_25_bounds(replace(kind, grids=worst)).verdict == "does not hold"


def test_verdict_on_the_average_weight(kind: Evidence) -> None:
    column = paper.estimate_mm(0.146, kind.paper_n, 60.0).round(2)
    same = claims.average_weight_is_the_networks(replace(kind, paper_estimate_mm=column))
    assert same.verdict == "holds"
    assert "One constant, w̄ = 0.146" in same.evidence
    other = [
        replace(grid, average_weight={name: np.array([-0.1, 0.1]) for name in NAMES})
        for grid in kind.grids
    ]
    row = claims.average_weight_is_the_networks(
        replace(kind, grids=other, paper_estimate_mm=column)
    )
    assert row.verdict == "does not hold"
    bent = column * np.array([1, 1, 1, 1.2, 1])
    row = claims.average_weight_is_the_networks(replace(kind, paper_estimate_mm=bent))
    assert "No one constant" in row.evidence


def test_verdicts_on_the_fall(kind: Evidence) -> None:
    falling = replace(kind, fall=Interval(0.25, 0.15, 0.34))
    assert claims.error_saturates(falling).verdict == "does not hold"
    assert "25 % from 125 to 216" in claims.error_saturates(falling).evidence
    assert claims.error_saturates(replace(kind, fall=None)).verdict == "cannot be tested"
    scattered = replace(kind, fall=Interval(0.25, -0.1, 0.5))
    assert claims.error_saturates(scattered).verdict == "cannot be tested"
    flat = replace(kind, fall=Interval(0.02, -0.03, 0.07))
    assert claims.error_saturates(flat).verdict == "holds"
    floor = {"here": Interval(1.5, 1.3, 1.8), "the paper’s column": Interval(0.1, 0.0, 0.4)}
    numbers = dict.fromkeys(floor, 20.0), dict.fromkeys(floor, 0.1)
    assert claims.error_follows_the_square(floor, *numbers).verdict == "holds in part"
    unknown = {"here": Interval(1.5, np.nan, np.nan)}
    assert claims.error_follows_the_square(unknown, *numbers).verdict == "cannot be tested"
