"""The checker: balls against exact numbers, its arm against the search's, and forgeries."""

from dataclasses import replace
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from certificate_cases import (
    linear_network,
    make_chain,
    plain_answer,
    plain_tip,
    planar,
    points_in,
    random_chain,
    random_network,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.certify.balls import Ball, norm_above, sum_above
from iksamples.certify.checker import verify
from iksamples.certify.checker_arm import Arm
from iksamples.certify.checker_network import Terms
from iksamples.certify.jets import Linkage
from iksamples.certify.residual import Comparison
from iksamples.certify.rounding import inference_slack_mm
from iksamples.certify.search import Leaves, certify_sup
from iksamples.certify.tiling import tiles
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])
NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=True) | st.sampled_from(
    [0.0, 1e-300, -1e-308, 1e300]
)


def exact(value):
    return mpmath.mpf(float(value))


def holds(ball, value):
    """Whether an exact number lies in a ball, decided without rounding."""
    return abs(value - exact(ball.mid)) <= exact(ball.rad)


@settings(max_examples=300, deadline=None)
@given(a=NUMBERS, b=NUMBERS, r=st.floats(0, 1e-3), s=st.floats(0, 1e-3))
def test_ball_arithmetic_holds_the_exact_result(a, b, r, s):
    with mpmath.workprec(2400):
        x, y = Ball(np.float64(a), np.float64(r)), Ball(np.float64(b), np.float64(s))
        for i in (-1, 0, 1):
            for j in (-1, 1):
                u, v = exact(a) + i * exact(r), exact(b) + j * exact(s)
                if max(abs(a), abs(b)) < 1e150:
                    assert holds(x * y, u * v)
                assert holds(x + y, u + v)
                assert holds(x - y, u - v)
                assert holds(x / 3.0, u / 3)
        assert exact(x.upper()) >= exact(a) + exact(r)
        assert exact(x.lower()) <= exact(a) - exact(r)
        assert exact(x.magnitude()) >= abs(exact(a)) + exact(r)


@settings(max_examples=200, deadline=None)
@given(a=st.floats(-20, 20), r=st.floats(0, 1e-3))
def test_balls_of_functions_hold_the_exact_result(a, r):
    with mpmath.workprec(200):
        ball = Ball(np.float64(a), np.float64(r))
        for u in (exact(a) - exact(r), exact(a), exact(a) + exact(r)):
            assert holds(ball.sin(), mpmath.sin(u))
            assert holds(ball.cos(), mpmath.cos(u))
            assert holds(ball.tanh(), mpmath.tanh(u))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), terms=st.integers(1, 40))
def test_balls_of_sums_hold_the_exact_result(seed, terms):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(2, terms)) * 10.0 ** rng.integers(-8, 8, (2, terms))
    b = rng.normal(size=(terms, 2)) * 10.0 ** rng.integers(-8, 8, (terms, 2))
    with mpmath.workprec(400):
        product = Ball.of(a) @ Ball.of(b)
        total = Ball.of(a).sum(1)
        for i in range(2):
            assert holds(total[i], mpmath.fsum(exact(v) for v in a[i]))
            for j in range(2):
                value = mpmath.fsum(exact(a[i, k]) * exact(b[k, j]) for k in range(terms))
                assert holds(product[i, j], value)
        sizes = np.abs(a[0])
        assert exact(sum_above(sizes, 0)) >= mpmath.fsum(exact(v) for v in sizes)
        squares = mpmath.fsum(exact(v) for v in sizes)
        assert exact(norm_above(sizes)) ** 2 >= squares


def test_a_radius_is_no_larger_than_it_needs_to_be():
    ball = Ball.of(np.full((1, 16), 0.1)) @ np.full((16, 1), 0.3)
    assert 0 < ball.rad[0, 0] < 1e-14


