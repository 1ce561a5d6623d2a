"""The whole workflow on a small study, as a user runs it, and what happens when things change."""

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tracking_server import mlflow_server
from watched_network import watch
from workflow_project import ROOT, TINY, project_copy, snakemake

from iksamples.answer.replication import read_replications
from iksamples.columns import TABLE, certificate_columns
from iksamples.evaluation.errors import send
from iksamples.evaluation.paths import waypoints
from iksamples.results import cells
from iksamples.study import read_study
from iksamples.task import study_task
from iksamples.tracking.store import connect


pytestmark = pytest.mark.slow


def planned(folder, *arguments):
    """Names of the rules a dry run would run."""
    out = snakemake(folder, "-n", "--cores", "2", *arguments).stdout
    return set() if "Nothing to be done" in out else rules_of(out)


def rules_of(out):
    """Names of the rules that a run, or a dry run, says it runs."""
    rows = out.split("Job stats:")[1].split("total")[0].splitlines()
    return {row.split()[0] for row in rows[3:] if row.strip()} - {"all"}


def contents(folder):
    """Every file and folder, what is in it and when it was written; but what is Snakemake's own."""
    return {
        str(path.relative_to(folder)): (
            path.is_file() and path.read_bytes(),
            path.stat().st_mtime_ns,
        )
        for path in folder.rglob("*")
        if ".snakemake" not in path.parts
    }


HOSTILE = """
name: hostile
title: "{x} {wildcards.study} {{y}} $(touch pwned) `touch pwned` 'q' <b> {input}"
robot: {urdf: "an {arm} here.urdf"}
samples: {points_per_axis: [2]}
methods: {METHOD: {kind: cubic}}
evaluation: {paths: {PATH: {shape: heart}}}
""".replace("METHOD", "m-" * 19 + "abc" * 7).replace("PATH", "p" * 59 + "q")


def test_what_a_study_says_is_no_pattern_of_snakemakes(tmp_path):
    folder = project_copy(tmp_path)
    (folder / "hostile.yaml").write_text(HOSTILE)
    shutil.copy(folder / "config/robots/rrr70.urdf", folder / "an {arm} here.urdf")
    rules = planned(folder, "--configfile", "hostile.yaml")
    assert {"samples", "train", "evaluate_untrained", "record", "report"} <= rules
    done = snakemake(folder, "results/hostile/samples/grid2.parquet", "--cores", "1",
                     "--configfile", "hostile.yaml")  # fmt: skip
    assert "(100%) done" in done.stderr
    assert not (folder / "pwned").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--configfile", "twice.yaml"), "twice.yaml: 'name' stands twice, on lines 1 and 2"),
        (("--configfile", "no-arm.yaml"), "robot.urdf: cannot read no.urdf (No such file"),
        (("--config", "training={'seeds': yes}"), "'training.seeds' should be a valid integer"),
        (("--config", "training={'seeds': 0}"), "'training.seeds' should be greater than"),
        (("--config", "sedes=3"), "unknown key 'sedes'; known keys here: name,"),
    ],
)
def test_a_study_is_refused_as_check_refuses_it(tmp_path, arguments, says):
    folder = project_copy(tmp_path)
    (folder / "twice.yaml").write_text("name: a\nname: b\n")
    (folder / "no-arm.yaml").write_text("name: a\nrobot: {urdf: no.urdf}\n")
    done = snakemake(folder, "-n", "--cores", "1", *arguments, check=False)
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("Error: ")
    assert says in last


