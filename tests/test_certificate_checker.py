"""The checker: balls against exact numbers, its arm against the search's, and forgeries."""

import tracemalloc
from dataclasses import replace
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from certificate_cases import (
    ONE,
    Along,
    certify_sup,
    check,
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

from iksamples.arm.target import Target
from iksamples.certify import checker_network
from iksamples.certify.balls import Ball, norm_above, sum_above, tiles
from iksamples.certify.checker_arm import Arm
from iksamples.certify.checker_network import Terms
from iksamples.certify.jets import Linkage
from iksamples.certify.rounding import inference_slack
from iksamples.certify.search import Leaves
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])
SQUARE = Region.box((20, 20), (50, 50))
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
@given(seed=st.integers(0, 2**32 - 1), terms=st.integers(1, 40), known=st.booleans())
def test_balls_of_products_hold_the_exact_result(seed, terms, known):
    """Also where one factor is all but too large and the other is all but nothing."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.choice([-290, -150, 0, 150, 298, 304])
    a = scale * rng.normal(size=(1, 2, terms))
    b = 1 / scale * rng.normal(size=(terms, 2)) * 10.0 ** rng.integers(-8, 8, (terms, 2))
    r, s = (1e-12 * np.abs(v) * rng.uniform(size=v.shape) for v in (a, b))
    product = Ball(a, r) @ (b if known else Ball(b, s))
    ends = np.sign(a[0, 0]) * r[0, 0], np.sign(b[:, 0]) * s[:, 0] * (not known)
    with mpmath.workprec(2400):
        for sign in (-1, 1):
            value = mpmath.fsum(
                (exact(a[0, 0, k]) + sign * exact(ends[0][k]))
                * (exact(b[k, 0]) + sign * exact(ends[1][k]))
                for k in range(terms)
            )
            assert holds(product[0, 0, 0], value)


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
    beside = replace(chain, tip_mm=rng.uniform(-100, 100, 3))
    derived = Arm([beside, chain]).derivatives(Ball.of(q))
    tip, first, second = (part[..., 1, :] for part in derived)
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
    checked = check(certificate, stack, 0, chain, Region.box(lower, upper))
    assert certificate.complete
    assert checked.verified
    assert checked.leaves == len(certificate.leaves.lower)
    # Not only above, but the same to rounding: two derivations of one bound.
    assert certificate.upper - 1e-6 < checked.upper <= certificate.upper
    points = points_in(rng, lower, upper, 2000)
    k = min(d, 3)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :k] - points[:, :k]
    assert np.linalg.norm(miss, axis=1).max() <= checked.upper


def test_axes_that_are_only_nearly_parallel_are_counted(rng):
    chain = make_chain(
        "RRR", [(0, 0, 1), (0, 2e-10, 1), (1e-10, 0, -1)], [(0, 0, 0), (70, 0, 0), (140, 0, 0)],
        (210, 0, 0),
    )  # fmt: skip
    stack = random_network(rng, (2, 8, 3), "tanh", lower=(50, 50), upper=(90, 90))
    certificate = certify_sup(stack, 0, chain, Region.box((50, 50), (90, 90)), keep_leaves=True)
    checked = check(certificate, stack, 0, chain, Region.box((50, 50), (90, 90)))
    # Wider than the search's bound, whose axes count as three runs, never tighter than the truth.
    assert checked.upper >= certificate.lower
    points = points_in(rng, (50, 50), (90, 90), 5000)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :2] - points
    assert np.linalg.norm(miss, axis=1).max() <= checked.upper


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
    bound = Arm([chain]).beyond(straight)
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
        certificate = certify_sup(
            stack, 0, slide, Region.box([0.0], [1.0]), keep_leaves=True, target=ONE
        )

        def error(x, first=first, bias=bias, second=second):
            hidden = [
                Fraction(float(w)) * x + Fraction(float(b))
                for w, b in zip(first[0], bias, strict=True)
            ]  # all open
            answer = sum(h * Fraction(float(w)) for h, w in zip(hidden, second[:, 0], strict=True))
            return abs(answer - x)

        largest = max(error(0), error(1))
        checked = check(certificate, stack, 0, slide, Region.box([0.0], [1.0]), target=ONE)
        assert Fraction(checked.lower) <= largest <= Fraction(checked.upper)
        assert largest <= Fraction(certificate.upper)


def certified(rng, activation="relu"):
    chain = planar([40.0, 30.0])
    stack = random_network(rng, (2, 8, 2), activation, n=2, lower=(20, 20), upper=(50, 50))
    return chain, stack, certify_sup(stack, 0, chain, SQUARE, keep_leaves=True)


def forgeries(honest, rng):
    """Leaves that prove nothing, by what is wrong with them."""
    part, low, high, bound = (
        getattr(honest.leaves, n) for n in ("part", "lower", "upper", "bound")
    )
    worst = int(bound.argmax())
    steps = np.arange(4097) / 4096

    def without(k):
        return Leaves(*(np.delete(v, k, 0) for v in (part, low, high, bound)))

    def again(k):
        return Leaves(*(np.concatenate([v, v[k : k + 1]]) for v in (part, low, high, bound)))

    nan, shrunk, grown, moved = (high.copy() for _ in range(4))
    nan[worst, 0] = np.nan
    shrunk[worst] = 0.5 * (low + high)[worst]
    grown[worst, 0] = 1.0 if high[worst, 0] < 1 else 1.0 + 2.0**-52
    moved[worst] = np.nextafter(high[worst], 0)
    swapped = part.copy()
    swapped[worst] = 1
    line = np.zeros(4096, int)
    return {
        "one dropped": without(worst),
        "one twice": again(worst),
        "none": Leaves(part[:0], low[:0], high[:0], bound[:0]),
        "not a number": replace(honest.leaves, upper=nan),
        "not finite": replace(honest.leaves, upper=np.where(high == 1, np.inf, high)),
        "shrunk": replace(honest.leaves, upper=shrunk),
        "grown": replace(honest.leaves, upper=grown),
        "moved by a last place": replace(honest.leaves, upper=moved),
        "upside down": replace(honest.leaves, lower=high, upper=low),
        "one column, on the diagonal": Leaves(line, steps[:-1, None], steps[1:, None], bound),
        "a column more": replace(
            honest.leaves,
            lower=np.column_stack([low, np.zeros(len(low))]),
            upper=np.column_stack([high, np.ones(len(high))]),
        ),
        "flat arrays": replace(honest.leaves, lower=low.ravel(), upper=high.ravel()),
        "one row for all": Leaves(part[:1], np.zeros((1, 1)), np.ones((1, 1)), bound[:1]),
        "single precision": replace(
            honest.leaves, lower=low.astype(np.float32), upper=high.astype(np.float32)
        ),
        "integers": Leaves(np.zeros(1, int), np.zeros((1, 2), int), np.ones((1, 2), int), bound),
        "complex": replace(honest.leaves, lower=low + 0j, upper=high + 0j),
        "another box of the region": replace(honest.leaves, part=swapped),
        "a box that counts from the end": replace(honest.leaves, part=part - 1),
        "boxes as floats": replace(honest.leaves, part=part.astype(float)),
        "fewer parts": replace(honest.leaves, part=part[:1]),
        "masked": replace(honest.leaves, lower=np.ma.array(low), upper=np.ma.array(high)),
        "lists": replace(honest.leaves, lower=low.tolist(), upper=high.tolist()),
        "shuffled corners": replace(honest.leaves, upper=rng.permutation(high)),
    }


def test_forged_leaves_prove_nothing(rng):
    chain, stack, honest = certified(rng)
    assert check(honest, stack, 0, chain, SQUARE).verified
    for kind, leaves in forgeries(honest, rng).items():
        checked = check(replace(honest, leaves=leaves), stack, 0, chain, SQUARE, upper=1e9)
        assert checked.upper == np.inf, kind
        assert not checked.verified, kind
    # Leaves for one box of a region say nothing about the other.
    both = Region(np.array([[20.0, 20.0], [50.0, 20.0]]), np.array([[50.0, 50.0], [60.0, 50.0]]))
    assert not check(honest, stack, 0, chain, both, upper=1e9).verified
    with pytest.raises(IksamplesError, match="keep_leaves"):
        check(replace(honest, leaves=None), stack, 0, chain, SQUARE)


def test_leaves_on_a_diagonal_are_no_proof():
    """One-column leaves broadcast onto the diagonal of the box, where this arm misses nothing."""
    gantry = make_chain("PP", np.eye(3)[:2], np.zeros((2, 3)), (0, 0, 0))
    stack = linear_network([[2, 0], [-1, 1]], (0, 0))  # (2 x - y, y) instead of (x, y)
    honest = certify_sup(stack, 0, gantry, SQUARE, keep_leaves=True)
    assert honest.lower == pytest.approx(30)
    steps = np.arange(4097) / 4096
    line = Leaves(np.zeros(4096, int), steps[:-1, None], steps[1:, None], np.zeros(4096))
    forged = replace(honest, leaves=line, upper=1.0, lower=0.0)
    checked = check(forged, stack, 0, gantry, SQUARE)
    assert checked.upper == np.inf
    assert not checked.verified


def test_claims_that_the_leaves_do_not_prove(rng):
    chain, stack, honest = certified(rng)

    def holds(row=0, chain=chain, region=SQUARE, **changed):
        return check(honest, stack, row, chain, region, **changed).verified

    assert holds()
    proved = check(honest, stack, 0, chain, SQUARE).upper
    assert holds(upper=proved)
    assert not holds(upper=float(np.nextafter(proved, 0)))
    assert not holds(upper=np.nan)
    assert not holds(upper=np.inf)
    assert not holds(lower=honest.upper)
    assert not holds(lower=np.nan)
    assert not holds(row=1)
    assert not holds(chain=planar([40.0, 30.5]))
    # What is claimed is the caller's: a larger region is not proved by leaves for a smaller one.
    assert not holds(region=Region.box((20, 20), (50, 51)), lower=0.0)
    assert not holds(target=Along((1, 0), 2))
    # A point outside of the region proves nothing, however near.
    assert not holds(argmax=honest.argmax + 1000.0)
    beside = np.where(honest.argmax > 35, 50 + 1e-6, 20 - 1e-6)
    assert holds(lower=1e-3)
    assert not holds(argmax=beside, lower=1e-3)
    assert not holds(argmax=np.full(2, np.nan))
    assert not holds(argmax=honest.argmax[:1])
    assert not holds(argmax=None)


@pytest.mark.parametrize("broken", ["nan", "gelu", "no scale", "torn", "row", "arm", "region"])
def test_what_is_no_network_is_not_checked(rng, broken):
    chain, stack, honest = certified(rng)
    row, region = 0, SQUARE
    if broken == "nan":
        stack.weights[0][0, 0, 0] = np.nan
    elif broken == "gelu":
        stack = replace(stack, activation="gelu")
    elif broken == "no scale":
        stack.scale[0] = 0
    elif broken == "torn":
        stack = replace(stack, biases=(stack.biases[0][:, :3], stack.biases[1]))
    elif broken == "row":
        row = -1
    elif broken == "arm":
        chain = planar([40.0, 30.0, 20.0])
    else:
        region = Region.box((20, 20, 20), (50, 50, 50))
    with pytest.raises(IksamplesError):
        check(honest, stack, row, chain, region)


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
            for x, o, s in zip(certificate.argmax, stack.offset, stack.scale, strict=True)
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
        x = 40 * mpmath.cos(q1) + 30 * mpmath.cos(q1 + q2) - exact(certificate.argmax[0])
        y = 40 * mpmath.sin(q1) + 30 * mpmath.sin(q1 + q2) - exact(certificate.argmax[1])
        error = mpmath.sqrt(x * x + y * y)
        assert exact(certificate.lower) <= error <= exact(certificate.upper)
        assert abs(error - exact(certificate.lower)) < 1e-6


def test_the_worst_position_is_inside_the_box_to_the_last_place(rng):
    """For most boxes the lower corner plus the edges is not the upper corner."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    stack = linear_network(np.zeros((3, 3)), (0, 0, 0))
    for lower, upper in zip(rng.uniform(-1, 1, (30, 3)), rng.uniform(2, 3, (30, 3)), strict=True):
        certificate = certify_sup(stack, 0, gantry, Region.box(lower, upper), keep_leaves=True)
        np.testing.assert_array_equal(certificate.argmax, upper)
        assert check(certificate, stack, 0, gantry, Region.box(lower, upper)).verified


