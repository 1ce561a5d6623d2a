"""The campaign of benchmarks/faults.py on its first step, so that it stays able to find things."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


ROOT = Path(__file__).parents[1]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform != "linux" or not shutil.which("gcc"), reason="a library for Linux, by gcc"
    ),
]


def campaign(project: Path, folder: Path, only: str) -> tuple[int, list[dict]]:
    """Exit status and trials of a campaign on recording the samples."""
    command = [sys.executable, "benchmarks/faults.py", "--folder", folder, "--until", "samples"]
    done = subprocess.run([*command, "--only", only], cwd=project, capture_output=True, text=True)
    assert "trials planned" in done.stdout, done.stderr
    lines = (folder / "trials.jsonl").read_text().splitlines()
    return done.returncode, [json.loads(line) for line in lines]


def test_a_step_goes_on_after_faults_at_its_file_operations(tmp_path: Path) -> None:
    code, trials = campaign(ROOT, tmp_path, "^state|^SIGKILL/.*[05]$|/(14|54)$")
    assert {trial["name"].split("/")[0] for trial in trials} == {
        "state", "SIGKILL", "SIGTERM", "SIGINT", "EIO", "ENOSPC", "EROFS"
    }  # fmt: skip
    assert len(trials) > 20
    assert all(trial["hit"] for trial in trials)
    assert [trial for trial in trials if trial["wrong"]] == []
    assert code == 0
    left = {trial["name"]: trial.get("left") for trial in trials}
    stops = [name for name in left if name.startswith("state/")]
    assert stops == [f"state/samples/{at}" for at in range(len(stops))]
    assert len(stops) > len({left[name] for name in stops}) > 20
    # A kill leaves what the stop at the same operation does.
    kills = [name for name in left if name.startswith("SIGKILL/")]
    assert [left[name] for name in kills] == [left[f"state{name[7:]}"] for name in kills]


def test_a_writer_that_leaves_half_a_file_is_found(tmp_path: Path) -> None:
    """A copy of the project in which a file gets its name before all of it is there.

    Whoever writes reads what an earlier one left unfinished, too.
    """
    for name in ("src/iksamples", "benchmarks", "workflow", "profiles", "config"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "Snakefile", tmp_path)
    files = tmp_path / "src/iksamples/files.py"
    moved = "unfinished.replace(path)"
    assert moved in files.read_text()
    text = files.read_text().replace(moved, "path.write_bytes(unfinished.read_bytes())")
    reads = "unfinished.exists() and unfinished.read_bytes()"
    begins = "        with writing(path):\n"
    assert begins in text
    files.write_text(text.replace(begins, f"        {reads}\n{begins}"))
    code, trials = campaign(tmp_path, tmp_path / "work", "^(SIGKILL|state)/samples/4[0-4]$")
    half = [trial for trial in trials if trial["wrong"].startswith("half-written: ")]
    assert code == 1
    assert [trial["name"].split("/")[0] for trial in half] == ["SIGKILL", "state"]
    assert {trial["hit"] for trial in half} == {"write results/faults/samples/grid3.parquet"}
    used = "a leftover is used: results/faults/samples/.unfinished-grid3.parquet"
    assert used in [trial["wrong"] for trial in trials]
