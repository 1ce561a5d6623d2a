"""Networks that are one function written in several ways get one bound."""

from dataclasses import replace

import numpy as np
import pytest
from certificate_cases import (
    certify_sup,
    check,
    make_chain,
    plain_answer,
    plain_tip,
    points_in,
    random_network,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.arm.chain import SerialChain
from iksamples.certify.rounding import inference_slack
from iksamples.certify.search import certify_stack
from iksamples.network import StackedMLP
from iksamples.region import Region


BOX = Region.box((20, 20, 0), (80, 80, 60))


def rescaled(stack, rng, largest):
    """Each ReLU neuron smaller by a power of two, and what follows it larger by the same."""
    weights = [np.float64(weight) for weight in stack.weights]
    biases = [np.float64(bias) for bias in stack.biases]
    for depth in range(len(weights) - 1):
        size = 2.0 ** rng.integers(-largest, largest + 1, biases[depth].shape)
        weights[depth] = weights[depth] * size[:, None]
        biases[depth] = biases[depth] * size
        weights[depth + 1] = weights[depth + 1] / size[:, :, None]
    return replace(stack, weights=tuple(weights), biases=tuple(biases))


def permuted(stack, rng):
    """The neurons of each hidden layer in another order."""
    weights, biases = list(stack.weights), list(stack.biases)
    for depth in range(len(weights) - 1):
        order = rng.permutation(biases[depth].shape[1])
        weights[depth], biases[depth] = weights[depth][:, :, order], biases[depth][:, order]
        weights[depth + 1] = weights[depth + 1][:, order]
    return replace(stack, weights=tuple(weights), biases=tuple(biases))


def padded(stack, rng, size=1.0):
    """Neurons more that are never open (relu) or that nobody listens to."""
    weights, biases = list(stack.weights), list(stack.biases)
    for depth in range(len(weights) - 1):
        n, into, out = *weights[depth].shape[:2], weights[depth + 1].shape[2]
        more = 3
        dead = size * rng.uniform(-1, 1, (n, into, more)).astype(np.float32)
        shift = np.full((n, more), -1e4 * size, np.float32)
        after = rng.uniform(-1, 1, (n, more, out)).astype(np.float32)
        if stack.activation == "tanh":
            after[:] = 0
        weights[depth] = np.concatenate([weights[depth], dead], axis=2)
        biases[depth] = np.concatenate([biases[depth], shift], axis=1)
        weights[depth + 1] = np.concatenate([weights[depth + 1], after], axis=1)
    return replace(stack, weights=tuple(weights), biases=tuple(biases))


def doubled(stack, rng):
    """Each neuron twice, with half of its weight behind either."""
    weights, biases = list(stack.weights), list(stack.biases)
    for depth in range(len(weights) - 1):
        weights[depth] = np.concatenate([weights[depth]] * 2, axis=2)
        biases[depth] = np.concatenate([biases[depth]] * 2, axis=1)
        weights[depth + 1] = np.concatenate([weights[depth + 1] * np.float32(0.5)] * 2, axis=1)
    return replace(stack, weights=tuple(weights), biases=tuple(biases))


def deeper(stack, rng):
    """A layer more that passes on what is not negative as it is."""
    width = stack.biases[0].shape[1]
    same = np.tile(np.eye(width, dtype=np.float32), (stack.n_seeds, 1, 1))
    zero = np.zeros((stack.n_seeds, width), np.float32)
    return replace(
        stack,
        weights=(stack.weights[0], same, *stack.weights[1:]),
        biases=(stack.biases[0], zero, *stack.biases[1:]),
    )


def elsewhere(stack, rng):
    """Normalised otherwise: by a power of two that the first layer takes off again."""
    size = 2.0 ** rng.integers(-20, 21, len(stack.scale))
    weights = (stack.weights[0] * np.float32(size[:, None]), *stack.weights[1:])
    return replace(stack, weights=weights, scale=stack.scale * size)


WAYS = {
    "relu": [
        lambda s, r: rescaled(s, r, 8),
        lambda s, r: rescaled(s, r, 100),
        permuted, padded, lambda s, r: padded(s, r, 1e30), doubled, deeper, elsewhere,
    ],
    "tanh": [permuted, padded, doubled, elsewhere],
}  # fmt: skip


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), activation=st.sampled_from(["relu", "tanh"]),
       depth=st.integers(1, 2), turns=st.integers(1, 3))  # fmt: skip
def test_one_function_gets_one_bound(seed, activation, depth, turns):
    rng = np.random.default_rng(seed)
    chain = make_chain(
        "RRR", [(0, 0, 1), (0, 1, 0), (0, 1, 0)], [(0, 0, 0), (0, 0, 70), (70, 0, 70)], (140, 0, 70)
    )  # fmt: skip
    hidden = rng.integers(3, 8, depth)
    stack = random_network(
        rng, (3, *hidden, 3), activation, lower=BOX.lower_corner, upper=BOX.upper_corner
    )
    other = stack
    for _ in range(turns):
        ways = WAYS[activation]
        other = ways[rng.integers(len(ways))](other, rng)
    points = points_in(rng, BOX.lower_corner, BOX.upper_corner, 2000)
    answers = [plain_answer(s, 0, points) for s in (stack, other)]
    np.testing.assert_allclose(*answers, rtol=1e-9, atol=1e-9)  # the same function, indeed
    errors = np.linalg.norm(plain_tip(chain, answers[0]) - points, axis=1)

    first, second = (certify_sup(s, 0, chain, BOX, rtol=0.01, keep_leaves=True)
                     for s in (stack, other))  # fmt: skip
    for found, network in ((first, stack), (second, other)):
        assert found.complete
        assert errors.max() <= found.upper
        assert found.upper <= 1.01 * found.lower + 1e-6
        assert check(found, network, 0, chain, BOX).verified
    assert first.lower <= second.upper
    assert second.lower <= first.upper


