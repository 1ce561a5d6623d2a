"""Certified look-up tables: against an interpolator from elsewhere, an optimiser, closed forms."""

from itertools import product

import numpy as np
import pytest
from certificate_cases import check, make_chain, plain_tip, points_in, random_chain
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import differential_evolution

from iksamples.certify.balls import Ball
from iksamples.certify.checker_network import CheckedTable
from iksamples.certify.mean import certify_mean
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.search import certify_stack
from iksamples.certify.table import Table
from iksamples.errors import IksamplesError
from iksamples.region import Region
from iksamples.samples.record import grid_samples


def interpolated(table):
    return RegularGridInterpolator(table.axes, table.joints, bounds_error=False, fill_value=None)


def random_table(rng, d, n_joints, ends=(-1.0, 2.0)):
    """Nodes of chance within, at and beyond the region's walls."""
    axes = []
    for _ in range(d):
        nodes = np.sort(rng.uniform(*ends, rng.integers(2, 5)))
        axes.append(nodes + 0.2 * np.arange(len(nodes)))
    joints = rng.normal(size=(*[len(axis) for axis in axes], n_joints))
    return Table(tuple(axes), joints)


def errors(table, chain, points):
    k = min(points.shape[1], 3)
    return np.linalg.norm(
        plain_tip(chain, interpolated(table)(points))[:, :k] - points[:, :k], axis=1
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), d=st.integers(2, 4), size=st.floats(0.001, 0.49))
def test_both_enclosures_of_a_table_hold_its_values(seed, d, size):
    """The search's and the checker's, over boxes inside cells."""
    rng = np.random.default_rng(seed)
    table = random_table(rng, d, 3)
    pieces = table.pieces(Region.box(np.full(d, -1.5), np.full(d, 2.5)))
    row = rng.integers(pieces.n_boxes)
    half = size * (pieces.upper - pieces.lower)[row]
    centre = rng.uniform(pieces.lower[row] + half, pieces.upper[row] - half)
    s = rng.uniform(-1, 1, (200, d))
    values = interpolated(table)(centre + s * half)

    found = table.expand(np.zeros(1, int), centre[None], half[None], average=False)
    mixed = [(a, b) for a in range(d) for b in range(a + 1, d)]
    kept = found.centre + s @ found.linear[0]
    kept = kept + np.stack([s[:, a] * s[:, b] for a, b in mixed], 1) @ found.quadratic[0, d:]
    apart = np.abs(values - kept)
    assert np.all(apart <= np.abs(found.noise[0]).sum(axis=0) + 1e-9)
    assert not found.quadratic[0, :d].any()

    terms = CheckedTable(table).terms(Ball.of(centre[None]), Ball.of(half[None]))
    kept = terms.centre.mid + s @ terms.linear.mid[0]
    kept = kept + np.stack([s[:, a] * s[:, b] for a, b in mixed], 1) @ terms.mixed.mid[0]
    noise = np.abs(terms.factor.mid[0]).sum(axis=0)
    assert np.all(np.abs(values - kept) <= noise + 1e-9)
    corners = 1.0 - 2.0 * ((np.arange(2**d)[:, None] >> np.arange(d)) & 1)
    at = interpolated(table)(centre + corners * half)
    exact = terms.centre.mid + corners @ terms.linear.mid[0] + terms.low[0] @ terms.factor.mid[0]
    exact = (
        exact + np.stack([corners[:, a] * corners[:, b] for a, b in mixed], 1) @ terms.mixed.mid[0]
    )
    np.testing.assert_allclose(exact, at, atol=1e-8)


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.sampled_from(["RR", "RRR", "RPR", "RRRR"]))
def test_no_table_exceeds_its_bound(seed, kinds):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    d = min(len(kinds), 4)
    table = random_table(rng, d, len(kinds))
    table.joints[..., [kind == "P" for kind in kinds]] *= 20
    region = Region.box(np.full(d, -0.5), np.full(d, 2.0))
    # However early it ends, it bounds.
    [found] = certify_stack(table, chain, region, rtol=0.1, max_boxes=2000, keep_leaves=True)
    points = points_in(rng, region.lower_corner, region.upper_corner, 3000)
    assert errors(table, chain, points).max() <= found.upper
    assert errors(table, chain, found.argmax[None])[0] >= found.lower
    checked = check(found, table, 0, chain, region)
    assert checked.verified
    assert found.lower <= checked.upper  # which knows a product of three at a corner
    mean = certify_mean(table, 0, chain, region, rtol=0.2, max_boxes=2000)
    inside = rng.uniform(-0.5, 2.0, (4000, d))
    sampled = errors(table, chain, inside)
    slack = 6 * sampled.std() / np.sqrt(len(sampled))
    assert mean.lower_mm - slack <= sampled.mean() <= mean.upper_mm + slack


