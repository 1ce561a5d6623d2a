"""The study file: what it accepts, and what it says when it does not."""

import json
import subprocess
from datetime import date

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iksamples.errors import IksamplesError
from iksamples.evaluation.paths import waypoints
from iksamples.study import Study, parse_study, read_study
from iksamples.study.reading import read_settings, typed
from iksamples.task import study_task


BAD = [
    ({}, "'name' is missing."),
    ({"name": "My Study"}, "'name' should be lower-case letters, digits, - and _, the first a"),
    ({"name": "x" * 61}, "'name' should have at most 60 characters"),
    ({"name": 2024}, "'name' should be text; put it in quotes (found 2024)"),
    ({"name": "x", "training": None}, "'training' should be a section with the keys optimizer,"),
    ({"name": "x", "methods": ["cubic"]}, "'methods' should be a section of names"),
    ({"name": "x", "methods": {"b": None}}, "'methods.b' should be a section with the keys kind,"),
    (
        {"name": "x", "methods": {"On Demand": {}}},
        "the name 'On Demand' under 'methods' should be lower-case letters, digits and -, the",
    ),
    ({"name": "x", "methods": {"m" * 300: {}}}, "should have at most 60 characters"),
    ({"name": "x", "methods": {"m" * 25: {}}}, "should not repeat the same letters 20 times"),
    ({"name": "x", "tracking": ["http://me:hush@h"]}, 'keys uri (found ["http://me:***@h"])'),
    ({"name": "x", "methods": {"cache": {}}}, "'cache' is another folder of the results"),
    ({"name": "x", "robot": {"limits_rad": {1: [-1, 1]}}}, "key 1 under 'robot.limits_rad' is no"),
    ({"name": "x", "training": {"seeds": True}}, "'training.seeds' should be a valid integer"),
    ({"name": "x", "training": {"seeds": "3"}}, "'training.seeds' should be a valid integer (fou"),
    ({"name": "x", "training": {"seeds": 3.0}}, "'training.seeds' should be a valid integer (fou"),
    ({"name": "x", "network": {"hidden": 16}}, "'network.hidden' should be a list such as [1, 2]"),
    (
        {"name": "x", "workspace": {"lower_mm": [1, 2]}},
        "'workspace' lower_mm and upper_mm must have as many numbers",
    ),
    ({"name": "x", "workspace": {"lower_mm": [1, 2, 3, 4]}}, "should have at most 3 items"),
    ({"name": "x", "tolerance": {"error_mm": float("inf")}}, "should be a finite number"),
    ({"name": date(2024, 5, 1)}, "'name' is neither text nor number (2024-05-01); quote it."),
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
        {"name": "x", "evaluation": {"paths": {"p": {"shape": "square"}}}},
        "'evaluation.paths.p' tag 'square' found using 'shape' does not match any",
    ),
    (
        {"name": "x", "evaluation": {"paths": {"p": {"shape": "heart", "size": 1}}}},
        "unknown key 'evaluation.paths.p.size'; known keys here: shape, waypoints",
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


def test_a_mistake_that_methods_inherit_is_said_once():
    methods = {"a": {"network": {"hidden": [4]}}, "b": {"training": {"batch_size": 4}}}
    with pytest.raises(IksamplesError) as caught:
        parse_study({"name": "x", "training": {"epochs": 0}, "methods": methods})
    assert len(str(caught.value).splitlines()) == 1


def merges(levels):
    """A mapping that would have 9 ** levels entries if merges were written out."""
    lines = ["a0: &a0 {k: 1}"]
    for i in range(levels):
        lines.append(f"a{i + 1}: &a{i + 1} {{<<: [{', '.join([f'*a{i}'] * 9)}], k{i}: 1}}")
    return "\n".join(lines)


def lists(levels):
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]" for i in range(levels)]
    return "\n".join([*lines, f"name: *a{levels}"])


