"""LeRobot data sets: both layouts are read, and nothing that no file says is guessed in silence."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from iksamples.arm.load import load_arm
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.lerobot import read_lerobot
from iksamples.study import Recorded


WRITTEN = Path(__file__).parent / "lerobot"
URDF = "config/robots/so101.urdf"
STATE = "observation.state"
DEG = 180 / np.pi
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]


@pytest.fixture(scope="module")
def drawing():
    return load_arm(URDF)


def frames():
    """What the library was given (lerobot/write.py): joints in rad, a gripper in per cent."""
    own = np.arange(6)
    parts = [
        np.stack([40 * np.sin(0.2 * i + 0.77 * episode + own) + 50 * (own == 5) for i in range(30)])
        for episode in range(3)
    ]
    return [one / ([DEG] * 5 + [1]) for one in parts]


def data_set(folder, episodes=None, version="v3.0", names=None):
    """A data set that the library wrote, with other states or joint names in their place."""
    shutil.copytree(WRITTEN / version, folder)
    rows = None if episodes is None else np.concatenate(episodes).astype(np.float32)
    for path in sorted((folder / "data").rglob("*.parquet")) if episodes else ():
        table = parquet.read_table(path)
        at, kind = table.schema.get_field_index(STATE), table.schema.field(STATE).type
        own, rows = rows[: len(table)], rows[len(table) :]
        parquet.write_table(table.set_column(at, STATE, pa.array(list(own), kind)), path)
    if names:
        path = folder / "meta" / "info.json"
        info = json.loads(path.read_text())
        info["features"][STATE]["names"] = names
        path.write_text(json.dumps(info))
    return folder


def read(folder, drawing, **settings):
    settings = {"joint_unit": "deg", "tool_from_drawing": True} | settings
    return read_lerobot(Recorded(path=str(folder), kind="lerobot", **settings), drawing)


OLDER = {"motors": [f"main_{name}" for name in (*JOINTS, "gripper")]}


@pytest.mark.parametrize("names", [None, OLDER], ids=["as written", "older names"])
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_the_library_wrote_is_read(tmp_path, drawing, version, names):
    found = read(data_set(tmp_path / "set", version=version, names=names), drawing)
    q = np.concatenate(frames())[:, :5]
    np.testing.assert_allclose(found.joints, q, atol=1e-6)
    np.testing.assert_allclose(found.position_mm, drawing.forward_mm(q), atol=5e-3)
    assert any("the drawing's, not the arm's" in line for line in found.remarks)
    assert any("taken as degrees from the drawing's zero" in line for line in found.remarks)


def in_range(drawing):
    """The same motions as -100 to 100 over the drawing's limits."""
    lower, span = drawing.lower, drawing.upper - drawing.lower
    return [
        np.column_stack([200 * (one[:, :5] - lower) / span - 100, one[:, 5]]) for one in frames()
    ]


def test_the_range_of_the_motors(tmp_path, drawing):
    share = in_range(drawing)
    q = np.concatenate(frames())[:, :5]
    found = read(data_set(tmp_path / "a", share), drawing, joint_unit="range")
    np.testing.assert_allclose(found.joints, q, atol=1e-5)
    share[1][3, 2] = 100  # a motor at its stop shows what the values are, and yet is not believed
    stopped = data_set(tmp_path / "b", share)
    with pytest.raises(IksamplesError, match="range, as values that stop at exactly 100 are"):
        read(stopped, drawing, joint_unit=None)
    with pytest.raises(IksamplesError, match="and not deg; say --joint-unit range"):
        read(stopped, drawing)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("values", ["degrees", "range"])
def test_what_no_file_says_has_to_be_said(tmp_path, drawing, version, values):
    folder = data_set(tmp_path / "set", in_range(drawing) if values == "range" else None, version)
    with pytest.raises(IksamplesError, match="say --joint-unit deg, rad or range"):
        read(folder, drawing, joint_unit=None)
    with pytest.raises(IksamplesError, match="does not say where the tool was"):
        read(folder, drawing, tool_from_drawing=False)
    with pytest.raises(IksamplesError, match="name its arm with --robot"):
        read(folder, None)
    with pytest.raises(IksamplesError, match="are no angles in rad"):
        read(folder, drawing, joint_unit="rad")


def broken_info(folder):
    (folder / "meta" / "info.json").write_text("{")


def another_version(folder):
    path = folder / "meta" / "info.json"
    path.write_text(path.read_text().replace("v3.0", "v1.6"))


def uneven_rows(folder):
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(path)
    at, rows = table.schema.get_field_index(STATE), [[1.0] * (5 + (i == 3)) for i in range(90)]
    parquet.write_table(table.set_column(at, STATE, pa.array(rows)), path)


def cut_file(folder):
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    path.write_bytes(path.read_bytes()[:-20])


def no_frames(folder):
    (folder / "data" / "chunk-000" / "file-000.parquet").unlink()


def other_names(folder):
    path = folder / "meta" / "info.json"
    path.write_text(path.read_text().replace("elbow_flex", "elbow"))


FAULTS = {
    broken_info: "no LeRobot data set whose meta/info.json",
    another_version: "of version v1.6; v2.1 and v3.0 are read",
    uneven_rows: "its frames cannot be read",
    cut_file: "its frames cannot be read",
    no_frames: "no frames in data/",
    other_names: "no joint 'elbow_flex' among",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_faults_are_told_in_a_line(tmp_path, drawing, fault):
    folder = data_set(tmp_path / "set")
    fault(folder)
    with pytest.raises(IksamplesError) as caught:
        read(folder, drawing)
    assert FAULTS[fault] in str(caught.value)
    assert str(caught.value).count("\n") == 0


def test_names_that_a_mapping_resolves(tmp_path, drawing):
    folder = data_set(tmp_path / "set")
    other_names(folder)
    found = read(folder, drawing, columns={"q_elbow_flex": "elbow.pos"})
    assert found.joint_names == tuple(JOINTS)


@pytest.mark.slow
def test_the_command_says_that_it_is_the_drawing(tmp_path, drawing):
    folder = data_set(tmp_path / "set")
    options = ["--robot", URDF, "--joint-unit", "deg", "--tool-from-drawing", "--subsets", "3"]
    said = CliRunner().invoke(app, ["size", str(folder), *options])
    assert said.exit_code == 0, (said.output, said.exception)
    assert "everything here is the drawing's" in said.output
    assert "Left out: calibrated: it knows the drawing" in said.output
    assert "gaussian-process" in said.output
