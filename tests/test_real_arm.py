"""Arms that are not their drawing: what gives way, what they record, who is judged on which."""

import numpy as np
import pandas as pd
import pytest

from iksamples.arm.load import load_arm
from iksamples.arm.real import STANDARD_GRAVITY, RealArm
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import evaluate, send
from iksamples.methods.registry import fit, fit_each
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import grid_samples
from iksamples.study import parse_study
from iksamples.task import study_task
from iksamples.training.problem import pose_problem


def arm_study(seeds=3, arm=(), **sections):
    return parse_study({
        "name": "arms", "arm": dict(arm), "training": {"seeds": seeds},
        "samples": {"points_per_axis": [3]}, **sections,
    })  # fmt: skip


def recorded(study):
    task = study_task(study)
    return task, grid_samples(study, task, 3)


DEVIATES = {"deviation_mm": 1.0, "deviation_rad": 0.0175}
UR5E = {
    "robot": {
        "urdf": "config/robots/ur5e.urdf",
        "home_rad": {
            "shoulder_pan_joint": 0,
            "shoulder_lift_joint": -1.9,
            "elbow_joint": 2.1,
            "wrist_1_joint": -1.77,
            "wrist_2_joint": -1.5708,
            "wrist_3_joint": 0,
        },
    },
    "task": {
        "inputs": ["x", "y", "z"],
        "orientation": "fixed",
        "reference_rpy_rad": [3.14159265358979, 0, 1.5707963267949],
    },
    "workspace": {"lower_mm": [-450, -230, 290], "upper_mm": [-250, -30, 490]},
}


@pytest.fixture
def bar():
    """A horizontal bar of 500 mm that turns about the y axis, which gravity bends down."""
    chain = load_arm("config/robots/planar2r.urdf").with_limits({})
    return chain.__class__(
        ("pitch",), ("revolute",), np.array([[0.0, 1.0, 0.0]]), np.zeros((1, 3)),
        np.array([500.0, 0.0, 0.0]), np.array([-2.0]), np.array([2.0]),
    )  # fmt: skip


def test_a_bar_sags_by_its_load_times_its_length_squared_over_its_stiffness(bar):
    arm = RealArm(bar, payload_kg=2.0, stiffness_nm_per_rad=10_000.0)
    droop_mm = -arm.forward_mm([0.0])[2]
    torque_nm = 2.0 * STANDARD_GRAVITY * 0.5
    assert droop_mm == pytest.approx(torque_nm / 10_000.0 * 500.0, rel=1e-5)
    assert arm.forward_mm([-np.pi / 2])[2] == pytest.approx(500.0)  # upright it does not


def test_what_the_load_bends_is_an_equilibrium_of_torques(bar):
    arm = RealArm(bar, payload_kg=3.0, stiffness_nm_per_rad=100.0)
    asked = np.array([[0.1], [-0.7], [1.2]])
    actual = arm.actual(asked)[:, 0]
    by_the_spring = 100.0 * (actual - asked[:, 0])
    assert by_the_spring == pytest.approx(3.0 * STANDARD_GRAVITY * 0.5 * np.cos(actual))


def test_a_load_that_the_joints_cannot_carry_has_no_place(bar):
    arm = RealArm(bar, payload_kg=1000.0, stiffness_nm_per_rad=10.0)
    assert np.isnan(arm.forward_mm([[0.3]])).all()


def test_reading_undoes_moving_but_for_the_encoders_step(bar, rng):
    arm = RealArm(bar, 2.0, 500.0, backlash_rad=0.01, encoder_step_rad=1e-4, seed=(3,))
    asked = rng.uniform(-1, 1, (50, 1))
    assert np.abs(arm.read(arm.actual(asked)) - asked).max() <= 0.5e-4 + 1e-12
    fine = RealArm(bar, 2.0, 500.0, backlash_rad=0.01, seed=(3,))
    assert fine.read(fine.actual(asked)) == pytest.approx(asked, abs=1e-12)