UNREADABLE = {
    "open bracket": (b"a: [1", "not a YAML file (line 1: "),
    "list": (b"- 1\n- 2", "expected a mapping of settings such as 'name: my-study', found a list"),
    "nothing": (b"", "found nothing"),
    "comment": (b"# nothing\n", "found nothing"),
    "toml": (b'name = "y"\n', "found a value"),
    "tab": (b"name: y\ntraining:\n\tseeds: 3\n", "not a YAML file (line 3: "),
    "key twice": (
        b"name: y\ntraining: {}\nname: z\n",
        "'name' stands twice, on lines 1 and 3; keep",
    ),
    "key twice in a line": (
        b"name: y\ntraining: {seeds: 3, seeds: 4}\n",
        "'seeds' stands twice, on line",
    ),
    "key twice in JSON": (b'{"name": "y",\n "name": "z"}', "'name' stands twice, on lines 1 and 2"),
    "two studies": (b"name: y\n---\nname: z\n", "line 2 begins a second study; a file holds one."),
    "tag": (
        b"name: !!python/object/apply:os.system [ls]\n",
        "line 1: the tag tag:yaml.org,2002:py",
    ),
    "binary": (
        b"name: !!binary aGVsbG8=\n",
        "line 1: the tag tag:yaml.org,2002:binary is not read",
    ),
    "mapping as key": (b"? {a: 1}\n: 2\n", "line 1: a key is a plain name"),
    "latin 1": ("name: étude\n".encode("latin-1"), "not a text file in UTF-8"),
    "picture": (bytes(range(256)), "not a text file in UTF-8"),
    "large": (b"name: y\ntitle: '" + b"x" * 300_000 + b"'\n", "over 200 kB is no study file"),
    "digits": (
        b"name: y\ntraining: {seeds: " + b"9" * 20_000 + b"}\n",
        "a whole number of 20000 dig",
    ),
    "deep": (
        b"name: y\ntitle: " + b"[" * 5000 + b"]" * 5000 + b"\n",
        "sections inside sections wit",
    ),
    "circular": (b"name: y\nmethods: &a {b: *a}\n", "'methods' holds more than any study"),
    "circular merge": (b"name: y\nmethods: &a {<<: *a}\n", "'<<' needs another mapping"),
    "list bomb": (lists(9).encode(), "'name' holds more than any study; does it repeat itself?"),
}


@pytest.mark.parametrize("kind", UNREADABLE)
def test_a_file_that_is_no_study_is_refused_in_a_line(tmp_path, kind):
    content, message = UNREADABLE[kind]
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(IksamplesError) as caught:
        read_study(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(IksamplesError, match="cannot read the study file"):
        read_study(tmp_path / "nowhere.yaml")


def test_merges_are_not_written_out(tmp_path):
    path = tmp_path / "merges.yaml"
    path.write_text(f"name: y\n{merges(40)}\n")
    with pytest.raises(IksamplesError, match="unknown key 'a0'"):
        read_study(path)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("no", "no"), ("on", "on"), ("2024-05-01", "2024-05-01"), ("010", "010"), ("1:30", "1:30"),
        ("0x10", "0x10"), ("3", 3), ("-3", -3), ("1_000", 1000), ("true", True), ("null", None),
        ("", None), ("1e-3", 1e-3), ("1e-05", 1e-5), ("1.5E+3", 1500.0), (".5", 0.5), ("3.", 3.0),
        ("'3'", "3"), ("0,5", "0,5"), ("2 mm", "2 mm"), ("1.2.3", "1.2.3"),
    ],
)  # fmt: skip
def test_a_scalar_is_what_it_looks_like(tmp_path, written, value):
    path = tmp_path / "one.yaml"
    path.write_text(f"x: {written}\n")
    found = read_settings(path)["x"]
    assert (found, type(found)) == (value, type(value))
    if not written.startswith("'"):
        assert typed({"x": [written]}) == {"x": [value]}


@given(st.floats(allow_nan=False) | st.integers(-(10**17), 10**17) | st.booleans() | st.none())
def test_what_json_writes_is_read_back(tmp_path_factory, value):
    path = tmp_path_factory.getbasetemp() / "value.json"
    path.write_text(json.dumps({"x": [value]}).replace("Infinity", ".inf"))
    found = read_settings(path)["x"][0]
    assert (found, type(found)) == (value, type(value))


