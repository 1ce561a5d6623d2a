"""Which points the arm can reach, known before a sample is taken."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain, load_urdf
from iksamples.arm.closed_form import inverse
from iksamples.errors import IksamplesError
from iksamples.study import Study


Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Reach:
    """What the arm can do at each of some points.

    Attributes:
        positions_mm: The points [mm], shape (points, 3).
        joints: Joint values on the study's branch [rad], NaN out of reach, shape (points, joints).
        in_reach: The links are long enough, shape (points,).
        in_limits: In reach and inside the joint limits, shape (points,).
        singular: In reach, and the Jacobian's smallest singular value is below the study's
            threshold, shape (points,).
    """

    positions_mm: Floats
    joints: Floats
    in_reach: Flags
    in_limits: Flags
    singular: Flags

    @property
    def usable(self) -> Flags:
        """In reach, inside the limits and not singular, shape (points,)."""
        return self.in_limits & ~self.singular

    def summary(self) -> dict[str, int]:
        """Number of points of each kind."""
        return {
            "points": len(self.positions_mm),
            "out_of_reach": int(np.sum(~self.in_reach)),
            "outside_joint_limits": int(np.sum(self.in_reach & ~self.in_limits)),
            "singular": int(np.sum(self.in_limits & self.singular)),
            "usable": int(np.sum(self.usable)),
        }

    def why_not(self, point: int, chain: SerialChain) -> str:
        """In words, why a point is not usable."""
        where = "({:g}, {:g}, {:g}) mm".format(*self.positions_mm[point])
        if not self.in_reach[point]:
            return f"{where} is out of reach"
        if not self.in_limits[point]:
            worst = int(
                np.argmax(
                    np.maximum(chain.lower - self.joints[point], self.joints[point] - chain.upper)
                )
            )
            return (
                f"{where} needs {chain.joint_names[worst]} = {self.joints[point, worst]:.3f} rad, "
                f"outside its limits [{chain.lower[worst]:.3f}, {chain.upper[worst]:.3f}]"
            )
        return f"{where} is singular"

    def require_usable(self, chain: SerialChain, what: str, remedy: str) -> None:
        """Stops where a point is not usable.

        Args:
            chain: The arm.
            what: What the points are, for the message.
            remedy: What the user can do.

        Raises:
            IksamplesError: Names the first such point, and why.
        """
        bad = np.flatnonzero(~self.usable)
        if bad.size:
            raise IksamplesError(
                f"{what}: {bad.size} of {len(self.positions_mm)} points cannot be used; "
                f"{self.why_not(int(bad[0]), chain)}. {remedy}"
            )


def study_chain(study: Study) -> SerialChain:
    """The study's arm, with the study's joint limits.

    Raises:
        IksamplesError: The URDF or a setting of ``robot`` is wrong.
    """
    robot = study.robot
    return load_urdf(robot.urdf, robot.base_link, robot.tip_link).with_limits(robot.limits_rad)


def reach(study: Study, chain: SerialChain, positions_mm: ArrayLike) -> Reach:
    """Classifies points of the workspace.

    Args:
        study: Names the branch of the inverse kinematics and the singularity threshold.
        chain: The arm.
        positions_mm: Points [mm], shape (points, 3).
    """
    positions = np.atleast_2d(np.asarray(positions_mm, float))
    solution = inverse(study.robot, chain, positions)
    in_limits = solution.reachable & chain.within_limits(solution.joints)
    singular = np.zeros(len(positions), bool)
    jacobians = chain.jacobian_mm(solution.joints[solution.reachable])
    smallest = np.linalg.svd(jacobians, compute_uv=False)[..., -1]
    singular[solution.reachable] = smallest < study.workspace.min_singular_value_mm
    return Reach(positions, solution.joints, solution.reachable, in_limits, singular)
