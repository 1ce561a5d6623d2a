"""The generated pages are in step with the code."""

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from iksamples.columns import TABLE
from iksamples.handbook import schema, settings_page
from iksamples.study import Study


def test_committed_pages_are_the_generated_ones():
    assert Path("config/README.md").read_text() == settings_page(), "run `iksamples handbook`"
    assert Path("config/schema.json").read_text() == schema(), "run `iksamples handbook`"


def test_every_setting_has_a_description():
    for line in settings_page().splitlines():
        if line.startswith("| `"):
            assert not line.endswith("|  |"), line


@pytest.mark.parametrize("path", sorted(map(str, Path("config").glob("**/*.yaml"))))
def test_study_files_satisfy_the_json_schema(path):
    validator = Draft202012Validator(json.loads(schema()))
    settings = yaml.safe_load(Path(path).read_text())
    assert not list(validator.iter_errors(settings))
    Study.model_validate(settings)


def test_columns_name_their_units():
    for name, column in TABLE.items():
        assert name.endswith("_mm") == (column.unit == "mm"), name
