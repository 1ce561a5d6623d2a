"""Runs in MLflow, read back with MLflow's own client."""

import getpass
import io
import json
import os
import shlex
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from watched_network import watch

from iksamples.answer.collect import collect
from iksamples.columns import CERTIFICATES
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.network import StackedMLP
from iksamples.paper.equations import paper_table
from iksamples.results import Cell, cells
from iksamples.samples.record import grid_samples
from iksamples.study import Study, Tracking, parse_study
from iksamples.study.sections import without_password
from iksamples.task import study_task
from iksamples.tracking.store import Outcome, connect, owner
from iksamples.tracking.track import DEFAULT_URI, source_tags, track, tracking_uri


pytestmark = pytest.mark.slow


os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"

ROOT = Path(__file__).parents[1]
SEEDS = (3, 4, 5)
EPOCHS = 250
RUNS = 1 + 1 + 2  # the paper's, the network's, its sizes'
PARENT = "mlflow.parentRunId"
ON_PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"


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
            "paper": True,
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
            (first, last), tuple(biases), "relu", samples.offset, samples.scale, SEEDS
        )
        network.save(cell.folder / "weights.safetensors")
        waypoints = track_paths(small.evaluation, study_task(small), network)
        cube = cube_errors(small.evaluation, study_task(small), network)
        history = pd.DataFrame(
            {
                "seed": np.repeat(SEEDS, EPOCHS),
                "epoch": np.tile(np.arange(1, EPOCHS + 1), len(SEEDS)),
                "train_loss": rng.uniform(size=len(SEEDS) * EPOCHS),
                "validation_loss": rng.uniform(size=len(SEEDS) * EPOCHS),
            }
        )
        members = pd.DataFrame(
            {
                "seed": SEEDS,
                "n_trained": m**3,
                "epochs_run": EPOCHS,
                "diverged": False,
                "test_loss": rng.uniform(size=len(SEEDS)),
            }
        )
        tables = {
            "history": history,
            "members": members,
            "errors": summarise(waypoints, cube),
        }
        for name, table in tables.items():
            table.to_parquet(cell.folder / f"{name}.parquet")
    no_proofs = pd.DataFrame(columns=list(CERTIFICATES))
    no_proofs.to_csv(made[0].results / "network" / "certificates.csv", index=False)
    return made


def at(study: Study, uri: str | None) -> Study:
    return study.model_copy(update={"tracking": Tracking(uri=uri)})


def log(study: Study, made: list[Cell]) -> tuple[Outcome, dict]:
    folder = made[0].results
    collect(study, folder).to_parquet(folder / "runs.parquet")
    outcome = track(study, folder, folder / "tracking.json")
    return outcome, json.loads((folder / "tracking.json").read_text())


def all_runs(uri: str, experiment: str = "small") -> list:
    """Every active run of an experiment."""
    client = connect(uri)
    found = client.get_experiment_by_name(experiment)
    return list(client.search_runs([found.experiment_id], max_results=1000))


def current(uri: str, experiment: str = "small") -> dict:
    """The current runs by name; fails where two have one name."""
    runs = [r for r in all_runs(uri, experiment) if r.data.tags["iksamples.current"] == "true"]
    by_name = {run.info.run_name: run for run in runs}
    assert len(by_name) == len(runs)
    return by_name


def change(made: list[Cell], add_mm: float) -> None:
    """Other errors of one seed on the larger grid."""
    errors = made[1].table("errors")
    errors.loc[errors["seed"] == 4, [c for c in errors if c.startswith("error_")]] += add_mm
    errors.to_parquet(made[1].folder / "errors.parquet")


def test_a_study_is_a_tree_of_runs(small: Study, results: list[Cell], uri: str) -> None:
    outcome, manifest = log(small, results)
    runs = current(uri)
    assert len(runs) == outcome.logged == RUNS
    assert manifest["runs"] == {name: run.info.run_id for name, run in runs.items()}
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert PARENT not in runs["network"].data.tags
    for m in (2, 3):
        size = runs[f"network, grid{m}"]
        assert size.data.tags[PARENT] == runs["network"].info.run_id
        # MLflow filters parents and children apart from each other.
        assert size.data.params.items() >= runs["network"].data.params.items()
    shown = {"n_samples": "27", "label": "grid3", "hidden": "16", "learning_rate": "0.001"}
    assert runs["network, grid3"].data.params.items() >= shown.items()
    assert runs["network"].data.tags["iksamples.study"] == small.digest()