@settings(max_examples=40, deadline=None)
@given(kinds=st.text("RRRP", min_size=1, max_size=7), seed=st.integers(0, 2**32 - 1))
def test_two_ways_to_the_arms_derivatives_agree(kinds, seed):
    """Products of derived transformations, and cross products of axes and arms."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    q = rng.uniform(-3, 3, (3, len(kinds)))
    tip, first, second = Arm(chain).derivatives(q)
    position, jacobian, hessian = Linkage.of(chain).jets(q)
    full = hessian + hessian.transpose(0, 1, 3, 2)
    for ball, value in (
        (tip, position.T),
        (first, jacobian.transpose(1, 2, 0)),
        (second, full.transpose(1, 2, 3, 0)),
    ):
        np.testing.assert_allclose(ball.mid, value, atol=1e-9)
        assert ball.rad.max() < 1e-9


CASES = [
    ("RRR", 3, (9,), "relu"),
    ("RRR", 3, (6, 5), "relu"),
    ("RRR", 3, (9,), "tanh"),
    ("RRR", 3, (6, 5), "tanh"),
    ("RRR", 3, (), "relu"),
    ("PRR", 3, (6,), "tanh"),
    ("RRPR", 3, (6,), "relu"),
    ("RRRRRR", 3, (6,), "relu"),
    ("RR", 2, (6,), "tanh"),
    ("RRRR", 4, (4,), "relu"),
]


@pytest.mark.parametrize(("kinds", "d", "hidden", "activation"), CASES)
def test_what_the_search_finds_is_proved(rng, kinds, d, hidden, activation):
    chain = random_chain(rng, kinds)
    lower, upper = np.full(d, -30.0), np.full(d, 20.0)
    stack = random_network(
        rng, (d, *hidden, len(kinds)), activation, spread=0.6, lower=lower, upper=upper
    )
    certificate = certify_sup(
        stack, 0, chain, Region.box(lower, upper), rtol=0.01, keep_leaves=True
    )
    checked = verify(certificate, stack, 0, chain)
    assert certificate.complete
    assert checked.verified
    assert checked.tiles
    assert checked.leaves == len(certificate.leaves.lower)
    # Not only above, but the same to rounding: two derivations of one bound.
    assert certificate.upper_mm - 1e-6 < checked.upper_mm <= certificate.upper_mm
    points = points_in(rng, lower, upper, 2000)
    k = min(d, 3)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :k] - points[:, :k]
    assert np.linalg.norm(miss, axis=1).max() <= checked.upper_mm


def test_axes_that_are_only_nearly_parallel_are_counted(rng):
    chain = make_chain(
        "RRR", [(0, 0, 1), (0, 2e-10, 1), (1e-10, 0, -1)], [(0, 0, 0), (70, 0, 0), (140, 0, 0)],
        (210, 0, 0),
    )  # fmt: skip
    stack = random_network(rng, (2, 8, 3), "tanh", lower=(50, 50), upper=(90, 90))
    certificate = certify_sup(stack, 0, chain, Region.box((50, 50), (90, 90)), keep_leaves=True)
    checked = verify(certificate, stack, 0, chain)
    # Wider than the search's bound, whose axes count as three runs, never tighter than the truth.
    assert checked.upper_mm >= certificate.lower_mm
    points = points_in(rng, (50, 50), (90, 90), 5000)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :2] - points
    assert np.linalg.norm(miss, axis=1).max() <= checked.upper_mm


def test_what_nearly_parallel_axes_leave_out_is_counted():
    """The second joint undoes the first but for 9e-10 of tilt, and the arm is long."""
    tilt, length, step = 9e-10, 1e6, 0.8
    chain = make_chain(
        "RR", [(0, 0, 1), (tilt, 0, 1)], np.zeros((2, 3)), (0, length, 0)
    )  # fmt: skip
    with mpmath.workdps(50):
        skews, tip = [], mpmath.matrix([0, length, 0])
        for axis in chain.axes:
            x, y, z = (exact(a) / mpmath.sqrt(sum(exact(b) ** 2 for b in axis)) for a in axis)
            skews.append(mpmath.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        a, b = skews[0] * step, skews[1] * -step
        moved = mpmath.expm(a) * mpmath.expm(b) * tip
        second = tip + (a + b) * tip + (a * a / 2 + a * b + b * b / 2) * tip
        left_out = float(mpmath.norm(moved - second))
    assert left_out > 1e-5
    nothing = np.zeros((1, 2, 0))
    straight = Terms(
        Ball.of(np.zeros((1, 2))),
        Ball.of(np.array([[[step, -step]]])),
        Ball.of(np.zeros((1, 1, 2))),
        Ball.of(np.zeros((1, 0, 2))),
        Ball.of(np.zeros((1, 0, 2))),
        np.zeros((1, 0)),
        nothing,
        nothing,
    )
    bound = Arm(chain).beyond(np.zeros((1, 2)), straight, np.zeros((1, 2)))
    assert left_out <= bound.min() < 1e3 * left_out


def test_cancellation_in_the_network_is_counted():
    """Terms of 1e8 that cancel: what rounding does to the answer is far above its last place."""
    rng = np.random.default_rng(5)
    slide = make_chain("P", [(1, 0, 0)], [(0, 0, 0)], (0, 0, 0))
    for _ in range(30):
        first, bias = np.float32(rng.uniform(0, 1, (1, 8))), np.float32(rng.uniform(1e4, 2e4, 8))
        second = np.float32(rng.uniform(-1e4, 1e4, (8, 1)))
        second[7] = -np.float32(np.float64(bias[:7]) @ second[:7] / bias[7])
        stack = StackedMLP(
            (first[None], second[None]), (bias[None], np.zeros((1, 1), np.float32)), "relu",
            np.zeros(1), np.ones(1), (0,),
        )  # fmt: skip
        certificate = certify_sup(stack, 0, slide, Region.box([0.0], [1.0]), keep_leaves=True)

        def error(x, first=first, bias=bias, second=second):
            hidden = [
                Fraction(float(w)) * x + Fraction(float(b))
                for w, b in zip(first[0], bias, strict=True)
            ]  # all open
            answer = sum(h * Fraction(float(w)) for h, w in zip(hidden, second[:, 0], strict=True))
            return abs(answer - x)

        largest = max(error(0), error(1))
        checked = verify(certificate, stack, 0, slide)
        assert Fraction(checked.lower_mm) <= largest <= Fraction(checked.upper_mm)
        assert largest <= Fraction(certificate.upper_mm)


def certified(rng, activation="relu"):
    chain = planar([40.0, 30.0])
    stack = random_network(rng, (2, 8, 2), activation, n=2, lower=(20, 20), upper=(50, 50))
    certificate = certify_sup(stack, 0, chain, Region.box((20, 20), (50, 50)), keep_leaves=True)
    return chain, stack, certificate


def test_forged_certificates_are_refused(rng):
    chain, stack, honest = certified(rng)
    assert verify(honest, stack, 0, chain).verified
    leaves = honest.leaves
    assert not verify(replace(honest, upper_mm=honest.upper_mm * 0.9995), stack, 0, chain).verified
    assert not verify(replace(honest, lower_mm=honest.upper_mm), stack, 0, chain).verified
    outside = replace(honest, argmax_mm=honest.argmax_mm + 1000.0)
    assert not verify(outside, stack, 0, chain).verified
    # So near outside that the error there is as good as the one inside.
    beside = np.where(honest.argmax_mm > 35, 50 + 1e-6, 20 - 1e-6)
    beside = replace(honest, argmax_mm=beside, lower_mm=1e-3)
    assert verify(replace(beside, argmax_mm=honest.argmax_mm), stack, 0, chain).verified
    assert not verify(beside, stack, 0, chain).verified
    worst = int(leaves.bound.argmax())
    parts = leaves.part, leaves.lower, leaves.upper, leaves.bound
    holed = Leaves(*(np.delete(v, worst, 0) for v in parts))
    checked = verify(replace(honest, leaves=holed), stack, 0, chain)
    assert not checked.tiles
    assert checked.upper_mm == np.inf
    doubled = Leaves(*(np.concatenate([v, v[:1]]) for v in parts))
    assert not verify(replace(honest, leaves=doubled), stack, 0, chain).tiles
    longer = planar([40.0, 30.5])
    assert not verify(honest, stack, 0, longer).verified
    assert not verify(honest, stack, 1, chain).verified
    with pytest.raises(IksamplesError, match="keep_leaves"):
        verify(replace(honest, leaves=None), stack, 0, chain)


def tiles_unit_box(lower, upper):
    return tiles(np.zeros(len(lower), int), lower, upper, (1, lower.shape[1]))


def test_tilings_that_are_none():
    low, high = np.array([[0, 0], [0.5, 0]]), np.array([[0.5, 1], [1, 1.0]])
    assert tiles_unit_box(low, high)
    assert tiles_unit_box(np.zeros((1, 3)), np.ones((1, 3)))
    assert not tiles_unit_box(np.zeros((0, 2)), np.zeros((0, 2)))
    assert not tiles_unit_box(low, high - 2.0**-52)  # a gap of one unit
    assert not tiles_unit_box(low, high + 1e-17 * np.array([[1, 0], [0, 0]]) + 2.0**-52)  # overlap
    assert not tiles_unit_box(low * 0.5, high * 0.5)
    assert not tiles_unit_box(low / 3, high)  # thirds are no binary fractions
    assert not tiles_unit_box(low, np.array([[0.5, np.nan], [1, 1]]))
    # A whole half without a box.
    assert not tiles_unit_box(np.array([[0.5], [0.75]]), np.array([[0.75], [1.0]]))
    # The same volume and no box missing, but one twice and a hole elsewhere.
    quarters = np.array([[0, 0], [0, 0.5], [0.5, 0], [0.5, 0]])
    assert not tiles_unit_box(quarters, quarters + 0.5)


def test_the_lower_bound_is_an_error_that_is_taken():
    """The residual at the worst point, in fifty digits."""
    rng = np.random.default_rng(8)
    _, stack, certificate = certified(rng, "tanh")
    with mpmath.workdps(50):
        hidden = [
            (exact(x) - exact(o)) / exact(s)
            for x, o, s in zip(certificate.argmax_mm, stack.offset_mm, stack.scale_mm, strict=True)
        ]
        for depth in range(2):
            weight, bias = stack.weights[depth][0], stack.biases[depth][0]
            hidden = [
                mpmath.fsum(h * exact(w) for h, w in zip(hidden, column, strict=True)) + exact(b)
                for column, b in zip(weight.T, bias, strict=True)
            ]
            if depth == 0:
                hidden = [mpmath.tanh(h) for h in hidden]
        q1, q2 = hidden
        x = 40 * mpmath.cos(q1) + 30 * mpmath.cos(q1 + q2) - exact(certificate.argmax_mm[0])
        y = 40 * mpmath.sin(q1) + 30 * mpmath.sin(q1 + q2) - exact(certificate.argmax_mm[1])
        error = mpmath.sqrt(x * x + y * y)
        assert exact(certificate.lower_mm) <= error <= exact(certificate.upper_mm)
        assert abs(error - exact(certificate.lower_mm)) < 1e-6


def test_the_worst_position_is_inside_the_box_to_the_last_place(rng):
    """For most boxes the lower corner plus the edges is not the upper corner."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    stack = linear_network(np.zeros((3, 3)), (0, 0, 0))
    for lower, upper in zip(rng.uniform(-1, 1, (30, 3)), rng.uniform(2, 3, (30, 3)), strict=True):
        certificate = certify_sup(stack, 0, gantry, Region.box(lower, upper), keep_leaves=True)
        np.testing.assert_array_equal(certificate.argmax_mm, upper)
        assert verify(certificate, stack, 0, gantry).verified