def test_the_lower_bound_is_rounded_down():
    """The error at the origin is the root of a whole number."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    for bias in ((3, 5, 7), (2, 5, 9), (4, 6, 7), (3, 3, 5), (2, 2, 3)):
        stack = linear_network(np.zeros((3, 3)), bias)
        certificate = certify_sup(
            stack, 0, gantry, Region.box((0, 0, 0), (1, 1, 1)), keep_leaves=True
        )
        np.testing.assert_array_equal(certificate.argmax, 0)
        checked = check(certificate, stack, 0, gantry, Region.box((0, 0, 0), (1, 1, 1)))
        square = sum(b * b for b in bias)
        assert Fraction(checked.lower) ** 2 <= square <= Fraction(checked.upper) ** 2


def test_what_is_asked_may_be_chosen(rng):
    """A planar arm in the x-z plane, and a network with an input that is not compared."""
    chain = make_chain("RR", [(0, 1, 0)] * 2, [(0, 0, 0), (40, 0, 0)], (70, 0, 0))
    stack = random_network(rng, (3, 6, 2), "relu", lower=(20, 10, 0), upper=(40, 30, 1))
    region, target = Region.box((20, 10, 0), (40, 30, 1)), Along((0, 2), 3)
    certificate = certify_sup(stack, 0, chain, region, keep_leaves=True, target=target)
    assert check(certificate, stack, 0, chain, region, target=target).verified
    points = points_in(rng, (20, 10, 0), (40, 30, 1), 5000)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, [0, 2]] - points[:, [0, 1]]
    assert np.linalg.norm(miss, axis=1).max() <= certificate.upper
    for wrong, measure in ((Target(("x", "y")), "position"), (Target(("x", "y", "z")), "angle")):
        with pytest.raises(IksamplesError, match="asked"):
            certify_sup(stack, 0, chain, region, target=wrong, measure=measure)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_single_precision_stays_within_its_slack(rng, activation):
    """The network in float32 throughout, its answer through the exact arm."""
    chain = random_chain(rng, "RRR")
    stack = random_network(rng, (3, 32, 32, 3), activation, lower=LOWER, upper=UPPER)
    points = points_in(rng, LOWER, UPPER, 5000)
    single = in_single_precision(stack, points)
    apart = np.linalg.norm(
        plain_tip(chain, single) - plain_tip(chain, plain_answer(stack, 0, points)),
        axis=1,
    )
    [slack] = inference_slack(stack, chain, Region.box(LOWER, UPPER))
    assert 0 < apart.max() <= slack < 500 * apart.max()


def in_single_precision(stack, points):
    """A network's answers with every number and operation in float32."""
    hidden = (np.float32(points) - np.float32(stack.offset)) / np.float32(stack.scale)
    for depth, (weight, bias) in enumerate(zip(stack.weights, stack.biases, strict=True)):
        hidden = hidden @ weight[0] + bias[0]
        if depth + 1 < len(stack.weights):
            hidden = np.tanh(hidden) if stack.activation == "tanh" else np.maximum(hidden, 0)
    assert hidden.dtype == np.float32
    return hidden.astype(float)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.sampled_from(["RRR", "PRR", "RRPR", "RRRRRR"]),
    activation=st.sampled_from(["relu", "tanh"]),
    depth=st.integers(1, 3),
    far=st.sampled_from([0.0, 1.0, 1e3]),
    small=st.sampled_from([0, 60, 125]),
)
def test_single_precision_is_bounded_for_any_network(seed, kinds, activation, depth, far, small):
    """Also far from the origin, where inputs lose digits, and where products underflow."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    lower = far * rng.uniform(-1, 1, 3)
    upper = lower + rng.uniform(0.1, 100, 3)
    stack = random_network(
        rng, (3, *rng.integers(2, 20, depth), len(kinds)), activation, lower=lower, upper=upper
    )
    if activation == "relu":
        size = np.float32(2.0**-small)
        stack = replace(
            stack,
            weights=(stack.weights[0] * size, stack.weights[1] / size, *stack.weights[2:]),
            biases=(stack.biases[0] * size, *stack.biases[1:]),
        )
    points = points_in(rng, lower, upper, 5000)
    single, exact = in_single_precision(stack, points), plain_answer(stack, 0, points)
    apart = np.linalg.norm(plain_tip(chain, single) - plain_tip(chain, exact), axis=1).max()
    [slack] = inference_slack(stack, chain, Region.box(lower, upper))
    assert apart <= slack


@pytest.mark.slow
def test_single_precision_on_a_crane():
    """An arm of 12 m: what is allowed for is a small part of a millimetre, not a hand's breadth."""
    rng = np.random.default_rng(4)
    chain = make_chain(
        "RRR", [(0, 1, 0), (1, 0, 0), (1, 0, 0)],
        [(0, 0, 0), (0, 4200, 0), (0, 4200, 7000)], (0, 4200, 12200),
    )  # fmt: skip
    lower, upper = np.array([2000.0, -3000.0, 1000.0]), np.array([8000.0, 3000.0, 5000.0])
    points = points_in(rng, lower, upper, 20_000)
    for activation in ("relu", "tanh"):
        stack = random_network(rng, (3, 16, 3), activation, lower=lower, upper=upper)
        single, exact = in_single_precision(stack, points), plain_answer(stack, 0, points)
        apart = np.linalg.norm(plain_tip(chain, single) - plain_tip(chain, exact), axis=1).max()
        [slack] = inference_slack(stack, chain, Region.box(lower, upper))
        assert apart <= slack < 0.2


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
    [slack] = inference_slack(stack, slide, Region.box([1.0], [2.0]), ONE)
    assert slack / 200 < apart <= slack