def test_play_rests_on_either_side_and_steps_round(bar):
    arm = RealArm(bar, backlash_rad=0.02, encoder_step_rad=0.1, seed=(1,))
    off = arm.actual(np.full((400, 1), 0.23))[:, 0] - 0.2
    assert set(np.round(off, 12)) == {-0.01, 0.01}
    assert abs(np.mean(off > 0) - 0.5) < 0.1
    alone = arm.actual(np.full((7, 1), 0.23))[:, 0] - 0.2
    assert np.array_equal(alone, off[:7])  # a point's side does not hang on the others


def test_prismatic_joints_have_neither_play_nor_steps_nor_sag():
    chain = load_arm("config/robots/scara.urdf")
    slides = [i for i, kind in enumerate(chain.joint_kinds) if kind == "prismatic"]
    arm = RealArm(chain, 5.0, 1000.0, backlash_rad=0.1, encoder_step_rad=0.5)
    asked = np.full((4, chain.n_joints), 0.3)
    assert np.array_equal(arm.actual(asked)[:, slides], asked[:, slides])


def test_an_arm_that_does_not_deviate_is_its_drawing():
    study = arm_study()
    task, samples = recorded(study)
    plain = study_task(parse_study({"name": "plain"}))
    assert samples.arms == (0, 1, 2)
    for seed in samples.arms:
        assert samples.of(seed).joints == pytest.approx(samples.joints, abs=1e-12)
        error = plain.target.position_error_mm(task.arm_of(seed), samples.joints, samples.x)
        assert error.max() < 1e-9


@pytest.mark.parametrize(
    "sections", [{}, UR5E, {**UR5E, "task": {**UR5E["task"], "orientation": "axis"}}]
)
def test_without_noise_the_true_arm_is_where_its_samples_say(sections):
    study = arm_study(2, DEVIATES, **sections)
    task = study_task(study)
    samples = grid_samples(study, task, 2)
    for seed in samples.arms:
        arm, own = task.arm_of(seed), samples.of(seed)
        assert task.target.position_error_mm(arm, own.joints, own.x).max() < 1e-9
        assert task.target.position_error_mm(arm, samples.joints, samples.x).max() > 0.5
        assert np.abs(own.joints - samples.joints).max() < 0.5  # the same branch
        if task.turns:
            assert task.target.angle_error_rad(arm, own.joints, own.x).max() < 1e-9
    first, second = (task.arm_of(seed).points_mm for seed in samples.arms)
    assert np.abs(first - second).max() > 0.1


def test_noise_is_as_large_as_it_is_said_to_be():
    study = arm_study(40, {"noise_mm": 0.3})
    task, samples = recorded(study)
    off = [task.drawing.forward_mm(samples.of(seed).joints) - samples.x for seed in samples.arms]
    assert np.std(off) == pytest.approx(0.3, rel=0.05)
    assert abs(np.mean(off)) < 0.02
    rows = np.array(off).reshape(len(samples.arms), -1)
    assert np.abs(np.corrcoef(rows) - np.eye(len(rows))).max() < 0.6  # each arm has its own


def test_noise_of_the_orientation_turns_the_tool():
    study = arm_study(30, {"noise_rad": 0.01}, **UR5E)
    task = study_task(study)
    samples = grid_samples(study, task, 2)
    angles = np.array([
        task.target.angle_error_rad(task.drawing, samples.of(seed).joints, samples.x)
        for seed in samples.arms
    ])  # fmt: skip
    assert np.sqrt(np.mean(angles**2) / 3) == pytest.approx(0.01, rel=0.1)


def test_an_arm_and_its_samples_do_not_hang_on_how_many_there_are():
    few, many = (recorded(arm_study(n, {**DEVIATES, "noise_mm": 0.1}))[1] for n in (2, 5))
    assert np.array_equal(few.of(1).joints, many.of(1).joints)
    assert np.array_equal(few.of(1).validation_joints, many.of(1).validation_joints)
    assert few.digest() == many.digest()
    other = recorded(arm_study(2, {**DEVIATES, "noise_mm": 0.2}))[1]
    assert few.digest() != other.digest()


