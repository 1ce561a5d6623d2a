"""Which points the study's arm can reach, known before a sample is taken."""

from numpy.typing import ArrayLike

from iksamples.arm.chain import SerialChain
from iksamples.arm.inverse import Solution, solve
from iksamples.arm.load import load_arm
from iksamples.arm.target import Target
from iksamples.study import Study


def study_chain(study: Study) -> SerialChain:
    """The study's arm, with the study's joint limits.

    Raises:
        IksamplesError: The URDF or a setting of ``robot`` is wrong.
    """
    robot = study.robot
    return load_arm(robot.urdf, robot.base_link, robot.tip_link).with_limits(robot.limits_rad)


def reach(study: Study, chain: SerialChain, positions_mm: ArrayLike) -> Solution:
    """Solves and classifies points of the workspace.

    Args:
        study: Names the branch of the inverse kinematics and the singularity threshold.
        chain: The arm.
        positions_mm: Points [mm], shape (points, 3).
    """
    return solve(
        chain,
        Target(),
        positions_mm,
        method=study.robot.inverse,
        elbow=study.robot.elbow,
        min_singular_value_mm=study.workspace.min_singular_value_mm,
    )
