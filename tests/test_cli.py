"""The command line on files, as used by hand."""

import io
import json
import os
import re
import signal
import socket
import subprocess
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from measured_arms import recorded
from typer.testing import CliRunner

from iksamples import cli
from iksamples.cli import app
from iksamples.cli.common import say
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.results import cells
from iksamples.samples.record import grid_samples


BOX = ("--box", "20", "20", "0", "80", "80", "60")
ARM = ("--robot", "config/robots/rrr70.urdf")


def run(*arguments):
    return subprocess.run([*map(str, arguments)], capture_output=True, text=True)


def test_every_command_has_help(command):
    top = run(command, "--help")
    assert top.returncode == 0
    commands = top.stdout.split("Commands:")[1]
    listed = [line.split()[0] for line in commands.splitlines() if line.startswith("  ")]
    steps = {"check", "samples", "train", "evaluate", "bounds", "prove", "map", "collect",
             "table", "answer", "recommend", "replicate", "plan", "next", "track", "record",
             "report", "certify", "handbook"}  # fmt: skip
    assert steps <= set(listed)


def test_help_keeps_its_units(command):
    text = " ".join(run(command, "certify", "--help").stdout.split())
    assert "[mm; angles: rad]" in text


def test_check_says_what_the_arm_can_reach(command):
    done = run(command, "check", "config/config.yaml")
    assert done.returncode == 0
    assert "grid5: 125 samples" in done.stdout
    assert "workspace: 8200 points: 8200 usable" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("prove", "--method", "cubic", "--folder", "f"),
            "nothing can be proved of 'cubic'; there",
        ),
        (("evaluate", "--method", "none", "--results", "r"), "no method 'none'; there are network"),
        (("record", "--path", "none", "--results", "r"), "no path 'none'; there are rectangles"),
        (("table", "--results", "r"), "certificates.csv: there is no such file. Either the name"),
        (("map", "--results", "r"), "there is no such file. Either the name is wrong"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_what_is_not_there_is_named_without_a_traceback(command, tmp_path, arguments, says):
    step, *options = arguments
    samples = [tmp_path / "s"] if step in ("prove", "evaluate") else []
    output = [] if step in ("table", "map", "evaluate") else ["-o", tmp_path / "out"]
    options = [tmp_path / option if option in ("r", "f") else option for option in options]
    done = run(command, step, "config/config.yaml", *samples, *options, *output)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


PIPE_OF = {
    "study": "check PIPE",
    "arm": "certify --weights x.pt --robot PIPE --box 0 0 0 1 1 1",
    "weights": "certify --weights PIPE --robot config/robots/rrr70.urdf --box 0 0 0 1 1 1",
    "records": "size PIPE --tolerance-mm 1",
    "curve": "size --curve PIPE",
    "records of a fit": "fit-arm --robot config/robots/rrr70.urdf --samples PIPE -o x",
    "samples": "next config/config.yaml --samples PIPE -o x",
    "steps": "train config/config.yaml PIPE -o x",
}


def socket_file(path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def waited(*_):
    raise AssertionError("waits for what never comes")


ODD = {
    "pipe": os.mkfifo,
    "socket": socket_file,
    "folder": os.mkdir,
    "device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("what", PIPE_OF)
def test_what_is_no_file_is_refused_and_not_waited_for(kind, what):
    with TemporaryDirectory() as folder:  # pytest's own are too deep for the name of a socket
        place = Path(folder) / "odd"
        ODD[kind](place)
        words = [str(place) if word == "PIPE" else word for word in PIPE_OF[what].split()]
        signal.signal(signal.SIGALRM, waited)
        signal.alarm(60)
        try:
            with pytest.raises(IksamplesError, match="odd") as refused:
                CliRunner().invoke(app, words, catch_exceptions=False)
        finally:
            signal.alarm(0)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("size r.csv --tip-link tool", "--tip-link tool is a link of an arm; name it, --robot"),
        ("size r.csv --joint-unit deg", "--joint-unit: of no use to records that are no LeRobot"),
        ("size r.csv --tool-from-drawing", "--tool-from-drawing: of no use"),
        ("size r.csv --socket-distance-mm 9", "--socket-distance-mm: of no use"),
        ("size --curve r.csv --tip-link tool", "--tip-link: of no use to a learning curve"),
        ("next --robot a.urdf -o x --anywhere", "--anywhere: of no use without --box"),
        ("next --robot a.urdf -o x --column x_mm=x", "--column: of no use without --samples"),
        ("certify --weights w --robot r --box 0 0 0 1 1 1 --atol-deg 1", "--atol-deg: of no use"),
        (
            "prove config/config.yaml s --method network --folder f -o x --proved p --seeds 0-1",
            "no --seeds",
        ),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(words, says):
    with pytest.raises(IksamplesError, match=re.escape(says)):
        CliRunner().invoke(app, words.split(), catch_exceptions=False)


@pytest.mark.parametrize("step", ["check", "learn"])
def test_records_without_an_arm_are_not_of_the_papers(command, tmp_path, step):
    recorded()[2].to_csv(tmp_path / "arm.csv", index=False)
    study = {"name": "s", "samples": {"recorded": {"path": str(tmp_path / "arm.csv")}}}
    (tmp_path / "s.json").write_text(json.dumps(study))
    done = run(command, step, tmp_path / "s.json", *(["--results", tmp_path] * (step == "learn")))
    assert done.returncode == 2
    assert "name the arm, robot.urdf" in done.stderr


def test_a_disk_that_cannot_be_written_is_a_line(command, tmp_path):
    (tmp_path / "taken").write_text("a file where a folder is to be")
    done = run(command, "samples", "config/config.yaml", "-o", tmp_path / "taken/samples")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith(f"Error: cannot write {tmp_path}/taken")


def test_what_memory_does_not_hold_is_a_line(monkeypatch, capsys):
    monkeypatch.setattr(cli, "app", lambda: bytearray(2**60))
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert re.fullmatch(r"Error: out of memory\..*\n", capsys.readouterr().err)


def test_a_set_that_is_not_in_the_study_is_named(command, tmp_path):
    done = run(command, "samples", "config/config.yaml", "--name", "grid9", "-o", tmp_path / "x")
    assert done.returncode == 2
    assert "no samples 'grid9'; there are grid2, grid3," in done.stderr
    assert not list(tmp_path.iterdir())


def test_certify_a_plain_pytorch_network(command, tmp_path, chain, rng):
    net = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 3))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.tensor(rng.normal(size=parameter.shape)))
    torch.save(net.state_dict(), tmp_path / "net.pt")
    done = run(
        command, "certify", "--weights", tmp_path / "net.pt", *ARM, *BOX, "--activation", "tanh",
        "--offset-mm", 20, 20, 0, "--scale-mm", 60, 60, 60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "(checked, " in done.stdout
    upper = float(done.stdout.split("more than ")[1].split(" mm")[0])
    points = np.array([20, 20, 0]) + 60 * rng.random((20_000, 3))
    with torch.no_grad():
        joints = net(torch.tensor((points - [20, 20, 0]) / 60).float()).numpy()
    errors = np.linalg.norm(chain.forward_mm(joints) - points, axis=1)
    assert 0.9 * upper < errors.max() < upper + 0.01


def test_certify_says_what_is_missing(command, tmp_path):
    done = run(command, "certify", "--weights", tmp_path / "no.pt", *ARM, *BOX)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no such file" in done.stderr


@pytest.mark.slow
def test_next_poses_can_be_recorded(command, tmp_path, study, task, chain):
    grid_samples(study, task, 3).save(tmp_path / "had.parquet")
    (tmp_path / "quick.yaml").write_text("name: quick\ntraining: {epochs: 50}\n")
    done = run(
        command, "next", tmp_path / "quick.yaml", "--samples", tmp_path / "had.parquet",
        "-k", 4, "-o", tmp_path / "next.csv",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    poses = pd.read_csv(tmp_path / "next.csv")
    assert len(poses) == 4
    joints = poses[[f"q_{name}_rad" for name in chain.joint_names]].to_numpy()
    assert chain.within_limits(joints, 1e-4).all()
    reached = chain.forward_mm(joints)
    np.testing.assert_allclose(reached, poses[["x_mm", "y_mm", "z_mm"]], atol=0.05)


@pytest.mark.slow
def test_a_study_by_hand_without_snakemake(command, tmp_path):
    """The steps in the README's order give a table."""
    study = "tests/studies/tiny.yaml"
    results = tmp_path / "tiny"
    files = [results / f"samples/{name}.parquet" for name in ("grid2", "grid3")]
    run(command, "samples", study, "-o", results / "samples")
    folder = results / "network"
    for step in (
        ("train", study, *files, "-o", results),
        ("evaluate", study, *files, "--method", "network", "--results", results),
        ("bounds", study, *files, "--folder", folder),
        ("prove", study, *files, "--method", "network", "--folder", folder,
         "-o", folder / "certificates.csv"),
        ("collect", study, "--results", results),
        ("table", study, "--results", results),
        ("answer", study, "--results", results),
    ):  # fmt: skip
        done = run(command, *step)
        assert done.returncode == 0, done.stderr
    assert list(pd.read_csv(results / "table.csv")["n_samples"]) == [8, 27]
    from iksamples.study import read_study

    for cell in cells(read_study(study), results):
        assert isinstance(cell.network, StackedMLP)
    assert "samples" in run(command, "recommend", "--results", results).stdout


@given(st.text(st.characters(blacklist_categories=["Cs"])))
def test_names_of_others_cannot_steer_a_terminal(text: str) -> None:
    with redirect_stdout(io.StringIO()) as printed:
        say(f"a {text} b\nc")
    lines = printed.getvalue()
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]", lines)
    assert lines.count("\n") == text.count("\n") + 2
