"""Certified angles, against dense points and SciPy's rotations."""

from dataclasses import replace

import numpy as np
import pytest
from certificate_cases import (
    certify_sup,
    check,
    linear_network,
    make_chain,
    plain_answer,
    plain_rotation,
    points_in,
    random_chain,
    random_network,
    turned_away,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from iksamples.arm.target import COORDINATES, Target
from iksamples.certify.checker import Claim, verify
from iksamples.certify.enclosure import pairs
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.rounding import inference_slack
from iksamples.certify.search import certify_stack
from iksamples.certify.table import Table
from iksamples.errors import IksamplesError
from iksamples.region import Region


ASKED = [
    ("x", "y", "z"),
    ("x", "y", "yaw"),
    ("x", "y", "z", "yaw"),
    ("x", "y", "z", "pitch"),
    ("x", "y", "z", "roll", "pitch"),
    ("x", "y", "z", "roll", "pitch", "yaw"),
]


def test_an_orientation_that_is_kept_is_no_endless_search(rng):
    """Two turns undo one another, whose axes are not parallel in the arm's zero posture."""
    chain = make_chain("RRR", [(0, 0, 1), (0, 1, 0), (0, 0, 1)], np.zeros((3, 3)), (50, 0, 0))
    network = linear_network([[0.01, 0, 0.01], [0.005, 0, 0.005]], [0, np.pi, 0])
    region = Region.box([-60, -60], [60, 60])
    down = Rotation.from_euler("y", np.pi).as_matrix()
    asked = {"target": Target(("x", "y"), "fixed", down), "measure": "angle"}
    atol = 1e-4
    [found] = certify_stack(network, chain, region, atol=atol, keep_leaves=True, **asked)
    assert found.complete
    assert found.boxes < 5000
    assert found.upper <= found.lower + atol
    assert check(found, network, 0, chain, region, **asked).verified
    points = points_in(rng, [-60, -60], [60, 60], 500)
    joints = plain_answer(network, 0, points)
    assert turned_away(chain, asked["target"], joints, points).max() <= found.upper


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.sampled_from(["PPP", "RRR", "RRP", "PRR", "RRRR", "RRRRRR"]),
    asked=st.sampled_from(ASKED),
    orientation=st.sampled_from(["fixed", "axis"]),
    activation=st.sampled_from(["relu", "tanh"]),
)
def test_no_point_is_turned_further_than_its_bound(seed, kinds, asked, orientation, activation):
    rng = np.random.default_rng(seed)
    tool, reference = (Rotation.random(rng=rng).as_matrix() for _ in range(2))
    chain = replace(random_chain(rng, kinds), tip_rotation=tool)
    target = Target(asked, orientation, reference)
    d = len(asked)
    lower = np.where([name in "xyz" for name in asked], -20.0, -0.4)
    stack = random_network(
        rng, (d, 4, len(kinds)), activation, spread=0.3, lower=lower, upper=-lower
    )
    region = Region.box(lower, -lower)
    found = certify_sup(
        stack, 0, chain, region, rtol=0.1, max_boxes=4000, keep_leaves=True,
        target=target, measure="angle",
    )  # fmt: skip
    points = points_in(rng, lower, -lower, 3000)
    apart = turned_away(chain, target, plain_answer(stack, 0, points), points)
    assert apart.max() <= found.upper
    most = found.argmax[None]
    [at] = turned_away(chain, target, plain_answer(stack, 0, most), most)
    assert found.lower <= at + 1e-7
    assert found.lower == pytest.approx(at, abs=1e-5)
    asked_of = {"target": target, "measure": "angle"}
    checked = check(found, stack, 0, chain, region, **asked_of)
    assert checked.verified
    assert found.upper - 1e-6 < checked.upper
    lower_claim = float(np.nextafter(checked.upper, 0))
    assert not check(found, stack, 0, chain, region, upper=lower_claim, **asked_of).verified


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), still=st.booleans())
def test_the_residual_stays_inside_its_enclosure(seed, still):
    """Also where the arm stands still and only what is asked turns."""
    rng = np.random.default_rng(seed)
    chain, target = pose_chain(), Target(COORDINATES, "fixed", Rotation.random(rng=rng).as_matrix())
    stack = random_network(rng, (6, 6), "relu", spread=0.0 if still else 0.3)
    lower, upper = np.full(6, -0.4), np.full(6, 0.4)
    errors = ErrorOverBoxes(stack, chain, Region.box(lower, upper), target, "angle")
    middle, half = rng.uniform(-0.2, 0.2, (1, 6)), rng.uniform(0, 0.2, (1, 6))
    s = rng.choice([-1.0, 1.0], (200, 6)) * rng.uniform(0.8, 1, (200, 6))
    points = middle + s * half
    reached = plain_rotation(chain, plain_answer(stack, 0, points)).as_matrix()
    asked = Rotation.from_euler("xyz", points[:, 3:]).as_matrix() @ target.reference_rotation
    first, second = pairs(6)
    for k, part in enumerate(errors.residuals(np.zeros(1, int), middle, half)):
        inside = part.centre_mm[0] + s @ part.linear_mm[0]
        inside += (s[:, first] * s[:, second]) @ part.quadratic_mm[0]
        apart = np.linalg.norm((reached - asked)[:, :, k] - inside, axis=1)
        assert part.noise_mm.shape[1] == 0
        assert 0 < apart.max() <= part.remainder_mm.max()


