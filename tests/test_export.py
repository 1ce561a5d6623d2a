"""A network to take away: one function in ONNX, in C and here, and a certificate of it."""

import ctypes
import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pandas as pd
import pytest
from certificate_cases import plain_tip, points_in, random_network, turned_away

from iksamples.answer.assess import answer
from iksamples.answer.collect import FILE as RUNS_FILE
from iksamples.answer.collect import outcomes, read_runs
from iksamples.certify.proof import rounded_up
from iksamples.certify.readers.layers import fed_as, read_as
from iksamples.certify.readers.network import load_network, prove
from iksamples.columns import RUNS
from iksamples.errors import IksamplesError
from iksamples.export.forms import c_source, plain_network
from iksamples.export.write import choose, export
from iksamples.network import StackedMLP
from iksamples.results import cells
from iksamples.samples.record import grid_samples
from iksamples.study import parse_study
from iksamples.task import Space, study_task
from iksamples.tracking.track import log_network


SEEDS = (3, 4, 5)


@pytest.fixture
def results(tmp_path, rng):
    """A finished study of random networks, with errors to choose by."""
    return finished(tmp_path / "results" / "small", rng)


def finished(folder, rng, **settings):
    study = parse_study(
        {
            "name": "small",
            "samples": {"points_per_axis": [2, 3]},
            "training": {"seeds": len(SEEDS), "first_seed": SEEDS[0]},
            "methods": {"bent": {"network": {"activation": "tanh"}}},
            **settings,
        }
    )
    rows = []
    for method, activation in (("network", "relu"), ("bent", "tanh")):
        for cell, m in zip(cells(study, folder, method), (2, 3), strict=True):
            cell.folder.mkdir(parents=True)
            cell.samples_path.parent.mkdir(exist_ok=True)
            grid_samples(study, study_task(study), m).save(cell.samples_path)
            low, high = np.array(study.workspace.lower), np.array(study.workspace.upper)
            stack = random_network(rng, (3, 6, 3), activation, n=3, lower=low, upper=high)
            StackedMLP(
                stack.weights, stack.biases, activation, stack.offset, stack.scale, SEEDS
            ).save(cell.folder / "weights.safetensors")
            for k, seed in enumerate(SEEDS):
                error = 10.0 * abs(k - 1) + 30.0 / m + (method == "bent")
                row = dict.fromkeys(RUNS, np.nan) | {
                    "method": method, "design": "grid", "label": cell.label, "n_samples": m**3,
                    "n_trained": m**3, "seed": seed, "failed": "", "unproved": "",
                    "error_mean_mm": error / 2, "error_p95_mm": error, "error_p99_mm": error,
                    "error_max_mm": error, "verified": False, "region_share": 1.0, "n_points": 8200,
                }  # fmt: skip
                regions = ("workspace", *study.evaluation.paths)
                rows += [row | {"region": region} for region in regions]
    pd.DataFrame(rows).to_parquet(folder / RUNS_FILE)
    found = answer(study, outcomes(study, read_runs(study, folder)))
    (folder / "study.json").write_text(study.model_dump_json())
    (folder / "answer.json").write_text(found.to_json())
    return folder


def test_the_best_seed_of_the_largest_set_unless_asked(results):
    found = choose(results)
    assert (found.cell.method, found.cell.label, found.seed) == ("network", "grid3", 4)
    assert "measured" in found.why
    found = choose(results, "bent", "grid2", 5)
    assert (found.cell.method, found.cell.label, found.seed) == ("bent", "grid2", 5)
    np.testing.assert_array_equal(found.network.weights[0][0], found.cell.network.weights[0][2])

    runs = pd.read_parquet(results / RUNS_FILE)
    proved = {3: (40.0, True), 4: (50.0, True), 5: (np.nan, False)}
    for seed, (upper, verified) in proved.items():
        runs.loc[runs["seed"] == seed, ["sup_upper_mm", "verified"]] = [upper, verified]
    runs.to_parquet(results / RUNS_FILE)
    found = choose(results)
    assert found.seed == 3
    assert "proved" in found.why


def test_a_size_that_is_the_answer_is_taken(results):
    known = json.loads((results / "answer.json").read_text())
    bent = next(one for one in known["variants"] if one["method"] == "bent")
    bent |= {"status": "answered", "n_samples": 8}
    (results / "answer.json").write_text(json.dumps(known))
    found = choose(results)
    assert (found.cell.method, found.cell.label) == ("bent", "grid2")
    assert "8" in found.why


def test_a_method_whose_trainings_all_failed_is_not_the_best(results):
    known = json.loads((results / "answer.json").read_text())
    for one in known["variants"]:
        if one["method"] == "network":
            one["sizes"][-1]["error_best_mm"] = None  # as an infinite error is written
    (results / "answer.json").write_text(json.dumps(known))
    assert choose(results).cell.method == "bent"


def test_records_leave_no_network_to_take_away(results):
    study = json.loads((results / "study.json").read_text())
    study["samples"] |= {"designs": ["recorded"], "recorded": {"path": "r.csv"}}
    (results / "study.json").write_text(json.dumps(study))
    with pytest.raises(IksamplesError, match="small: its networks judge records"):
        choose(results)


