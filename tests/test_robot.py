"""The arm against closed forms, a URDF library and finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iksamples.arm.load import load_arm
from iksamples.arm.solvers import yaw_pitch_pitch
from iksamples.errors import IksamplesError
from iksamples.samples.designs import full_grid
from iksamples.study import parse_study
from iksamples.task import study_task


ARM = "config/robots/rrr70.urdf"


def drawn_by_hand(q1, q2, q3):
    """The formula in the head of the URDF, written out."""
    r = -70 * (np.sin(q2) + np.sin(q2 + q3))
    z = 70 + 70 * (np.cos(q2) + np.cos(q2 + q3))
    return np.stack([r * np.cos(q1), r * np.sin(q1), z], axis=-1)


def test_forward_kinematics_is_the_documented_formula(chain, rng):
    q = rng.uniform(chain.lower, chain.upper, (500, 3))
    np.testing.assert_allclose(chain.forward_mm(q), drawn_by_hand(*q.T), atol=1e-12)


def test_drawing_pose_puts_the_pen_on_the_table(chain):
    pose = np.radians([90, -90, -90])
    np.testing.assert_allclose(chain.forward_mm(pose), [0, 70, 0], atol=1e-12)
    np.testing.assert_allclose(
        chain.skeleton_mm(pose), [[0, 0, 0], [0, 0, 70], [0, 70, 70], [0, 70, 0]], atol=1e-12
    )


def test_units_and_the_tool_offset(wrist_file, rng):
    wrist = load_arm(wrist_file)
    assert wrist.joint_units == ("rad", "mm", "rad")
    q = rng.uniform(-1, 1, (20, 3))
    position, rotation = wrist.pose(q)
    tool = wrist.with_tool([3, -1, 20])
    np.testing.assert_allclose(tool.forward_mm(q), position + rotation @ [3, -1, 20], atol=1e-12)
    np.testing.assert_allclose(tool.rotation(q), rotation, atol=1e-15)


def test_jacobian_is_the_derivative(wrist_file, rng):
    wrist = load_arm(wrist_file)
    q = rng.uniform(-1, 1, (20, 3))
    step = 1e-6
    for i, unit in enumerate(np.eye(3)):
        difference = (wrist.forward_mm(q + step * unit) - wrist.forward_mm(q - step * unit)) / (
            2 * step
        )
        np.testing.assert_allclose(wrist.jacobian_mm(q)[..., i], difference, atol=1e-6)


@given(
    q1=st.floats(0, np.pi), q2=st.floats(-np.pi, 0), q3=st.floats(-3.1, -0.04),
)  # fmt: skip
def test_inverse_undoes_forward_on_its_branch(q1, q2, q3):
    chain = load_arm(ARM)
    position = drawn_by_hand(q1, q2, q3)
    joints = yaw_pitch_pitch(chain, position[None], "negative")[0]
    assert not np.isnan(joints).any()
    np.testing.assert_allclose(chain.forward_mm(joints), position, atol=1e-7)
    if -70 * (np.sin(q2) + np.sin(q2 + q3)) > 1e-3:  # it reaches forward: the same joints again
        np.testing.assert_allclose(joints, [q1, q2, q3], atol=1e-6)


@given(
    x=st.floats(-100, 100), y=st.floats(-100, 100), z=st.floats(-30, 170),
)  # fmt: skip
def test_both_branches_reach_what_is_in_reach_and_say_what_is_not(x, y, z):
    chain = load_arm(ARM)
    distance = np.sqrt(x**2 + y**2 + (z - 70) ** 2)
    for elbow, sign in (("negative", -1), ("positive", 1)):
        joints = yaw_pitch_pitch(chain, [[x, y, z]], elbow)[0]
        reached = not np.isnan(joints).any()
        if abs(distance - 140) > 1e-6:
            assert reached == (distance < 140)
        if reached:
            np.testing.assert_allclose(chain.forward_mm(joints), [x, y, z], atol=1e-5)
            assert sign * joints[2] >= 0
        else:
            assert np.isnan(joints).all()


def test_inverse_refuses_an_arm_it_does_not_fit(wrist_file):
    with pytest.raises(IksamplesError, match="yaw-pitch-pitch"):
        yaw_pitch_pitch(load_arm(wrist_file), [[1, 2, 3]], "negative")


def test_the_stated_corner_is_beyond_any_70_70_arm(study, task, chain):
    answer = task.reach([[100, 100, 70]])
    assert answer.summary()["out_of_reach"] == 1
    assert "(100, 100, 70) mm is out of reach" in answer.why_not(0)


def test_default_cube_does_not_fit_the_stated_joint_ranges():
    third = np.pi / 3
    stated = {"yaw": (third, 2 * third), "shoulder": (-2 * third, -third),
              "elbow": (-2 * third, -third)}  # fmt: skip
    study = parse_study({"name": "stated", "robot": {"limits_rad": stated}})
    corners = full_grid((20, 20, 0), (80, 80, 60), 2)
    answer = study_task(study).reach(corners)
    assert answer.in_reach.all()
    assert answer.in_limits.sum() == 1
    assert "needs yaw = 0.785 rad, outside its limits [1.047, 2.094]" in answer.why_not(0)


def test_stretched_arm_is_singular(study, task, chain):
    outstretched = chain.forward_mm([np.pi / 4, -np.pi / 2, 0.0])
    answer = task.reach(outstretched)
    assert answer.singular[0]
    assert not task.reach([[50, 50, 30]]).singular[0]


def test_missing_file_link_and_joint_are_explained(chain):
    with pytest.raises(IksamplesError, match="cannot read"):
        load_arm("nowhere.urdf")
    with pytest.raises(IksamplesError, match="no link 'hand'; the links are base, column"):
        load_arm(ARM, tip_link="hand")
    with pytest.raises(IksamplesError, match="does not hang"):
        load_arm(ARM, base_link="forearm", tip_link="column")