def test_the_papers_table_is_a_line_in_its_own_study_alone(
    small: Study, results: list[Cell], uri: str
) -> None:
    log(small, results)
    client = connect(uri)
    curve = client.get_metric_history(
        current(uri)["paper, Table 1"].info.run_id, "rectangles/error_mean_mm"
    )
    table = paper_table().set_index("n_samples")["paper_error_mm"]
    assert {point.step: point.value for point in curve} == table.to_dict()
    other = small.model_copy(update={"name": "other", "paper": False})
    log(other, results)
    assert len(current(uri, "other")) == RUNS - 1


def test_every_variant_is_a_curve(small: Study, results: list[Cell], uri: str) -> None:
    """All named alike, so that MLflow draws them in one chart."""
    settings = small.model_dump(mode="json")
    settings["methods"] = {"wide": {"network": {"hidden": [32]}}, "table": {"kind": "multilinear"}}
    study = parse_study(settings)
    proofs = []
    for cell, factor in zip(results, (2.0, 3.0), strict=True):
        folder = cell.results / "wide" / cell.label
        shutil.copytree(cell.folder, folder)
        errors = cell.table("errors")
        errors = errors.assign(**{c: errors[c] * factor for c in errors if c.endswith("_mm")})
        errors.to_parquet(folder / "errors.parquet")
        table = cell.results / "table" / cell.label
        table.mkdir(parents=True)
        alone = errors[errors["seed"] == SEEDS[0]].assign(seed=0)
        alone.to_parquet(table / "errors.parquet")
        members = cell.table("members")
        members.loc[0, "diverged"] = True
        members.to_parquet(folder / "members.parquet")
        key = {"method": "wide", "label": cell.label, "n_samples": cell.samples.n_samples}
        key |= {"complete": True, "verified": True, "mean_lower_mm": 0.0, "mean_upper_mm": 1e6}
        proofs += [{**key, "seed": s, "sup_lower_mm": 1.0, "sup_upper_mm": 1e4 + s} for s in SEEDS]
    frame = pd.DataFrame(proofs, columns=list(CERTIFICATES))
    frame.to_csv(results[0].results / "wide" / "certificates.csv", index=False)
    frame[:0].to_csv(results[0].results / "table" / "certificates.csv", index=False)
    log(study, results)
    runs = current(uri)
    client = connect(uri)
    assert len(runs) == RUNS + 2 * 3
    for cell, factor, n in zip(results, (2.0, 3.0), (8, 27), strict=True):
        errors = cell.table("errors").set_index(["region", "seed"])["error_mean_mm"]
        for name, of_seeds in (("wide", SEEDS[1:]), ("table", SEEDS[:1])):
            for region, ours in (("workspace", "cube"), ("heart", "heart")):
                curve = client.get_metric_history(runs[name].info.run_id, f"{region}/error_mean_mm")
                value = {point.step: point.value for point in curve}[n]
                assert value == pytest.approx(factor * errors[ours][list(of_seeds)].mean())
    assert runs["wide"].data.metrics["workspace/sup_worst_mm"] == 1e4 + SEEDS[-1]
    assert "workspace/sup_worst_mm" not in runs["table"].data.metrics
    assert runs["wide"].data.params["hidden"] == "32"
    assert runs["table"].data.params["kind"] == "multilinear"


