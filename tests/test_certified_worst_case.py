"""Certified worst cases against dense points, closed forms, a second checker and broken copies."""

import itertools
import time
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from certificate_cases import certify_sup, check
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.arm.chain import SerialChain
from iksamples.arm.load import load_arm
from iksamples.certify import jets
from iksamples.certify.balls import tiles
from iksamples.certify.jets import cubic_remainder_mm
from iksamples.certify.mean import certify_coverage, certify_mean
from iksamples.certify.search import certify_stack
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])


def networks(rng, activation="relu", hidden=(16,), n=2, spread=1.0):
    """Random networks whose answers lie about the middle of the arm's range."""
    sizes = (3, *hidden, 3)
    weights = [
        (spread * rng.normal(size=(n, a, b)) / np.sqrt(a)).astype(np.float32)
        for a, b in pairwise(sizes)
    ]
    biases = [(0.3 * rng.normal(size=(n, b))).astype(np.float32) for b in sizes[1:]]
    biases[-1] += np.float32([0.8, -1.2, -1.6])
    return StackedMLP(
        tuple(weights), tuple(biases), activation, LOWER, UPPER - LOWER, tuple(range(n))
    )


def plain_errors(network, row, points):
    """Errors by another route: one layer at a time, and the arm's formula written out."""
    hidden = (points - LOWER) / (UPPER - LOWER)
    last = len(network.weights) - 1
    for depth in range(last + 1):
        w, b = (np.float64(p[depth][row]) for p in (network.weights, network.biases))
        hidden = np.einsum("pi,io->po", hidden, w) + b
        if depth < last:
            hidden = np.tanh(hidden) if network.activation == "tanh" else hidden * (hidden > 0)
    q1, q2, q3 = hidden.T
    r = -70 * (np.sin(q2) + np.sin(q2 + q3))
    z = 70 + 70 * (np.cos(q2) + np.cos(q2 + q3))
    reached = np.stack([r * np.cos(q1), r * np.sin(q1), z], axis=-1)
    return np.linalg.norm(reached - points, axis=-1)


def box_points(rng, n):
    """Points of the box, a third of them pressed onto its faces, and the corners."""
    points = rng.random((n, 3))
    third = n // 3
    points[:third] = np.where(
        rng.random((third, 3)) < 0.5, np.round(points[:third]), points[:third]
    )
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(-1, 3)
    return LOWER + (UPPER - LOWER) * np.concatenate([points, corners])


SHAPES = [("relu", (16,)), ("tanh", (16,)), ("relu", (16, 16)), ("tanh", (16, 16))]


@pytest.mark.parametrize(("activation", "hidden"), SHAPES)
def test_no_point_is_above_and_one_point_attains_the_lower_bound(chain, rng, activation, hidden):
    stack = networks(rng, activation, hidden)
    for row, certificate in enumerate(certify_stack(stack, chain, Region.box(LOWER, UPPER))):
        assert certificate.complete
        assert certificate.upper <= 1.001 * certificate.lower * (1 + 1e-9)
        errors = plain_errors(stack, row, box_points(rng, 30_000))
        assert errors.max() <= certificate.upper
        taken = plain_errors(stack, row, certificate.argmax[None])[0]
        assert taken == pytest.approx(certificate.lower, abs=1e-6)


@pytest.mark.slow
def test_a_million_points_on_twenty_networks_and_none_above(chain, rng):
    for k in range(20):
        activation, hidden = SHAPES[k % 4]
        stack = networks(rng, activation, hidden, n=1, spread=0.5 + 0.1 * k)
        certificate = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER))
        for _ in range(4):
            errors = plain_errors(stack, 0, box_points(rng, 250_000))
            assert errors.max() <= certificate.upper


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), activation=st.sampled_from(["relu", "tanh"]))
def test_random_networks_in_random_small_boxes(seed, activation):
    rng = np.random.default_rng(seed)
    chain = load_arm("config/robots/rrr70.urdf")
    stack = networks(rng, activation, (int(rng.integers(1, 9)),), n=1, spread=rng.uniform(0.2, 3))
    size = 10 ** rng.uniform(-2, 1.5)
    low = LOWER + rng.random(3) * (UPPER - LOWER - size)
    certificate = certify_sup(stack, 0, chain, Region.box(low, low + size), rtol=0.05)
    points = low + size * rng.random((2000, 3))
    assert plain_errors(stack, 0, points).max() <= certificate.upper


