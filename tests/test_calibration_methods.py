"""Methods that know something of the arm: on arms that differ from their drawing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from iksamples.arm.inverse import followed
from iksamples.arm.real import deviated
from iksamples.calibration.fit import fit_samples
from iksamples.evaluation.errors import evaluate
from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.registry import fit
from iksamples.methods.trigonometric import products, ridge
from iksamples.samples.record import grid_samples, record_samples, region_points
from iksamples.study import parse_study, read_study
from iksamples.task import study_task


@pytest.fixture
def arm(chain):
    """An arm that is a millimetre and a degree off its drawing, component by component."""
    sd = np.array([1, 1, 1, *np.radians([1, 1, 1])])
    return deviated(chain, np.random.default_rng(3).normal(size=(4, 6)) * sd)


def recorded(task, arm, samples, noise_mm=0.0):
    """The samples as recorded on an arm whose tool is measured with some noise."""
    noise = noise_mm * np.random.default_rng(4).normal(size=samples.x.shape)
    joints = followed(task.reach(samples.x), arm)
    for _ in range(20):  # joints at which the arm is where the noise has it
        off = samples.x + noise - arm.forward_mm(joints)
        joints += np.linalg.solve(arm.jacobian_mm(joints), off[..., None])[..., 0]
    return replace(samples, joints=joints)


def worst_mm(task, arm, predictor):
    points = region_points(task.region, 2000)
    return np.max(task.target.position_error_mm(arm, predictor.predict(points)[0], points))


def test_followed_joints_put_another_arm_where_the_drawing_was_to_be(task, arm):
    x = np.concatenate([region_points(task.region, 500), [[500.0, 0.0, 0.0]]])
    solution = task.reach(x)
    joints = followed(solution, arm)
    assert np.isnan(joints[-1]).all()
    np.testing.assert_allclose(arm.forward_mm(joints[:-1]), x[:-1], atol=1e-6)
    # On the same branch: a degree or so per joint for every degree and millimetre.
    assert np.nanmax(np.abs(joints - solution.joints)) < 0.3
    np.testing.assert_allclose(
        followed(solution, task.drawing)[:-1], solution.joints[:-1], atol=1e-9
    )


@pytest.mark.parametrize(
    ("kind", "m", "limit_mm"),
    # The drawing's worst is about 6 mm; 8 corners and 27 poses determine these models, but the
    # first one reckons with 0.1 mm of noise.
    [("calibrated", 2, 0.1), ("trigonometric", 3, 1e-5), ("residual", 4, 0.4)],
)
def test_what_is_known_of_the_arm_makes_few_samples_enough(kind, m, limit_mm, study, task, arm):
    samples = recorded(task, arm, grid_samples(study, task, m))
    plain = worst_mm(task, arm, fit("nominal", task, samples))
    assert plain > 3
    assert worst_mm(task, arm, fit(kind, task, samples)) < limit_mm
    cubic = worst_mm(task, arm, fit("cubic", task, samples))
    assert worst_mm(task, arm, fit(kind, task, samples)) < cubic


@pytest.mark.parametrize("kind", ["calibrated", "trigonometric", "residual"])
def test_noise_is_not_learnt_by_heart(kind, study, task, arm):
    samples = recorded(task, arm, grid_samples(study, task, 5), noise_mm=0.3)
    error = worst_mm(task, arm, fit(kind, task, samples))
    assert error < 0.6 * worst_mm(task, arm, fit("cubic", task, samples))


def simulated(arm, n):
    """The task of a study's arm of seed 0, and what it recorded on a grid makes of the drawing."""
    study = parse_study(
        {"name": "arms", "arm": arm, "samples": {"points_per_axis": [n]}, "training": {"seeds": 1}}
    )
    task = study_task(study)
    samples = grid_samples(study, task, n).of(0)
    return task, fit_samples(task, samples)


def test_the_fit_expects_of_the_arm_what_the_study_says():
    rough = {"deviation_mm": 3, "deviation_rad": 0.03}
    task, fitted = simulated(rough, 2)
    points = task.reach(region_points(task.region, 500)).joints
    off = fitted.chain.forward_mm(points) - task.arm_of(0).forward_mm(points)
    assert np.abs(off).max() < 1e-3  # without noise the corners are enough
    # An arm that is farther from its drawing than is expected is not held to that.
    stiff = {"deviation_mm": 0.1, "deviation_rad": 0.001, "noise_mm": 0.1}
    task, fitted = simulated({**rough, "expected": stiff}, 2)
    off = fitted.chain.forward_mm(points) - task.arm_of(0).forward_mm(points)
    assert np.abs(off).max() < 0.3
    # One that is its drawing, as is expected, keeps its geometry.
    task, fitted = simulated({"noise_mm": 0.1, "expected": stiff}, 2)
    assert np.abs(fitted.deviations).max() < 0.2
    task, fitted = simulated({**rough, "noise_mm": 0.3}, 5)
    assert fitted.noise_mm == 0.3