GOOD = {
    "names that YAML 1.1 takes for something else": (
        b"name: no\nmethods: {on: {kind: cubic}, yes: {kind: cubic}}\n"
        b"robot: {limits_rad: {1: [-1, 1]}}\n",
        {"name": "no", "methods": {"on": {"kind": "cubic"}, "yes": {"kind": "cubic"}},
         "robot": {"limits_rad": {"1": (-1, 1)}}},
    ),
    "merge": (
        b"name: y\nnetwork: &n {hidden: [8], activation: tanh}\n"
        b"methods: {b: {network: {<<: *n, hidden: [4]}}}\n",
        {"name": "y", "network": {"hidden": [8], "activation": "tanh"},
         "methods": {"b": {"network": {"hidden": [4], "activation": "tanh"}}}},
    ),
    "byte order mark": (b"\xef\xbb\xbfname: y\n", {"name": "y"}),
    "UTF-16": ("\ufeffname: y\n".encode("utf-16-le"), {"name": "y"}),
    "CRLF": (b"name: y\r\ntraining: {seeds: 3}\r\n", {"name": "y", "training": {"seeds": 3}}),
    "JSON": (b'{"name": "y", "training": {"seeds": 3}}', {"name": "y", "training": {"seeds": 3}}),
    "title": ("name: y\ntitle: Études ≤ 2 mm".encode(), {"name": "y", "title": "Études ≤ 2 mm"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", GOOD)
def test_what_is_meant_is_read(tmp_path, kind):
    content, settings = GOOD[kind]
    path = tmp_path / "good.yaml"
    path.write_bytes(content)
    assert read_study(path) == parse_study(settings)


def test_files_are_laid_over_one_another(tmp_path):
    (tmp_path / "a.yaml").write_text("name: y\ntraining: {seeds: 3, epochs: 7}\n")
    (tmp_path / "b.yaml").write_text("training: {seeds: 4}\n")
    study = read_study(
        tmp_path / "a.yaml", tmp_path / "b.yaml", changes={"network": {"hidden": []}}
    )
    assert (study.training.seeds, study.training.epochs, study.network.hidden) == (4, 7, [])


def test_the_papers_study_file_says_what_the_defaults_say():
    written = read_study("config/config.yaml")
    unsaid = Study(name="paper", paper=True)
    said = {"methods", "title", "evaluation"}
    assert written.model_dump(exclude=said) == unsaid.model_dump(exclude=said)
    task = study_task(unsaid)
    for name, path in written.evaluation.paths.items():
        for one, other in zip(
            waypoints(path, task), waypoints(unsaid.evaluation.paths[name], task), strict=True
        ):
            np.testing.assert_array_equal(one, other)


def test_digest_follows_the_settings_that_numbers_depend_on():
    study = read_study("config/config.yaml")
    assert study.digest() == Study.model_validate(study.model_dump()).digest()
    settings = read_settings("config/config.yaml")
    for change, same in (
        ({"title": "else"}, True),
        ({"tracking": {"uri": "sqlite:///else.db"}}, True),
        ({"replication": {"seeds": 9}}, True),
        ({"network": {"hidden": [15]}}, False),
        ({"tolerance": {"error_mm": 3}}, False),
    ):
        assert (parse_study({**settings, **change}).digest() == study.digest()) is same


@pytest.mark.parametrize(
    ("uri", "kept"),
    [
        ("http://me:hush@host:5000/a?b=1", "http://me:***@host:5000/a?b=1"),
        ("postgresql+psycopg2://me:hu/sh@en@host/db", "postgresql+psycopg2://me:***@host/db"),
        ("http://me:hush@[::1", "http://me:***@[::1"),
        ("mssql://host/db?user=me&Password=hush&x=1", "mssql://host/db?user=me&Password=***&x=1"),
        ("http://host/?api_key=hush", "http://host/?api_key=***"),
        ("http://me@host:5000", "http://me@host:5000"),
        ("sqlite:///mlflow.db", "sqlite:///mlflow.db"),
        (None, None),
    ],
)
def test_a_password_is_used_and_not_kept(uri, kept):
    study = parse_study({"name": "x", "tracking": {"uri": uri}})
    assert study.tracking.uri == uri
    assert study.model_dump()["tracking"]["uri"] == kept
    assert "hush" not in study.model_dump_json()


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


@pytest.mark.parametrize(
    "name", ["../x", "/x", "a/b", "..", ".", "", "a\\b", "a\n", "a\0", "~", "-a", "a" * 300, "con:"]
)
def test_no_name_leads_out_of_its_folder(name):
    for settings in (
        {"name": name},
        {"name": "x", "methods": {name: {"kind": "cubic"}}},
        {"name": "x", "evaluation": {"paths": {name: {"shape": "heart"}}}},
    ):
        with pytest.raises(IksamplesError):
            parse_study(settings)
