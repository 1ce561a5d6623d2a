"""Recordings of a UR5e that is not its drawing, through the whole workflow: tables, runs, page."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml
from measured_arms import table_of
from mlflow import MlflowClient
from workflow_project import project_copy, snakemake


pytestmark = pytest.mark.slow

STUDIES = {
    "drawn": {
        "samples": {"recorded": {"path": "ur5e.csv", "subsets": 3}, "sizes": [8, 16, 32]},
        "methods": {kind: {"kind": kind} for kind in ("nominal", "calibrated", "residual")},
    },
    "posed": {
        "samples": {"recorded": {"path": "ur5e.parquet", "subsets": 3}, "sizes": [8, 32]},
        "methods": {"gaussian-process": {"kind": "gaussian-process"}},
        "task": {"orientation": "fixed"},
        "tolerance": {"error_mm": 1, "angle_deg": 1, "of": "mean"},
    },
}
COMMON = {
    "robot": {"urdf": "config/robots/ur5e.urdf"},
    "network": {"hidden": [8], "activation": "tanh"},
    "training": {"optimizer": "levenberg-marquardt", "epochs": 15},
    "tolerance": {"error_mm": 1, "of": "mean"},
}


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Both studies, finished: positions in a CSV with an odd row and a repeat, poses in Parquet."""
    folder = project_copy(tmp_path_factory.mktemp("recorded"))
    table, off_mm = table_of("config/robots/ur5e.urdf", 48, noise_mm=0.05)
    table.to_parquet(folder / "ur5e.parquet")
    odd = table.filter(regex="^(x|y|z)_m$|_deg$")
    odd.loc[7, "z_m"] += 0.06
    pd.concat([odd, odd.iloc[[3]]]).to_csv(folder / "ur5e.csv", index=False)
    for name, study in STUDIES.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump({"name": name} | COMMON | study))
        snakemake(folder, "--cores", "2", "--configfile", f"{name}.yaml")
    return folder, off_mm


@pytest.mark.parametrize("name", STUDIES)
def test_runs_are_what_was_judged(project, name):
    folder, _ = project
    rows = pd.read_parquet(folder / "results" / name / "judged.parquet")
    named = {"method", "design", "n_samples", "seed", "record", "failed"}
    assert set(rows.columns) == named | {"error_mm", "angle_deg", "joint_deg"}
    assert np.isfinite(rows["angle_deg"]).all() == (name == "posed")
    client = MlflowClient(f"sqlite:///{folder}/mlflow.db")
    experiment = client.get_experiment_by_name(name)
    runs = client.search_runs([experiment.experiment_id], max_results=100)
    sizes = [run for run in runs if run.data.tags["iksamples.kind"] == "size"]
    own = rows.groupby(["method", "n_samples"])
    assert {run.info.run_name for run in sizes} == {
        f"{method}, recorded{n}" for method, n in own.groups
    }
    for run in sizes:
        method, _, n = run.info.run_name.partition(", recorded")
        means = own.get_group((method, int(n))).groupby("seed")["error_mm"].mean()
        logged = run.data.metrics["workspace/error_mean_mm"]
        assert means.min() <= logged <= means.max()


def test_the_drawing_is_judged_by_the_arm(project):
    folder, off_mm = project
    rows = pd.read_parquet(folder / "results/drawn/judged.parquet")
    own = rows[rows["method"] == "nominal"].set_index("record")["error_mm"]
    np.testing.assert_allclose(own.drop(7), np.delete(off_mm, 7), rtol=1e-9)
    assert own[7] > 40


def test_what_is_odd_is_a_list_and_what_is_left_out_says_why(project):
    folder, _ = project
    about = json.loads((folder / "results/drawn/recorded.json").read_text())
    text = (folder / "reports/drawn/README.md").read_text()
    items = [line for line in text.splitlines() if line.startswith("- ")]
    assert len(items) == len(about["doubts"]) == 2
    assert "row 49 (line 50)" in items[0]
    assert "row 8 (line 9)" in items[1]
    assert set(about["left_out"]) == {"residual"}
    assert "Left out: `residual`: 6 joints and 3 measured" in text


@pytest.mark.parametrize("name", STUDIES)
def test_the_page_opens(project, browser, name):
    folder, _ = project
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    complaints, requests = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    address = (folder / f"reports/{name}/index.html").as_uri()
    page.goto(address)
    assert complaints == []
    assert [url for url in requests if not url.startswith("data:")] == [address]
    for method in ("network", *STUDIES[name]["methods"]):
        assert page.get_by_text(method, exact=True).count()
    for drawing in page.locator("main svg[role=img]").all():
        assert drawing.bounding_box()["height"] > 50
    assert page.locator("main svg[role=img]").count() == 2
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    page.set_viewport_size({"width": 390, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.close()
