"""Labels of the kept robots over boxes of their workspaces, against other solvers."""

import re
from dataclasses import dataclass, field

import numpy as np
import pytest

from iksamples.arm.inverse import (
    Solution,
    jumps,
    largest_usable_box,
    require_usable_lattice,
    solve,
)
from iksamples.arm.load import load_arm
from iksamples.arm.target import Target
from iksamples.errors import IksamplesError
from iksamples.samples.record import require_workspace
from iksamples.study import parse_study
from iksamples.task import study_task


DOWN = np.diag([1.0, -1, -1])


@dataclass
class Job:
    robot: str
    target: Target
    home: list[float]
    lower: list[float]
    upper: list[float]
    locked: list[str] = field(default_factory=list)

    @property
    def chain(self):
        return load_arm(f"config/robots/{self.robot}.urdf")

    def solve(self, x) -> Solution:
        return solve(self.chain, self.target, x, home=self.home, locked=self.locked)


XYZ = ("x", "y", "z")
UR5E = [0, -1.4, 1.9, -2.0708, -1.5708, 0]
PANDA = [0, -0.785, 0, -2.356, 0, 1.571, 0.785]
IIWA = [0, 0.5, 0, -1.4, 0, 1.2416, 0]
SO101 = [0, -0.2, 0.5, 1.27, 0]
# The flange of the UR5e at home, pointing down.
UR5E_DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])

JOBS = {
    "planar2r": Job("planar2r", Target(("x", "y")), [0.4, 1.2], [60, 40], [120, 120]),
    "planar3r-yaw": Job("planar3r", Target(("x", "y", "yaw"), "fixed"), [0.2, 0.9, 0.4],
                        [80, 60, 1.0], [130, 130, 1.8]),
    "planar3r-spare": Job("planar3r", Target(("x", "y")), [0.2, 0.9, 0.4], [80, 60], [140, 140]),
    "scara": Job("scara", Target((*XYZ, "yaw"), "fixed"), [0.3, 1.2, -75, -1.5],
                 [80, 60, 40, -0.5], [180, 160, 160, 0.5]),
    "scara-axis": Job("scara", Target(XYZ, "axis"), [0.3, 1.2, -75, -1.5],
                      [80, 60, 40], [180, 160, 160]),
    "ur5e-down": Job("ur5e", Target(XYZ, "fixed", UR5E_DOWN), UR5E,
                     [-660, -280, 150], [-380, 20, 430]),
    "ur5e-axis": Job("ur5e", Target(XYZ, "axis", UR5E_DOWN), UR5E,
                     [-660, -280, 150], [-380, 20, 430]),
    "ur5e-pose": Job("ur5e", Target((*XYZ, "roll", "pitch", "yaw"), "fixed", UR5E_DOWN), UR5E,
                     [-600, -230, 200, -0.4, -0.4, -0.4], [-420, -30, 380, 0.4, 0.4, 0.4]),
    "panda-down": Job("panda", Target(XYZ, "fixed", DOWN), PANDA,
                      [210, -100, 390], [410, 100, 590]),
    "panda-free": Job("panda", Target(XYZ), PANDA, [160, -150, 340], [460, 150, 640]),
    "iiwa-down": Job("iiwa14", Target(XYZ, "axis", DOWN), IIWA, [480, -100, 370], [680, 100, 570]),
    "iiwa-locked": Job("iiwa14", Target(XYZ, "fixed", np.diag([-1.0, 1, -1])), IIWA,
                       [480, -100, 370], [680, 100, 570], ["joint_a3"]),
    "so101-down": Job("so101", Target(XYZ, "axis", DOWN), SO101, [190, -50, 20], [240, 50, 70]),
    "so101-free": Job("so101", Target(XYZ), SO101, [180, -60, 20], [280, 60, 100]),
}  # fmt: skip


def lattice(job, n):
    """A lattice of the box, and its axes."""
    axes = [np.linspace(low, high, n) for low, high in zip(job.lower, job.upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)), axes


