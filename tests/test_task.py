"""What is learned: its spaces, and the one region that everything is over."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from iksamples.certify.step import certify_networks
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, track_paths
from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.registry import fit
from iksamples.network import StackedMLP
from iksamples.samples.record import grid_samples, record_samples, region_points
from iksamples.study import Study, parse_study, read_study
from iksamples.task import merged, study_task
from iksamples.training.module import fit as fit_seeds
from iksamples.training.module import make_engine
from iksamples.training.problem import Problem, pose_problem
from iksamples.training.record import final_network, unstack
from iksamples.training.run import train


HALF = {"lower_mm": [20, 20, 0], "upper_mm": [110, 110, 60]}
"""A workspace whose far corner the arm cannot reach."""


@pytest.fixture
def partly() -> Study:
    """A study of a workspace that the arm reaches in part."""
    return parse_study(
        {
            "name": "partly",
            "workspace": HALF,
            "samples": {"points_per_axis": [4], "unreachable": "mask"},
            "network": {"activation": "tanh"},
            "training": {"seeds": 2, "optimizer": "levenberg-marquardt", "epochs": 60},
            "evaluation": {"cube_points": 1024},
        }
    )


def test_everything_is_over_the_usable_part_of_the_workspace(partly, tmp_path):
    """Errors were measured over this part, and certificates over the box: 1.1 mm beside 300 mm."""
    task = study_task(partly)
    assert 0.5 < task.region_share < 0.95
    assert not task.region.contains(np.array(HALF["upper_mm"], float))
    for design in ("grid", "sobol", "latin", "uniform", "joints"):
        samples = record_samples(partly, task, design, 64)
        for x in (samples.x, samples.validation_x, samples.test_x):
            assert task.region.contains(x).all()
            assert task.reach(x).usable.all()
    samples = grid_samples(partly, task, 4)
    train(partly, samples, tmp_path)
    network = StackedMLP.load(tmp_path / "weights.safetensors")
    measured = cube_errors(partly.evaluation, task, network).groupby("seed")["error_mm"].max()
    proved = certify_networks(partly, task, "network", samples, network).set_index("seed")
    assert proved["verified"].all()
    assert (measured <= proved["sup_upper_mm"] + 1e-3).all()
    # The worst point of some thousand is near the worst of all.
    assert (proved["sup_lower_mm"] <= 4 * measured).all()
    worst = proved[["argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]].to_numpy(float)
    assert task.region.contains(worst).all()


def test_the_region_is_usable_and_misses_little(partly, rng):
    task = study_task(partly)
    inside = region_points(task.region, 4096)
    assert task.reach(inside).usable.all()
    spread = task.x.lower + (task.x.upper - task.x.lower) * rng.random((20_000, 3))
    usable = task.reach(spread).usable
    assert 0.85 * usable.mean() < task.region_share < usable.mean()
    assert task.region.contains(spread).mean() == pytest.approx(task.region_share, abs=0.02)


def test_a_whole_workspace_is_one_box(task):
    assert task.region.n_boxes == 1
    assert task.region_share == 1
    assert (task.region.lower_corner == task.x.lower).all()
    assert (task.region.upper_corner == task.x.upper).all()


def test_a_workspace_out_of_reach_is_refused(partly):
    settings = partly.model_dump(mode="json")
    settings["workspace"] = {"lower_mm": [300, 300, 0], "upper_mm": [400, 400, 60]}
    with pytest.raises(IksamplesError, match=r"can use no part of it; \(300, 300, 0\) mm is out"):
        study_task(parse_study(settings))


@pytest.mark.parametrize("shape", [(7, 9), (5, 4, 6), (3, 2, 3, 2)])
def test_merged_cells_are_covered_once(shape, rng):
    cells = rng.random(shape) < 0.7
    covered = np.zeros(shape, int)
    firsts, lasts = merged(cells)
    for first, last in zip(firsts, lasts, strict=True):
        covered[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] += 1
    np.testing.assert_array_equal(covered, cells)
    assert len(merged(np.ones(shape, bool))[0]) == 1


# --- units ---------------------------------------------------------------------------------------


@pytest.fixture
def sliding() -> Study:
    """A study of an arm with a joint that slides, from (x, y, z, yaw)."""
    return read_study(
        "config/studies/scara.yaml",
        changes={"training": {"seeds": 2, "optimizer": "adam", "epochs": 30}},
    )


def test_columns_carry_their_unit(task, sliding, tmp_path):
    assert task.x.columns() == ["x_mm", "y_mm", "z_mm"]
    assert task.q.columns("q_") == ["q_yaw_rad", "q_shoulder_rad", "q_elbow_rad"]
    scara = study_task(sliding)
    inputs = ["x_mm", "y_mm", "z_mm", "yaw_rad"]
    joints = ["q_joint1_rad", "q_joint2_rad", "q_joint3_mm", "q_joint4_rad"]
    samples = record_samples(sliding, scara, "grid", 16)
    samples.save(tmp_path / "samples.parquet")
    columns = pd.read_parquet(tmp_path / "samples.parquet").columns
    assert {*inputs, *joints} <= set(columns)
    exact = fit("nominal", scara, samples)
    paths = track_paths(sliding.evaluation, scara, exact)
    assert {*(f"target_{name}" for name in inputs), *joints} <= set(paths.columns)
    assert paths["error_mm"].max() < 1e-6
    assert paths["angle_deg"].max() < 1e-6
    assert -150 <= paths["q_joint3_mm"].min() < paths["q_joint3_mm"].max() <= 0


def test_lengths_weigh_like_angles_and_networks_answer_in_millimetres(sliding):
    """A training in mm is that of the same values over a power of two, bit by bit."""
    task = study_task(sliding)
    samples = record_samples(sliding, task, "sobol", 64)
    scale = samples.output_scale
    assert scale.tolist()[:2] + scale.tolist()[3:] == [1, 1, 1]
    assert np.log2(scale[2]) % 1 == 0
    assert 1 <= np.ptp(samples.joints[:, 2]) / scale[2] <= 4
    parts = ("joints", "validation_joints", "test_joints")
    angles = replace(task.q, units=("rad",) * 4)
    plain = replace(
        samples,
        joint_space=angles,
        **{name: getattr(samples, name) / scale for name in parts},
    )
    networks = []
    for one in (samples, plain):
        problem = pose_problem(sliding, one, sliding.seeds)
        engine = make_engine("fused", problem)
        networks.append(final_network(problem, one, fit_seeds(problem, engine)))
    in_mm, scaled = networks
    np.testing.assert_array_equal(in_mm.predict(samples.x), scaled.predict(samples.x) * scale)
    np.testing.assert_array_equal(in_mm.weights[-1], scaled.weights[-1] * np.float32(scale))
    np.testing.assert_array_equal(in_mm.weights[0], scaled.weights[0])


# --- sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "shape"),
    [(16, (2, 2, 2, 2)), (36, (3, 3, 2, 2)), (40, (3, 3, 2, 2)), (100, (4, 3, 3, 3))],
)
def test_a_grid_takes_the_nearest_shape_and_says_so(sliding, n, shape):
    """The longest sides are (x, y, z) = (100, 120, 100) mm; the angle comes last."""
    task = study_task(sliding)
    found = sliding.grid_shape(n)
    assert sorted(found) == sorted(shape)
    assert found[1] == max(found)
    assert found[3] == min(found)
    samples = record_samples(sliding, task, "grid", n)
    assert samples.n_samples == np.prod(shape)
    for column, m in zip(samples.x.T, found, strict=True):
        assert len(np.unique(column)) == m
    many = "x".join(map(str, found)) if len(set(found)) > 1 else str(found[0])
    assert samples.label == f"grid{many}"
    assert record_samples(sliding, task, "sobol", n).n_samples == n


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"samples": {"sizes": [16, 60, 64]}}, "60 and 64 are both nearest to a grid of 4 x 4 x 4"),
        ({"samples": {"sizes": [7]}}, "7 is less than the 8 corners"),
        ({"samples": {"sizes": [], "points_per_axis": []}}, "name at least one size"),
        ({"task": {"inputs": ["x", "y"]}}, "each of the inputs (x, y); they have 3"),
        ({"workspace": {"lower_rad": [0], "upper_rad": [1]}}, "inputs (none); they have 1"),
        ({"workspace": {"lower_rad": [0], "upper_rad": [0]}}, "upper_rad must be greater than"),
    ],
)
def test_settings_that_do_not_fit_together(settings, says):
    with pytest.raises(IksamplesError) as caught:
        parse_study({"name": "x", **settings})
    assert says in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"robot": {"limits_mm": {"yaw": [0, 1]}}}, "robot.limits_mm: no joint 'yaw' in mm; there"),
        ({"robot": {"home_rad": {"wrist": 1}}}, "robot.home_rad: no joint 'wrist' in rad; there"),
        ({"task": {"orientation": "axis"}}, "how is the tool to be turned"),
        ({"task": {"inputs": ["y", "x", "z"]}}, "name x, y and what else"),
    ],
)
def test_an_arm_that_does_not_fit_its_settings_is_named(settings, says):
    with pytest.raises(IksamplesError) as caught:
        study_task(parse_study({"name": "x", **settings}))
    assert says in str(caught.value)


# --- engines and methods of any size -------------------------------------------------------------


@pytest.mark.parametrize(
    ("engine", "n_inputs", "n_outputs"),
    [("fused", 2, 2), ("fused", 4, 4), ("fused", 6, 6), ("fused", 6, 7), ("reference", 6, 7)],
)
def test_engines_train_networks_of_any_size(engine, n_inputs, n_outputs, rng):
    x = rng.random((60, n_inputs)).astype(np.float32)
    weights = rng.normal(size=(n_inputs, n_outputs))
    y = np.sin(x @ weights).astype(np.float32)
    training = parse_study({"name": "x", "training": {"epochs": 200, "seeds": 2}}).training
    rows = np.broadcast_to(np.arange(60, dtype=np.int32), (2, 60))
    problem = Problem(
        (0, 1), (n_inputs, 12, 9, n_outputs), "tanh", x, y, np.ones(n_outputs),
        rows, rows[:, :10], rows[:, :0], training,
    )  # fmt: skip
    record = fit_seeds(problem, make_engine(engine, problem))
    first, last = record.history[0, 0], record.history[0, -1]
    assert (last < 0.2 * first).all()
    network = StackedMLP(
        *unstack(record.parameters, problem.sizes, problem.output_scale),
        "tanh", np.zeros(n_inputs), np.ones(n_inputs), (0, 1),
    )  # fmt: skip
    loss = np.mean((network.predict(x) - y) ** 2, axis=(1, 2))
    np.testing.assert_allclose(loss, last, rtol=0.2)


def test_methods_of_many_inputs(rng):
    """Grids end at four inputs, by name; methods for scattered samples go on."""
    study = read_study("config/studies/ur5e-pose.yaml")
    task = study_task(study)
    samples = record_samples(study, task, "sobol", 64)
    for kind in ("multilinear", "cubic", "polynomial"):
        with pytest.raises(NotApplicableError, match=f"{kind}: interpolates in 2 to 4 inputs, and"):
            fit(kind, task, samples)
    for kind in ("rbf", "gaussian-process"):
        answer = fit(kind, task, samples).predict(samples.x)[0]
        np.testing.assert_allclose(answer, samples.joints, atol=1e-4)