def pose_chain():
    """Shoulder, elbow and a wrist whose three axes meet."""
    return make_chain(
        "RRRRRR",
        [(0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0)],
        [(0, 0, 0), (0, 0, 90), (0, 0, 290), (200, 0, 290), (200, 0, 290), (200, 0, 290)],
        (280, 0, 290),
    )


def test_a_table_that_keeps_the_orientation_takes_no_long_search():
    """As on a UR5e: three parallel axes whose angles sum to 0, and a wrist that turns back."""
    axes, places = [(0, 0, 1), *[(0, 1, 0)] * 3, (0, 0, 1)], [(0, 0, 0), (0, 0, 90), (0, 0, 290)]
    chain = make_chain("RRRRR", axes, [*places, (200, 0, 290), (200, 0, 290)], (280, 0, 290))
    turn, lift, bend = np.moveaxis(np.random.default_rng(3).uniform(-0.2, 0.2, (3, 3, 3)), -1, 0)
    nodes = np.array([0.0, 50.0, 100.0])
    table = Table((nodes, nodes), np.stack([turn, lift, bend, -lift - bend, -turn], axis=-1))
    [found] = certify_stack(
        table, chain, Region.box([0, 0], [100, 100]), rtol=0.05, max_boxes=30_000,
        target=Target(("x", "y"), "fixed", np.eye(3)), measure="angle",
    )  # fmt: skip
    assert found.complete
    assert found.upper < 1e-5


def test_a_chain_that_turns_with_what_is_asked_is_off_by_a_constant():
    """A SCARA's yaw, roll about the same axis: joint = yaw + 0.3 is off by 0.3 rad everywhere."""
    chain = make_chain("R", [(0, 0, 1)], [(0, 0, 0)], (100, 0, 0))
    weights = (np.float32([[[0.0], [0.0], [1.0]]]),)
    stack = random_network(np.random.default_rng(0), (3, 1), "relu")
    stack = replace(
        stack, weights=weights, biases=(np.float32([[0.25]]),), offset=np.zeros(3),
        scale=np.ones(3),
    )  # fmt: skip
    region = Region.box((-50, -50, -1), (50, 50, 1))
    for orientation, exact in (("fixed", 0.25), ("axis", 0.0)):
        target = Target(("x", "y", "yaw"), orientation)
        found = certify_sup(
            stack, 0, chain, region, keep_leaves=True, target=target, measure="angle"
        )
        assert found.lower <= exact <= found.upper
        assert found.upper - found.lower < 1e-9
        assert check(found, stack, 0, chain, region, target=target, measure="angle").verified