@pytest.mark.parametrize("name", JOBS)
def test_labels_are_right_and_on_one_branch(name):
    job = JOBS[name]
    n = {2: 15, 3: 6, 4: 4, 6: 3}[len(job.lower)]
    points, _ = lattice(job, n)
    solution = job.solve(points)
    assert solution.usable.all(), solution.why_not(int(np.argmin(solution.usable)))
    position, rotation = job.chain.pose(solution.joints)
    wanted, facing = job.target.wanted(points)
    asked = list(job.target.positions)
    assert np.abs(position - wanted)[:, asked].max() < 1e-6  # 1e-9 m
    if job.target.orientation == "fixed":
        np.testing.assert_allclose(rotation, facing, atol=1e-9)
    if job.target.orientation == "axis":
        np.testing.assert_allclose(rotation[..., 2], facing[..., 2], atol=1e-9)
    assert not jumps(solution, [n] * len(job.lower)).any()
    np.testing.assert_array_equal(
        solution.limit_distances.min(axis=-1) >= 0, job.chain.within_limits(solution.joints)
    )


@pytest.mark.parametrize("name", ["planar2r", "ur5e-down", "so101-down", "panda-down"])
def test_a_label_is_a_function_of_its_input_alone(name, rng):
    job = JOBS[name]
    x = rng.uniform(job.lower, job.upper, (40, len(job.lower)))
    together = job.solve(x).joints
    alone = np.concatenate([job.solve(one).joints for one in x[:10]])
    np.testing.assert_allclose(alone, together[:10], atol=1e-11)


@pytest.mark.parametrize("name", ["planar2r", "scara", "ur5e-down", "ur5e-pose", "iiwa-locked"])
def test_joints_move_as_the_jacobian_says(name, rng):
    """Central differences of the labels against the inverse of the geometric Jacobian."""
    job = JOBS[name]
    x = rng.uniform(job.lower, job.upper, (10, len(job.lower)))
    small = np.where(np.array(job.target.units) == "mm", 1e-2, 1e-4)
    labels = job.solve(x).joints
    linear, angular = job.chain.jacobians(labels)
    for step in np.diag(small):
        moved = job.solve(x + step).joints - job.solve(x - step).joints
        (p, r), (o, s) = job.target.wanted(x + step), job.target.wanted(x - step)
        asked = list(job.target.positions)
        np.testing.assert_allclose(
            (linear @ moved[..., None])[:, asked, 0], (p - o)[:, asked], atol=1e-6
        )
        if job.target.orientation == "fixed":
            skew = (r @ np.swapaxes(s, -1, -2) - s @ np.swapaxes(r, -1, -2)) / 2
            turn = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
            np.testing.assert_allclose((angular @ moved[..., None])[..., 0], turn, atol=1e-8)


def test_planar_and_scara_labels_are_the_law_of_cosines(rng):
    for name, (a, b) in (("planar2r", (100, 80)), ("scara", (120, 130))):
        job = JOBS[name]
        x = rng.uniform(job.lower, job.upper, (100, len(job.lower)))
        square = (x[:, :2] ** 2).sum(axis=-1)
        elbow = np.arccos((square - a**2 - b**2) / (2 * a * b))
        shoulder = np.arctan2(x[:, 1], x[:, 0]) - np.arctan2(
            b * np.sin(elbow), a + b * np.cos(elbow)
        )
        joints = job.solve(x).joints
        np.testing.assert_allclose(joints[:, :2], np.stack([shoulder, elbow], -1), atol=1e-10)
        if name == "scara":
            np.testing.assert_allclose(joints[:, 2], x[:, 2] - 176, atol=1e-9)
            np.testing.assert_allclose(joints[:, 3], x[:, 3] - shoulder - elbow, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "n"), [("ur5e-down", 10_000), ("ur5e-pose", 10_000), ("iiwa-locked", 10_000)]
)
def test_eaik_finds_the_same_branch(name, n, rng):
    """Of the up to eight solutions of EAIK each label is one, always the one with home's signs."""
    library = pytest.importorskip("eaik.IK_HP")
    job = JOBS[name]
    chain = job.chain
    steps = np.diff(np.vstack([np.zeros(3), chain.points_mm, chain.tip_mm]), axis=0) / 1000
    held = [(chain.joint_names.index(joint), 0.0) for joint in job.locked]
    theirs = library.HPRobot(chain.axes, steps, *([held] if held else []))
    x = rng.uniform(job.lower, job.upper, (n, len(job.lower)))
    labels = job.solve(x).joints
    position, rotation = job.target.wanted(x)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation @ chain.tip_rotation.T, position / 1000
    off = []
    for pose, label in zip(poses, labels, strict=True):
        others = np.array(theirs.IK(pose).Q)
        off.append(np.abs((others - label + np.pi) % (2 * np.pi) - np.pi).max(axis=-1).min())
    assert np.max(off) < 1e-9
    # Elbow and wrist, whose signs tell the branches apart (with the shoulder's side of the base).
    elbow, wrist = (2, 4) if job.robot == "ur5e" else (3, 5)
    for joint in (elbow, wrist):
        assert (np.sign(labels[:, joint]) == np.sign(job.home[joint])).all()


