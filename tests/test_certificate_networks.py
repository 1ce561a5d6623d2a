"""Stacks, trainings, networks from elsewhere, and searches of other dimensions."""

import subprocess
import sys

import numpy as np
import pytest
from certificate_cases import (
    certify_sup,
    plain_answer,
    plain_tip,
    points_in,
    random_chain,
    random_network,
)

from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.search import _climb, certify_stack
from iksamples.errors import IksamplesError
from iksamples.region import Region


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_a_stack_is_certified_like_its_networks(chain, rng, activation):
    stack = random_network(rng, (3, 9, 7, 3), activation, n=5, lower=LOWER, upper=UPPER)
    together = certify_stack(stack, chain, Region.box(LOWER, UPPER), keep_leaves=True)
    for row, both in enumerate(together):
        alone = certify_sup(stack, row, chain, Region.box(LOWER, UPPER))
        assert both.complete
        assert alone.complete
        assert both.lower <= alone.upper
        assert alone.lower <= both.upper
        assert both.boxes >= len(both.leaves.lower)


@pytest.mark.parametrize(
    ("kinds", "d", "activation"),
    [("RR", 2, "relu"), ("RRRR", 4, "tanh"), ("RRRRR", 5, "relu"), ("RRRRRR", 6, "tanh")],
)
def test_two_to_six_inputs(rng, kinds, d, activation):
    chain = random_chain(rng, kinds)
    lower, upper = np.full(d, -10.0), np.full(d, 10.0)
    stack = random_network(
        rng, (d, 5, len(kinds)), activation, spread=0.4, lower=lower, upper=upper
    )
    certificate = certify_sup(stack, 0, chain, Region.box(lower, upper), rtol=0.05)
    assert certificate.complete
    points = points_in(rng, lower, upper, 3000)
    k = min(d, 3)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :k] - points[:, :k]
    assert np.linalg.norm(miss, axis=1).max() <= certificate.upper
    taken = certificate.argmax[None]
    error = plain_tip(chain, plain_answer(stack, 0, taken))[:, :k] - taken[:, :k]
    assert np.linalg.norm(error) == pytest.approx(certificate.lower, abs=1e-6)


def test_points_climb_but_never_leave_the_region(rng):
    """The arm stays where it is, so its error grows towards the corners."""
    chain = random_chain(rng, "RRRRRR")
    lower, upper = np.full(6, -300.0), np.full(6, 300.0)
    stack = random_network(rng, (6, 4, 6), "relu", n=2, lower=lower, upper=upper)
    stack.weights[1][:] = 0
    errors = ErrorOverBoxes(stack, chain, Region.box(lower, upper))
    points, which = rng.uniform(lower, upper, (8, 6)), np.arange(8) % 2
    values = errors.values(which, points)
    before = values.copy()
    _climb(errors, which, np.zeros(8, int), points, values)
    assert np.all((points >= lower) & (points <= upper))
    assert np.all(values >= before)
    np.testing.assert_array_equal(values, errors.values(which, points))
    # Of the convex distance to where the arm stays, only corners are local maxima.
    np.testing.assert_array_equal(np.abs(points[values.argmax(), :3]), 300.0)


def test_no_time_is_still_a_bound(chain, rng):
    stack = random_network(rng, (3, 16, 16, 3), "relu", n=3, lower=LOWER, upper=UPPER)
    points = points_in(rng, LOWER, UPPER, 2000)
    for row, cut in enumerate(
        certify_stack(stack, chain, Region.box(LOWER, UPPER), time_limit_s=0.0)
    ):
        errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, row, points)) - points, axis=1)
        assert errors.max() <= cut.upper < np.inf
        assert not cut.complete


def test_networks_and_arms_that_do_not_fit(chain, rng):
    with pytest.raises(IksamplesError, match="joints"):
        certify_sup(random_network(rng, (3, 4, 2), "relu"), 0, chain, Region.box(LOWER, UPPER))
    torn = random_network(rng, (3, 4, 3), "relu")
    torn = type(torn)(
        (torn.weights[0], torn.weights[1][:, :3]), torn.biases, "relu",
        torn.offset, torn.scale, torn.seeds,
    )  # fmt: skip
    with pytest.raises(IksamplesError, match="fit"):
        certify_sup(torn, 0, chain, Region.box(LOWER, UPPER))
    whole = random_network(rng, (3, 4, 3), "relu")
    whole.scale[1] = 0.0
    with pytest.raises(IksamplesError, match="normalisation"):
        certify_sup(whole, 0, chain, Region.box(LOWER, UPPER))


def test_certificates_need_an_arm_a_region_and_a_network_alone():
    """No study, no table, and none of the slow imports."""
    code = (
        "import sys, iksamples.certify.search, iksamples.certify.checker, iksamples.certify.mean; "
        "print(*sorted(sys.modules))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    slow = {"torch", "pandas", "scipy", "numba", "lightning", "mlflow", "matplotlib", "pydantic"}
    assert not slow & {name.split(".")[0] for name in loaded}
    own = {name.split(".")[1] for name in loaded if name.startswith("iksamples.")}
    assert own <= {"arm", "certify", "errors", "files", "network", "region"}