def test_powers_of_two_change_nothing_at_all(chain, rng):
    stack = random_network(rng, (3, 12, 8, 3), "relu", lower=BOX.lower_corner, upper=(80, 80, 60))
    first, second = (
        certify_sup(s, 0, chain, BOX, keep_leaves=True) for s in (stack, rescaled(stack, rng, 100))
    )
    assert (first.lower, first.upper, first.boxes) == (second.lower, second.upper, second.boxes)
    np.testing.assert_array_equal(first.leaves.lower, second.leaves.lower)


@pytest.mark.parametrize("exponent", [60, 90, 105, 120, 126])
def test_a_first_layer_that_nearly_vanishes(chain, exponent):
    """Noise of a neuron may be of any size, since the next weights may be."""
    rng = np.random.default_rng(exponent)
    low = np.float32(2.0**-exponent)
    for _ in range(4):
        plain = random_network(rng, (3, 8, 3), "relu", lower=BOX.lower_corner, upper=(80, 80, 60))
        stack = replace(
            plain,
            weights=(plain.weights[0] * low, plain.weights[1] / low),
            biases=(plain.biases[0] * low, plain.biases[1]),
        )
        found = certify_sup(stack, 0, chain, BOX, rtol=0.01, keep_leaves=True)
        points = points_in(rng, BOX.lower_corner, BOX.upper_corner, 3000)
        errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, 0, points)) - points, axis=1)
        assert errors.max() <= found.upper <= 1.011 * found.lower
        assert check(found, stack, 0, chain, BOX).verified


def reach_and_box(chain: SerialChain, region: Region) -> float:
    """The length of all links, and the farthest corner."""
    lengths = np.linalg.norm(np.diff([*chain.points_mm, chain.tip_mm], axis=0), axis=1).sum()
    first = np.linalg.norm(chain.points_mm[0])
    return float(lengths + first + np.linalg.norm(np.abs([region.lower, region.upper]).max(0)))


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("size", [30.0, 1e6, 1e18, 3e37])
def test_no_bound_exceeds_the_arms_reach(chain, rng, activation, size):
    """Networks that turn the arm many times within a step: nothing to gain, nothing false."""
    stack = random_network(
        rng, (3, 8, 6, 3), activation, n=2, lower=(20, 20, 0), upper=(80, 80, 60)
    )
    stack = replace(stack, weights=tuple(np.float32(size) * w for w in stack.weights))
    for row, found in enumerate(
        certify_stack(stack, chain, BOX, rtol=0.05, max_boxes=600, keep_leaves=True)
    ):
        assert found.upper <= reach_and_box(chain, BOX) * (1 + 1e-9)
        proof = check(found, stack, row, chain, BOX)
        assert proof.upper <= reach_and_box(chain, BOX) * (1 + 1e-9)
        assert proof.verified
        points = points_in(rng, BOX.lower_corner, BOX.upper_corner, 2000)
        with np.errstate(all="ignore"):
            answers = plain_answer(stack, row, points)
        fine = np.isfinite(answers).all(axis=1)
        errors = np.linalg.norm(plain_tip(chain, answers[fine]) - points[fine], axis=1)
        assert errors.max(initial=0) <= found.upper


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_a_box_far_beyond_the_arm(chain, rng, activation):
    """Far away the bound is the distance, not what the network makes of it."""
    stack = random_network(rng, (3, 16, 3), activation, lower=(20, 20, 0), upper=(80, 80, 60))
    far = Region.box((-1e6,) * 3, (1e6,) * 3)
    found = certify_sup(stack, 0, chain, far, rtol=0.01, max_boxes=5000, keep_leaves=True)
    assert np.sqrt(3) * 1e6 - 400 <= found.lower <= found.upper <= np.sqrt(3) * 1e6 + 400
    assert check(found, stack, 0, chain, far).verified


def test_an_answer_that_overflows_is_no_bound_where_a_joint_slides():
    """A slide has no reach: a number that cannot be computed is no number."""
    slide = make_chain("PP", np.eye(3)[:2], np.zeros((2, 3)), (0, 0, 0))
    big = np.full((1, 2, 2), 3e38, np.float32)
    stack = StackedMLP(
        (big,) * 12, (np.zeros((1, 2), np.float32),) * 12, "relu", np.zeros(2), np.ones(2), (0,)
    )
    square = Region.box((1, 1), (2, 2))
    found = certify_sup(stack, 0, slide, square, max_boxes=50, keep_leaves=True)
    assert found.upper == np.inf
    assert not found.complete
    assert not check(found, stack, 0, slide, square).verified
    assert inference_slack(stack, slide, square) == np.inf
