"""LeRobot data sets: both layouts are read, and nothing that no file says is guessed in silence."""

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from iksamples.arm.load import load_arm
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.lerobot import read_lerobot
from iksamples.study import Recorded


URDF = "config/robots/so101.urdf"
DEG = 180 / np.pi
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]


@pytest.fixture(scope="module")
def drawing():
    return load_arm(URDF)


def frames(drawing, n=90, episodes=3):
    """Smooth motions in rad, episode by episode, and a gripper in per cent."""
    rng = np.random.default_rng(0)
    parts = []
    for _ in range(episodes):
        ends = rng.uniform(0.6 * drawing.lower, 0.6 * drawing.upper, (4, 5))
        at = np.linspace(0, 3, n // episodes)
        parts.append(np.stack([np.interp(at, range(4), end) for end in ends.T], axis=1))
    return [np.column_stack([part, np.linspace(0, 90, len(part))]) for part in parts]


def data_set(folder, episodes, version="v3.0", suffix=".pos"):
    """Writes episodes as that version lays them out."""
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    (folder / "meta").mkdir()
    names = [f"{name}{suffix}" for name in (*JOINTS, "gripper")]
    names = {"motors": names} if version == "v2.1" else names
    info = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "features": {"observation.state": {"dtype": "float32", "shape": [6], "names": names}},
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables = [
        pd.DataFrame({"observation.state": list(one.astype(np.float32)), "episode_index": i})
        for i, one in enumerate(episodes)
    ]
    if version == "v3.0":
        pd.concat(tables).to_parquet(data / "file-000.parquet")
    else:
        for i, table in enumerate(tables):
            table.to_parquet(data / f"episode_{i:06}.parquet")
    return folder


def in_degrees(episodes):
    return [one * ([DEG] * 5 + [1]) for one in episodes]


def read(folder, drawing, **settings):
    settings = {"joint_unit": "deg", "tool_from_drawing": True} | settings
    return read_lerobot(Recorded(path=str(folder), kind="lerobot", **settings), drawing)


@pytest.mark.parametrize("suffix", [".pos", ""])
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_both_layouts_hold_the_same(tmp_path, drawing, version, suffix):
    episodes = frames(drawing)
    folder = data_set(tmp_path / "set", in_degrees(episodes), version, suffix)
    found = read(folder, drawing)
    q = np.concatenate(episodes)[:, :5]
    np.testing.assert_allclose(found.joints, q, atol=1e-5)
    np.testing.assert_allclose(found.position_mm, drawing.forward_mm(q), atol=5e-3)
    assert any("the drawing's, not the arm's" in line for line in found.remarks)
    assert any("taken as degrees, as said" in line for line in found.remarks)


def test_the_range_of_older_recordings(tmp_path, drawing):
    episodes = frames(drawing)
    share = [
        np.column_stack(
            [200 * (one[:, :5] - drawing.lower) / (drawing.upper - drawing.lower) - 100, one[:, 5]]
        )
        for one in episodes
    ]
    q = np.concatenate(episodes)[:, :5]
    found = read(data_set(tmp_path / "a", share), drawing, joint_unit="range")
    np.testing.assert_allclose(found.joints, q, atol=1e-5)
    share[1][3, 2] = 100  # a motor at its stop shows what the values are
    stopped = data_set(tmp_path / "b", share)
    found = read(stopped, drawing, joint_unit=None)
    assert any("detected, since values stop at exactly 100" in line for line in found.remarks)
    with pytest.raises(IksamplesError, match="and not deg; say --joint-unit range"):
        read(stopped, drawing)


def test_what_no_file_says_has_to_be_said(tmp_path, drawing):
    folder = data_set(tmp_path / "set", in_degrees(frames(drawing)))
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
    cut_file: "its frames cannot be read",
    no_frames: "no frames in data/",
    other_names: "no joint 'elbow_flex' among",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_faults_are_told_in_a_line(tmp_path, drawing, fault):
    folder = data_set(tmp_path / "set", in_degrees(frames(drawing)))
    fault(folder)
    with pytest.raises(IksamplesError) as caught:
        read(folder, drawing)
    assert FAULTS[fault] in str(caught.value)
    assert str(caught.value).count("\n") == 0


def test_names_that_a_mapping_resolves(tmp_path, drawing):
    folder = data_set(tmp_path / "set", in_degrees(frames(drawing)))
    other_names(folder)
    found = read(folder, drawing, columns={"q_elbow_flex": "elbow.pos"})
    assert found.joint_names == tuple(JOINTS)


@pytest.mark.slow
def test_the_command_says_that_it_is_the_drawing(tmp_path, drawing):
    folder = data_set(tmp_path / "set", in_degrees(frames(drawing, 60)))
    options = ["--robot", URDF, "--joint-unit", "deg", "--tool-from-drawing", "--subsets", "3"]
    said = CliRunner().invoke(app, ["size", str(folder), *options])
    assert said.exit_code == 0, (said.output, said.exception)
    assert "everything here is the drawing's" in said.output
    assert "Left out: calibrated: it knows the drawing" in said.output
    assert "gaussian-process" in said.output
