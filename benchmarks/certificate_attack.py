"""An adversarial campaign against the certificates; run by ``benchmarks/certificates.py``.

Every attack is on networks of the paper's arm, whose errors are evaluated by code of this folder:
forged leaves, the same function written otherwise, extreme weights, and a maximiser of its own.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from iksamples.arm.chain import SerialChain
from iksamples.certify.checker import Claim, Verification, verify
from iksamples.certify.search import Certificate, Leaves, certify_stack
from iksamples.network import StackedMLP
from iksamples.region import Region


Case = tuple[SerialChain, StackedMLP, np.ndarray, np.ndarray]
Errors = Callable[[StackedMLP, np.ndarray], np.ndarray]

RTOL = 0.01


def attack(cases: list[Case], errors: Errors) -> None:
    """Runs the campaign and prints its table.

    Args:
        cases: Networks of the paper's arm, with their boxes.
        errors: Position errors [mm] at points, by other code than the certificates'.
    """
    rng = np.random.default_rng(0)
    print("| attack | tried | false bounds proved | bounds not proved |")
    print("|---|---:|---:|---:|")
    for title, run in (
        ("10^6 points with ascent on each bound", points),
        ("forged leaves for a claim below the truth", forged),
        ("first layer times 2^-60 to 2^-126, second layer back", vanishing),
        ("neurons scaled by powers of two up to 2^±100", scaled),
        ("neurons doubled, permuted, padded with dead ones of 10^30", rewritten),
        ("weights times 30, 10^6 and 10^18", extreme),
    ):
        tried = wrong = missing = 0
        for case in cases:
            for false, proved in run(case, errors, rng):
                tried, wrong, missing = tried + 1, wrong + false, missing + (not proved)
        lost = "-" if run is forged else missing
        print(f"| {title} | {tried} | {wrong} | {lost} |", flush=True)


Outcome = Iterator[tuple[bool, bool]]


def points(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """The largest error that can be found, against the bound."""
    yield judged(case, case[1], largest(case, errors, rng, 10**6))


def vanishing(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """The same function with a first layer of numbers near the smallest there are."""
    _, stack, _, _ = case
    if stack.activation != "relu":
        return
    truth = largest(case, errors, rng, 50_000)
    for exponent in (60, 90, 105, 120, 126):
        low = 2.0**-exponent
        weights = [np.float64(w) for w in stack.weights]
        weights[0], weights[1] = weights[0] * low, weights[1] / low
        biases = (np.float64(stack.biases[0]) * low, *stack.biases[1:])
        yield judged(case, replace(stack, weights=tuple(weights), biases=biases), truth)


def scaled(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """Each neuron smaller or larger, and what follows it larger or smaller."""
    _, stack, _, _ = case
    if stack.activation != "relu":
        return
    truth = largest(case, errors, rng, 50_000)
    for _ in range(3):
        weights = [np.float64(w) for w in stack.weights]
        biases = [np.float64(b) for b in stack.biases]
        for depth in range(len(weights) - 1):
            size = 2.0 ** rng.integers(-100, 101, biases[depth].shape)
            weights[depth], biases[depth] = weights[depth] * size[:, None], biases[depth] * size
            weights[depth + 1] = weights[depth + 1] / size[:, :, None]
        other = replace(stack, weights=tuple(weights), biases=tuple(biases))
        yield judged(case, other, truth)


def rewritten(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """Each neuron twice, with half of what follows; dead neurons; all in another order."""
    _, stack, _, _ = case
    truth = largest(case, errors, rng, 50_000)
    weights, biases = list(stack.weights), list(stack.biases)
    for depth in range(len(weights) - 1):
        into, out = weights[depth].shape[1], weights[depth + 1].shape[2]
        dead = np.full((1, into, 4), 1e30 if stack.activation == "relu" else 1.0, np.float32)
        shut = np.full((1, 4), -1e34 if stack.activation == "relu" else 1.0, np.float32)
        after = rng.uniform(-1, 1, (1, 4, out)).astype(np.float32)
        after = after if stack.activation == "relu" else 0 * after
        half = weights[depth + 1] * np.float32(0.5)
        order = rng.permutation(2 * weights[depth].shape[2] + 4)
        weights[depth] = np.concatenate([weights[depth]] * 2 + [dead], axis=2)[:, :, order]
        biases[depth] = np.concatenate([biases[depth]] * 2 + [shut], axis=1)[:, order]
        weights[depth + 1] = np.concatenate([half, half, after], axis=1)[:, order]
    yield judged(case, replace(stack, weights=tuple(weights), biases=tuple(biases)), truth)


def extreme(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """Networks that turn the arm many times within a millimetre."""
    _, stack, _, _ = case
    for size in (30.0, 1e6, 1e18):
        other = replace(stack, weights=tuple(np.float32(size) * w for w in stack.weights))
        moved = case[0], other, *case[2:]
        yield judged(case, other, largest(moved, errors, rng, 20_000), max_boxes=2000)


def forged(case: Case, errors: Errors, rng: np.random.Generator) -> Outcome:
    """Leaves that are no proof, for a claim that is false."""
    chain, stack, lower, upper = case
    honest = prove(case, stack)[0]
    truth = largest(case, errors, rng, 50_000)
    claim = Claim(stack, 0, chain, Region.box(lower, upper), upper=0.95 * truth)
    leaves = honest.leaves
    assert leaves is not None
    part, low, high, bound = leaves.part, leaves.lower, leaves.upper, leaves.bound
    small = bound <= 0.9 * truth
    steps = np.arange(4097) / 4096
    line = Leaves(np.zeros(4096, int), steps[:-1, None], steps[1:, None], np.zeros(4096))
    for forgery in (
        leaves,  # an honest tiling for a false claim
        line,
        Leaves(part[small], low[small], high[small], bound[small]),
        Leaves(part[:1], low[:1], high[:1], bound[:1]),
        Leaves(part, low, np.where(small[:, None], high, 0.5 * (low + high)), bound),
        Leaves(part, low, np.where(small[:, None], high, np.nan), bound),
        Leaves(part, 0.5 * low, 0.5 * high, bound),
        Leaves(part, low.astype(np.float32), high.astype(np.float32), bound),
        Leaves(part, low[:, :1], high[:, :1], bound),
        Leaves(np.zeros(0, int), low[:0], high[:0], bound[:0]),
    ):
        yield verify(claim, forgery).verified, True


def prove(case: Case, stack: StackedMLP, **limits: int) -> tuple[Certificate, Verification]:
    """The search's bounds, and what the checker says of them."""
    chain, _, lower, upper = case
    region = Region.box(lower, upper)
    [found] = certify_stack(stack.select([0]), chain, region, rtol=RTOL, keep_leaves=True, **limits)
    claim = Claim(stack, 0, chain, region, found.upper, found.lower, found.argmax)
    return found, verify(claim, found.leaves)