# Measured beforehand by an independent program on many random points.
@pytest.mark.parametrize(
    ("m", "known"),
    [(2, 14.9), (3, 4.52), (4, 2.31), (5, 1.41), (6, 0.95), (7, 0.69), (8, 0.52)],
)
def test_the_worst_case_of_the_papers_table_is_the_known_one(m, known, study, task):
    samples = grid_samples(study, task, m)
    axes = [np.unique(x) for x in samples.x.T]
    table = Table(tuple(axes), samples.joints.reshape(m, m, m, 3))
    [found] = certify_stack(table, task.drawing, task.region, rtol=1e-2, keep_leaves=True)
    assert found.complete
    assert found.upper <= 1.0101 * found.lower
    assert found.lower == pytest.approx(known, rel=0.012)
    assert check(found, table, 0, task.drawing, task.region).verified
    if m == 3:
        box = list(zip(task.x.lower, task.x.upper, strict=True))
        best = differential_evolution(
            lambda x: -errors(table, task.drawing, x.T.reshape(-1, 3)), box, vectorized=True,
            updating="deferred", popsize=20, maxiter=60, rng=1, tol=1e-6,
        )  # fmt: skip
        assert found.lower * (1 - 1e-2) <= -best.fun <= found.upper


def test_the_worst_case_of_a_gantry_is_at_a_node(rng):
    """A gantry's error is multilinear in each cell as the table is: largest at a corner."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    for offset in (0.0, 6.0):
        axis = np.array([0.0, 25.0, 60.0])
        nodes = np.array(list(product(axis, repeat=3)))
        wrong = nodes + offset + rng.normal(size=nodes.shape)
        table = Table((axis,) * 3, wrong.reshape(3, 3, 3, 3))
        region = Region.box((0, 0, 0), (60, 60, 60))
        [found] = certify_stack(table, gantry, region, rtol=1e-6, keep_leaves=True)
        worst = np.linalg.norm(wrong - nodes, axis=1).max()
        assert found.lower == pytest.approx(worst, abs=1e-9)
        assert worst <= found.upper <= worst * (1 + 1e-6) + 1e-9
        assert check(found, table, 0, gantry, region).verified


def test_bounds_close_on_the_error_as_the_cube_of_the_box(study, task):
    """The enclosure is exact to second order, so that halving a box takes three quarters off."""
    samples = grid_samples(study, task, 4)
    axis = [np.unique(x) for x in samples.x.T]
    errors_over = ErrorOverBoxes(
        Table(tuple(axis), samples.joints.reshape(4, 4, 4, 3)), task.drawing, task.region
    )
    cells = errors_over.region
    centre = cells.lower + 0.4 * (cells.upper - cells.lower)
    which = np.zeros(len(centre), int)
    excess = []
    for share in (0.1, 0.05, 0.025):
        radius = share * (cells.upper - cells.lower)
        upper, _, _ = errors_over.upper_bounds(which, centre, radius)
        s = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3), axis=-1).reshape(-1, 1, 3)
        values = np.max([errors_over.values(which, centre + p * radius) for p in s], axis=0)
        excess.append(np.median(upper - values))
    assert excess[1] < excess[0] / 3
    assert excess[2] < excess[1] / 3


def test_leaves_across_a_node_prove_nothing(rng):
    """The checker cuts the region itself: leaves for the uncut box do not tile it."""
    gantry = make_chain("PP", np.eye(3)[:2], np.zeros((2, 3)), (0, 0, 0))
    axis = np.array([0.0, 1.0, 2.0])
    bump = np.zeros((3, 3, 2))
    bump[1, 1] = 5.0  # between the corners the error is large
    nodes = np.array(list(product(axis, repeat=2))).reshape(3, 3, 2)
    table = Table((axis, axis), nodes + bump)
    region = Region.box((0, 0), (2, 2))
    [found] = certify_stack(table, gantry, region, keep_leaves=True)
    assert check(found, table, 0, gantry, region).verified
    assert found.lower == pytest.approx(5 * np.sqrt(2))
    [smooth] = certify_stack(
        Table((axis[::2], axis[::2]), nodes[::2, ::2]), gantry, region, keep_leaves=True
    )
    assert not check(smooth, table, 0, gantry, region, upper=5.0, lower=0.0).verified


def test_tables_that_are_none():
    axis = np.array([0.0, 1.0])
    with pytest.raises(IksamplesError, match="not finite"):
        Table((axis, axis), np.full((2, 2, 2), np.nan))
    with pytest.raises(IksamplesError, match="nodes"):
        Table((axis, axis), np.zeros((2, 3, 2)))
    with pytest.raises(IksamplesError, match="nodes"):
        Table((axis[:1], axis), np.zeros((1, 2, 2)))
    with pytest.raises(IksamplesError, match="increasing"):
        CheckedTable(Table((axis[::-1], axis), np.zeros((2, 2, 2))))