@pytest.mark.parametrize("name", ["planar3r-spare", "scara-axis", "panda-down", "iiwa-down",
                                  "panda-free", "so101-down", "so101-free"])  # fmt: skip
def test_scipy_finds_the_same_nearest_posture(name, rng):
    """Joints to spare: constrained least squares by another optimiser, from home."""
    from scipy.optimize import minimize

    job = JOBS[name]
    chain, home = job.chain, np.array(job.home)
    x = rng.uniform(job.lower, job.upper, (3, len(job.lower)))
    solution = job.solve(x)
    length = np.sqrt(np.mean(np.sum(chain.jacobian_mm(home) ** 2, axis=0)[
        np.array(chain.joint_units) == "rad"]))  # fmt: skip
    weight = np.where(np.array(chain.joint_units) == "mm", length, 1.0)
    asked = list(job.target.positions)
    for one, label in zip(x, solution.joints, strict=True):
        position, rotation = job.target.wanted(one)

        def missing(scaled, position=position, rotation=rotation):
            now, turned = chain.pose(scaled * weight)
            rest = [(now - position)[asked] / length]
            if job.target.orientation == "axis":
                # Two components, which say all near the axis; the third depends on them.
                rest.append((turned[:, 2] - rotation[:, 2])[:2])
            if job.target.orientation == "fixed":
                rest.append((turned.T @ rotation)[[0, 0, 1], [1, 2, 2]])
            return np.concatenate(rest)

        if name in ("so101-down", "scara-axis"):  # what the arm cannot break is no constraint
            free = 1 if name == "so101-down" else 0
            across = np.array([-np.sin(label[0]), np.cos(label[0])])

            def missing(scaled, position=position, free=free, across=across):
                now, turned = chain.pose(scaled * weight)
                ahead = turned[:2, 2] @ [across[1], -across[0]]
                return np.concatenate([(now - position)[asked] / length, [ahead][:free]])

        best = minimize(
            lambda scaled: np.sum((scaled - home / weight) ** 2), home / weight, method="SLSQP",
            constraints={"type": "eq", "fun": missing}, options={"ftol": 1e-15, "maxiter": 1000},
        )  # fmt: skip
        np.testing.assert_allclose(label / weight, best.x, atol=2e-5)


@pytest.mark.parametrize(
    "name",
    ["planar2r", "so101-down"]
    + [pytest.param(name, marks=pytest.mark.slow)
       for name in ("ur5e-down", "panda-down", "iiwa-down")],
)  # fmt: skip
def test_a_box_across_the_reach_is_masked_and_a_smaller_one_proposed(name):
    """Three times the sides of the box: parts cannot be used, and what can hangs together."""
    job = JOBS[name]
    lower, upper = np.array(job.lower, float), np.array(job.upper, float)
    ends = [(lower + upper + sign * 3 * (upper - lower)) / 2 for sign in (-1, 1)]
    job = Job(job.robot, job.target, job.home, *ends)
    points, axes = lattice(job, 25 if len(lower) == 2 else 9)
    shape = [len(axis) for axis in axes]
    solution = job.solve(points)
    jumping = jumps(solution, shape)
    usable = solution.usable & ~jumping
    assert 0 < usable.sum() < len(points)
    assert np.isnan(solution.joints[~solution.in_reach]).all()
    # The UR5e folds past its base on either side; nothing else is torn.
    assert jumping.sum() <= (2 if name == "ur5e-down" else 0)
    low, high = largest_usable_box(usable.reshape(shape), axes)
    inside = ((points >= low) & (points <= high)).all(axis=-1)
    assert inside.sum() > 8
    assert usable[inside].all()
    for point in np.flatnonzero(~solution.usable)[:50]:
        assert any(word in solution.why_not(point) for word in ("out of reach", "outside its lim"))


