"""A method that fails on some samples is a result; what stems from the machine stops its job."""

import json
import subprocess

import pandas as pd
import pytest
from lxml import html
from test_workflow import planned, project_copy, snakemake


pytestmark = pytest.mark.slow

# Radial basis functions of four inputs take five samples; of four, the system is singular.
STUDY = """
name: part
robot:
  urdf: config/robots/scara.urdf
  home_rad: {joint1: -0.6, joint2: 1.4, joint4: 0}
  home_mm: {joint3: -75}
task: {inputs: [x, y, z, yaw], orientation: fixed, reference_rpy_rad: [0, 0, 0]}
workspace: {lower_mm: [110, -60, 50], upper_mm: [210, 60, 150], lower_rad: [-1], upper_rad: [1]}
samples: {designs: [sobol], sizes: [4, 16]}
training: {epochs: 4, seeds: 2, snapshots: 2}
tolerance: {error_mm: 100, success_share: 0.5, confidence: 0.6}
bounds: {sup_rtol: 1, mean_rtol: 1}
evaluation: {cube_points: 64, paths: {heart: {shape: heart, waypoints: 20}}}
methods:
  rbf: {kind: rbf}
  gp: {kind: gaussian-process}
"""
COMMAND = ("--cores", "2", "--configfile", "part.yaml")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = project_copy(tmp_path_factory.mktemp("project"))
    (folder / "part.yaml").write_text(STUDY)
    return folder


def test_a_file_that_cannot_be_written_stops_one_job_and_the_next_run_finishes(project):
    """Of the others those go on that can, and nothing is half-written."""
    results = project / "results/part"
    in_the_way = results / "rbf/sobol16/.unfinished-cube.parquet"
    in_the_way.mkdir(parents=True)
    done = snakemake(project, *COMMAND, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    output = in_the_way.relative_to(project).with_name("cube.parquet")
    assert f"Error: cannot write {output}: Is a directory." in done.stderr
    assert (results / "network/certificates.csv").exists()
    assert (results / "recordings/heart.rrd").exists()
    assert not (results / "runs.parquet").exists()
    assert list(results.rglob(".unfinished*")) == [in_the_way]
    in_the_way.rmdir()
    snakemake(project, *COMMAND)
    assert planned(project, *COMMAND[2:]) == set()


def test_one_failed_size_of_one_method_does_not_stop_the_others(project):
    runs = pd.read_parquet(project / "results/part/runs.parquet")
    lost = runs[runs["failed"].ne("")]
    assert set(zip(lost["method"], lost["label"], strict=True)) == {("rbf", "sobol4")}
    assert lost["failed"].str.startswith("rbf: cannot interpolate sobol4").all()
    assert runs.groupby(["method", "label"]).ngroups == 6
    answer = json.loads((project / "results/part/answer.json").read_text())
    (rbf,) = (one for one in answer["variants"] if one["method"] == "rbf")
    assert [(size["n_failed"], size["n_met"], size["meets"]) for size in rbf["sizes"]] == [
        (1, 0, False), (0, 1, True)
    ]  # fmt: skip
    assert rbf["n_samples"] == 16


@pytest.mark.parametrize(
    "file", ["reports/part/index.html", "reports/part/README.md", "reports/index.html"]
)
def test_the_report_says_how_many_failed_and_why(project, file):
    text = (project / file).read_text(encoding="utf-8")
    if file.endswith("html"):
        text = html.fromstring(text).text_content()
    assert "5 of 6 combinations" in " ".join(text.split())
    if file != "reports/index.html":
        assert "cannot interpolate sobol4 (At least 5 data points" in " ".join(text.split())


def test_its_run_has_failed_and_says_why(project, command):
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{project}/mlflow.db")
    runs = client.search_runs([client.get_experiment_by_name("part").experiment_id])
    of = {run.info.run_name: run for run in runs}
    failed = {name for name, run in of.items() if run.info.status == "FAILED"}
    assert failed == {"rbf, sobol4"}
    tags = of["rbf, sobol4"].data.tags
    assert tags["iksamples.failed"].startswith("rbf: cannot interpolate sobol4")
    assert {run.info.status for run in of.values()} == {"FAILED", "FINISHED"}
    # Tracked again it is there already.
    before = len(runs)
    again = [command, "track", "results/part/study.json", "--results", "results/part"]
    subprocess.run(again, cwd=project, check=True)
    assert len(client.search_runs([runs[0].info.experiment_id])) == before
