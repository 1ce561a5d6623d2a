"""Labels on one branch: against closed forms, scipy's optimiser and the forward kinematics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iksamples.arm.chain import SerialChain
from iksamples.arm.inverse import jumps, largest_usable_box, solve
from iksamples.arm.solvers import fits_yaw_pitch_pitch, yaw_pitch_pitch
from iksamples.arm.target import Target
from iksamples.errors import IksamplesError


def moved(chain: SerialChain, rotation: np.ndarray, shift_mm: np.ndarray) -> SerialChain:
    """The same arm on another base."""
    return replace(
        chain,
        axes=chain.axes @ rotation.T,
        points_mm=chain.points_mm @ rotation.T + shift_mm,
        tip_mm=rotation @ chain.tip_mm + shift_mm,
        tip_rotation=rotation @ chain.tip_rotation,
    )


def yaw_and_pitches(rng: np.random.Generator) -> SerialChain:
    """A yaw and two pitches across it, with offsets, senses and a base drawn at random."""
    knots = np.array([[0, 0, 0], [20, 5, 60], [40, -8, 150], [130, 12, 170]])
    senses = rng.choice([-1.0, 1.0], 3)
    chain = SerialChain(
        ("yaw", "shoulder", "elbow"),
        ("revolute",) * 3,
        senses[:, None] * np.array([[0, 0, 1.0], [0, 1, 0], [0, 1, 0]]),
        knots[:3] + rng.normal(size=(3, 3)) * [0, 3, 0] + rng.normal(size=(3, 3)) * [[1, 0, 1]],
        knots[3] + rng.normal(size=3) * 10,
        np.full(3, -np.pi),
        np.full(3, np.pi),
    )
    return moved(chain, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 100)


@pytest.mark.parametrize("draw", range(20))
def test_closed_form_solves_any_yaw_and_two_pitches_on_any_base(draw):
    rng = np.random.default_rng(draw)
    chain = yaw_and_pitches(rng)
    home = rng.uniform(-2, 2, 3)
    # Postures of one branch: little away from home, so neither side nor facing changes.
    joints = home + rng.uniform(-0.02, 0.02, (50, 3))
    found = yaw_pitch_pitch(chain, chain.forward_mm(joints), home=home)
    np.testing.assert_allclose(found, joints, atol=1e-9)


@pytest.mark.parametrize("axis", [[0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]])
@pytest.mark.parametrize("turned", [0.0, 1.57, -0.3])
def test_an_upright_arm_that_could_do_either_looks_ahead_with_its_elbow_up(axis, turned, rng):
    upright = SerialChain(
        ("a", "b", "c"), ("revolute",) * 3, np.array([[0, 0, 1.0], axis, axis]),
        np.array([[0.0, 0, 0], [0, 0, 50], [0, 0, 100]]), np.array([0.0, 0, 150]),
        np.full(3, -3.0), np.full(3, 3.0),
    )  # fmt: skip
    chain = moved(upright, Rotation.from_euler("z", turned).as_matrix(), np.zeros(3))
    x = rng.uniform([30, 10, 20], [60, 40, 60], (50, 3))
    joints = yaw_pitch_pitch(chain, x)
    np.testing.assert_allclose(chain.forward_mm(joints), x, atol=1e-9)
    assert np.abs(joints[:, 0]).max() < np.pi  # no more than facing takes
    elbow = chain.skeleton_mm(joints)[:, 2]
    on_the_line = 50 + (x[:, 2] - 50) * np.linalg.norm(elbow[:, :2], axis=1) / np.linalg.norm(
        x[:, :2], axis=1
    )
    assert (elbow[:, 2] > on_the_line).all()


def test_closed_form_answers_nothing_beside_the_yaw_axis_of_an_arm_with_an_offset(rng):
    chain = SerialChain(
        ("a", "b", "c"), ("revolute",) * 3, np.array([[0, 0, 1.0], [0, 1, 0], [0, 1, 0]]),
        np.array([[0.0, 0, 0], [0, 0, 50], [50, 0, 50]]), np.array([100.0, 30, 50]),
        np.full(3, -np.pi), np.full(3, np.pi),
    )  # fmt: skip
    assert np.isnan(yaw_pitch_pitch(chain, [[10.0, 5, 40]])).all()
    assert not np.isnan(yaw_pitch_pitch(chain, [[40.0, 5, 40]])).any()


def test_newton_follows_the_branch_of_the_closed_form(chain, rng):
    x = rng.uniform([20, 20, 0], [80, 80, 60], (500, 3))
    home = yaw_pitch_pitch(chain, [[50.0, 50, 30]])[0]
    closed, numeric = (
        solve(chain, Target(), x, method=method, home=home)
        for method in ("yaw-pitch-pitch", "newton")
    )
    assert closed.usable.all()
    assert numeric.usable.all()
    np.testing.assert_allclose(numeric.joints, closed.joints, atol=1e-9)
    np.testing.assert_allclose(numeric.smallest_singular_mm, closed.smallest_singular_mm, rtol=1e-9)


def test_the_closed_form_is_taken_where_it_applies_alone(chain):
    home = [0.8, -1.2, -1.6]
    x = chain.forward_mm(home)[None]
    assert fits_yaw_pitch_pitch(chain)
    np.testing.assert_array_equal(solve(chain, Target(), x).joints, yaw_pitch_pitch(chain, x))
    plane = Target(("x", "y"))
    with pytest.raises(
        IksamplesError, match=r"robot\.home_rad: .*a value for each of yaw, shoulder"
    ):
        solve(chain, plane, x[:, :2])
    with pytest.raises(IksamplesError, match="say newton"):
        solve(chain, plane, x[:, :2], method="yaw-pitch-pitch")
    locked = solve(chain, plane, x[:, :2] + 5, home=home, locked=["yaw"])
    assert locked.in_reach.sum() == 0  # a plane through the yaw axis holds no such point
    held = solve(chain, plane, x[:, :2] * 1.1, home=home, locked=["shoulder"])
    assert held.joints[0, 1] == home[1]
    np.testing.assert_allclose(chain.forward_mm(held.joints)[:, :2], x[:, :2] * 1.1, atol=1e-9)


@pytest.mark.parametrize(
    ("home", "message"),
    [
        ([0.8, -1.2], "one finite value for each of yaw"),
        ([0.8, -1.2, np.nan], "one finite value"),
        ([0.8, -1.2, 0.5], r"elbow = 0.5 rad is outside its limits \[-3.142, 0.000\]"),
    ],
)
def test_a_home_that_is_no_posture_is_refused(chain, home, message):
    with pytest.raises(IksamplesError, match=message):
        solve(chain, Target(), [[50.0, 50, 30]], home=home)
    with pytest.raises(IksamplesError, match="no joint 'wrist'"):
        solve(chain, Target(), [[50.0, 50, 30]], locked=["wrist"])


def test_joints_to_spare_take_the_posture_nearest_to_home(chain, rng):
    """Against scipy's constrained optimiser."""
    from scipy.optimize import minimize

    home = np.array([0.8, -1.2, -1.6])
    target = Target(("x", "y"))
    x = chain.forward_mm(home)[:2] + rng.uniform(-15, 15, (5, 2))
    solution = solve(chain, target, x, home=home)
    for wanted, joints in zip(x, solution.joints, strict=True):
        best = minimize(
            lambda q: np.sum((q - home) ** 2),
            home,
            method="SLSQP",
            constraints={
                "type": "eq",
                "fun": lambda q, wanted=wanted: chain.forward_mm(q)[:2] - wanted,
            },
            options={"ftol": 1e-14, "maxiter": 500},
        )
        np.testing.assert_allclose(joints, best.x, atol=1e-5)


