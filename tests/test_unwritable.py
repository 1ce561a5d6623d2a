"""A place that takes no output is named in a line, whichever command was to write there."""

import sys
from pathlib import Path
from typing import Any

import pytest
from measured_arms import recorded
from report_study import finished

from iksamples.cli import main


pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {
    "name": "small",
    "samples": {"points_per_axis": [2]},
    "training": {"seeds": 1, "epochs": 5},
    "evaluation": {"cube_points": 64},
}
OF_A_STUDY = "results/small/study.json --results results/small -o PLACE"
COMMANDS = {
    "fit-arm": "fit-arm --robot ROBOT --samples records.csv -o PLACE",
    "parameters": "fit-arm --robot ROBOT --samples records.csv -o ok.urdf --parameters PLACE",
    "next": "next --robot ROBOT --noise-mm 0.1 --tolerance-mm 1 -o PLACE",
    "samples": "samples results/small/study.json -o PLACE",
    "handbook": "handbook -o PLACE",
    "export": "export --results results/small -o PLACE",
    **{name: f"{name} {OF_A_STUDY}" for name in ("record", "report", "track")},
    "train": "train results/small/study.json results/small/samples/grid2.parquet -o PLACE",
}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished study, records of an arm, and a file where a folder is to be."""
    folder = tmp_path_factory.mktemp("project")
    finished(SMALL, folder, paper=False)
    recorded()[2].to_csv(folder / "records.csv", index=False)
    (folder / "config").symlink_to(Path("config").resolve())
    (folder / "taken").write_text("a file where a folder is to be")
    return folder


def left(folder: Path) -> set[Path]:
    """What a command may have left; the tracking store and a lock of it are none of its outputs."""
    return {path for path in folder.rglob("*") if "mlflow" not in path.name}


@pytest.mark.parametrize(
    ("place", "why"),
    [("taken/x/y", "Not a directory"), ("/proc/no/x/y", "No such file or directory")],
)
@pytest.mark.parametrize("command", COMMANDS)
def test_it_is_said_in_a_line_and_nothing_is_left(
    project: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    place: str,
    why: str,
) -> None:
    robot = str(Path("config/robots/rrr70.urdf").resolve())
    words = COMMANDS[command].replace("PLACE", place).replace("ROBOT", robot).split()
    monkeypatch.chdir(project)
    monkeypatch.setattr(sys, "argv", ["iksamples", *words])
    before = left(project)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr().err.splitlines()
    assert len([line for line in said if not line.startswith("Note: ")]) == 1, said
    assert said[-1].startswith(f"Error: cannot write {place}")
    assert said[-1].endswith(f": {why}.")
    assert left(project) == before


@pytest.mark.parametrize(
    "words",
    [
        "-o out/urdf --parameters a.csv",
        "-o a.urdf --parameters out",
        "-o a.urdf --parameters out/../a.urdf",
    ],
)
def test_of_two_files_both_are_written_or_neither(
    project: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
) -> None:
    """A folder stands where one is to be, or they are one and the same."""
    robot = str(Path("config/robots/rrr70.urdf").resolve())
    monkeypatch.chdir(project)
    (project / "out/urdf").mkdir(parents=True, exist_ok=True)
    arguments = f"iksamples fit-arm --robot {robot} --samples records.csv {words}".split()
    monkeypatch.setattr(sys, "argv", arguments)
    before = left(project)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert left(project) == before
