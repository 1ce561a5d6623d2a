"""Tests of arms that differ from their drawing."""

import numpy as np
import pytest
from scipy.linalg import expm

from iksamples.arm.load import load_arm
from iksamples.arm.real import deviated, deviated_pose, rotation_of


def motion(rotation_vector, centre, move=(0.0, 0.0, 0.0)):
    """Homogeneous matrix of a turn about a point, then a displacement (matrix exponential)."""
    x, y, z = rotation_vector
    matrix = np.eye(4)
    matrix[:3, :3] = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    matrix[:3, 3] = np.asarray(centre) + move - matrix[:3, :3] @ centre
    return matrix


@pytest.mark.parametrize("robot", ["rrr70", "scara", "panda"])
def test_the_arm_is_its_drawing_with_a_motion_before_every_joint_and_the_tool(robot):
    chain = load_arm(f"config/robots/{robot}.urdf")
    generator = np.random.default_rng(1)
    rows = generator.normal(size=(chain.n_joints + 1, 6)) * [5, 5, 5, 0.1, 0.1, 0.1]
    arm = deviated(chain, rows)
    for _ in range(20):
        joints = generator.uniform(-1, 1, chain.n_joints)
        pose = np.eye(4)
        for i, kind in enumerate(chain.joint_kinds):
            point, axis, value = chain.points_mm[i], chain.axes[i], joints[i]
            pose = pose @ motion(rows[i, 3:], point, rows[i, :3])
            turning = kind == "revolute"
            pose = pose @ motion(axis * value * turning, point, axis * value * (not turning))
        pose = pose @ motion(rows[-1, 3:], chain.tip_mm, rows[-1, :3])
        position, rotation = arm.pose(joints)
        np.testing.assert_allclose(position, (pose @ [*chain.tip_mm, 1])[:3], atol=1e-9)
        np.testing.assert_allclose(rotation, pose[:3, :3] @ chain.tip_rotation, atol=1e-12)
        np.testing.assert_allclose(arm.forward_mm(joints), position, atol=1e-9)


def test_without_deviations_it_is_the_drawing():
    chain = load_arm("config/robots/ur5e.urdf")
    arm = deviated(chain, np.zeros((7, 6)))
    np.testing.assert_array_equal(arm.axes, chain.axes)
    np.testing.assert_allclose(arm.tip_mm, chain.tip_mm)


@pytest.mark.parametrize("robot", ["scara", "panda"])
def test_how_the_pose_changes_with_the_deviations(robot):
    chain = load_arm(f"config/robots/{robot}.urdf")
    generator = np.random.default_rng(2)
    rows = generator.normal(size=(chain.n_joints + 1, 6)) * [5, 5, 5, 0.1, 0.1, 0.1]
    rows[1] = 0  # where a turn is none, its derivative is a limit
    joints = generator.uniform(-1, 1, (3, chain.n_joints))
    position, rotation, linear, angular = deviated_pose(chain, rows, joints)
    arm = deviated(chain, rows)
    np.testing.assert_allclose(position, arm.forward_mm(joints), atol=1e-9)
    np.testing.assert_allclose(rotation, arm.rotation(joints), atol=1e-12)
    for i in range(rows.size):
        step = 1e-5 * np.eye(rows.size)[i].reshape(rows.shape)
        ahead, behind = (deviated_pose(chain, rows + sign * step, joints) for sign in (1, -1))
        np.testing.assert_allclose((ahead[0] - behind[0]) / 2e-5, linear[..., i], atol=1e-5)
        turned = ahead[1] @ np.swapaxes(rotation_of(2e-5 * angular[..., i]) @ behind[1], -1, -2)
        np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-9)