def test_a_linear_answer_needs_no_leaves_but_the_first(rng):
    """Nothing is lost on a gantry, so the first boxes prove the bound exactly."""
    gantry = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
    stack = linear_network([[1.1, 0, 0], [0, 0.9, 0.1], [0, 0, 1]], [1, 2, 3])
    certificate = certify_sup(
        stack, 0, gantry, Region.box((0, 0, 0), (10, 10, 10)), keep_leaves=True
    )
    assert certificate.boxes == 64
    checked = check(certificate, stack, 0, gantry, Region.box((0, 0, 0), (10, 10, 10)))
    assert checked.upper == pytest.approx(checked.lower, rel=1e-12)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_how_many_leaves_are_checked_at_once_changes_no_bound(monkeypatch, activation):
    stack = random_network(np.random.default_rng(5), (2, 8, 8, 2), activation, upper=(50, 50))
    chain = planar((60.0, 50.0))
    certificate = certify_sup(stack, 0, chain, SQUARE, rtol=0.01, keep_leaves=True)
    checked = check(certificate, stack, 0, chain, SQUARE)
    monkeypatch.setattr(checker_network, "_NUMBERS", 300)
    assert check(certificate, stack, 0, chain, SQUARE) == checked


def test_a_wide_network_is_checked_in_little_memory():
    """Its noise is a square of its neurons for each leaf: once for all leaves, 20 GB for 4096."""
    stack = random_network(np.random.default_rng(6), (2, 2500, 2), "tanh", upper=(50, 50))
    chain = planar((60.0, 50.0))
    certificate = certify_sup(stack, 0, chain, SQUARE, max_boxes=200, keep_leaves=True)
    tracemalloc.start()
    try:
        assert check(certificate, stack, 0, chain, SQUARE).verified
        assert tracemalloc.get_traced_memory()[1] < 1.5e9
    finally:
        tracemalloc.stop()
