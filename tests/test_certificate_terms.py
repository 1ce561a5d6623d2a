"""Every term of the certificate alone: exact where it claims to be, attained where a bound."""

import numpy as np
import pytest
from certificate_cases import (
    Along,
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

from iksamples.certify import jets
from iksamples.certify.enclosure import (
    _tanh,
    corners,
    expand,
    pairs,
    sizes,
    third_derivative_bound,
)
from iksamples.certify.jets import Linkage, bending_mm, cubic_remainder_mm
from iksamples.certify.layers import Layers
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.network import StackedMLP
from iksamples.region import Region


KINDS = st.text("RRRP", min_size=1, max_size=7)
SEEDS = st.integers(0, 2**32 - 1)


def joint_values(rng, kinds, size):
    scale = np.array([1.0 if kind == "R" else 50.0 for kind in kinds])
    return rng.uniform(-3, 3, (size, len(kinds))) * scale


@settings(max_examples=60, deadline=None)
@given(kinds=KINDS, seed=SEEDS)
def test_jets_of_any_chain(kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    linkage = Linkage.of(chain)
    q = joint_values(rng, kinds, 4)
    position, jacobian, hessian = linkage.jets(q)
    np.testing.assert_allclose(position.T, plain_tip(chain, q), atol=1e-9)
    np.testing.assert_allclose(linkage.position_mm(q), plain_tip(chain, q), atol=1e-9)
    np.testing.assert_allclose(jacobian.transpose(1, 0, 2), chain.jacobian_mm(q), atol=1e-9)
    full = hessian + hessian.transpose(0, 1, 3, 2)
    step = 1e-5
    for i in range(len(kinds)):
        shift = step * np.eye(len(kinds))[i]
        slope = (chain.jacobian_mm(q + shift) - chain.jacobian_mm(q - shift)) / (2 * step)
        np.testing.assert_allclose(full[:, :, i].transpose(1, 0, 2), slope, atol=2e-5)


def left_out(linkage, chain, q, step):
    """What the second-order expansion leaves out, and the closed-form bound of it."""
    position, jacobian, hessian = linkage.jets(q)
    second = (
        position.T
        + np.einsum("kbi,bi->bk", jacobian, step)
        + np.einsum("kbij,bi,bj->bk", hessian, step, step)
    )
    bound = cubic_remainder_mm(
        linkage.lengths_mm(q),
        linkage.turns(np.abs(step @ linkage.angle_sums.T)),
        linkage.shifts_mm(np.abs(step)),
    )
    return np.linalg.norm(plain_tip(chain, q + step) - second, axis=1), bound


@settings(max_examples=150, deadline=None)
@given(kinds=KINDS, seed=SEEDS, size=st.floats(0.03, 2))
def test_the_cubic_remainder_holds_for_any_chain(kinds, seed, size):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    q = joint_values(rng, kinds, 20)
    step = size * joint_values(rng, kinds, 20) / 3 * (rng.random((20, len(kinds))) < 0.6)
    measured, bound = left_out(Linkage.of(chain), chain, q, step)
    assert np.all(measured <= bound * (1 + 1e-9) + 1e-9)


@pytest.mark.parametrize("n", range(1, 8))
def test_the_cubic_remainder_is_attained_by_stretched_planar_arms(n):
    chain = planar(np.linspace(90, 40, n))
    step = np.zeros((1, n))
    step[0, 0] = 0.02  # the whole arm turns about its base
    measured, bound = left_out(Linkage.of(chain), chain, np.zeros((1, n)), step)
    assert measured / bound == pytest.approx(1, abs=1e-3)


def test_angles_of_parallel_joints_add_up_before_they_are_bounded():
    """The elbow undoes the shoulder: the last link only shifts, only the first leaves a rest."""
    chain = planar([70, 70])
    measured, bound = left_out(
        Linkage.of(chain), chain, np.array([[0.3, -0.8]]), np.array([[0.05, -0.05]])
    )
    assert measured / bound == pytest.approx(1, abs=1e-3)
    upside_down = make_chain("RR", [(0, 0, 1), (0, 0, -1)], chain.points_mm, chain.tip_mm)
    measured, bound = left_out(
        Linkage.of(upside_down), upside_down, np.array([[0.3, 0.8]]), np.array([[0.05, 0.05]])
    )
    assert measured / bound == pytest.approx(1, abs=1e-3)


def test_a_link_along_its_own_axis_is_not_turned_by_it():
    chain = make_chain("RR", [(0, 1, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, 50)], (0, 0, 90))
    linkage = Linkage.of(chain)
    step = np.array([[0.0, 0.4]])
    measured, bound = left_out(linkage, chain, np.zeros((1, 2)), step)
    assert bound == pytest.approx(0, abs=1e-12)
    assert measured == pytest.approx(0, abs=1e-9)


def test_the_sliding_remainder_is_attained_by_a_slide_on_a_turning_axis():
    chain = make_chain("RP", [(0, 0, 1), (1, 0, 0)], [(0, 0, 0), (0, 0, 0)], (0, 0, 0))
    step = np.array([[0.01, 30.0]])
    measured, bound = left_out(Linkage.of(chain), chain, np.zeros((1, 2)), step)
    assert measured / bound == pytest.approx(1, abs=1e-2)


def test_a_slide_along_the_axes_before_it_leaves_nothing_out():
    """A SCARA arm: its quill moves along the axes that turn it."""
    chain = make_chain(
        "RRP", [(0, 0, 1), (0, 0, 1), (0, 0, -1)], [(0, 0, 0), (200, 0, 0), (350, 0, 0)],
        (350, 0, -40),
    )  # fmt: skip
    linkage = Linkage.of(chain)
    assert linkage.shifts_mm(np.array([1.0, 1.0, 80.0])).max() == 0
    measured, bound = left_out(linkage, chain, np.zeros((1, 3)), np.array([[0.1, -0.1, 80.0]]))
    assert measured / bound == pytest.approx(1, abs=1e-2)


def test_bending_is_attained_by_a_single_joint():
    """Turning by a + b instead of a: the second-order term grows by u (a b + b^2 / 2)."""
    length, a, b = 70.0, 0.3, 0.1
    grown = length * ((a + b) ** 2 - a**2) / 2
    assert bending_mm(np.array([length]), np.array([a]), np.array([b])) == pytest.approx(grown)


@settings(max_examples=100, deadline=None)
@given(kinds=KINDS, seed=SEEDS)
def test_bending_holds_for_any_chain(kinds, seed):
    rng = np.random.default_rng(seed)
    linkage = Linkage.of(random_chain(rng, kinds))
    q, main, small = (joint_values(rng, kinds, 10) for _ in range(3))
    small = 0.1 * small
    _, _, hessian = linkage.jets(q)
    second = [np.einsum("kbij,bi,bj->bk", hessian, v, v) for v in (main + small, main)]
    bound = bending_mm(
        linkage.lengths_mm(q),
        *(linkage.turns(np.abs(v @ linkage.angle_sums.T)) for v in (main, small)),
        *(linkage.shifts_mm(np.abs(v)) for v in (main, small)),
    )
    assert np.all(np.linalg.norm(second[0] - second[1], axis=1) <= bound * (1 + 1e-9) + 1e-9)


def test_levers_bound_what_a_joint_can_move():
    rng = np.random.default_rng(3)
    for kinds in ("RRR", "RPR", "PRRP"):
        chain = random_chain(rng, kinds)
        q = joint_values(rng, kinds, 500)
        moved = np.linalg.norm(chain.jacobian_mm(q), axis=1).max(axis=0)
        levers = Linkage.of(chain).levers_mm(np.abs(q).max(axis=0))
        assert np.all(moved <= levers * (1 + 1e-9))


@settings(max_examples=100, deadline=None)
@given(low=st.floats(-4, 4), width=st.floats(1e-6, 4))
def test_the_third_derivative_of_tanh_is_enclosed_and_attained(low, width):
    z = np.linspace(low, low + width, 4001)
    t = np.tanh(z)
    largest = np.abs(2 * (1 - t * t) * (3 * t * t - 1)).max()
    bound = third_derivative_bound(np.array(low), np.array(low + width))
    assert largest <= bound * (1 + 1e-12)
    assert bound <= largest + 2 * (width / 4000) ** 2 * 20 + 1e-9


def values_of(expansion, s, symbols):
    first, second = pairs(s.shape[1])
    value = expansion.centre + np.einsum("pa,bav->pv", s, expansion.linear)
    if expansion.quadratic.shape[1]:
        value = value + np.einsum("pq,bqv->pv", s[:, first] * s[:, second], expansion.quadratic)
    return value + np.einsum("pk,bkv->pv", symbols, expansion.noise)


@pytest.mark.parametrize(("z", "width"), [(0.0, 0.3), (0.0, 1.0), (0.05, 0.3), (-0.2, 0.5)])
def test_relu_symbol_is_exact_at_corners_and_attained_at_the_kink(z, width):
    """One neuron on one input: at a corner the symbol is known exactly; its ends are taken."""
    stack = StackedMLP(
        (np.float32([[[1.0]]]), np.float32([[[1.0]]])),
        (np.float32([[0.0]]), np.float32([[0.0]])), "relu", np.zeros(1), np.ones(1), (0,),
    )  # fmt: skip
    expansion = expand(
        Layers.of(stack), np.zeros(1, int), np.array([[z]]), np.array([[width]]), average=False
    )
    reach = expansion.reach[0, :, 0]
    for v, s in enumerate(corners(1)):
        exact = max(0.0, z + width * s[0])
        assert values_of(expansion, s[None], np.array([[2 * reach[v] - 1]])) == pytest.approx(exact)
    # At the kink the function is zero, which is the symbol's lower end, and nothing is lower.
    at_kink = values_of(expansion, np.array([[-z / width]]), np.array([[-1.0]]))
    assert at_kink == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_noise_of_the_layer_before_is_counted_on_both_sides(sign):
    """At x = 1 a first kink's noise is at its end, and the second kink loses all it may lose.

    h = max(0, x) is enclosed by [-0.5, 1], so max(0, z) with z = sign (2 h - 0.9) has a slope of
    top / 3; a second, always open path takes what that slope passes on of h away again.
    """
    slope = (1.1 if sign > 0 else 1.9) / 3.0
    stack = StackedMLP(
        (
            np.float32([[[1.0]]]),
            np.float32([[[2.0 * sign, 1.0]]]),
            np.float32([[[1.0], [-2.0 * sign * slope]]]),
        ),
        (np.float32([[0.0]]), np.float32([[-0.9 * sign, 10.0]]), np.float32([[0.0]])),
        "relu",
        np.zeros(1),
        np.ones(1),
        (0,),
    )
    expansion = expand(
        Layers.of(stack), np.zeros(1, int), np.zeros((1, 1)), np.ones((1, 1)), average=False
    )
    at = values_of(expansion, corners(1), expansion.reach[0] - 1.0)
    short = expansion.reach[0] @ np.abs(expansion.noise[0])
    apart = np.abs(plain_answer(stack, 0, corners(1)) - at)
    assert np.all(apart <= short + 1e-6)
    assert apart[1] == pytest.approx(short[1], abs=1e-6)


def test_tanh_symbol_is_attained_in_the_limit():
    """About 0, tanh z - z tends to -z^3 / 3, which is the third-derivative bound."""
    stack = StackedMLP(
        (np.float32([[[1.0]]]), np.float32([[[1.0]]])),
        (np.float32([[0.0]]), np.float32([[0.0]])), "tanh", np.zeros(1), np.ones(1), (0,),
    )  # fmt: skip
    width = 0.02
    expansion = expand(
        Layers.of(stack), np.zeros(1, int), np.zeros((1, 1)), np.array([[width]]), average=False
    )
    gap = abs(np.tanh(width) - values_of(expansion, np.ones((1, 1)), np.zeros((1, 1)))[0, 0])
    assert gap / expansion.noise[0, 0, 0] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("other", [0.0, 0.01, 0.03])
def test_what_tanh_makes_of_noise_is_attained(other):
    """One neuron, z = z0 + 0.02 s + other e, where tanh bends most: s = e = 1 is worst."""
    z0 = np.arctanh(np.sqrt(1 / 3))
    rows = np.array([[[z0], [0.02], [0.0], [other]]])
    half, reach, _ = _tanh(rows, (2, 3), np.ones((1, 1, 1)), average=False)
    s, e = (v.ravel() for v in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)))
    kept = np.stack([np.ones_like(s), s, s * s, e]).T @ rows[0, :, 0]
    apart = np.abs(np.tanh(z0 + 0.02 * s + other * e) - kept)
    assert apart.max() <= half[0, 0, 0]
    assert apart[np.abs(s) == 1].max() <= reach[0, 0, 0] * half[0, 0, 0] * (1 + 1e-12)
    if other:
        assert apart.max() / half[0, 0, 0] > 0.9


