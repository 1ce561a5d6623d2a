"""Errors measured through the forward kinematics."""

import numpy as np
import pandas as pd
import pytest
from certificate_cases import plain_answer, plain_tip, random_network, turned_away

from iksamples.cli.common import write_tables
from iksamples.errors import IksamplesError
from iksamples.evaluation import errors
from iksamples.evaluation.errors import cube_errors, evaluate, send, summarise, track_paths
from iksamples.evaluation.paths import count_waypoints, require_reachable, waypoints
from iksamples.evaluation.slices import error_slices
from iksamples.methods.predictor import Single, Stacked, in_parts
from iksamples.network import StackedMLP
from iksamples.paper.equations import audit
from iksamples.samples.record import grid_samples, region_points
from iksamples.study import CsvPath, DoubleRectangle, Heart, parse_study, read_study
from iksamples.task import study_task


def constant_network(joints, seeds=(0,)):
    """A network that answers the same joint values everywhere."""
    n = len(seeds)
    return StackedMLP(
        (np.zeros((n, 3, 4), np.float32), np.zeros((n, 4, 3), np.float32)),
        (np.zeros((n, 4), np.float32), np.broadcast_to(np.float32(joints), (n, 3)).copy()),
        "relu",
        np.zeros(3),
        np.ones(3),
        tuple(seeds),
    )


def in_plane():
    """The task of a planar arm, (x, y)."""
    return study_task(
        parse_study(
            {
                "name": "plane",
                "robot": {
                    "urdf": "config/robots/planar2r.urdf",
                    "home_rad": {"shoulder": 0.5, "elbow": 1.2},
                },
                "task": {"inputs": ["x", "y"]},
                "workspace": {"lower_mm": [60, 20], "upper_mm": [120, 80]},
            }
        )
    )


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("Singular"), ZeroDivisionError("by 0")])
def test_an_arm_whose_method_cannot_be_asked_fails_and_others_do_not(monkeypatch, error):
    methods = {"table": {"kind": "multilinear"}}
    study = parse_study({"name": "x", "evaluation": {"cube_points": 64}, "methods": methods})
    task = study_task(study)

    def fails(x):
        raise error

    def sound(x):
        return np.zeros((len(x), 3))

    monkeypatch.setattr(
        errors, "fit_each", lambda *_: Stacked([Single(sound), Single(fails)], (3, 4))
    )
    [*tables] = evaluate(study, task, grid_samples(study, task, 2), "table", None)
    found = pd.concat(one["errors"] for one in tables).set_index("seed")
    assert (found.loc[3, "failed"] == "").all()
    assert found.loc[4, "failed"].str.fullmatch(f"multilinear on grid2: {error}.").all()
    assert np.isfinite(found.loc[3, "error_max_mm"]).all()
    assert np.isinf(found.loc[4, "error_max_mm"]).all()


def test_slices_of_many_inputs_go_through_the_worst_point(rng):
    study = read_study("config/studies/scara.yaml")
    task = study_task(study)
    network = random_network(rng, (4, 6, 4), "tanh", 2, lower=task.x.lower, upper=task.x.upper)
    table = error_slices(task, network, 1, 128)
    points = region_points(task.region, 128)
    rows = [k for k, unit in enumerate(task.x.units) if unit == "mm"]

    def misses(x):
        joints = plain_answer(network, 1, x)
        position = np.linalg.norm(plain_tip(task.drawing, joints) - x[:, rows], axis=1)
        return position, np.degrees(turned_away(task.drawing, task.target, joints, x))

    worst = points[misses(points)[0].argmax()]
    pairs = []
    for _, part in table.groupby("slice", sort=False):
        x = part[task.x.columns()].to_numpy()
        held = np.flatnonzero((x == worst).all(axis=0))
        pairs.append(tuple(np.setdiff1d(range(4), held)))
        few = slice(None, None, 97)
        position, angle = misses(x[few])
        np.testing.assert_allclose(part["error_mm"].iloc[few], position)
        np.testing.assert_allclose(part["angle_deg"].iloc[few], angle, atol=1e-9)
    assert pairs == [(0, 1), (2, 3)]


def test_rectangles_run_around_both_heights(task):
    points, pen_up = waypoints(DoubleRectangle(shape="double_rectangle", waypoints=82), task)
    assert np.flatnonzero(pen_up).tolist() == [41]
    low, high = points[:41], points[41:]
    for half, height in ((low, 10), (high, 50)):
        assert set(half[:, 2]) == {height}
        np.testing.assert_array_equal(half[0], half[-1])
        steps = np.linalg.norm(np.diff(half, axis=0), axis=1)
        np.testing.assert_allclose(steps, 160 / 40)
        for corner in ((30, 30), (70, 30), (70, 70), (30, 70)):
            assert np.abs(half[:, :2] - corner).sum(axis=1).min() < 1e-9


