"""What an input asks of the tool, against scipy's rotations and known angles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from iksamples.arm.chain import SerialChain, roll_pitch_yaw
from iksamples.arm.target import Target
from iksamples.errors import IksamplesError


@pytest.fixture
def wrist() -> SerialChain:
    """Three joints through the origin that turn a tool 50 mm away about z, y and x."""
    return SerialChain(
        ("a", "b", "c"),
        ("revolute",) * 3,
        np.eye(3)[::-1],
        np.zeros((3, 3)),
        np.array([50.0, 0, 0]),
        np.full(3, -np.pi),
        np.full(3, np.pi),
    )


@given(st.tuples(*[st.floats(-7, 7)] * 3))
def test_roll_pitch_yaw_is_a_turn_about_the_fixed_axes(angles):
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(roll_pitch_yaw(angles), expected, atol=1e-14)


def test_inputs_are_named_with_their_units_and_the_rest_stays_at_the_reference(rng):
    down = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    target = Target(("x", "y", "pitch", "yaw"), "fixed", down, np.array([1.0, 2, 3]))
    assert target.coordinates == ("x", "y", "pitch", "yaw")
    assert target.units == ("mm", "mm", "rad", "rad")
    x = rng.uniform(-1, 1, (5, 4, 4))
    position, rotation = target.wanted(x)
    np.testing.assert_array_equal(position[..., :2], x[..., :2])
    np.testing.assert_array_equal(position[..., 2], 3)
    turned = Rotation.from_euler("yz", x.reshape(-1, 4)[:, 2:]).as_matrix() @ down
    np.testing.assert_allclose(rotation.reshape(-1, 3, 3), turned, atol=1e-14)


def test_position_is_measured_on_the_named_coordinates_alone(wrist):
    joints = np.zeros((1, 3))
    assert Target(("x", "y")).position_error_mm(wrist, joints, [[53.0, 4]]) == pytest.approx(5)
    spatial = Target(("x", "y", "z"))
    assert spatial.position_error_mm(wrist, joints, [[53.0, 4, 12]]) == pytest.approx(13)


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-8, 1e-3, 1, np.pi / 2, 3, np.pi - 1e-9, np.pi])
def test_angles_are_right_at_tiny_ones_and_near_pi(wrist, angle, rng):
    base = rng.uniform(-0.5, 0.5, 3)
    position_and_turn = np.array([0.0, 0, 0, *base])
    # The tool is turned by the angle about its own x axis: the third joint, about x, is last.
    joints = np.array([base[2], base[1], base[0] + angle])
    target = Target(("x", "y", "z", "roll", "pitch", "yaw"), "fixed")
    assert target.angle_error_rad(wrist, joints, position_and_turn) == pytest.approx(
        angle, rel=1e-3, abs=3e-16
    )
    axis = Target(("x", "y", "z", "roll", "pitch", "yaw"), "axis")
    assert axis.angle_error_rad(wrist, joints, position_and_turn) == pytest.approx(
        angle, rel=1e-3, abs=3e-16
    )


def test_the_angle_is_the_size_of_the_rotation_between(wrist, rng):
    joints, x = rng.uniform(-3, 3, (200, 3)), rng.uniform(-3, 3, (200, 6))
    target = Target(("x", "y", "z", "roll", "pitch", "yaw"), "fixed")
    tool = Rotation.from_matrix(wrist.rotation(joints))
    between = tool.inv() * Rotation.from_euler("xyz", x[:, 3:])
    np.testing.assert_allclose(
        target.angle_error_rad(wrist, joints, x), between.magnitude(), atol=1e-12
    )


def test_a_turn_about_the_tool_axis_is_free_when_only_the_axis_matters(wrist):
    target = Target(("x", "y", "z"), "axis", Rotation.from_euler("z", 1.0).as_matrix())
    assert target.angle_error_rad(wrist, [0.3, 0, 0], [50, 0, 0]) < 1e-15
    with pytest.raises(ValueError, match="free"):
        Target().angle_error_rad(wrist, [0, 0, 0], [50, 0, 0])


@pytest.mark.parametrize(
    "inputs",
    [("x",), ("y", "x"), ("x", "z"), ("x", "y", "y"), ("x", "y", "w"), ("x", "y", "yaw", "z"), ()],
)
def test_inputs_that_ask_for_nothing_sensible_are_refused(inputs):
    with pytest.raises(IksamplesError, match=r"task\.inputs"):
        Target(inputs, "fixed")


def test_angles_among_the_inputs_need_an_orientation():
    with pytest.raises(IksamplesError, match="with yaw among the inputs"):
        Target(("x", "y", "yaw"), "free")