def test_a_constant_network_is_worst_at_the_farthest_corner(chain):
    pose = np.float32([0.8, -1.2, -1.6])
    stack = StackedMLP(
        (np.zeros((1, 3, 1), np.float32), np.zeros((1, 1, 3), np.float32)),
        (np.zeros((1, 1), np.float32), pose[None]),
        "relu",
        LOWER,
        UPPER - LOWER,
        (0,),
    )
    tip = chain.forward_mm(pose.astype(float))
    farthest = np.where(tip > (LOWER + UPPER) / 2, LOWER, UPPER)
    certificate = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER))
    np.testing.assert_allclose(certificate.argmax, farthest)
    assert certificate.lower == pytest.approx(np.linalg.norm(tip - farthest))


def test_prismatic_arm_has_the_error_of_its_network():
    """A gantry answers with its joints, so the error is the network's own, affine here."""
    eye = np.eye(3)
    gantry = SerialChain(
        ("x", "y", "z"), ("prismatic",) * 3, eye, np.zeros((3, 3)), np.zeros(3),
        np.full(3, -200.0), np.full(3, 200.0),
    )  # fmt: skip
    kernel = np.float32([[55, 5, 0], [0, 60, 0], [0, 0, 70]])
    bias = np.float32([20, 20, 0])
    stack = StackedMLP((kernel[None],), (bias[None],), "relu", LOWER, UPPER - LOWER, (0,))
    certificate = certify_sup(stack, 0, gantry, Region.box(LOWER, UPPER))
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    exact = np.linalg.norm(corners @ kernel + bias - (LOWER + 60 * corners), axis=1).max()
    assert certificate.lower <= exact + 1e-9
    assert exact <= certificate.upper <= 1.0011 * exact


def test_cubic_remainder_is_attained_by_a_single_joint():
    for step in (0.3, 0.1, 0.01):
        left_out = np.array([np.cos(step) - 1 + step**2 / 2, np.sin(step) - step]) * 70
        bound = cubic_remainder_mm(np.array([70.0]), np.array([step]))
        assert np.linalg.norm(left_out) <= bound
    assert np.linalg.norm(left_out) / bound == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_the_checker_proves_what_the_search_found(chain, rng, activation):
    stack = networks(rng, activation, (12, 8))
    certificate = certify_sup(stack, 1, chain, Region.box(LOWER, UPPER), keep_leaves=True)
    checked = check(certificate, stack, 1, chain, Region.box(LOWER, UPPER))
    assert checked.verified
    assert abs(checked.upper - certificate.upper) < 1e-6
    # The same certificate is refused for another network.
    assert not check(certificate, stack, 0, chain, Region.box(LOWER, UPPER)).verified


def test_the_checker_refuses_a_search_without_its_cubic_term(chain, rng, monkeypatch):
    stack = networks(rng, "relu", (6,), n=1, spread=0.4)
    honest = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER), rtol=0.02, keep_leaves=True)
    monkeypatch.setattr(jets, "cubic_remainder_mm", lambda *_: 0.0)
    broken = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER), rtol=0.02, keep_leaves=True)
    assert broken.upper < honest.upper or broken.boxes < honest.boxes
    assert check(honest, stack, 0, chain, Region.box(LOWER, UPPER)).verified
    assert not check(broken, stack, 0, chain, Region.box(LOWER, UPPER)).verified