def test_the_lower_bound_is_rounded_down():
    """The error at the origin is the root of a whole number."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    for bias in ((3, 5, 7), (2, 5, 9), (4, 6, 7), (3, 3, 5), (2, 2, 3)):
        stack = linear_network(np.zeros((3, 3)), bias)
        certificate = certify_sup(
            stack, 0, gantry, Region.box((0, 0, 0), (1, 1, 1)), keep_leaves=True
        )
        np.testing.assert_array_equal(certificate.argmax_mm, 0)
        checked = verify(certificate, stack, 0, gantry)
        square = sum(b * b for b in bias)
        assert Fraction(checked.lower_mm) ** 2 <= square <= Fraction(checked.upper_mm) ** 2


def test_compared_coordinates_may_be_chosen(rng):
    """A planar arm in the x-z plane, and a network with an input that is not compared."""
    chain = make_chain("RR", [(0, 1, 0)] * 2, [(0, 0, 0), (40, 0, 0)], (70, 0, 0))
    stack = random_network(rng, (3, 6, 2), "relu", lower=(20, 0, 10), upper=(40, 1, 30))
    compare = Comparison((0, 2), (0, 2))
    certificate = certify_sup(
        stack, 0, chain, Region.box((20, 0, 10), (40, 1, 30)), keep_leaves=True, compare=compare
    )
    assert verify(certificate, stack, 0, chain).verified
    points = points_in(rng, (20, 0, 10), (40, 1, 30), 5000)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, [0, 2]] - points[:, [0, 2]]
    assert np.linalg.norm(miss, axis=1).max() <= certificate.upper_mm
    for coordinates, inputs in (((0, 3), (0, 1)), ((0,), (0, 1)), ((0, 1), (0, 3)), ((), ())):
        with pytest.raises(IksamplesError, match="compare"):
            certify_sup(
                stack,
                0,
                chain,
                Region.box((20, 0, 10), (40, 1, 30)),
                compare=Comparison(coordinates, inputs),
            )


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_single_precision_stays_within_its_slack(rng, activation):
    """The network in float32 throughout, its answer through the exact arm."""
    chain = random_chain(rng, "RRR")
    stack = random_network(rng, (3, 32, 32, 3), activation, lower=LOWER, upper=UPPER)
    points = points_in(rng, LOWER, UPPER, 5000)
    hidden = (np.float32(points) - np.float32(stack.offset_mm)) / np.float32(stack.scale_mm)
    for depth in range(3):
        hidden = hidden @ stack.weights[depth][0] + stack.biases[depth][0]
        if depth < 2:
            hidden = np.tanh(hidden) if activation == "tanh" else np.maximum(hidden, np.float32(0))
    assert hidden.dtype == np.float32
    apart = np.linalg.norm(
        plain_tip(chain, hidden.astype(float)) - plain_tip(chain, plain_answer(stack, 0, points)),
        axis=1,
    )
    [slack] = inference_slack_mm(stack, chain, Region.box(LOWER, UPPER))
    assert 0 < apart.max() <= slack < 1.0


def test_single_precision_adds_up_over_many_layers(rng):
    """One neuron wide and 200 layers deep: one layer's roundings alone would be too few."""
    slide = make_chain("P", [(1, 0, 0)], [(0, 0, 0)], (0, 0, 0))
    weights = tuple(np.float32(rng.uniform(0.8, 1.25, (1, 1, 1))) for _ in range(200))
    stack = StackedMLP(
        weights, (np.zeros((1, 1), np.float32),) * 200, "relu", np.zeros(1), np.ones(1), (0,)
    )
    points = rng.uniform(1, 2, (2000, 1))
    hidden = np.float32(points)
    for weight in weights:
        hidden = hidden @ weight[0]
    assert hidden.dtype == np.float32
    apart = np.abs(hidden - plain_answer(stack, 0, points)).max()
    [slack] = inference_slack_mm(stack, slide, Region.box([1.0], [2.0]))
    assert slack / 200 < apart <= slack


def test_a_linear_answer_needs_no_leaves_but_the_first(rng):
    """Nothing is lost on a gantry, so the first boxes prove the bound exactly."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    stack = linear_network([[1.1, 0, 0], [0, 0.9, 0.1], [0, 0, 1]], [1, 2, 3])
    certificate = certify_sup(
        stack, 0, gantry, Region.box((0, 0, 0), (10, 10, 10)), keep_leaves=True
    )
    assert certificate.boxes == 64
    checked = verify(certificate, stack, 0, gantry)
    assert checked.upper_mm == pytest.approx(checked.lower_mm, rel=1e-12)