def test_noise_that_cannot_explain_the_residuals_is_not_believed():
    _, fitted = simulated({"deviation_mm": 1, "deviation_rad": 0.01, "backlash_rad": 0.01}, 4)
    # The joints rest 5 mrad to either side, 50 to 150 mm from the tool.
    assert 0.25 < fitted.noise_mm < 1.5


def test_calibrated_takes_poses_and_inputs_of_any_task():
    study = read_study("config/studies/ur5e-pose.yaml")
    task = study_task(study)
    sd = np.array([1, 1, 1, *np.radians([1, 1, 1])])
    arm = deviated(task.drawing, np.random.default_rng(0).normal(size=(7, 6)) * sd)
    samples = record_samples(study, task, "sobol", 12)
    truly = replace(samples, joints=followed(task.reach(samples.x), arm))
    points = region_points(task.region, 500)
    joints = fit("calibrated", task, truly).predict(points)[0]
    assert task.target.position_error_mm(arm, joints, points).max() < 0.5
    assert task.target.angle_error_rad(arm, joints, points).max() < 3e-3
    with pytest.raises(NotApplicableError, match=r"trigonometric.*6 joints move \(0 slide\)"):
        fit("trigonometric", task, truly)


def test_an_arm_that_cannot_turn_its_tool_as_asked_comes_as_near_as_it_can():
    """A SCARA stands upright; one whose axes lean a little cannot hold its tool upright."""
    task = study_task(read_study("config/studies/scara.yaml"))
    lean = np.zeros((5, 6))
    lean[0, 3] = 0.01
    arm = deviated(task.drawing, lean)
    x = region_points(task.region, 200)
    joints = followed(task.reach(x), arm)
    angle = task.target.angle_error_rad(arm, joints, x)
    np.testing.assert_allclose(angle, 0.01, rtol=0.05)
    assert task.target.position_error_mm(arm, joints, x).max() < 0.1


def test_products_are_all_of_them_and_ridge_finds_the_arms(chain, rng):
    q = rng.uniform(-1, 1, (200, 3))
    features = products(q)
    assert features.shape == (200, 27)
    a, b, c = q.T
    for own in (np.cos(a) * np.sin(b) * np.cos(c), np.sin(a), np.ones(200), np.sin(b) * np.sin(c)):
        assert np.min(np.abs(features - own[:, None]).max(axis=0)) < 1e-15
    weights = ridge(features, chain.forward_mm(q))
    fresh = rng.uniform(-1, 1, (50, 3))
    np.testing.assert_allclose(products(fresh) @ weights, chain.forward_mm(fresh), atol=1e-6)


def test_ridge_is_the_posterior_mean_at_the_likeliest_ridge(rng):
    features, truth = rng.normal(size=(12, 30)), rng.normal(size=(30, 2))
    targets = features @ truth + 0.5 * rng.normal(size=(12, 2))
    found = ridge(features, targets)

    def dual(own):  # the same in its dual form
        return features.T @ np.linalg.solve(features @ features.T + own * np.eye(12), targets)

    def evidence(own):
        matrix = features @ features.T + own * np.eye(12)
        fitness = np.sum(targets * np.linalg.solve(matrix, targets))
        return -12 * np.log(fitness) - np.linalg.slogdet(matrix)[1]

    ridges = np.linalg.norm(features, 2) ** 2 * np.logspace(-24, 1, 101)
    best = max(ridges[ridges > 1e-9], key=evidence)
    np.testing.assert_allclose(found, dual(best), atol=1e-6)


def test_trigonometric_refuses_what_it_cannot_be(study, task):
    samples = grid_samples(study, task, 3)
    held = replace(samples, joints=samples.joints * [1.0, 1.0, 0.0])
    with pytest.raises(
        NotApplicableError, match=r"trigonometric.*2 joints move.*inputs are x, y, z"
    ):
        fit("trigonometric", task, held)


@pytest.mark.slow
def test_a_fitted_drawing_says_how_far_it_may_be_off(tmp_path):
    """With 95 % confidence, over arms; other methods and paths say nothing."""
    study = parse_study(
        {
            "name": "arms",
            "arm": {"deviation_mm": 1, "deviation_rad": 0.0175, "noise_mm": 0.2},
            "samples": {"points_per_axis": [2]},
            "training": {"seeds": 60},
            "evaluation": {"cube_points": 128},
            "methods": {"fitted": {"kind": "calibrated"}, "nominal": {"kind": "nominal"}},
        }
    )
    task = study_task(study)
    samples = grid_samples(study, task, 2)
    errors = next(evaluate(study, task, samples, "fitted", tmp_path))["errors"]
    whole = errors[errors["region"] == "cube"]
    missed = int((whole["error_max_mm"] > whole["confident_mm"]).sum())
    assert missed <= binom.ppf(0.999, 60, 0.05)
    assert (whole["confident_mm"] / whole["error_max_mm"]).median() < 2
    assert errors.loc[errors["region"] != "cube", "confident_mm"].isna().all()
    nominal = next(evaluate(study, task, samples, "nominal", tmp_path))["errors"]
    assert nominal["confident_mm"].isna().all()