def test_heart_closes_has_its_width_and_lies_in_its_plane(task):
    heart = Heart(shape="heart", centre_mm=(50, 50, 30), width_mm=40, tilt_rad=0.6)
    points, pen_up = waypoints(heart, task)
    assert not pen_up.any()
    np.testing.assert_allclose(points[0], points[-1], atol=1e-9)
    assert np.ptp(points[:, 0]) == pytest.approx(40, rel=1e-3)
    normal = np.array([0, -np.sin(0.6), np.cos(0.6)])
    np.testing.assert_allclose((points - [50, 50, 30]) @ normal, 0, atol=1e-9)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    np.testing.assert_allclose(middle, [50, 50, 30], atol=1e-6)


def test_default_paths_lie_in_the_cube(study, task):
    require_reachable(study, task)
    for path in study.evaluation.paths.values():
        points = waypoints(path, task).x
        assert (points > study.workspace.lower_mm).all()
        assert (points < study.workspace.upper_mm).all()


def test_a_path_out_of_reach_is_named():
    study = parse_study(
        {"name": "x", "evaluation": {"paths": {"far": {"shape": "heart", "width_mm": 400}}}}
    )
    with pytest.raises(IksamplesError, match=r"evaluation\.paths\.far: .* cannot be used"):
        require_reachable(study, study_task(study))


def test_error_is_the_distance_through_the_forward_kinematics(task):
    pose = np.radians([90, -90, -90])  # the tool is at (0, 70, 0)
    result = send(constant_network(pose), task, np.array([[0, 70, 0], [3, 74, 0], [0, 70, 12.0]]))
    np.testing.assert_allclose(result.error_mm, [[0, 5, 12]], atol=1e-5)


def test_summary_is_over_points_within_a_seed(study, chain):
    study = study.model_copy(
        update={"evaluation": study.evaluation.model_copy(update={"cube_points": 64})}
    )
    network = constant_network(np.radians([45, -60, -90]), seeds=(7, 3))
    tracked = track_paths(study.evaluation, study_task(study), network)
    cube = cube_errors(study.evaluation, study_task(study), network)
    table = summarise(tracked, cube).set_index(["region", "seed"])
    assert set(table.index) == {(r, s) for r in ("rectangles", "heart", "cube") for s in (3, 7)}
    reached = chain.forward_mm(network.predict(np.zeros((1, 3)))[0, 0])
    for region, points in (
        ("heart", waypoints(study.evaluation.paths["heart"], study_task(study)).x),
        ("cube", region_points(study_task(study).region, 64)),
    ):
        error = np.linalg.norm(points - reached, axis=1)
        row = table.loc[(region, 3)]
        assert row["error_mean_mm"] == pytest.approx(error.mean(), rel=1e-6)
        assert row["error_p95_mm"] == pytest.approx(np.percentile(error, 95), rel=1e-6)
        assert row["error_max_mm"] == pytest.approx(error.max(), rel=1e-6)
    one = tracked.query("path == 'heart' and seed == 7")
    assert len(one) == study.evaluation.paths["heart"].waypoints
    reached_mm = one[["reached_x_mm", "reached_y_mm", "reached_z_mm"]].to_numpy()
    joints = one[["q_yaw_rad", "q_shoulder_rad", "q_elbow_rad"]].to_numpy()
    np.testing.assert_allclose(chain.forward_mm(joints), reached_mm, atol=1e-9)