def test_another_folder_uses_it_as_a_module(tmp_path):
    """As snakedeploy sets it up: a Snakefile of three lines, and a config folder beside it."""
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copy(ROOT / TINY, tmp_path / "config/config.yaml")
    (tmp_path / "Snakefile").write_text(
        'configfile: "config/config.yaml"\n'
        "module iksamples:\n"
        f"    snakefile: {str(ROOT / 'workflow/Snakefile')!r}\n"
        "    config: config\n"
        "use rule * from iksamples\n"
    )
    before = contents(tmp_path)
    assert {"train", "report"} <= planned(tmp_path)
    assert contents(tmp_path) == before
    snakemake(tmp_path, "results/tiny/samples/grid2.parquet", "--cores", "1")
    assert (tmp_path / "results/tiny/samples/grid2.parquet").exists()
    # Read as strictly as ever, and a part of a larger configuration as Snakemake gives it.
    study = (ROOT / TINY).read_text()
    (tmp_path / "config/config.yaml").write_text(f"{study}name: twice\n")
    done = snakemake(tmp_path, "-n", check=False)
    assert "'name' stands twice" in done.stderr
    (tmp_path / "config/config.yaml").write_text("arm: {name: part, training: {seeds: 4}}\n")
    snakefile = tmp_path / "Snakefile"
    snakefile.write_text(
        snakefile.read_text().replace("config: config\n", 'config: config["arm"]\n')
    )
    snakemake(tmp_path, "results/part/samples/grid2.parquet", "--cores", "1")
    assert '"seeds": 4' in (tmp_path / "results/part/study.json").read_text()


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A finished small study, whose run reached for nothing beyond this machine."""
    folder = project_copy(tmp_path_factory.mktemp("project"))
    watched = watch(tmp_path_factory.mktemp("watch"))
    done = snakemake(folder, "--cores", "2", "--configfile", TINY, base=watched.environment)
    assert watched.reached() == set()
    (folder / "last-lines.txt").write_text(done.stdout + done.stderr)
    return folder


def test_it_ends_by_saying_where_the_results_are(project):
    text = (project / "last-lines.txt").read_text()
    assert "(100%) done" in text
    for place in (
        "reports/tiny/index.html",
        "results/tiny/table.csv",
        "rerun results/tiny/recordings/heart.rrd",
        "mlflow ui",
    ):
        assert place in text


def test_table_has_the_documented_columns_and_agrees_with_the_weights(project, monkeypatch):
    table = pd.read_csv(project / "results/tiny/table.csv")
    assert list(table.columns) == list(TABLE)
    assert list(table["n_samples"]) == [8, 27]
    assert list(table["paper_error_mm"]) == [19.31, 5.31]
    study = read_study(project / "results/tiny/study.json")
    path = waypoints(study.evaluation.paths["rectangles"], study_task(study)).x
    for row, cell in zip(table.itertuples(), cells(study, project / "results/tiny"), strict=True):
        means = send(cell.network, study_task(study), path).error_mm.mean(axis=1)
        assert row.error_mean_mm == pytest.approx(means.mean())
        assert row.error_sd_mm == pytest.approx(means.std(ddof=1))
        assert row.error_over_spacing == pytest.approx(
            means.mean() / (60 / (row.samples_per_axis - 1))
        )


@pytest.mark.filterwarnings("ignore:starlette.middleware.wsgi")
def test_a_run_ends_without_its_server_and_one_command_logs_it_later(project, tmp_path):
    folder = tmp_path / "project"
    shutil.copytree(project, folder)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = f"tracking={{'uri': 'http://127.0.0.1:{port}'}}"
    done = snakemake(folder, "--cores", "2", "--configfile", TINY, "--config", server)
    assert "(100%) done" in done.stderr
    manifest = json.loads((folder / "results/tiny/tracking.json").read_text())
    last = done.stderr.split("tiny: done.")[1]
    assert f"Not logged  {manifest['reason']}" in last
    assert f"Log it later by\n              {manifest['command']}\n" in last
    command = shlex.split(manifest["command"])
    command[0] = str(Path(sys.executable).with_name(command[0]))
    report = ["report", "results/tiny/study.json", "--results", "results/tiny", "-o", "later"]
    subprocess.run([command[0], *report], cwd=folder, check=True)
    assert manifest["command"] in (folder / "later/README.md").read_text()
    assert subprocess.run(command, cwd=folder, capture_output=True).returncode == 2  # still down
    with mlflow_server(tmp_path, f"sqlite:///{tmp_path}/served.db", port) as running:
        for _ in range(2):  # which changes nothing the second time
            subprocess.run(command, cwd=folder, check=True)
        client = connect(running.uri)
        [found] = [one for one in client.search_experiments() if one.name == "tiny"]
        runs = client.search_runs([found.experiment_id])
        assert {run.info.status for run in runs} == {"FINISHED"}
        logged = json.loads((folder / "results/tiny/tracking.json").read_text())["runs"]
        assert sorted(logged.values()) == sorted(run.info.run_id for run in runs)
        assert {"network", "network, grid2", "network, grid3"} <= logged.keys()
    subprocess.run([command[0], *report], cwd=folder, check=True)
    assert running.uri in (folder / "later/README.md").read_text()


def test_a_finished_study_has_nothing_to_be_done(project):
    done = snakemake(project, "-n", "--cores", "2", "--configfile", TINY)
    assert "Nothing to be done" in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("change", "rules"),
    [
        (
            "evaluation={'cube_points': 300}",
            {"evaluate", "bounds", "map", "collect", "table", "answer"},
        ),
        ("title='{x} anew'", set()),
        ("bounds={'average_weight': 'rms'}", {"bounds", "table"}),
        (
            "training={'seeds': 4}",
            {"train", "evaluate", "bounds", "prove", "map", "collect", "table", "answer"},
        ),
    ],
)
def test_a_change_runs_the_steps_it_affects(project, change, rules):
    later = {"track", "record", "report"}
    plan = planned(project, "--configfile", TINY, "--config", change)
    assert plan - later == rules
    assert {"track", "report"} <= plan


def test_a_password_is_in_no_file_and_on_no_console(project, tmp_path):
    folder = tmp_path / "secret"
    shutil.copytree(project, folder)
    command = ("--cores", "2", "--configfile", TINY)
    done = snakemake(folder, *command, "--config",
                     "tracking={'uri': 'http://me:hush@127.0.0.1:9'}")  # fmt: skip
    assert "tracking.uri: cannot use http://me:***@127.0.0.1:9 (" in done.stderr
    assert "hush" not in done.stdout + done.stderr
    # All else is done, and the end says what logs the study later; so does the next run.
    last = done.stderr[done.stderr.index("tiny: done.") :]
    assert "  iksamples track results/tiny/study.json --results results/tiny\n" in last
    assert "127.0.0.1:9" in (folder / "results/tiny/study.json").read_text()
    for file in folder.rglob("*"):
        assert not file.is_file() or b"hush" not in file.read_bytes(), file
    assert "track" in planned(folder, *command)


def cut(file):
    """As after a full disk, or a hand."""
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def flip(file):
    """One bit, as a failing disk flips it."""
    content = bytearray(file.read_bytes())
    content[-40] ^= 1
    file.write_bytes(content)


def test_a_dry_run_changes_nothing(project, tmp_path):
    fresh, folder = project_copy(tmp_path / "fresh"), tmp_path / "finished"
    shutil.copytree(project, folder)
    makers = {
        "results/tiny/samples/grid2.parquet": "samples",
        "results/tiny/network/grid3/weights.safetensors": "train",
        "results/tiny/network/certificates.csv": "prove",
        "results/tiny/answer.json": "answer",
        "results/tiny/recordings/heart.rrd": "record",
        "reports/tiny/index.html": "report",
    }
    command = ("--cores", "2", "--configfile", TINY)
    for place in (fresh, folder):
        before = contents(place)
        planned(place, *command)
        assert contents(place) == before
    kept = {
        file.suffix for file in folder.rglob("*") if file.with_name(f".{file.name}.sha256").exists()
    }
    assert kept - {"", ".md"} == {Path(file).suffix for file in makers}
    for file in makers:
        cut(folder / file)
    # Nor is forgotten what an earlier run could not log.
    (folder / "results/tiny/tracking.json").write_text('{"command": "iksamples track"}')
    before = contents(folder)
    assert planned(folder, *command) >= {*makers.values(), "track"}
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        (flip, "results/tiny/network/grid3/weights.safetensors"),
        (cut, "results/tiny/network/grid2/errors.parquet"),
        (cut, "results/tiny/certificates.csv"),
        (flip, "results/tiny/samples-needed.csv"),  # which no job reads
        (cut, "reports/tiny/README.md"),
    ],
)
def test_what_was_damaged_is_noticed_and_made_again(project, tmp_path, damage, file):
    folder = tmp_path / "damaged"
    shutil.copytree(project, folder)
    damaged = folder / file
    before, times = damaged.read_bytes(), damaged.stat()
    damage(damaged)
    os.utime(damaged, ns=(times.st_atime_ns, times.st_mtime_ns))  # a disk changes no times
    target = "results/tiny/answer.json"
    asked = (target, file, "--cores", "2", "--configfile", TINY)
    plan = planned(folder, *asked)
    done = snakemake(folder, *asked)
    assert rules_of(done.stderr) == plan
    assert f"{file}: not as it was written (SHA-256); a run makes it again." in done.stderr
    assert damaged.read_bytes() == before
    assert (folder / target).read_bytes() == (project / target).read_bytes()


@pytest.mark.parametrize("damage", [cut, Path.unlink])
def test_a_report_with_a_damaged_or_lost_figure_is_made_again(project, tmp_path, damage):
    folder = tmp_path / "damaged"
    shutil.copytree(project, folder)
    figures = folder / "reports/tiny/figures"
    before = {file.name: file.read_bytes() for file in figures.iterdir()}
    damage(figures / "arm.png")
    done = snakemake(folder, "--cores", "2", "--configfile", TINY)
    assert "reports/tiny/figures: not as it was written (SHA-256)" in done.stderr
    assert {file.name: file.read_bytes() for file in figures.iterdir()} == before
    assert planned(folder, "--configfile", TINY) == set()


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
def test_what_is_no_rules_output_is_made_again_as_well(project, tmp_path, damage):
    folder = tmp_path / "damaged"
    shutil.copytree(project, folder)
    files = [folder / "reports/index.html", folder / "results/tiny/study.json"]
    before = [file.read_bytes() for file in files]
    for file in files:
        damage(file)
    snakemake(folder, "--cores", "2", "--configfile", TINY)
    assert [file.read_bytes() for file in files] == before
    assert planned(folder, "--configfile", TINY) == set()


@pytest.mark.parametrize(
    "file",
    ["network/grid2/weights.safetensors", "network/grid3/errors.parquet", "certificates.csv"],
)
def test_what_was_removed_is_made_again(project, tmp_path, file):
    folder = tmp_path / "removed"
    shutil.copytree(project, folder)
    before = (folder / "results/tiny" / file).read_bytes()
    (folder / "results/tiny" / file).unlink()
    snakemake(folder, f"results/tiny/{file}", "--cores", "2", "--configfile", TINY)
    assert (folder / "results/tiny" / file).read_bytes() == before


def test_a_new_grid_trains_only_itself(project, tmp_path):
    folder = tmp_path / "more"
    shutil.copytree(project, folder)
    before = (folder / "results/tiny/network/grid3/weights.safetensors").read_bytes()
    done = snakemake(
        folder, "results/tiny/table.csv", "--cores", "2", "--configfile", TINY,
        "--config", "samples={'points_per_axis': [2, 3, 4]}",
    )  # fmt: skip
    said = {line.split(":")[0]: line for line in done.stderr.splitlines() if "seeds" in line}
    assert "nothing new" in said["network/grid2"]
    assert "nothing new" in said["network/grid3"]
    assert "nothing new" not in said["network/grid4"]
    assert (folder / "results/tiny/network/grid3/weights.safetensors").read_bytes() == before


def test_two_studies_do_not_touch_each_other(project, tmp_path):
    folder = tmp_path / "two"
    shutil.copytree(project, folder)
    before = {p: p.read_bytes() for p in (folder / "results/tiny").rglob("*") if p.is_file()}
    text = (ROOT / TINY).read_text().replace("name: tiny", "name: other")
    (folder / "other.yaml").write_text(text)
    snakemake(folder, "results/other/table.csv", "--cores", "2", "--configfile", "other.yaml")
    assert {
        p: p.read_bytes() for p in (folder / "results/tiny").rglob("*") if p.is_file()
    } == before
    # The same settings under another name: the same numbers.
    for name in ("table.csv", "network/grid3/weights.safetensors"):
        one, other = (folder / "results" / study / name for study in ("tiny", "other"))
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("after_s", [4.0, 8.0])
def test_a_killed_run_goes_on_when_typed_again_with_the_same_numbers(project, tmp_path, after_s):
    folder = project_copy(tmp_path / "killed")
    arguments = ("results/tiny/table.csv", "--cores", "2", "--configfile", TINY)
    process = subprocess.Popen(
        [str(Path(sys.executable).with_name("snakemake")), *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    time.sleep(after_s)
    assert process.poll() is None, "finished before it could be killed"
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    snakemake(folder, *arguments)
    for name in ("table.csv", "network/grid2/weights.safetensors"):
        assert (folder / "results/tiny" / name).read_bytes() == (
            project / "results/tiny" / name
        ).read_bytes()


def test_several_designs_and_fresh_seeds(tmp_path):
    """Samples without a spacing come first; the answer is checked; the order of designs matters."""
    folder = project_copy(tmp_path / "designs")
    settings = {
        "samples": {"designs": ["sobol", "grid"], "points_per_axis": [2, 3]},
        "training": {"epochs": 300, "seeds": 6, "snapshots": 6},
        "tolerance": {"error_mm": 150, "success_share": 0.5},
        "replication": {"seeds": 7},
    }
    changes = [f"{key}={value}" for key, value in settings.items()]
    command = ("--cores", "2", "--configfile", TINY, "--config", *changes)
    snakemake(folder, *command)
    report = (folder / "reports/tiny/README.md").read_text(encoding="utf-8")
    assert "nan" not in report.lower()
    assert "Error over spacing" not in report
    assert "Samples placed" in report
    checks = read_replications(folder / "results/tiny")
    assert {check.design for check in checks} == {"sobol", "grid"}
    assert all(check.at.n_seeds == 7 for check in checks)
    assert ("fresh trainings?" in report) == bool(checks)
    assert planned(folder, *command[2:]) == set()
    turned = [change.replace("['sobol', 'grid']", "['grid', 'sobol']") for change in changes]
    assert {"table", "answer", "report"} <= planned(folder, *command[2:5], *turned)


def test_a_bad_study_starts_no_job(tmp_path):
    folder = project_copy(tmp_path / "bad")
    (folder / "bad.yaml").write_text("name: bad\ntraining: {epochs: many}\n")
    done = snakemake(folder, "--cores", "2", "--configfile", "bad.yaml", check=False)
    assert done.returncode == 2
    assert "'training.epochs' should be a valid integer" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (folder / "results").exists()


def test_an_unreachable_workspace_ends_before_training(tmp_path):
    folder = project_copy(tmp_path / "far")
    (folder / "far.yaml").write_text(
        "name: far\nworkspace: {lower_mm: [20, 20, -10], upper_mm: [100, 100, 60]}\n"
    )
    done = snakemake(folder, "--cores", "2", "--configfile", "far.yaml", check=False)
    assert done.returncode == 1
    assert "mm is out of reach." in done.stderr
    assert "Move it, or set samples.unreachable" in done.stderr
    assert not list(folder.glob("results/far/network/*/*"))
    assert not list(folder.glob("results/far/samples/*"))


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    from filelock import FileLock

    folder = project_copy(tmp_path / "busy")
    (folder / ".snakemake").mkdir()
    with FileLock(folder / ".snakemake/iksamples.lock"):
        done = snakemake(folder, "--cores", "2", "--configfile", TINY, check=False)
    assert done.returncode == 2
    assert "another run is working in this folder" in done.stderr


def test_certificates_hold_for_what_was_measured(project):
    proofs = pd.read_csv(project / "results/tiny/certificates.csv")
    assert list(proofs.columns) == certificate_columns(["x_mm", "y_mm", "z_mm"])
    assert proofs["complete"].all()
    assert proofs["verified"].all()
    for label, rows in proofs.groupby("label"):
        errors = pd.read_parquet(project / f"results/tiny/network/{label}/errors.parquet")
        cube = errors.query("region == 'cube'").set_index("seed")
        for row in rows.itertuples():
            assert cube.loc[row.seed, "error_max_mm"] <= row.sup_upper_mm
            assert row.sup_upper_mm <= 1.0011 * row.sup_lower_mm


def test_recommend_prints_the_answer(project, command):
    done = subprocess.run(
        [command, "recommend", "--results", project / "results/tiny"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.startswith("For every point of the workspace within 2 mm")


def test_front_page_links_the_report(project):
    page = " ".join((project / "reports/index.html").read_text().split())
    assert 'href="tiny/index.html"' in page
    assert "For every point of the workspace within 2 mm" in page


def test_benchmarks_are_kept(project):
    files = list((project / "results/tiny/benchmarks").rglob("*.jsonl"))
    assert len(files) >= 8
    for file in files:
        assert np.isfinite(json.loads(file.read_text())["s"])


def test_a_recorded_study_needs_its_recording(tmp_path):
    folder = project_copy(tmp_path)
    asked = ("--configfile", "config/studies/panda-recorded.yaml")
    done = snakemake(folder, "-n", "--cores", "2", *asked, check=False)
    errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
    assert done.returncode
    assert len(errors) == 1
    assert "there is no such recording. It can be had from https://" in errors[0]
    (folder / "recordings/mukca/data/panda_2_clean").mkdir(parents=True)
    assert planned(folder, *asked) == {"learn", "size", "describe", "track"}