def judged(case: Case, stack: StackedMLP, truth: float, **limits: int) -> tuple[bool, bool]:
    """Whether an error exceeds what was proved, and whether anything was."""
    proof = prove(case, stack, **limits)[1]
    return truth > proof.upper * (1 + 1e-12), bool(np.isfinite(proof.upper))


def largest(case: Case, errors: Errors, rng: np.random.Generator, n: int) -> float:
    """The largest error that is found: points inside, on faces and edges, then ascent."""
    _, stack, lower, upper = case
    best_points, best = np.empty((0, len(lower))), np.empty(0)
    for first in range(0, n, 50_000):
        share = rng.random((min(50_000, n - first), len(lower)))
        pressed = rng.random(share.shape) < 0.25
        share[pressed] = np.round(share[pressed])
        tried = lower + (upper - lower) * share
        with np.errstate(all="ignore"):
            values = np.nan_to_num(errors(stack, tried), nan=0.0)
        best_points, best = np.concatenate([best_points, tried]), np.concatenate([best, values])
        top = np.argsort(best)[-100:]
        best_points, best = best_points[top], best[top]
    step = 0.05 * (upper - lower)
    for _ in range(200):
        moved = best_points + step * rng.normal(size=best_points.shape)
        moved = np.clip(moved, lower, upper)
        with np.errstate(all="ignore"):
            values = np.nan_to_num(errors(stack, moved), nan=0.0)
        better = values > best
        best_points[better], best[better] = moved[better], values[better]
        step = step * (1.05 if better.mean() > 0.2 else 0.93)
    return float(best.max())