def test_samples_of_many_arms_come_back_from_their_file(tmp_path):
    _, samples = recorded(arm_study(3, {**DEVIATES, "noise_mm": 0.1}))
    samples.save(tmp_path / "samples.parquet")
    again = SampleSet.load(tmp_path / "samples.parquet")
    assert again.arms == samples.arms
    assert np.array_equal(again.arm_joints, samples.arm_joints)
    assert again.digest() == samples.digest()
    for seed in samples.arms:
        for name in ("x", "joints", "validation_joints", "test_joints"):
            assert np.array_equal(getattr(again.of(seed), name), getattr(samples.of(seed), name))
    table = pd.read_parquet(tmp_path / "samples.parquet")
    assert sorted(table["seed"].unique()) == [-1, 0, 1, 2]


def test_every_seed_learns_from_its_own_arm():
    study = arm_study(3, {**DEVIATES, "noise_mm": 0.1})
    _, samples = recorded(study)
    problem = pose_problem(study, samples, (2, 0))
    for row, seed in enumerate((2, 0)):
        own = samples.of(seed)
        for rows, joints in (
            (problem.train_rows[row], own.joints),
            (problem.validation_rows[row], own.validation_joints),
            (problem.test_rows[row], own.test_joints),
        ):
            assert np.array_equal(problem.targets[rows], joints.astype(np.float32))
    assert np.array_equal(
        problem.inputs[problem.train_rows[0]], problem.inputs[: samples.n_samples]
    )


def test_a_method_is_fitted_to_each_arm_and_judged_on_it():
    study = arm_study(3, DEVIATES)
    task, samples = recorded(study)
    stacked = fit_each("multilinear", task, samples, samples.arms)
    assert stacked.seeds == samples.arms
    errors = send(stacked, task, samples.x).error_mm
    assert errors.max() < 1e-9  # a table is right at its own samples, on its own arm
    for row, seed in enumerate(samples.arms):
        alone = fit("multilinear", task, samples.of(seed))
        points = samples.x[:5] + 1.0
        assert np.array_equal(alone.predict(points)[0], stacked.predict(points)[row])


def test_errors_are_per_arm_and_against_inputs_without_noise(tmp_path):
    study = arm_study(4, {"noise_mm": 0.2}, methods={"table": {"kind": "multilinear"}})
    task, samples = recorded(study)
    tables = next(evaluate(study, task, samples, "table", tmp_path))
    assert tables["errors"].groupby("region")["seed"].apply(list).iloc[0] == [0, 1, 2, 3]
    at_samples = send(fit_each("multilinear", task, samples, samples.arms), task, samples.x)
    assert np.sqrt(np.mean(at_samples.error_mm**2) / 3) == pytest.approx(0.2, rel=0.15)


def test_an_arm_that_cannot_get_to_a_sample_is_named():
    study = arm_study(4, {"deviation_mm": 60.0})
    with pytest.raises(IksamplesError, match=r"arm of seed \d cannot get to .*deviation_mm"):
        recorded(study)


def test_samples_of_another_arm_are_not_made_up():
    _, samples = recorded(arm_study(2))
    with pytest.raises(IksamplesError, match="not recorded on the arm of seed 7"):
        samples.of(7)


@pytest.mark.parametrize(
    ("arm", "message"),
    [
        ({"payload_kg": 3}, "stiffness_nm_per_rad"),
        ({"stiffness_nm_per_rad": 3}, "payload_kg"),
        ({"deviation_mm": -1}, "deviation_mm"),
    ],
)
def test_an_arm_that_makes_no_sense_is_refused(arm, message):
    with pytest.raises(IksamplesError, match=message):
        arm_study(1, arm)


def test_the_paper_has_no_other_arm():
    with pytest.raises(IksamplesError, match="paper"):
        arm_study(1, paper=True)


def test_what_is_expected_of_an_arm_is_as_it_is_where_nothing_is_said():
    arm = {"deviation_mm": 2.0, "noise_mm": 0.1, "expected": {"deviation_mm": 1.0}}
    expected = study_task(arm_study(1, arm)).expected
    assert (expected.deviation_mm, expected.noise_mm) == (1.0, 0.1)
    assert (expected.deviation_rad, expected.noise_rad) == (0.0, 0.0)
