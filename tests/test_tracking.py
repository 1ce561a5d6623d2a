"""Runs in MLflow, read back with MLflow's own client."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from iksamples.columns import CERTIFICATES
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.files import kept_file
from iksamples.network import StackedMLP
from iksamples.paper.audit import audit
from iksamples.paper.table import study_table
from iksamples.results import Cell, cells
from iksamples.samples.record import grid_samples
from iksamples.study import Study, Tracking, parse_study
from iksamples.study.section import without_password
from iksamples.task import study_task
from iksamples.tracking.content import STUDY_KEY, study_runs
from iksamples.tracking.store import Outcome, connect
from iksamples.tracking.track import DEFAULT_URI, source_tags, track, tracking_uri


pytestmark = pytest.mark.slow


os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"

ROOT = Path(__file__).parents[1]
SEEDS = (3, 4, 5)
EPOCHS = 250
RUNS = 1 + 2 + 2 * len(SEEDS)


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new SQLite store, which takes MLflow seconds to make."""
    path = tmp_path_factory.mktemp("store") / "mlflow.db"
    connect(f"sqlite:///{path}")
    return path


@pytest.fixture
def uri(empty_store: Path, tmp_path: Path) -> str:
    """An empty store of the test's own."""
    return f"sqlite:///{shutil.copy(empty_store, tmp_path / 'mlflow.db')}"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MLflow puts artifacts into the working folder."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


@pytest.fixture
def small(uri: str) -> Study:
    return parse_study(
        {
            "name": "small",
            "tracking": {"uri": uri},
            "robot": {"urdf": str(ROOT / "config/robots/rrr70.urdf")},
            "samples": {"points_per_axis": [2, 3]},
            "training": {"seeds": len(SEEDS), "first_seed": SEEDS[0], "epochs": EPOCHS},
            "evaluation": {
                "cube_points": 64,
                "paths": {
                    "rectangles": {"shape": "double_rectangle", "waypoints": 12},
                    "heart": {"shape": "heart", "waypoints": 10},
                },
            },
        }
    )


@pytest.fixture
def results(small: Study, rng: np.random.Generator, tmp_path: Path) -> list[Cell]:
    """Results of networks with random weights and invented losses."""
    made = list(cells(small, tmp_path / "results" / "small"))
    for cell, m in zip(made, small.samples.points_per_axis, strict=True):
        cell.folder.mkdir(parents=True)
        cell.samples_path.parent.mkdir(exist_ok=True)
        samples = grid_samples(small, study_task(small), m)
        samples.save(cell.samples_path)
        shapes = [(3, 5), (5, 3), (5,), (3,)]
        first, last, *biases = (
            rng.normal(size=(len(SEEDS), *shape)).astype("float32") for shape in shapes
        )
        network = StackedMLP(
            (first, last), tuple(biases), "relu", samples.offset_mm, samples.scale_mm, SEEDS
        )
        network.save(cell.folder / "weights.safetensors")
        waypoints = track_paths(small.evaluation, study_task(small), network)
        cube = cube_errors(small.evaluation, study_task(small), network)
        history = pd.DataFrame(
            {
                "seed": np.repeat(SEEDS, EPOCHS),
                "epoch": np.tile(np.arange(1, EPOCHS + 1), len(SEEDS)),
                "train_loss_rad2": rng.uniform(size=len(SEEDS) * EPOCHS),
                "validation_loss_rad2": rng.uniform(size=len(SEEDS) * EPOCHS),
            }
        )
        members = pd.DataFrame(
            {
                "seed": SEEDS,
                "n_trained": m**3,
                "epochs_run": EPOCHS,
                "diverged": False,
                "test_loss_rad2": rng.uniform(size=len(SEEDS)),
            }
        )
        tables = {
            "history": history,
            "members": members,
            "errors": summarise(waypoints, cube),
            "bounds": audit(small, samples, network, cube),
        }
        for name, table in tables.items():
            table.to_parquet(cell.folder / f"{name}.parquet")
    write_table(small, made)
    return made


def write_table(study: Study, made: list[Cell]) -> None:
    no_proofs = pd.DataFrame(columns=list(CERTIFICATES))
    study_table(study, made, no_proofs).to_csv(made[0].results / "table.csv", index=False)


def at(study: Study, uri: str | None) -> Study:
    return study.model_copy(update={"tracking": Tracking(uri=uri)})