@settings(max_examples=60, deadline=None)
@given(
    seed=SEEDS,
    activation=st.sampled_from(["relu", "tanh"]),
    depth=st.integers(0, 3),
    d=st.integers(1, 6),
    size=st.floats(0.005, 0.5),
)
def test_networks_stay_inside_their_enclosure(seed, activation, depth, d, size):
    """Each value lies within the polynomial and the noise, at corners within the shorter noise."""
    rng = np.random.default_rng(seed)
    sizes = (d, *rng.integers(1, 9, depth), 3)
    stack = random_network(rng, sizes, activation, spread=rng.uniform(0.3, 2.5))
    centre = rng.uniform(0, 1, (1, d))
    radius = size * rng.uniform(0.1, 1, (1, d))
    expansion = expand(Layers.of(stack), np.zeros(1, int), centre, radius, average=False)
    s = np.concatenate([corners(d), rng.uniform(-1, 1, (300, d))])
    answer = plain_answer(stack, 0, centre + radius * s)
    noise = np.abs(expansion.noise[0]).sum(axis=0)
    middle = values_of(expansion, s, np.zeros((len(s), expansion.noise.shape[1])))
    assert np.all(np.abs(answer - middle) <= noise + 1e-9)
    reach = expansion.reach[0]
    shift = reach - 1.0 if expansion.one_sided else np.zeros_like(reach)
    at = values_of(expansion, corners(d), shift)
    short = reach @ np.abs(expansion.noise[0])
    assert np.all(np.abs(answer[: 2**d] - at) <= short + 1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, d=st.integers(1, 5))