@pytest.mark.parametrize(
    ("asked", "match"),
    [
        ({"method": "cubic"}, "no trained method 'cubic'; there are: network, bent"),
        ({"samples": "grid9"}, "no samples 'grid9'; there are grid2, grid3"),
        ({"seed": 99}, "no sound seed 99; there are 3, 4, 5"),
    ],
)
def test_what_there_is_not_is_named(results, asked, match):
    with pytest.raises(IksamplesError, match=match):
        choose(results, **asked)


def test_an_unfinished_study_has_nothing_to_take_away(tmp_path):
    with pytest.raises(IksamplesError, match="no such results folder"):
        choose(tmp_path / "nothing")


def run_onnx(path, points):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    [given], [asked] = session.get_inputs(), session.get_outputs()
    assert (given.name, asked.name) == ("position", "joints")
    return session.run(None, {given.name: points.astype(np.float32)})[0]


def compile_c(source, tmp_path):
    """The function of a C file, built with every warning an error."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    library = tmp_path / "ik.so"
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-O2"]
    subprocess.run(
        ["gcc", *flags, "-shared", "-fPIC", str(source), "-lm", "-o", str(library)], check=True
    )
    return ctypes.CDLL(str(library)).ik


def run_c(function, points, n_outputs):
    answers = []
    for point in points.astype(np.float32):
        found = np.zeros(n_outputs, np.float32)
        pointer = ctypes.POINTER(ctypes.c_float)
        function(point.ctypes.data_as(pointer), found.ctypes.data_as(pointer))
        answers.append(found)
    return np.array(answers)


@pytest.mark.parametrize("method", ["network", "bent"])
@pytest.mark.parametrize(
    ("input_unit", "output_units", "given", "asked"),
    [("mm", (), 1.0, 1.0), ("m", ("deg",), 1e-3, 180 / np.pi)],
)
def test_onnx_c_and_here_answer_the_same(
    results, rng, tmp_path, method, input_unit, output_units, given, asked
):
    choice = choose(results, method)
    certificate = export(choice, tmp_path / "out", input_unit, output_units)
    task = study_task(choice.study)
    points = points_in(rng, task.x.lower, task.x.upper, 200)
    expected = choice.network.predict(points)[0] * asked
    size = np.abs(expected).max()
    found = run_onnx(tmp_path / "out" / "ik.onnx", points * given)
    np.testing.assert_allclose(found, expected, atol=2e-5 * size)
    function = compile_c(tmp_path / "out" / "ik.c", tmp_path)
    np.testing.assert_allclose(run_c(function, points * given, 3), expected, atol=2e-5 * size)

    # What is run in float32 keeps to what is proved and allowed for.
    bound = certificate["position_error"]["upper_mm"] + certificate["position_error"]["float32_mm"]
    q = found.astype(float) / asked
    tips = plain_tip(task.drawing, q)
    assert np.linalg.norm(tips - points, axis=1).max() <= bound + 1e-3


def test_the_file_is_certified_as_the_study_was(results, tmp_path):
    """The bound of the file that was written is the bound of the network that was trained."""
    choice = choose(results)
    task = study_task(choice.study)
    certificate = export(choice, tmp_path / "out", "m", ("deg",))
    written = tmp_path / "out" / "ik.onnx"
    assert certificate == json.loads((tmp_path / "out" / "certificate.json").read_text())
    assert certificate["file_sha256"] == hashlib.sha256(written.read_bytes()).hexdigest()
    urdf = Path(choice.study.robot.urdf).read_bytes()
    assert certificate["robot"]["sha256"] == hashlib.sha256(urdf).hexdigest()
    choice.network.save(tmp_path / "one.safetensors")
    rtol = choice.study.bounds.sup_rtol
    ours = load_network(tmp_path / "one.safetensors", (3, 3))
    [direct] = prove(ours, task.drawing, task.region, task.target, rtol=rtol)["position"]
    read = load_network(
        written, (3, 3), fed=fed_as(["mm"] * 3, ["m"], None, None),
        read=read_as(["rad"] * 3, ["deg"], None, None),
    )  # fmt: skip
    [again] = prove(read, task.drawing, task.region, task.target, rtol=rtol)["position"]
    for bound in (direct.upper, again.upper):
        assert certificate["position_error"]["upper_mm"] == pytest.approx(bound, rel=1e-5)


PLANAR = {
    "robot": {
        "urdf": "config/robots/planar3r.urdf",
        "home_rad": {"shoulder": 0.2, "elbow": 0.9, "wrist": 0.4},
    },
    "task": {"inputs": ["x", "y", "yaw"], "orientation": "fixed", "reference_rpy_rad": [0, 0, 0]},
    "workspace": {
        "lower_mm": [80, 60], "upper_mm": [130, 130], "lower_rad": [1.0], "upper_rad": [1.8]
    },
}  # fmt: skip


def test_a_task_that_turns_the_tool_has_its_angle_certified_too(rng, tmp_path):
    """No joint values of the ONNX file turn the tool further away than is proved of it."""
    choice = choose(finished(tmp_path / "turned", rng, **PLANAR), "bent")
    certificate = export(choice, tmp_path / "out")
    task = study_task(choice.study)
    points = points_in(rng, task.x.lower, task.x.upper, 500)
    joints = run_onnx(tmp_path / "out" / "ik.onnx", points).astype(float)
    angle = certificate["angle_error"]
    away = np.degrees(turned_away(task.drawing, task.target, joints, points))
    assert 0.9 * angle["lower_deg"] < away.max() <= angle["upper_deg"] + angle["float32_deg"]
    most = np.array([angle["argmax"]])
    [away] = np.degrees(
        turned_away(task.drawing, task.target, choice.network.predict(most)[0], most)
    )
    assert away == pytest.approx(angle["lower_deg"], abs=1e-3)
    off = np.linalg.norm(plain_tip(task.drawing, joints)[:, :2] - points[:, :2], axis=1)
    position = certificate["position_error"]
    assert off.max() <= position["upper_mm"] + position["float32_mm"]
    assert certificate["task"]["inputs"] == ["x", "y", "yaw"]
    assert certificate["task"]["reference_rotation"] == np.eye(3).tolist()
    comment = (tmp_path / "out" / "ik.c").read_text().split("*/")[0]
    assert f"{rounded_up(angle['upper_deg'])} deg" in comment


def test_the_onnx_file_says_what_it_is(results, tmp_path):
    export(choose(results), tmp_path / "out", "m", ("deg",))
    model = onnx.load(str(tmp_path / "out" / "ik.onnx"))
    onnx.checker.check_model(model, full_check=True)
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["inputs"] == "x [m], y [m], z [m]"
    assert "[deg]" in about["outputs"]
    assert about["study"] == "small"


def test_the_same_network_is_the_same_files(results, tmp_path):
    for name in ("a", "b"):
        export(choose(results), tmp_path / name)
    for file in sorted((tmp_path / "a").iterdir()):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


@pytest.mark.parametrize(
    ("input_unit", "output_units", "match"),
    [
        ("km", (), "--input-unit"),
        ("mm", ("turns",), "--output-unit"),
        ("mm", ("m",), "no prismatic joint"),
        ("mm", ("deg", "rad"), "two units"),
    ],
)
def test_units_that_are_none_leave_nothing_behind(
    results, tmp_path, input_unit, output_units, match
):
    with pytest.raises(IksamplesError, match=match):
        export(choose(results), tmp_path / "out", input_unit, output_units)
    assert not (tmp_path / "out").exists()


def test_what_is_not_proved_is_not_written(results, tmp_path, monkeypatch):
    import iksamples.certify.checker as checker

    monkeypatch.setattr(checker._Checks, "largest", lambda *_: np.inf)
    with pytest.raises(IksamplesError, match="no bound"):
        export(choose(results), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_prismatic_joints_many_inputs_and_odd_names(rng, tmp_path):
    """C for a pose network whose joints are named to break a comment."""
    x = Space(("x", "y", "yaw"), ("mm", "mm", "rad"), np.zeros(3), np.ones(3))
    names = ("turn */ /*", "gleitet ä", "*\\\n/ int x;", "*\\\r/ ??/")
    q = Space(names, ("rad", "mm", "rad", "mm"), np.zeros(4), np.ones(4))
    stack = random_network(rng, (3, 5, 4, 4), "tanh", lower=np.zeros(3), upper=np.ones(3))
    network = plain_network(stack, x, q, "m", ["deg", "m"])
    (tmp_path / "ik.c").write_text(c_source(network, ["bound */"]), encoding="utf-8")
    function = compile_c(tmp_path / "ik.c", tmp_path)
    points = rng.uniform(-1, 1, (20, 3))
    expected = stack.predict(points)[0] * [180 / np.pi, 1e-3, 180 / np.pi, 1e-3]
    found = run_c(function, points * [1e-3, 1e-3, 1], 4)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_run_holds_the_network_as_a_model(results, tmp_path, monkeypatch):
    import mlflow

    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    client = mlflow.MlflowClient(uri)
    where = client.create_experiment("small", artifact_location=(tmp_path / "kept").as_uri())
    run = client.create_run(where).info.run_id
    log_network(client, run, results)
    folder = next((tmp_path / "kept").rglob("network"))
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    log_network(client, run, results)  # there already
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before

    model = mlflow.pyfunc.load_model(str(folder / "model"))
    assert [one.name for one in model.metadata.signature.inputs] == ["position"]
    point = np.array([[50.0, 40.0, 30.0]], np.float32)
    found = model.predict({"position": point})["joints"]
    np.testing.assert_allclose(found, choose(results).network.predict(point)[0], atol=1e-4)

    for cell in cells(choose(results).study, results):
        weights = cell.network.weights
        weights[0][:] = np.nan
        cell.network.save(cell.folder / "weights.safetensors")
    log_network(client, run, results)
    assert client.get_run(run).data.tags["iksamples.network"].startswith("none: ")