def log(study: Study, made: list[Cell]) -> tuple[Outcome, dict]:
    manifest = made[0].results / "tracking.json"
    outcome = track(study, made, made[0].results / "table.csv", manifest)
    return outcome, json.loads(manifest.read_text())


def runs_by_key(uri: str, experiment: str = "small") -> dict:
    """Every active run of an experiment; fails where two have one key."""
    client = connect(uri)
    found = client.get_experiment_by_name(experiment)
    runs = client.search_runs([found.experiment_id], max_results=1000)
    by_key = {run.data.tags["iksamples.key"]: run for run in runs}
    assert len(by_key) == len(runs)
    return by_key


def test_a_study_is_a_tree_of_runs(small: Study, results: list[Cell], uri: str) -> None:
    outcome, manifest = log(small, results)
    runs = runs_by_key(uri)
    assert len(runs) == outcome.logged == RUNS
    assert manifest["runs"] == {key: run.info.run_id for key, run in runs.items()}
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    parent = "mlflow.parentRunId"
    assert parent not in runs[STUDY_KEY].data.tags
    for m in (2, 3):
        grid = runs[f"network/grid{m}"]
        assert grid.data.tags[parent] == runs[STUDY_KEY].info.run_id
        for seed in SEEDS:
            child = runs[f"network/grid{m}/seed{seed}"]
            assert child.data.tags[parent] == grid.info.run_id
            # MLflow filters parents and children apart from each other.
            assert child.data.params.items() >= grid.data.params.items()
            assert child.data.params["seed"] == str(seed)
    shown = {"n_samples": "27", "samples_per_axis": "3", "hidden": "16", "learning_rate": "0.001"}
    assert runs["network/grid3/seed4"].data.params.items() >= shown.items()
    assert runs[STUDY_KEY].data.tags["iksamples.study"] == small.digest()


def test_every_other_method_is_a_curve(small: Study, results: list[Cell], uri: str) -> None:
    """Beside the study's, and named as it is, so that MLflow draws them in one chart."""
    settings = small.model_dump(mode="json")
    settings["methods"] = {"wide": {"network": {"hidden": [32]}}, "table": {"kind": "multilinear"}}
    study = parse_study(settings)
    proofs = []
    for cell, factor in zip(results, (2.0, 3.0), strict=True):
        errors = cell.table("errors")
        errors = errors.assign(**{c: errors[c] * factor for c in errors if c.endswith("_mm")})
        for method, rows in (("wide", errors), ("table", errors[errors["seed"] == SEEDS[0]])):
            folder = cell.results / method / cell.label
            folder.mkdir(parents=True)
            rows.to_parquet(folder / "errors.parquet")
        members = cell.table("members")
        members.loc[0, "diverged"] = True
        members.to_parquet(cell.results / "wide" / cell.label / "members.parquet")
        key = {"method": "wide", "label": cell.label, "n_samples": cell.samples.n_samples}
        key |= {"samples_per_axis": cell.samples.points_per_axis, "verified": True}
        proofs += [{**key, "seed": s, "sup_lower_mm": 1.0, "sup_upper_mm": 9.0 + s} for s in SEEDS]
    pd.DataFrame(proofs).to_csv(results[0].results / "certificates.csv", index=False)
    log(study, results)
    runs = runs_by_key(uri)
    client = connect(uri)
    assert len(runs) == RUNS + 2
    wide, table = runs["methods/wide/grid"], runs["methods/table/grid"]
    for cell, factor, n in zip(results, (2.0, 3.0), (8, 27), strict=True):
        errors = cell.table("errors").set_index(["region", "seed"])["error_mean_mm"]
        for run, of_seeds in ((wide, SEEDS[1:]), (table, SEEDS[:1])):
            curve = client.get_metric_history(run.info.run_id, "cube_error_mean_mm")
            value = {point.step: point.value for point in curve}[n]
            assert value == pytest.approx(factor * errors["cube"][list(of_seeds)].mean())
    assert wide.data.metrics["sup_worst_mm"] == 9.0 + SEEDS[-1]
    assert "sup_worst_mm" not in table.data.metrics
    assert wide.data.params["hidden"] == "32"
    assert table.data.params["kind"] == "multilinear"
    assert runs[STUDY_KEY].data.metrics.keys() >= {"cube_error_mean_mm", "error_max_mm"}