def test_a_refused_box_says_where_and_what_would_do():
    job = JOBS["ur5e-down"]
    job = Job("ur5e", job.target, UR5E, [-940, -560, -130], [-100, 300, 710])
    points, axes = lattice(job, 9)
    with pytest.raises(IksamplesError, match="Move it") as refusal:
        require_usable_lattice(job.solve(points), axes, "The workspace", "Move it.")
    message = str(refusal.value)
    assert "of 729 points cannot be used" in message
    numbers = re.search(
        r"largest usable box inside is x (.+) to (.+) mm, y (.+) to (.+) mm, z (.+) to (.+) mm\.",
        message,
    ).groups()
    low, high = np.array(numbers, float).reshape(3, 2).T
    assert job.solve(np.stack([low, high, (low + high) / 2])).usable.all()
    # The paper's arm, whose closed form needs no home.
    wide = parse_study({"name": "wide", "workspace": {"upper_mm": [110, 110, 60]}})
    with pytest.raises(IksamplesError, match="largest usable box inside is x 20 to"):
        require_workspace(wide, study_task(wide))


@pytest.mark.parametrize("unreachable", ["error", "mask"])
def test_where_nothing_can_be_used_the_remedy_is_the_place_of_the_tool(unreachable):
    """A workspace in metres by mistake: masking is no way out, knowing where the arm is one."""
    metres = {"lower_mm": [0.02, 0.02, 0], "upper_mm": [0.08, 0.08, 0.06]}
    samples = {"unreachable": unreachable}
    study = parse_study({"name": "metres", "workspace": metres, "samples": samples})
    with pytest.raises(IksamplesError, match="can") as refusal:
        require_workspace(study, study_task(study))
    assert "mask" not in str(refusal.value)
    place = re.search(r"the tool is at \((.+), (.+), (.+)\) mm: move the box", str(refusal.value))
    there = np.array(place.groups(), float)
    moved = {"lower_mm": (there - 3).tolist(), "upper_mm": (there + 3).tolist()}
    study = parse_study({"name": "moved", "workspace": moved, "samples": samples})
    require_workspace(study, study_task(study))


def test_a_home_in_degrees_is_recognised():
    chain = JOBS["ur5e-down"].chain
    with pytest.raises(IksamplesError, match=r"-90 rad is outside .* -90 deg is -1\.571 rad"):
        solve(chain, JOBS["ur5e-down"].target, np.zeros((1, 3)), home=[0, -90, 1.5, -1.5, -1.5, 0])


def test_limits_in_degrees_are_not_blamed_on_home():
    job = JOBS["ur5e-down"]
    chain = job.chain.with_limits({"elbow_joint": (20, 160)})
    with pytest.raises(
        IksamplesError, match=r"limits_rad: elbow_joint = 1\.5 .* 0\.3491 to 2\.793"
    ):
        solve(chain, job.target, np.zeros((1, 3)), home=[0, -1.5, 1.5, -1.5, -1.5, 0])


def test_a_box_that_is_torn_inside_is_refused_and_the_tear_left_out():
    """The UR5e past its base: both points are usable, but not from one to the other."""
    job = JOBS["ur5e-down"]
    job = Job("ur5e", job.target, UR5E, [-101, 94, -25], [-99, 96, 80])
    solution = job.solve(lattice(job, 2)[0])
    assert solution.usable.all()
    with pytest.raises(IksamplesError, match="the joints jump at 8 of 8 points"):
        require_usable_lattice(solution, lattice(job, 2)[1], "The workspace", "Move it.")


def test_a_singular_point_is_told_and_the_other_side_is_not_taken(rng):
    job = JOBS["planar2r"]
    reach = np.array([[179.999, 0.0], [150, 60], [300, 0]])
    solution = solve(job.chain, job.target, reach, home=job.home, min_singular_value_mm=1.0)
    assert solution.in_reach.tolist() == [True, True, False]
    assert solution.singular.tolist() == [True, False, False]
    assert "singular" in solution.why_not(0)
    assert "x 300 mm, y 0 mm" in solution.why_not(2)
    # Smallest singular value of the two-link arm's Jacobian, in closed form from its determinant.
    linear = job.chain.jacobian_mm(solution.joints[1])[:2]
    squares = np.sum(linear**2)
    determinant = abs(100 * 80 * np.sin(solution.joints[1, 1]))
    expected = np.sqrt((squares - np.sqrt(squares**2 - 4 * determinant**2)) / 2)
    assert solution.smallest_singular_mm[1] == pytest.approx(expected)