@pytest.mark.parametrize("turn", [0.0, 1e-6, 0.3, 1.2, 2.5, 3.1, np.pi])
def test_angles_up_to_half_a_turn(turn):
    """A tool held still, asked to be turned: the angle is the turn, however large."""
    chain = make_chain("RR", [(0, 0, 1), (0, 1, 0)], [(0, 0, 0)] * 2, (10, 0, 0))
    stack = random_network(np.random.default_rng(0), (2, 3, 2), "relu")
    for layer in (*stack.weights, *stack.biases):
        layer[:] = 0
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    region = Region.box((0, 0), (1, 1))
    rotation = Rotation.from_rotvec(turn * axis)
    target = Target(("x", "y"), "fixed", rotation.as_matrix())
    found = certify_sup(stack, 0, chain, region, keep_leaves=True, target=target, measure="angle")
    assert found.lower <= turn + 1e-12
    assert turn <= found.upper + 1e-15
    # Where the sine is flat, rounding shows as its root.
    assert found.upper - found.lower < (1e-10 if turn < 3.1 else 1e-5)
    assert check(found, stack, 0, chain, region, target=target, measure="angle").verified


def test_forged_angles_are_refused(rng):
    chain, target = pose_chain(), Target(COORDINATES, "fixed")
    lower = np.array([150, -50, 200, -0.2, -0.2, -0.2])
    region = Region.box(lower, lower + np.array([50, 50, 50, 0.4, 0.4, 0.4]))
    stack = random_network(rng, (6, 5, 6), "tanh", spread=0.3, lower=lower, upper=region.upper[0])
    asked = {"target": target, "measure": "angle"}
    found = certify_sup(stack, 0, chain, region, rtol=0.1, keep_leaves=True, **asked)
    assert check(found, stack, 0, chain, region, **asked).verified

    def holds(**changed):
        return check(
            found, stack, 0, **{"chain": chain, "region": region, **asked, **changed}
        ).verified

    assert not holds(upper=found.lower)
    assert not holds(lower=found.upper * 1.01)
    turned = Rotation.from_rotvec([0, 0, 0.05]).as_matrix()
    assert not holds(chain=replace(chain, tip_rotation=turned), lower=0.0) or not holds(
        target=Target(COORDINATES, "fixed", turned), lower=0.0
    )
    # A tool's matrix that is no rotation is farther from one, and the bound with it.
    bent = chain.tip_rotation + 0.05 * np.eye(3)
    assert not holds(chain=replace(chain, tip_rotation=bent), lower=0.0)
    free = Target(("x", "y", "z"))
    three = random_network(rng, (3, 5, 6), "tanh")
    box = Region.box((0, 0, 0), (1, 1, 1))
    with pytest.raises(IksamplesError, match="orientation"):
        verify(Claim(three, 0, chain, box, 1.0, target=free, measure="angle"), found.leaves)


def test_stacks_and_single_precision_of_angles(rng):
    chain, target = pose_chain(), Target(COORDINATES, "fixed")
    lower = np.array([150, -50, 200, -0.2, -0.2, -0.2])
    upper = lower + np.array([50, 50, 50, 0.4, 0.4, 0.4])
    region = Region.box(lower, upper)
    stack = random_network(rng, (6, 5, 6), "relu", n=2, spread=0.3, lower=lower, upper=upper)
    both = certify_stack(stack, chain, region, rtol=0.1, target=target, measure="angle")
    slack = inference_slack(stack, chain, region, target, "angle")
    points = points_in(rng, lower, upper, 4000)
    for row, found in enumerate(both):
        one = stack.select([row])
        exact = plain_answer(one, 0, points)
        assert turned_away(chain, target, exact, points).max() <= found.upper
        hidden = (np.float32(points) - np.float32(one.offset)) / np.float32(one.scale)
        for depth in range(2):
            hidden = hidden @ one.weights[depth][0] + one.biases[depth][0]
            hidden = np.maximum(hidden, 0) if depth == 0 else hidden
        assert hidden.dtype == np.float32
        before, after = (plain_rotation(chain, np.float64(q)) for q in (exact, hidden))
        moved = (before.inv() * after).magnitude()
        assert 0 < moved.max() <= slack[row] < 1e-4