def test_runs_name_the_commit(small: Study) -> None:
    assert "mlflow.source.git.commit" not in source_tags(small)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for call in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *call], check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    assert source_tags(small)["mlflow.source.git.commit"] == head.stdout.strip()


def test_runs_hold_what_the_tables_hold(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    runs = runs_by_key(uri)
    client = connect(uri)
    table = pd.read_csv(results[0].results / "table.csv").set_index("n_samples")
    curve = client.get_metric_history(runs[STUDY_KEY].info.run_id, "error_mean_mm")
    assert {point.step: point.value for point in curve} == dict(table["error_mean_mm"])
    for cell in results:
        grid = runs[f"network/{cell.label}"]
        row = table.loc[cell.samples.n_samples]
        for name in (
            "error_mean_mm",
            "error_sd_mm",
            "cube_error_p95_mm",
            "estimate_mm",
            "paper_error_mm",
        ):
            assert grid.data.metrics[name] == row[name]
        errors = cell.table("errors").set_index(["region", "seed"])
        assert grid.data.metrics["heart_error_mean_mm"] == pytest.approx(
            errors.loc["heart", "error_mean_mm"].mean()
        )
        bounds = cell.table("bounds").set_index("seed")
        history = cell.table("history").set_index(["seed", "epoch"])
        for seed in SEEDS:
            run = runs[f"network/{cell.label}/seed{seed}"]
            metrics = run.data.metrics
            assert metrics["error_mean_mm"] == errors.loc[("rectangles", seed), "error_mean_mm"]
            assert metrics["heart_error_max_mm"] == errors.loc[("heart", seed), "error_max_mm"]
            assert metrics["cube_error_p95_mm"] == errors.loc[("cube", seed), "error_p95_mm"]
            assert metrics["estimate_mm"] == bounds.loc[seed, "estimate_mean_mm"]
            losses = client.get_metric_history(run.info.run_id, "validation_loss_rad2")
            steps = [point.step for point in losses]
            assert steps == sorted(set(steps))
            assert (steps[0], steps[-1], len(steps)) == (1, EPOCHS, 100)
            for point in losses:
                assert point.value == history.loc[(seed, point.step), "validation_loss_rad2"]


def test_weights_and_samples_go_with_the_grid(
    small: Study, results: list[Cell], uri: str, tmp_path: Path
) -> None:
    log(small, results)
    runs = runs_by_key(uri)
    client = connect(uri)
    grid = runs["network/grid3"]
    (tmp_path / "fetched").mkdir()
    file = client.download_artifacts(
        grid.info.run_id, "weights.safetensors", str(tmp_path / "fetched")
    )
    loaded, network = StackedMLP.load(file), results[1].network
    for ours, theirs in zip(loaded.weights, network.weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    names = {item.path for item in client.list_artifacts(grid.info.run_id)}
    assert names >= {"grid3.parquet", "errors.parquet", "bounds.parquet", "history.parquet"}
    [used] = grid.inputs.dataset_inputs
    assert (used.dataset.name, used.dataset.digest) == ("grid3", results[1].samples.digest())
    study_files = {item.path for item in client.list_artifacts(runs[STUDY_KEY].info.run_id)}
    assert "table.csv" in study_files


def test_doing_it_again_changes_nothing(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    before = runs_by_key(uri)
    connect(uri).set_tag(before["network/grid2"].info.run_id, "mlflow.note.content", "my own words")
    where = before[STUDY_KEY].info.experiment_id
    connect(uri).set_experiment_tag(where, "mlflow.note.content", "my experiment")
    outcome, _ = log(small, results)
    after = runs_by_key(uri)
    assert connect(uri).get_experiment(where).tags["mlflow.note.content"] == "my experiment"
    assert (outcome.logged, outcome.kept, outcome.removed) == (0, RUNS, 0)
    assert {key: run.info.run_id for key, run in after.items()} == {
        key: run.info.run_id for key, run in before.items()
    }
    assert after["network/grid2"].data.tags["mlflow.note.content"] == "my own words"


def test_only_what_changed_is_replaced(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    before = runs_by_key(uri)
    errors = results[1].table("errors")
    errors.loc[errors["seed"] == 4, "error_mean_mm"] += 1.0
    errors.to_parquet(results[1].folder / "errors.parquet")
    write_table(small, results)
    outcome, _ = log(small, [replace(cell) for cell in results])
    after = runs_by_key(uri)
    changed = {key for key in after if after[key].info.run_id != before[key].info.run_id}
    assert changed == {STUDY_KEY, "network/grid3", "network/grid3/seed4"}
    assert outcome.removed == 3
    for seed in SEEDS:  # also those that stayed hang below the new run
        child = after[f"network/grid3/seed{seed}"]
        assert child.data.tags["mlflow.parentRunId"] == after["network/grid3"].info.run_id
    assert after["network/grid2"].data.tags["mlflow.parentRunId"] == after[STUDY_KEY].info.run_id


@pytest.mark.parametrize("calls", [1, 4, RUNS - 1])
def test_a_cut_off_logging_is_finished_by_the_next(
    small: Study, results: list[Cell], uri: str, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mlflow import MlflowClient

    whole = MlflowClient.set_terminated
    left = iter(range(calls))

    def dies(self: MlflowClient, *args: object, **kwargs: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        whole(self, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "set_terminated", dies)
        with pytest.raises(KeyboardInterrupt):
            log(small, results)
    assert not (results[0].results / "tracking.json").exists()
    half = {key: run.info for key, run in runs_by_key(uri).items()}
    assert [info.status for info in half.values()].count("RUNNING") == 1
    outcome, _ = log(small, results)
    runs = runs_by_key(uri)
    assert len(runs) == RUNS
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert (outcome.kept, outcome.removed) == (calls, 1)
    assert all(
        runs[key].info.run_id == info.run_id
        for key, info in half.items()
        if info.status == "FINISHED"
    )


def test_what_left_the_study_leaves_the_experiment(
    small: Study, results: list[Cell], uri: str
) -> None:
    log(small, results)
    client = connect(uri)
    where = client.get_experiment_by_name("small").experiment_id
    foreign = client.create_run(where, run_name="somebody's own")
    outcome, manifest = log(small, results[:1])
    assert outcome.removed == 1 + 1 + len(SEEDS)  # the study's run has one grid fewer
    active = {run.info.run_id for run in client.search_runs([where])}
    assert active == {*manifest["runs"].values(), foreign.info.run_id}


def test_two_studies_share_a_store(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    other = small.model_copy(update={"name": "other"})
    log(other, results)
    assert len(runs_by_key(uri, "small")) == len(runs_by_key(uri, "other")) == RUNS


def test_a_deleted_experiment_comes_back(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    client = connect(uri)
    client.delete_experiment(client.get_experiment_by_name("small").experiment_id)
    log(small, results)
    assert len(runs_by_key(uri)) == RUNS


def test_grids_come_before_seeds_in_the_list(small: Study, results: list[Cell], uri: str) -> None:
    """MLflow lists and charts the newest runs first."""
    log(small, results)
    newest = sorted(runs_by_key(uri).items(), key=lambda item: -item[1].info.start_time)
    keys = [key for key, _ in newest]
    assert keys[:3] == [STUDY_KEY, "network/grid2", "network/grid3"]


def test_a_diverged_seed_has_no_numbers_that_are_none(
    small: Study, results: list[Cell], uri: str
) -> None:
    [errors, members, history] = (results[0].table(t) for t in ("errors", "members", "history"))
    errors.loc[errors["seed"] == 5, ["error_mean_mm", "error_p95_mm", "error_max_mm"]] = np.nan
    members.loc[members["seed"] == 5, ["diverged", "test_loss_rad2"]] = [True, np.nan]
    history.loc[(history["seed"] == 5) & (history["epoch"] > 9), "train_loss_rad2"] = np.inf
    for name, table in (("errors", errors), ("members", members), ("history", history)):
        with kept_file(results[0].folder / f"{name}.parquet") as file:
            table.to_parquet(file)
    write_table(small, results)
    log(small, results)
    runs = runs_by_key(uri)
    lost = runs["network/grid2/seed5"]
    assert lost.data.params["diverged"] == "true"
    assert "error_mean_mm" not in lost.data.metrics
    assert all(np.isfinite(value) for run in runs.values() for value in run.data.metrics.values())
    grid = runs["network/grid2"].data.metrics
    sound = history[history["seed"] != 5].groupby("epoch")["train_loss_rad2"].mean()
    assert grid["train_loss_rad2"] == pytest.approx(sound[EPOCHS])
    assert grid["n_diverged"] == 1


def test_early_stopped_curves_end_where_they_end(small: Study, results: list[Cell]) -> None:
    history = results[0].table("history")
    history = history[(history["seed"] != 4) | (history["epoch"] <= 7)]
    with kept_file(results[0].folder / "history.parquet") as file:
        history.to_parquet(file)
    contents = {
        run.key: run for run in study_runs(small, results, results[0].results / "table.csv")
    }
    steps = {
        key: [step for name, _, step in run.metrics if name == "train_loss_rad2"]
        for key, run in contents.items()
    }
    assert steps["network/grid2/seed4"] == list(range(1, 8))
    assert len(steps["network/grid2/seed3"]) == 100


def test_which_store(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tracking_uri(study) == DEFAULT_URI
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:5000")
    assert tracking_uri(study) == "http://127.0.0.1:5000"
    assert tracking_uri(at(study, "sqlite:///mine.db")) == "sqlite:///mine.db"


def test_a_kept_study_gets_its_password_from_the_environment(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = "http://me:hush@127.0.0.1:9"
    kept = Study.model_validate_json(at(study, whole).model_dump_json())
    with pytest.raises(IksamplesError, match="Set MLFLOW_TRACKING_URI to the whole address") as no:
        tracking_uri(kept)
    assert "hush" not in str(no.value)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", whole)
    assert tracking_uri(kept) == tracking_uri(at(study, whole)) == whole


@pytest.mark.parametrize(
    "unusable",
    ["http://user:secret@127.0.0.1:9", "sqlite:////dev/null/mlflow.db", "nonsense://x", "./mlruns"],
)
def test_an_unusable_store_is_one_line(small: Study, results: list[Cell], unusable: str) -> None:
    began = time.monotonic()
    with pytest.raises(IksamplesError) as caught:
        log(at(small, unusable), results)
    message = str(caught.value)
    assert message.startswith(f"tracking.uri: cannot use {without_password(unusable)} (")
    assert "\n" not in message
    assert "secret" not in message
    assert time.monotonic() - began < 20
    assert not (results[0].results / "tracking.json").exists()


@pytest.mark.slow
def test_a_new_file_is_made_whole_or_not_at_all(small: Study, results: list[Cell]) -> None:
    # What a kill during its making leaves behind.
    Path(".unfinished-mlflow.db").mkdir()
    Path(".unfinished-mlflow.db/mlflow.db").write_bytes(b"half of a database")
    Path(".unfinished-mlflow.db/mlflow.db-journal").write_bytes(b"and its journal")
    log(at(small, None), results)
    assert {path.name for path in Path().iterdir()} == {"mlflow.db", "mlruns"}
    assert len(runs_by_key(DEFAULT_URI)) == RUNS


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """A tracking server of its own on a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = tmp_path / "server"
    folder.mkdir()
    call = [str(Path(sys.executable).with_name("mlflow")), "server", "--workers", "1"]
    call += ["--host", "127.0.0.1", "--port", str(port)]
    with (folder / "log").open("w") as output:
        # Without workers for jobs, which take long to start and to stop.
        calm = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        process = subprocess.Popen(call, cwd=folder, env=calm, stdout=output, stderr=output)
        try:
            uri = f"http://127.0.0.1:{port}"
            for _ in range(240):
                try:
                    urllib.request.urlopen(f"{uri}/health", timeout=1).close()
                    break
                except OSError:
                    assert process.poll() is None, (folder / "log").read_text()
                    time.sleep(0.5)
            yield uri
        finally:
            process.terminate()
            process.wait(30)


@pytest.mark.slow
def test_a_tracking_server_takes_them_too(
    small: Study, results: list[Cell], server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server)
    first, manifest = log(at(small, None), results)
    again, _ = log(at(small, None), results)
    assert (first.logged, again.logged, again.kept) == (RUNS, 0, RUNS)
    assert manifest["tracking_uri"] == server
    assert len(runs_by_key(server)) == RUNS
    (tmp_path / "fetched").mkdir()
    file = connect(server).download_artifacts(
        manifest["runs"]["network/grid2"], "weights.safetensors", str(tmp_path / "fetched")
    )
    assert StackedMLP.load(file).seeds == SEEDS
    assert not any(Path().iterdir())  # nothing beside the server
