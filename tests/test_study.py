"""The study file: what it accepts, and what it says when it does not."""

import subprocess
from pathlib import Path

import pytest
import yaml

from iksamples.errors import IksamplesError
from iksamples.study import Study, parse_study, read_study


BAD = [
    ({}, "'name' is missing."),
    ({"name": "My Study"}, "'name' String should match pattern"),
    ({"name": "x", "netwrok": {}}, "unknown key 'netwrok'; known keys here: name, title, robot,"),
    ({"name": "x", "network": {"hiden": [8]}}, "unknown key 'network.hiden'; known keys here: hid"),
    ({"name": "x", "network": {"activation": "swishy"}}, "'network.activation' should be 'relu'"),
    ({"name": "x", "network": {"hidden": [0]}}, "'network.hidden.0' should be greater than or eq"),
    ({"name": "x", "training": {"epochs": "many"}}, "'training.epochs' should be a valid integer"),
    (
        {"name": "x", "training": {"learning_rate": -1}},
        "'training.learning_rate' should be greater",
    ),
    (
        {"name": "x", "training": {"seeds": 0}},
        "'training.seeds' should be greater than or equal to",
    ),
    (
        {"name": "x", "training": {"early_stopping": {"patienc": 5}}},
        "unknown key 'training.early_stopping.patienc'; known keys here: patience,",
    ),
    ({"name": "x", "samples": {"points_per_axis": [1]}}, "'samples.points_per_axis.0' should be g"),
    ({"name": "x", "samples": {"points_per_axis": [3, 3]}}, "should name each size once"),
    (
        {"name": "x", "workspace": {"lower_mm": [90, 0, 0]}},
        "'workspace' upper_mm must be greater than lower_mm along every axis",
    ),
    (
        {"name": "x", "evaluation": {"paths": {"p": {"shape": "circle"}}}},
        "'evaluation.paths.p' tag 'circle' found using 'shape' does not match any",
    ),
    (
        {"name": "x", "evaluation": {"paths": {"p": {"shape": "heart", "size": 1}}}},
        "unknown key 'evaluation.paths.p.size'; known keys here: shape, centre_mm",
    ),
    ({"name": "x", "bounds": {"scale_mm": 0}}, "'bounds.scale_mm' should be greater than 0 (found"),
]


@pytest.mark.parametrize(("settings", "message"), BAD)
def test_bad_settings_name_the_key_and_what_is_allowed(settings, message):
    with pytest.raises(IksamplesError) as caught:
        parse_study(settings, "my.yaml")
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("my.yaml: ")
    assert message in lines[0]


def test_every_mistake_has_its_own_line():
    with pytest.raises(IksamplesError) as caught:
        parse_study({"name": "x", "robott": 1, "training": {"epochs": 0}})
    assert len(str(caught.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [("a: [1", "not a YAML file"), ("- 1\n- 2", "expected a mapping"), ("", "expected a mapping")],
)
def test_bad_files(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    path.write_text(content)
    with pytest.raises(IksamplesError, match=message):
        read_study(path)
    with pytest.raises(IksamplesError, match="cannot read"):
        read_study(tmp_path / "nowhere.yaml")


def test_the_papers_study_file_says_what_the_defaults_say():
    written = read_study("config/config.yaml")
    said = {"methods", "title"}
    assert written.model_dump(exclude=said) == Study(name="paper").model_dump(exclude=said)


def test_digest_follows_every_setting_and_nothing_else():
    study = read_study("config/config.yaml")
    assert study.digest() == Study.model_validate(study.model_dump()).digest()
    other = parse_study({**yaml.safe_load(Path("config/config.yaml").read_text()), "title": "else"})
    assert other.digest() != study.digest()


def test_command_line_prints_the_line_and_no_traceback(command, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("name: x\nsamples: {points_per_axis: [2], desing: grid}\n")
    done = subprocess.run([command, "check", path], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith(f"Error: {path}: unknown key 'samples.desing'; known keys here:")
    assert len(done.stderr.splitlines()) == 1