@pytest.mark.parametrize("sizes", [(3, 9, 3), (3, 9, 5, 3)])
def test_numbers_do_not_depend_on_how_much_is_held_at_once(sizes, rng, tmp_path, monkeypatch):
    """In one piece and in parts of seeds and points, through the files."""
    study = parse_study({"name": "x", "evaluation": {"cube_points": 100}})
    task = study_task(study)
    network = random_network(rng, sizes, "tanh", 7, lower=task.x.lower, upper=task.x.upper)
    network.save(tmp_path / "weights.safetensors")
    samples = grid_samples(study, task, 2)
    kinds = ("waypoints", "cube", "errors")

    def measured(name):
        write_tables(tmp_path / name, evaluate(study, task, samples, "network", tmp_path))
        tables = {kind: pd.read_parquet(tmp_path / name / f"{kind}.parquet") for kind in kinds}
        tables["bounds"] = pd.concat(
            [
                audit(study, samples, part, tables["cube"][tables["cube"]["seed"].isin(part.seeds)])
                for part in in_parts(network, 100, 250 if name == "parts" else 10**6)
            ],
            ignore_index=True,
        )
        return tables

    whole = measured("whole")
    for module, name, value in (
        ("evaluation.errors", "_ROWS", 1200),
        ("evaluation.errors", "_AT_ONCE", 48),
        ("network", "_POINTS", 16),
        ("network", "_NEURONS", 300),
    ):
        monkeypatch.setattr(f"iksamples.{module}.{name}", value)
    parts = measured("parts")
    assert not parts["waypoints"].equals(whole["waypoints"])  # in another order
    for kind, table in whole.items():
        keys = [key for key in ("region", "path", "seed", "waypoint", "point") if key in table]
        pd.testing.assert_frame_equal(
            parts[kind].sort_values(keys, ignore_index=True),
            table.sort_values(keys, ignore_index=True),
            check_exact=True,
        )


def test_a_point_without_an_answer_is_no_point_less(task):
    """The others alone would make a method that gives up look better than one that tries."""
    errors = pd.DataFrame({"seed": [0, 0, 1, 1], "error_mm": [1.0, np.nan, 1.0, 2.0]})
    table = summarise(errors.assign(path="heart"), errors).set_index(["region", "seed"])
    for region in ("heart", "cube"):
        assert table.loc[(region, 0), "error_max_mm"] == np.inf
        assert table.loc[(region, 0), "error_mean_mm"] == np.inf
        assert table.loc[(region, 1), "error_max_mm"] == 2


@pytest.mark.parametrize("shape", ["double_rectangle", "heart", "circle", "lemniscate", "helix"])
def test_every_path_fits_every_workspace(shape, task):
    """A path that says nothing of its size lies in the workspace, and closes but for the helix."""
    paths = {"p": {"shape": shape}}
    path = parse_study({"name": "x", "evaluation": {"paths": paths}}).evaluation.paths["p"]
    for one in (task, in_plane()):
        if shape == "helix" and len(one.x) == 2:
            with pytest.raises(IksamplesError, match="a helix needs z"):
                waypoints(path, one)
            continue
        x, pen_up = waypoints(path, one)
        assert x.shape == (path.waypoints, len(one.x))
        assert one.region.contains(x).all()
        assert np.ptp(x, axis=0)[:2].min() > 5
        for stroke in np.split(x, np.flatnonzero(pen_up)):
            assert np.allclose(stroke[0, :2], stroke[-1, :2])
            steps = np.linalg.norm(np.diff(stroke, axis=0), axis=1)
            assert steps.max() < 6


def test_waypoints_from_a_file_are_in_its_units(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("y_m, x_cm, pen_up, note\n0.03, 7, 0, a\n0.04, 8, 1, b\n")
    path = {"shape": "csv", "file": str(file)}
    study = parse_study({"name": "x", "evaluation": {"paths": {"p": path}}})
    x, pen_up = waypoints(study.evaluation.paths["p"], in_plane())
    np.testing.assert_allclose(x, [[70, 30], [80, 40]])
    assert pen_up.tolist() == [False, True]
    # As people record samples: units below the names, semicolons and decimal commas.
    other = tmp_path / "other.csv"
    other.write_text("x;y\nmm;m\n70,5;0,03\n80;0,04\n1;1\n")
    path = CsvPath(shape="csv", file=str(other))
    x, pen_up = waypoints(path, in_plane())
    np.testing.assert_allclose(x, [[70.5, 30], [80, 40], [1, 1000]])
    assert not pen_up.any()
    assert count_waypoints(path) == 3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x_mm,z_mm\n1,2\n", "no column y_mm; there are x_mm, z_mm"),
        ("x_mm,x_m,y_mm\n1,2,3\n", "the columns x_mm and x_m mean the same"),
        ("x,y\n1,2\n", "no unit is said for x, y; write it into the names"),
        ("x_mm,y_mm\n1,2\n3,up\n", r"row 2 \(line 3\) has 'up' as y_mm"),
        ("x_mm,y_mm\n1,2\n", "1 rows; at least 2 are needed"),
        ("", "the file is empty"),
    ],
)
def test_a_faulty_file_of_waypoints_is_named(tmp_path, text, says):
    file = tmp_path / "path.csv"
    file.write_text(text)
    path = {"shape": "csv", "file": str(file)}
    study = parse_study({"name": "x", "evaluation": {"paths": {"p": path}}})
    with pytest.raises(IksamplesError, match=says):
        waypoints(study.evaluation.paths["p"], in_plane())