def test_neighbours_on_two_branches_are_seen(chain):
    home = yaw_pitch_pitch(chain, [[50.0, 50, 30]])[0]
    x = np.array([[50.0, 50, 30], [51, 50, 30], [52, 50, 30]])
    solution = solve(chain, Target(), x, home=home)
    assert not jumps(solution, [3]).any()
    other = yaw_pitch_pitch(chain, x[2:], "positive")
    within = np.ones(3, bool)
    torn = replace(solution, joints=np.concatenate([solution.joints[:2], other]), in_limits=within)
    assert jumps(torn, [3]).tolist() == [False, True, True]


def brute_force(usable, axes):
    from itertools import combinations, product

    best, corners = 0.0, None
    for ends in product(*[list(combinations(range(n), 2)) for n in usable.shape]):
        if usable[tuple(slice(low, high + 1) for low, high in ends)].all():
            sides = [axis[high] - axis[low] for axis, (low, high) in zip(axes, ends, strict=True)]
            if np.prod(sides) > best:
                best = float(np.prod(sides))
                corners = [[axis[i] for axis, i in zip(axes, c, strict=True)]
                           for c in zip(*ends, strict=True)]  # fmt: skip
    return best, corners


@pytest.mark.parametrize("shape", [(7, 6), (5, 4, 4), (3, 3, 3, 3)])
@pytest.mark.parametrize("share", [0.0, 0.7, 0.9, 1.0])
def test_largest_usable_box_is_the_largest(shape, share, rng):
    usable = rng.uniform(size=shape) < share
    axes = [np.sort(rng.uniform(0, 100, n)) for n in shape]
    volume, corners = brute_force(usable, axes)
    box = largest_usable_box(usable, axes)
    if corners is None:
        assert box is None
    else:
        assert np.prod(box[1] - box[0]) == pytest.approx(volume)
        inside = tuple(
            (axis >= low) & (axis <= high) for axis, low, high in zip(axes, *box, strict=True)
        )
        assert usable[np.ix_(*inside)].all()