def test_a_size_holds_its_seeds(
    small: Study, results: list[Cell], uri: str, tmp_path: Path
) -> None:
    log(small, results)
    client = connect(uri)
    (tmp_path / "fetched").mkdir()
    for cell in results:
        run_id = current(uri)[f"network, {cell.label}"].info.run_id
        errors = cell.table("errors").set_index(["region", "seed"])
        curve = client.get_metric_history(run_id, "seeds/heart_error_max_mm")
        assert {point.step: point.value for point in curve} == {
            seed: errors.loc[("heart", seed), "error_max_mm"] for seed in SEEDS
        }
        history = cell.table("history").groupby("epoch")["validation_loss"].mean()
        losses = client.get_metric_history(run_id, "loss/validation_loss")
        steps = [point.step for point in losses]
        assert steps == sorted(set(steps))
        assert (steps[0], steps[-1], len(steps)) == (1, EPOCHS, 100)
        for point in losses:
            assert point.value == pytest.approx(history[point.step])

        folder = str(tmp_path / "fetched")
        file = client.download_artifacts(run_id, "weights.safetensors", folder)
        for ours, theirs in zip(StackedMLP.load(file).weights, cell.network.weights, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        table = pd.read_csv(client.download_artifacts(run_id, "seeds.csv", folder))
        assert set(table["seed"]) == set(SEEDS)
        assert set(table["region"]) == {"workspace", "rectangles", "heart"}
        [used] = client.get_run(run_id).inputs.dataset_inputs
        assert (used.dataset.name, used.dataset.digest) == (cell.label, cell.samples.digest())


def test_doing_it_again_changes_nothing(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    before = current(uri)
    client = connect(uri)
    client.set_tag(before["network, grid2"].info.run_id, "mlflow.note.content", "my own words")
    where = before["network"].info.experiment_id
    client.set_experiment_tag(where, "mlflow.note.content", "my experiment")
    outcome, _ = log(small, results)
    after = current(uri)
    assert client.get_experiment(where).tags["mlflow.note.content"] == "my experiment"
    assert (outcome.logged, outcome.kept, outcome.outdated) == (0, RUNS, 0)
    assert {name: run.info.run_id for name, run in after.items()} == {
        name: run.info.run_id for name, run in before.items()
    }
    assert after["network, grid2"].data.tags["mlflow.note.content"] == "my own words"


def test_what_changed_is_another_run_and_the_older_one_stays(
    small: Study, results: list[Cell], uri: str
) -> None:
    log(small, results)
    before = current(uri)
    change(results, 1.0)
    outcome, _ = log(small, results)
    after = current(uri)
    changed = {name for name in after if after[name].info.run_id != before[name].info.run_id}
    assert changed == {"network", "network, grid3"}
    assert (outcome.logged, outcome.outdated) == (2, 2)
    for m in (2, 3):  # also the size that stayed hangs below the new run
        assert after[f"network, grid{m}"].data.tags[PARENT] == after["network"].info.run_id
    active = {run.info.run_id for run in all_runs(uri)}
    assert active == {run.info.run_id for run in [*before.values(), *after.values()]}
    change(results, -1.0)  # and back
    log(small, results)
    again = {name: run.info.run_id for name, run in current(uri).items()}
    close = {name for name, run in before.items() if again[name] == run.info.run_id}
    assert close >= {"paper, Table 1", "network, grid2"}


def test_runs_of_another_owner_are_left_alone(
    small: Study, results: list[Cell], uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two people with a study of one name on one server."""
    log(small, results)
    theirs = {run.info.run_id: dict(run.data.tags) for run in all_runs(uri)}
    ours = owner()
    monkeypatch.setattr(getpass, "getuser", lambda: "o'brien")
    assert owner() != ours
    change(results, 1.0)
    outcome, manifest = log(small, results)
    assert (outcome.logged, outcome.kept, outcome.outdated) == (RUNS, 0, 0)
    after = {run.info.run_id: dict(run.data.tags) for run in all_runs(uri)}
    assert {run_id: after[run_id] for run_id in theirs} == theirs
    assert len(after) == 2 * RUNS
    assert not set(manifest["runs"].values()) & set(theirs)
    foreign = connect(uri).create_run(manifest["experiment_id"], run_name="somebody's own")
    log(small, results)
    assert foreign.info.run_id in {run.info.run_id for run in all_runs(uri)}


def test_one_owner_per_user_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = owner()
    assert here == owner()
    monkeypatch.chdir(tmp_path)
    assert owner() != here

    def nameless() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert owner().startswith(f"{os.getuid()}-")


@pytest.mark.parametrize("calls", [1, RUNS - 1])
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
    half = current(uri)
    assert [run.info.status for run in half.values()].count("RUNNING") == 1
    outcome, _ = log(small, results)
    runs = current(uri)
    assert len(runs) == RUNS
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert outcome.kept == calls
    assert len(all_runs(uri)) == RUNS  # it went on in the run that was cut off


DIES = """
import os, sys
from pathlib import Path
from iksamples.study import Study
from iksamples.tracking.track import track

begun = []
def dies(event, arguments):
    # At whatever comes after a file among a run's was opened to be written.
    if begun:
        os._exit(9)
    if event == "open" and "/artifacts/" in str(arguments[0]) and arguments[2] & os.O_CREAT:
        begun.append(event)

sys.addaudithook(dies)
study, results = Study.model_validate_json(sys.argv[1]), Path(sys.argv[2])
track(study, results, results / "tracking.json")
"""


def test_nothing_is_left_of_a_file_that_was_cut_off(
    small: Study, results: list[Cell], empty_store: Path, tmp_path: Path
) -> None:
    collect(small, results[0].results).to_parquet(results[0].results / "runs.parquet")
    call = [sys.executable, "-c", DIES, small.model_dump_json(), str(results[0].results)]
    assert subprocess.run(call).returncode == 9
    assert [path for path in Path("mlruns").rglob("*") if path.is_file()] != []
    log(small, results)
    left = {path.name for path in Path("mlruns").rglob("*") if path.is_file()}
    shutil.rmtree("mlruns")
    log(at(small, f"sqlite:///{shutil.copy(empty_store, tmp_path / 'other.db')}"), results)
    assert left == {path.name for path in Path("mlruns").rglob("*") if path.is_file()}


def test_a_deleted_experiment_comes_back(small: Study, results: list[Cell], uri: str) -> None:
    log(small, results)
    client = connect(uri)
    client.delete_experiment(client.get_experiment_by_name("small").experiment_id)
    log(small, results)
    assert len(current(uri)) == RUNS


def test_a_diverged_seed_has_no_numbers_that_are_none(
    small: Study, results: list[Cell], uri: str
) -> None:
    [errors, members, history] = (results[0].table(t) for t in ("errors", "members", "history"))
    errors.loc[errors["seed"] == 5, ["error_mean_mm", "error_p95_mm", "error_max_mm"]] = np.nan
    members.loc[members["seed"] == 5, ["diverged", "test_loss"]] = [True, np.nan]
    history.loc[(history["seed"] == 5) & (history["epoch"] > 9), "train_loss"] = np.inf
    for name, table in (("errors", errors), ("members", members), ("history", history)):
        table.to_parquet(results[0].folder / f"{name}.parquet")
    log(small, results)
    runs = current(uri)
    assert all(np.isfinite(value) for run in runs.values() for value in run.data.metrics.values())
    size = runs["network, grid2"]
    sound = history[history["seed"] != 5].groupby("epoch")["train_loss"].mean()
    assert size.data.metrics["loss/train_loss"] == pytest.approx(sound[EPOCHS])
    assert size.data.metrics["n_failed"] == 1
    client = connect(uri)
    text = Path(client.download_artifacts(size.info.run_id, "seeds.csv")).read_text()
    table = pd.read_csv(io.StringIO(text)).set_index("seed")
    assert table.loc[5, "failed"].notna().all()
    curve = client.get_metric_history(size.info.run_id, "seeds/workspace_error_mean_mm")
    assert [point.step for point in curve] == [3, 4]


def test_runs_name_the_commit(small: Study) -> None:
    assert "mlflow.source.git.commit" not in source_tags(small)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for call in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *call], check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    assert source_tags(small)["mlflow.source.git.commit"] == head.stdout.strip()


def test_a_title_is_no_html_on_mlflows_page(small: Study, results: list[Cell], uri: str) -> None:
    log(
        small.model_copy(update={"title": "<img src=x onerror=alert(1)> [a](javascript:b)"}),
        results,
    )
    [note] = [
        one.tags["mlflow.note.content"]
        for one in connect(uri).search_experiments()
        if one.name == "small"
    ]
    assert "<img" not in note
    assert "[a](" not in note


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
    [
        "http://user:secret@127.0.0.1:9",
        "http://user:secret@[::1",
        "sqlite:////dev/null/mlflow.db",
        "postgresql://user:secret@127.0.0.1:9/x",
        "postgresql+nodriver://user:secret@127.0.0.1/x",
        "nonsense://x",
        "./mlruns",
    ],
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


@pytest.mark.parametrize("kept_nowhere", ["sqlite://", "sqlite:///:memory:", "sqlite+pysqlite://"])
def test_a_store_in_memory_is_refused(kept_nowhere: str) -> None:
    with pytest.raises(IksamplesError, match="would be gone at the end; name a file"):
        connect(kept_nowhere)


def test_a_study_tracked_twice_at_once_is_there_once(
    small: Study, results: list[Cell], uri: str, command: str
) -> None:
    folder = results[0].results
    collect(small, folder).to_parquet(folder / "runs.parquet")
    (folder / "study.json").write_text(small.model_dump_json())
    call = [command, "track", folder / "study.json", "--results", folder]
    both = [subprocess.Popen(call, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [one.communicate()[1].splitlines() for one in both]
    assert all(" s: logging the runs to sqlite:" in line for lines in said for line in lines)
    assert [one.returncode for one in both] == [0, 0]
    assert len(all_runs(uri)) == RUNS
    manifest = json.loads((folder / "tracking.json").read_text())
    assert manifest["runs"] == {name: run.info.run_id for name, run in current(uri).items()}


def test_what_cannot_be_logged_now_is_logged_later(
    small: Study, results: list[Cell], uri: str, command: str
) -> None:
    folder = results[0].results
    collect(small, folder).to_parquet(folder / "runs.parquet")
    (folder / "study.json").write_text(at(small, "http://127.0.0.1:9").model_dump_json())
    call = [command, "track", folder / "study.json", "--results", folder]
    assert subprocess.run(call, capture_output=True).returncode == 2
    done = subprocess.run([*call, "--or-later"], capture_output=True, text=True, check=True)
    manifest = json.loads((folder / "tracking.json").read_text())
    assert manifest["reason"] in done.stderr
    assert done.stderr.splitlines()[-1].strip() == manifest["command"]
    (folder / "study.json").write_text(small.model_dump_json())
    subprocess.run(
        shlex.split(manifest["command"]), check=True, env={**os.environ, "PATH": ON_PATH}
    )
    assert len(current(uri)) == RUNS


def test_what_is_waited_for_is_said_and_not_for_ever(
    small: Study, results: list[Cell], command: str
) -> None:
    """A server that takes calls and does not answer them."""
    folder = results[0].results
    collect(small, folder).to_parquet(folder / "runs.parquet")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"http://me:s3cret@127.0.0.1:{silent.getsockname()[1]}"
        (folder / "study.json").write_text(small.model_dump_json())
        environment = {**os.environ, "MLFLOW_HTTP_REQUEST_TIMEOUT": "3"}
        settings = json.loads((folder / "study.json").read_text()) | {"tracking": {"uri": uri}}
        (folder / "study.json").write_text(json.dumps(settings))
        call = [command, "track", folder / "study.json", "--results", folder]
        done = subprocess.run(call, capture_output=True, text=True, env=environment)
    shown = uri.replace("s3cret", "***")
    *waiting, last = done.stderr.splitlines()
    assert waiting
    assert all(line.endswith(f" s: logging the runs to {shown} ...") for line in waiting)
    assert last.startswith(f"Error: tracking.uri: cannot use {shown} (")
    assert done.returncode == 2


def test_a_new_file_is_made_whole_or_not_at_all(small: Study, results: list[Cell]) -> None:
    # What a kill during its making leaves behind.
    Path(".unfinished-mlflow.db").mkdir()
    Path(".unfinished-mlflow.db/mlflow.db").write_bytes(b"half of a database")
    Path(".unfinished-mlflow.db/mlflow.db-journal").write_bytes(b"and its journal")
    log(at(small, None), results)
    assert {path.name for path in Path().iterdir()} == {"mlflow.db", "mlruns"}
    # And right after it.
    Path(".unfinished-mlflow.db").mkdir()
    os.link("mlflow.db", ".unfinished-mlflow.db/mlflow.db")
    Path(".mlflow.db.lock").touch()
    log(at(small, None), results)
    assert {path.name for path in Path().iterdir()} == {"mlflow.db", "mlruns"}
    assert len(current(DEFAULT_URI)) == RUNS


FULL = """
import resource
from iksamples.tracking.store import connect, prepare
prepare()
import mlflow
resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))
connect("sqlite:///mlflow.db")
"""


def test_nothing_is_left_of_a_store_that_a_full_disk_cut_off() -> None:
    done = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True)
    assert "StoreError: tracking.uri: cannot use sqlite:///mlflow.db (" in done.stderr
    # The lock is empty, and stays for whoever waits for it.
    assert {path.name for path in Path().iterdir()} <= {".mlflow.db.lock"}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """A tracking server of its own on a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = tmp_path / "server"
    folder.mkdir()
    watched = watch(tmp_path)
    call = [str(Path(sys.executable).with_name("mlflow")), "server", "--workers", "1"]
    call += ["--host", "127.0.0.1", "--port", str(port)]
    with (folder / "log").open("w") as output:
        # As README.md and the report say it is started; without workers for jobs, which take long
        # to start and to stop.
        calm = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        environment = watched.environment | calm
        process = subprocess.Popen(call, cwd=folder, env=environment, stdout=output, stderr=output)
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
    assert watched.reached() == set()


def test_a_server_is_opened_on_the_errors_and_is_told_no_secret(
    small: Study,
    results: list[Cell],
    server: str,
    browser: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """MLflow's own page in a browser: a line per variant over n, on logarithmic axes."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.replace("//", "//user:s3cret@"))
    first, manifest = log(at(small, None), results)
    again, _ = log(at(small, None), results)
    assert (first.logged, again.logged, again.kept) == (RUNS, 0, RUNS)
    assert manifest["tracking_uri"] == server.replace("//", "//user:***@")
    assert len(current(server)) == RUNS
    (tmp_path / "fetched").mkdir()
    file = connect(server).download_artifacts(
        manifest["runs"]["network, grid2"], "weights.safetensors", str(tmp_path / "fetched")
    )
    assert StackedMLP.load(file).seeds == SEEDS
    assert not any(Path().iterdir())  # nothing beside the server
    for path in [*(tmp_path / "server").rglob("*"), *results[0].results.rglob("*")]:
        assert path.is_dir() or b"s3cret" not in path.read_bytes(), path

    page = browser.new_page(viewport={"width": 1600, "height": 1000})
    page.goto(f"{server}/{manifest['page']}")
    page.wait_for_function(
        """() => [...document.querySelectorAll(".js-plotly-plot")].filter(
            (plot) => plot.data && plot.data.length).length >= 4""",
        timeout=120_000,
    )
    charts = page.evaluate(
        """() => [...document.querySelectorAll(".js-plotly-plot")].map((plot) => ({
            axes: [plot._fullLayout.xaxis.type, plot._fullLayout.yaxis.type],
            lines: Object.fromEntries(plot.data.map((line) => [line.name, [...line.x]])),
        }))"""
    )
    assert all(chart["axes"] == ["log", "log"] for chart in charts)
    assert charts[0]["lines"] == {
        "network": [8, 27],
        "paper, Table 1": [8, 27, 64, 125, 216, 343, 512],
    }
    assert [set(chart["lines"]) for chart in charts[1:]] == [{"network"}] * (len(charts) - 1)
    page.close()
