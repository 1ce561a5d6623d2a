"""Whatever file it is given, iksamples reads it or refuses it in words: no traceback, no end of
memory, no code of the file run, nothing written.

Of each kind some hundreds are tried here, 10 000 by
`pytest tests/test_fuzz.py --hypothesis-profile=nightly`.
"""

import io
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import typer
import yaml
from fuzz_files import (
    Files,
    bombs,
    checkpoints,
    folder_of,
    named,
    one_spoilt,
    onnx_models,
    safetensors_files,
    study_files,
    urdfs,
)
from fuzzing import (
    MOST_LINES,
    as_json,
    changed,
    csvs,
    json_files,
    limits,
    outcome,
    parquets,
    spoilt,
    with_header,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from measured_arms import recorded, sockets
from pyarrow import parquet
from test_arm_files import MODIFIED, STANDARD
from test_lerobot import data_set, frames
from test_size_curve import curve
from test_sizing_outcomes import make_study, write_results

from iksamples.answer.answer import FILE as ANSWER
from iksamples.answer.answer import recommend
from iksamples.answer.assess import answer
from iksamples.answer.collect import FILE as RUNS
from iksamples.answer.collect import collect, outcomes, read_runs
from iksamples.answer.replication import read_replications
from iksamples.arm.drawing import drawn_urdf, shows_bodies
from iksamples.arm.load import load_arm
from iksamples.certify.readers.network import load_network
from iksamples.cli import app, main
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import networks_over_epochs
from iksamples.evaluation.paths import _table, waypoints
from iksamples.network import StackedMLP
from iksamples.paper.equations import paper_table
from iksamples.paper.readings import Reading, rank, read_parts
from iksamples.recorded.curve import read_curve
from iksamples.recorded.doubts import checked
from iksamples.recorded.learn import read_samples
from iksamples.recorded.lerobot import read_lerobot
from iksamples.recorded.read import read_recording
from iksamples.recorded.sockets import odd_postures, read_places
from iksamples.report.data import ReportData, read_benchmarks
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import grid_samples
from iksamples.study import CsvPath, Recorded, parse_study, read_study
from iksamples.task import study_task


pytestmark = pytest.mark.slow

EXAMPLES = 200
NAMES = (
    "study", "urdf", "dh.yaml", "dh.csv", "records", "records, no drawing", "records, Parquet",
    "samples", "set of samples", "sockets", "lerobot", "checkpoint", "safetensors", "weights",
    "onnx", "curve", "curve, Parquet", "waypoints", "answer", "runs", "readings", "snapshots",
    "results", "logged",
)  # fmt: skip


class Kind(NamedTuple):
    """Spoilt files by their names, and what reads them from a folder."""

    files: st.SearchStrategy[Files]
    read: Callable[[Path], object]


@cache
def task() -> Any:
    return study_task(parse_study({"name": "paper"}))


def small_study() -> Any:
    return make_study(samples={"points_per_axis": [2]}, methods={})


def certified(name: str) -> Callable[[Path], object]:
    return lambda folder: load_network(
        folder / name, (3, 3), activation=None if "onnx" in name else "tanh"
    )


# What reads them.


def read_urdf(folder: Path) -> None:
    arm = load_arm(folder / "arm.urdf")
    assert np.isfinite(arm.forward_mm(np.zeros(arm.n_joints))).all()
    drawn_urdf(arm)
    shows_bodies(folder / "arm.urdf")


def read_dh(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        arm = load_arm(folder / name)
        assert np.isfinite(arm.forward_mm(np.zeros(arm.n_joints))).all()
        drawn_urdf(arm)

    return read


def read_records(name: str, drawn: bool) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        drawing = recorded()[0] if drawn else None
        checked(read_recording(folder / name, drawing), drawing)

    return read


def lerobot(folder: Path) -> object:
    said = Recorded(path=str(folder), kind="lerobot", joint_unit="rad", tool_from_drawing=True)
    drawing = load_arm("config/robots/so101.urdf")
    return checked(read_lerobot(said, drawing), drawing)


def held(folder: Path) -> object:
    drawing = load_arm("config/robots/panda.urdf")
    return odd_postures(read_places(Recorded(path=str(folder), kind="sockets"), drawing), drawing)


def sized(name: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        study = parse_study({"name": "recorded"})
        return answer(study, outcomes(study, read_curve(folder / name)[0]))

    return read


def drawn(folder: Path) -> object:
    _table.cache_clear()
    return waypoints(CsvPath(shape="csv", file=str(folder / "way.csv")), task())


def collected(folder: Path) -> None:
    try:
        collect(small_study(), folder)
    except FileNotFoundError as error:  # which the command line tells
        raise IksamplesError(str(error)) from None


def logged(folder: Path) -> None:
    study = parse_study({"name": "paper"})
    assert isinstance(ReportData(study, folder, "", pd.DataFrame(), 0).tracking, dict)
    read_benchmarks(folder)


def kept_epochs(folder: Path) -> object:
    own: Any = SimpleNamespace(weights=[np.empty((2, 3, 3))])
    cell: Any = SimpleNamespace(folder=folder, network=own)
    return networks_over_epochs(cell, 0)


def recommended(folder: Path) -> None:
    recommend(folder)
    read_replications(folder)


@cache
def kinds() -> dict[str, Kind]:
    """Every kind of file that a command takes."""
    _, _, records = recorded(n=14)
    study = parse_study({"name": "paper"})
    runs, _ = _runs()
    kept = parse_study({"name": "s", "samples": {"recorded": {"path": "x.csv"}}})
    with tempfile.TemporaryDirectory() as scratch:
        grid_samples(study, task(), 2).save(Path(scratch) / "s.parquet")
        samples = parquet.read_table(Path(scratch) / "s.parquet")
    robots = [
        folder_of(lambda folder, v=v: data_set(folder / "set", frames(), v))
        for v in ("v2.1", "v3.0")
    ]
    holes = folder_of(lambda folder: sockets(folder / "set", places=2, postures=3))
    finished = folder_of(write_results)
    finished = {k: v for k, v in finished.items() if "grid3" not in k and "cubic" not in k}
    answered = answer(study, outcomes(study, runs))
    numbers = {"n_seeds": 2, "n_diverged": 0, "error_mean_mm": 2.5, "error_sd_mm": 0.1}
    sizes = paper_table()["n_samples"]
    search = pd.DataFrame([Reading.named().names | numbers | {"n_samples": n} for n in sizes])
    way = pd.DataFrame(
        {"x_mm": [30.0, 50, 70], "y_m": [0.03, 0.04, 0.05], "z_mm": 20.0, "pen_up": 0}
    )

    def of_set(files: Files) -> st.SearchStrategy[Files]:
        ways = {}
        for name, content in files.items():
            if name.endswith("parquet"):
                ways[name] = parquets(parquet.read_table(io.BytesIO(content)))
            elif name.endswith("json"):
                ways[name] = json_files(json.loads(content))
            elif name.endswith("csv"):
                ways[name] = spoilt(st.just(content))
        return one_spoilt(files, ways)

    return {
        "study": Kind(
            named("study.json", study_files()), lambda f: read_study(f / "study.json").digest()),
        "urdf": Kind(named("arm.urdf", urdfs()), read_urdf),
        "dh.yaml": Kind(
            named("dh.yaml", changed(st.just(yaml.safe_load(STANDARD))).map(as_json)
                  | spoilt(st.just(STANDARD.encode()))),
            read_dh("dh.yaml")),
        "dh.csv": Kind(named("dh.csv", spoilt(st.just(MODIFIED.encode()))), read_dh("dh.csv")),
        "records": Kind(named("r.csv", csvs(records)), read_records("r.csv", True)),
        "records, no drawing": Kind(named("r", csvs(records)), read_records("r", False)),
        "records, Parquet": Kind(named("r", parquets(records)), read_records("r", True)),
        "samples": Kind(
            named("s", with_header(samples) | csvs(records)),
            lambda f: read_samples(study, task(), f / "s")),
        "set of samples": Kind(
            named("samples/grid2.parquet", with_header(samples)),
            lambda f: SampleSet.load(f / "samples/grid2.parquet")),
        "sockets": Kind(of_set(holes), lambda f: held(f / "set")),
        "lerobot": Kind(st.one_of(*map(of_set, robots)), lambda f: lerobot(f / "set")),
        "checkpoint": Kind(named("net.pt", checkpoints()), certified("net.pt")),
        "safetensors": Kind(named("net", safetensors_files()), certified("net")),
        "weights": Kind(named("w", safetensors_files()), lambda f: StackedMLP.load(f / "w")),
        "onnx": Kind(onnx_models(), certified("net.onnx")),
        "curve": Kind(named("c.csv", csvs(curve(seeds=3))), sized("c.csv")),
        "curve, Parquet": Kind(named("c", parquets(curve(seeds=3))), sized("c")),
        "waypoints": Kind(named("way.csv", csvs(way)), drawn),
        "answer": Kind(
            one_spoilt({ANSWER: answered.to_json().encode(), "replication.json": b"[]"},
                       {ANSWER: json_files(json.loads(answered.to_json())),
                        "replication.json": json_files([])}),
            recommended),
        "runs": Kind(
            named(RUNS, parquets(runs)),
            lambda f: answer(kept, outcomes(kept, read_runs(kept, f)))),
        "readings": Kind(
            named("p.csv", csvs(search)), lambda f: rank(read_parts([f / "p.csv"]))),
        "snapshots": Kind(
            named("snapshots.safetensors", safetensors_files()), kept_epochs),
        "results": Kind(of_set(finished), collected),
        "logged": Kind(
            one_spoilt({}, {"tracking.json": json_files({"tracking_uri": "x", "runs": {"y": "z"}}),
                            "train.jsonl": json_files({"s": 1.5, "cpu_time": None, "max_rss": 7})}),
            logged),
    }  # fmt: skip


def _runs() -> tuple[pd.DataFrame, str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.csv"
        curve(seeds=3).to_csv(path, index=False)
        return read_curve(path)


@contextmanager
def given_files(files: Files, folder: Path) -> Iterator[Path]:
    """Some files in a folder; they are still all that is in it afterwards, and then gone."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    try:
        yield folder
        left = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        assert left == set(files)
        assert not Path("ran").exists()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("name", NAMES)
def test_every_file_is_read_or_refused_in_words(tmp_path, name):
    files, read = kinds()[name]
    came: Counter[str] = Counter()

    @settings(max_examples=max(EXAMPLES, settings.default.max_examples))
    @given(files)
    def check(some: Files) -> None:
        with given_files(some, tmp_path / "given") as folder:
            came[outcome(lambda: read(folder))] += 1

    check()
    print(f"{name}: {came.total()} files, {came['refused']} refused")  # pytest -rP shows it


def test_small_files_that_mean_to_be_large_are_read_or_refused(tmp_path):
    for content in bombs():
        with given_files({"study.json": content}, tmp_path / "given") as folder:
            outcome(lambda folder=folder: kinds()["study"].read(folder))


STUDY = "{own}/study.json"
RRR70 = "config/robots/rrr70.urdf"
CERTIFIED = f"--robot {RRR70} --box 20 20 0 80 80 60 --activation tanh"
PAPER = "config/config.yaml"
COMMANDS = {
    **{f"{words} {{}}/study.json {more}": "study" for words, more in {
        "check": "", "plan": "", "samples": "-o {out}", "train": "none -o {out}",
        "floor": "none -o {out}", "bounds": "none --folder {out}",
        "prove": "none --method network --folder {out} -o {out}", "table": "--results {out}",
        "replicate": "--results {out} -o {out}", "record": "--results {out} -o {out}",
        "report": "--results {out} -o {out}", "readings search": "--part 0 -o {out}",
        "readings confirm": "none --part 0 -o {out}",
        "readings report": "--results {out} -o {out}",
    }.items()},
    "export --results {} -o {out}": "study",
    f"evaluate {PAPER} {{}}/samples/grid2.parquet --method network --results {{out}}":
        "set of samples",
    f"map {STUDY} --results {{}}": "set of samples",
    f"collect {STUDY} --results {{}}": "results",
    "check {own}/learn.json": "records",
    "learn {own}/learn.json --results {out}": "records",
    f"next {PAPER} --samples {{own}}/s --weights {{}}/w -o {{out}}": "weights",
    f"track {PAPER} --results {{}} -o {{out}}": "runs",
    f"next {PAPER} --samples {{}}/s -o {{out}}": "samples",
    "next --robot {}/arm.urdf -o {out}": "urdf",
    "next --robot {}/dh.csv -o {out}": "dh.csv",
    "fit-arm --robot {}/arm.urdf --samples none.csv -o {out}": "urdf",
    f"fit-arm --robot {RRR70} --samples {{}}/r.csv -o {{out}}": "records",
    f"size {{}}/r.csv --robot {RRR70}": "records",
    "size {}/r": "records, no drawing",
    "size {}/set --robot config/robots/so101.urdf --joint-unit rad --tool-from-drawing": "lerobot",
    "size --curve {}/c.csv": "curve",
    f"certify --weights {{}}/net.pt {CERTIFIED}": "checkpoint",
    f"certify --weights {{}}/net {CERTIFIED}": "safetensors",
    f"certify --weights {{}}/net.onnx {CERTIFIED.rpartition(' --')[0]}": "onnx",
    "recommend --results {}": "answer",
    f"answer {PAPER} --results {{}}": "runs",
    f"report {PAPER} --results {{}} -o {{out}}": "runs",
    "readings rank {}/p.csv -o {out} --best {out}": "readings",
}  # fmt: skip


def test_no_command_that_takes_a_file_is_left_out():
    words = {"handbook", *COMMANDS}
    commands = typer.main.get_command(app).commands
    left = {name for name in commands if not any(one.split()[0] == name for one in words)}
    left |= {n for n in commands["readings"].commands if not any(f"gs {n} " in w for w in words)}
    assert not left


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_refuses_what_cannot_be_read(tmp_path, monkeypatch, words):
    """In a few lines, with an exit code, and before it has written anything."""
    files, read = kinds()[COMMANDS[words]]
    recorded = {"path": str(tmp_path / "given/r.csv")}
    learn = {"name": "r", "samples": {"recorded": recorded}, "robot": {"urdf": RRR70}}
    (tmp_path / "learn.json").write_bytes(as_json(learn))
    (tmp_path / "study.json").write_text(small_study().model_dump_json())
    grid_samples(parse_study({"name": "paper"}), task(), 3).save(tmp_path / "s")

    @settings(max_examples=settings.default.max_examples // 10)
    @given(files)
    def check(some: Files) -> None:
        with given_files(some, tmp_path / "given") as folder:
            assume(outcome(lambda: read(folder)) == "refused")
            line = words.format(folder, out=tmp_path / "out", own=tmp_path).split()
            code, said = run(monkeypatch, line)
            assert code == 2, said
            lines = said.splitlines()
            assert 1 <= len(lines) <= (MOST_LINES if COMMANDS[words] == "study" else 2), said
            assert all(one.startswith("Error: ") for one in lines), said
            assert not (tmp_path / "out").exists()

    check()


def run(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> tuple[int, str]:
    """The exit code of a command and what it says on stderr."""
    with monkeypatch.context() as patch, io.StringIO() as said:
        patch.setattr(sys, "argv", ["iksamples", *words])
        with redirect_stderr(said), redirect_stdout(io.StringIO()), limits():
            try:
                main()
            except SystemExit as end:
                return int(end.code or 0), said.getvalue()
        return 0, said.getvalue()