def test_leaves_tile_the_box_exactly(chain, rng):
    stack = networks(rng, "tanh", (16,), n=1)
    leaves = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER), keep_leaves=True).leaves
    volume = sum(
        np.prod([Fraction(float(h)) - Fraction(float(lo)) for lo, h in zip(a, b, strict=True)])
        for a, b in zip(leaves.lower, leaves.upper, strict=True)
    )
    assert volume == 1
    assert tiles(leaves.part, leaves.lower, leaves.upper, (1, 3))
    assert not tiles(leaves.part[1:], leaves.lower[1:], leaves.upper[1:], (1, 3))
    shifted = leaves.upper.copy()
    shifted[0] = np.nextafter(shifted[0], 0)
    assert not tiles(leaves.part, leaves.lower, shifted, (1, 3))


def test_an_unfinished_search_says_so_and_still_bounds(chain, rng):
    stack = networks(rng, "relu", (16, 16), n=1)
    cut = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER), max_boxes=9)
    assert not cut.complete
    full = certify_sup(stack, 0, chain, Region.box(LOWER, UPPER))
    assert cut.lower <= full.upper <= cut.upper * (1 + 1e-12)
    assert cut.upper > full.upper


def test_no_number_depends_on_how_busy_the_machine_is(chain, rng, monkeypatch):
    stack = networks(rng, "tanh", (16,), n=1)
    box = Region.box(LOWER, UPPER)

    def numbers():
        worst, mean = certify_sup(stack, 0, chain, box), certify_mean(stack, 0, chain, box)
        share = certify_coverage(stack, 0, chain, box, worst.lower / 2)
        return (
            (worst.lower, worst.upper, worst.boxes, worst.complete),
            (mean.lower_mm, mean.upper_mm, mean.boxes, mean.complete),
            (share.lower, share.upper, share.boxes, share.complete),
        )

    quiet = numbers()
    hours = itertools.count(step=3600.0)
    monkeypatch.setattr(time, "perf_counter", lambda: next(hours))
    assert numbers() == quiet


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ((20, 20, 0), (20, 80, 60), "box"),
        ((20, 20, 0), (10, 80, 60), "box"),
        ((20, 20), (80, 80), "box"),
        ((np.nan, 20, 0), (80, 80, 60), "box"),
    ],
)
def test_bad_boxes_are_refused(chain, rng, lower, upper, message):
    with pytest.raises(IksamplesError, match=message):
        certify_sup(networks(rng), 0, chain, Region.box(lower, upper))


def test_broken_networks_are_refused(chain, rng):
    stack = networks(rng)
    stack.weights[0][0, 0, 0] = np.nan
    with pytest.raises(IksamplesError, match="finite"):
        certify_sup(stack, 0, chain, Region.box(LOWER, UPPER))
    with pytest.raises(IksamplesError, match="gelu"):
        certify_sup(networks(rng, "gelu"), 0, chain, Region.box(LOWER, UPPER))


def test_certified_mean_encloses_the_sampled_mean(chain, rng):
    stack = networks(rng, "relu", (16,), n=1)
    mean = certify_mean(stack, 0, chain, Region.box(LOWER, UPPER), rtol=0.025)
    assert mean.complete
    assert mean.upper_mm <= 1.06 * mean.lower_mm
    points = LOWER + (UPPER - LOWER) * rng.random((200_000, 3))
    errors = plain_errors(stack, 0, points)
    slack = 5 * errors.std() / np.sqrt(len(errors))
    assert mean.lower_mm - slack <= errors.mean() <= mean.upper_mm + slack


def test_certified_coverage_encloses_the_sampled_share_and_bad_cells_are_bad(chain, rng):
    stack = networks(rng, "relu", (16,), n=1)
    points = LOWER + (UPPER - LOWER) * rng.random((100_000, 3))
    errors = plain_errors(stack, 0, points)
    tolerance = float(np.median(errors))
    coverage = certify_coverage(stack, 0, chain, Region.box(LOWER, UPPER), tolerance)
    assert coverage.complete
    assert coverage.lower - 0.01 <= 0.5 <= coverage.upper + 0.01
    assert coverage.upper - coverage.lower <= 0.0401
    for low, high in list(zip(coverage.bad_lower_mm, coverage.bad_upper_mm, strict=True))[:50]:
        inside = low + (high - low) * rng.random((20, 3))
        assert plain_errors(stack, 0, inside).min() > tolerance * (1 - 1e-9)