def test_cubic_means_hold_and_are_near(seed, d):
    rng = np.random.default_rng(seed)
    linear = rng.normal(size=(1, d, 4)) * rng.choice([0.0, 1.0, 1.0], (1, d, 4))
    bound = sizes(linear, average=True)[0, -1]
    drawn = rng.uniform(-1, 1, (20_000, d)) @ linear[0]
    exact = np.cbrt(np.mean(np.abs(drawn) ** 3, axis=0))
    assert np.all(0.97 * exact <= bound)
    assert np.all(bound <= 1.08 * exact)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=SEEDS, kinds=st.sampled_from(["RR", "RRR", "RRP"]), d=st.integers(2, 3),
    activation=st.sampled_from(["relu", "tanh"]), size=st.floats(0.01, 0.4),
)  # fmt: skip
def test_what_is_left_out_is_small_on_average_too(seed, kinds, d, activation, size):
    """Positions drawn from a box: the distance from the polynomial, on average."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    stack = random_network(rng, (d, 6, len(kinds)), activation, spread=rng.uniform(0.3, 1.5))
    errors = ErrorOverBoxes(stack, chain, Region.box(np.full(d, -1.0), np.full(d, 2.0)))
    centre, radius = rng.uniform(0, 1, (1, d)), size * rng.uniform(0.1, 1, (1, d))
    [residual] = errors.residuals(np.zeros(1, int), centre, radius, average=True)
    s = rng.uniform(-1, 1, (4000, d))
    points = centre + radius * s
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :d] - points
    first, second = pairs(d)
    inside = residual.centre_mm[0] + s @ residual.linear_mm[0]
    inside += (s[:, first] * s[:, second]) @ residual.quadratic_mm[0]
    apart = np.linalg.norm(miss - inside, axis=1)
    lengths = np.linalg.norm(residual.noise_mm[0], axis=1)
    reach = 1.0 if residual.one_sided else residual.mean_reach[0, 0]
    most = float(np.sum(reach * lengths)) + residual.mean_remainder_mm[0, 0]
    assert apart.mean() - 5 * apart.std() / np.sqrt(len(s)) <= most + 1e-9


@settings(max_examples=60, deadline=None)
@given(
    seed=SEEDS,
    kinds=st.sampled_from(["R", "RR", "RRR", "RRP", "PRR", "RPRR", "RRRRRR", "RRRRRRR", "PPP"]),
    activation=st.sampled_from(["relu", "tanh"]),
    depth=st.integers(0, 2),
    d=st.integers(2, 6),
    size=st.floats(0.005, 0.5),
)
def test_no_point_of_a_box_is_above_its_bound(seed, kinds, activation, depth, d, size):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    stack = random_network(
        rng, (d, *rng.integers(1, 9, depth), len(kinds)), activation, spread=rng.uniform(0.3, 2)
    )
    errors = ErrorOverBoxes(stack, chain, Region.box(np.full(d, -1.0), np.full(d, 2.0)))
    centre, radius = rng.uniform(0, 1, (1, d)), size * rng.uniform(0.1, 1, (1, d))
    bound, corner, _ = errors.upper_bounds(np.zeros(1, int), centre, radius)
    points = points_in(rng, centre[0] - radius[0], centre[0] + radius[0], 200)
    k = min(d, 3)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :k] - points[:, :k]
    sampled = np.linalg.norm(miss, axis=1)
    assert sampled.max() <= bound[0]
    np.testing.assert_allclose(
        errors.values(np.zeros(len(points), int), points), sampled, atol=1e-8
    )
    assert np.all(np.abs(np.abs(corner[0, 0] - centre[0]) - radius[0]) < 1e-12)


@pytest.mark.parametrize("dropped", ["cubic_remainder_mm", "bending_mm"])
def test_a_dropped_remainder_is_noticed(monkeypatch, dropped):
    """On these boxes the bound without the term is exceeded, so the tests above do see it."""
    target = Along((1,), 1)  # the arm's y against a single input
    if dropped == "cubic_remainder_mm":  # 70 sin(x / 70) - x is all third order
        chain, stack, lower, upper = planar([70.0]), linear_network([[1 / 70]], [0.0]), -70.0, 70.0
    else:  # a kink in the angle, where 200 sin(angle) - x bends upwards
        chain, lower, upper = planar([200.0]), -1000.2, -999.8
        stack = StackedMLP(
            (np.float32([[[1.0]]]), np.float32([[[2.0]]])),
            (np.float32([[0.0]]), np.float32([[-1.5]])),
            "relu",
            np.array([-1000.0]),
            np.ones(1),
            (0,),
        )

    def excess():
        errors = ErrorOverBoxes(stack, chain, Region.box([lower], [upper]), target)
        middle, half = np.array([[(lower + upper) / 2]]), np.array([[(upper - lower) / 2]])
        bound, _, _ = errors.upper_bounds(np.zeros(1, int), middle, half)
        x = np.linspace(lower, upper, 2001)[:, None]
        return errors.values(np.zeros(len(x), int), x).max() - bound[0]

    assert excess() <= 0
    monkeypatch.setattr(jets, dropped, lambda *_: np.zeros((1, 1)))
    assert excess() > 0
