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


def test_digest_follows_the_settings_that_numbers_depend_on():
    study = read_study("config/config.yaml")
    assert study.digest() == Study.model_validate(study.model_dump()).digest()
    settings = yaml.safe_load(Path("config/config.yaml").read_text())
    for change, same in (
        ({"title": "else"}, True),
        ({"tracking": {"uri": "sqlite:///else.db"}}, True),
        ({"calibration": {"seeds": 9}}, True),
        ({"network": {"hidden": [15]}}, False),
        ({"tolerance": {"error_mm": 3}}, False),
    ):
        assert (parse_study({**settings, **change}).digest() == study.digest()) is same


@pytest.mark.parametrize("name", ["cube", "workspace"])
def test_a_path_cannot_be_called_like_the_workspace(name):
    with pytest.raises(IksamplesError, match=f"'{name}' means the whole workspace"):
        parse_study({"name": "s", "evaluation": {"paths": {name: {"shape": "heart"}}}})


def test_fresh_points_are_the_studys_and_not_a_methods():
    for training, own in (
        ({"held_out": {"source": "grid"}}, {"held_out": {"source": "fresh"}}),
        ({}, {"held_out": {"validation_share": 0.5}}),
    ):
        settings = {"name": "s", "training": training, "methods": {"other": {"training": own}}}
        with pytest.raises(IksamplesError, match=r"'methods.other.training.held_out'.*once for"):
            parse_study(settings)
    parse_study({"name": "s", "methods": {"o": {"training": {"held_out": {"source": "grid"}}}}})


def test_early_stopping_must_have_something_to_watch():
    training = {"early_stopping": {}, "held_out": {"source": "grid"}}
    with pytest.raises(IksamplesError, match=r"nothing to watch: validation_share 0.05 of 8"):
        parse_study({"name": "s", "training": training})
    parse_study({"name": "s", "training": training, "samples": {"points_per_axis": [3]}})


def test_a_budget_in_steps_is_the_same_at_every_size():
    second = {"optimizer": "levenberg-marquardt"}
    study = parse_study(
        {
            "name": "s",
            "training": {"steps": 320},
            "methods": {"lm": {"training": second}, "epochs": {"training": {"epochs": 7}}},
        }
    )
    for n, first_order in ((8, 320), (125, 20), (512, 5)):
        assert study.for_method("network", n).training.epochs == first_order
        assert study.for_method("lm", n).training.epochs == 320
        # It says epochs, so it does not inherit the steps.
        assert study.for_method("epochs", n).training.epochs == 7


def test_command_line_prints_the_line_and_no_traceback(command, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("name: x\nsamples: {points_per_axis: [2], desing: grid}\n")
    done = subprocess.run([command, "check", path], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith(f"Error: {path}: unknown key 'samples.desing'; known keys here:")
    assert len(done.stderr.splitlines()) == 1
