"""Files of two runs in one folder, without their digests: told in a line or two, or of no harm."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from report_study import finished

import iksamples.files
from iksamples.cli import main
from iksamples.tracking import track as tracking
from iksamples.tracking.store import StoreError


pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PATH = {"shape": "heart", "waypoints": 20}
BASE: dict[str, Any] = {
    "name": "small",
    "paper": True,
    "samples": {"points_per_axis": [2, 3]},
    "training": {"seeds": 2, "epochs": 12, "snapshots": 2},
    "methods": {"other": {}, "cubic": {"kind": "cubic"}},
    "tolerance": {"error_mm": 100},
    "evaluation": {"cube_points": 64, "paths": {"heart": PATH}},
    "bounds": {"sup_rtol": 1, "mean_rtol": 1},
}
OTHERS: dict[str, dict[str, Any]] = {
    "seeds": {"training": {**BASE["training"], "first_seed": 7}},
    "samples": {"samples": {"points_per_axis": [2, 4]}},
    "methods": {"methods": {"table": {"kind": "multilinear"}}},
    "paths": {"evaluation": {"cube_points": 80, "paths": {"line": PATH, "heart": PATH}}},
    "waypoints": {"evaluation": {"cube_points": 64, "paths": {"heart": PATH | {"waypoints": 9}}}},
    "epochs": {"training": {**BASE["training"], "epochs": 30, "snapshots": 3}},
    "arm": {
        "robot": {
            "urdf": "config/robots/planar2r.urdf",
            "home_rad": {"shoulder": 0.3, "elbow": 1.4},
        },
        "task": {"inputs": ["x", "y"]},
        "workspace": {"lower_mm": [60, 20], "upper_mm": [120, 100]},
        "paper": False,
    },
}
R = Path("results/small")
COMMANDS = {
    **{name: f"{name} {R}/study.json --results {R}" for name in ("collect", "table", "answer")},
    "report": f"report {R}/study.json --results {R} -o reports/small",
    "record": f"record {R}/study.json --results {R} -o {R}/recordings",
    "track": f"track {R}/study.json --results {R} -o {R}/tracking.json",
    "export": f"export --results {R} -o exported",
    "recommend": f"recommend --results {R}",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """A folder with a finished study of each kind, none with digests."""
    folders = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, changes in {"base": {}, **OTHERS}.items():
            folders[name] = tmp_path_factory.mktemp(name)
            (folders[name] / "config").symlink_to(ROOT / "config")
            patch.chdir(folders[name])
            settings = BASE | changes
            finished(settings, folders[name], paper=settings["paper"])
            without_digests(folders[name])
        yield folders


def without_digests(folder: Path) -> None:
    for digest in folder.rglob(".*.sha256"):
        digest.unlink()


def run(words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    """A command's exit code and what it said of an error; a traceback is this test's failure."""
    capsys.readouterr()
    code = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["iksamples", *words.split()])
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    said = capsys.readouterr().err.splitlines()
    return code, [line for line in said if line.startswith("Error: ")]


def counterpart(other: Path, file: Path) -> Path | None:
    """The file that has the same place in another study: the same, or of its last method or set."""
    if (other / file).exists():
        return other / file
    within = other / R / "samples" if "samples" in file.parts else other / R
    every = within.rglob(f"*{file.suffix}" if "samples" in file.parts else file.name)
    same = [one for one in every if len(one.parts) == len((other / file).parts)]
    return max(same, default=None)


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("command", COMMANDS)
def test_one_file_of_another_run_is_told_or_does_no_harm(
    made: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    other: str,
) -> None:
    seen, checked = set(), iksamples.files.checked

    def noted(path: str | Path) -> Path:
        seen.add(Path(path))
        return checked(path)

    def no_store(uri: str) -> None:
        raise StoreError("no store; all that is read is read before one is asked for")

    monkeypatch.setattr(tracking, "connect", no_store)
    project = tmp_path / "project"
    shutil.copytree(made["base"], project, symlinks=True)
    monkeypatch.chdir(project)
    with pytest.MonkeyPatch.context() as patch:
        for module in [*sys.modules.values()]:
            if getattr(module, "checked", None) is checked:
                patch.setattr(module, "checked", noted)
        assert run(COMMANDS[command], capsys)[0] == (2 if command == "track" else 0)
    tried = refused = 0
    for file in sorted(file for file in seen if R in file.parents and file.exists()):
        source = counterpart(made[other], file)
        if source is None or source.read_bytes() == (made["base"] / file).read_bytes():
            continue
        without_digests(project)
        shutil.copy(source, file)
        code, said = run(COMMANDS[command], capsys)
        assert (code, len(said)) in [(0, 0), (2, 1), (2, 2)], (file, said)
        tried, refused = tried + 1, refused + ("un the study again" in " ".join(said))
        without_digests(project)
        shutil.copy(made["base"] / file, file)
        for output in ("exported", "reports"):
            shutil.rmtree(project / output, ignore_errors=True)
    print(f"{command}, {other}: {tried} files exchanged, {refused} refused")
    assert refused or command in ("export", "recommend") or other not in ("seeds", "samples")
