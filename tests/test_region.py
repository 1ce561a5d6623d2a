"""Regions: unions of boxes, what is in them, and certificates over them."""

import numpy as np
import pytest
from certificate_cases import (
    certify_sup,
    check,
    plain_answer,
    plain_tip,
    points_in,
    random_chain,
    random_network,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.certify.mean import certify_coverage, certify_mean
from iksamples.errors import IksamplesError
from iksamples.region import Region


def holed(lower, upper, n, rng, share=0.6):
    """Some of the n^d equal cells of a box, and never none."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    edges = np.linspace(lower, upper, n + 1)
    cells = np.argwhere(rng.random((n,) * len(lower)) < share)
    cells = cells if len(cells) else np.zeros((1, len(lower)), int)
    axes = np.arange(len(lower))
    return Region(edges[cells, axes], edges[cells + 1, axes])


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 4), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_volume_and_membership(n, d, seed):
    rng = np.random.default_rng(seed)
    region = holed(np.full(d, -1.0), np.full(d, 2.0), n, rng)
    assert region.volume == pytest.approx(region.n_boxes * (3 / n) ** d)
    assert region.shares.sum() == pytest.approx(1)
    points = rng.uniform(-1.5, 2.5, (20_000, d))
    inside = region.contains(points)
    box = Region.box(region.lower_corner, region.upper_corner)
    assert np.all(box.contains(points)[inside])
    share = region.volume / 4**d
    assert inside.mean() == pytest.approx(share, abs=5 * np.sqrt(share / len(points)))
    # Every corner belongs to its box: the boxes are closed.
    assert region.contains(region.lower).all()
    assert region.contains(region.upper).all()


@pytest.mark.parametrize(
    ("lower", "upper", "match"),
    [
        ([[0, 0]], [[1, 0]], "empty"),
        ([[0, 0]], [[1, np.inf]], "empty"),
        ([[0, np.nan]], [[1, 1]], "empty"),
        ([[0, 0]], [[1]], "limit"),
        ([0, 0], [1, 1], "limit"),
        (np.zeros((0, 2)), np.zeros((0, 2)), "limit"),
        ([[0, 0], [0.9, 0.9]], [[1, 1], [2, 2]], "overlap"),
        ([[0, 0], [0, 0]], [[1, 1], [1, 1]], "overlap"),
    ],
)
def test_regions_that_are_none(lower, upper, match):
    with pytest.raises(IksamplesError, match=match):
        Region(np.array(lower, float), np.array(upper, float))


def test_points_of_another_dimension_are_refused():
    with pytest.raises(ValueError, match="coordinates"):
        Region.box((0, 0), (1, 1)).contains([[0.5]])


def test_faces_may_be_shared_and_corners_cannot_be_moved():
    region = Region(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 1.0], [2.0, 1.0]]))
    assert region.volume == 2
    with pytest.raises(ValueError, match="read-only"):
        region.upper[0, 0] = 5


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    activation=st.sampled_from(["relu", "tanh"]),
    n=st.integers(1, 4),
)
def test_certificates_over_a_union_of_boxes(seed, activation, n):
    """Worst case, mean and share of what is in the region, and of nothing that is not."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "RRR")
    lower, upper = np.full(3, -30.0), np.full(3, 20.0)
    region = holed(lower, upper, n, rng)
    stack = random_network(rng, (3, 6, 3), activation, spread=0.6, lower=lower, upper=upper)
    points = np.concatenate(
        [points_in(rng, *walls, 400) for walls in zip(region.lower, region.upper, strict=True)]
    )
    errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, 0, points)) - points, axis=1)

    worst = certify_sup(stack, 0, chain, region, rtol=0.01, keep_leaves=True)
    assert worst.complete
    assert region.contains(worst.argmax)
    assert errors.max() <= worst.upper
    assert errors.max() >= 0.9 * worst.lower
    assert check(worst, stack, 0, chain, region).verified

    inside = rng.uniform(lower, upper, (20_000, 3))
    inside = inside[region.contains(inside)]
    errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, 0, inside)) - inside, axis=1)
    mean = certify_mean(stack, 0, chain, region, rtol=0.05)
    assert mean.complete
    slack = 6 * errors.std() / np.sqrt(len(errors))
    assert mean.lower_mm - slack <= errors.mean() <= mean.upper_mm + slack
    tolerance = float(np.median(errors))
    coverage = certify_coverage(stack, 0, chain, region, tolerance, atol=0.05)
    slack = 3 / np.sqrt(len(errors))
    assert coverage.lower - slack <= 0.5 <= coverage.upper + slack
    centres = 0.5 * (coverage.bad_lower_mm + coverage.bad_upper_mm)
    assert region.contains(centres).all()
