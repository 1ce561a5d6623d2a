"""Finished studies for the report's tests, made by the steps' own commands."""

from pathlib import Path
from typing import Any

import yaml
from typer.testing import CliRunner

from iksamples.cli import app
from iksamples.results import certified, networks, sample_sets
from iksamples.study import Study, read_study


def step(*arguments: object) -> None:
    """Runs one command of iksamples in this process."""
    done = CliRunner().invoke(app, [str(one) for one in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output


def finished(settings: dict[str, Any], project: Path, paper: bool = True) -> Study:
    """Runs a study up to its answer, in ``project/results/<name>``.

    Args:
        settings: The study.
        project: A folder.
        paper: Whether it is held against the paper, too.
    """
    results = project / "results" / settings["name"]
    results.mkdir(parents=True)
    file = results / "study.json"
    file.write_text(yaml.safe_dump(settings))
    study = read_study(file)
    file.write_text(study.model_dump_json())
    sets = [results / "samples" / f"{label}.parquet" for label in sample_sets(study)]
    step("samples", file, "-o", results / "samples")
    step("train", file, *sets, "-o", results)
    methods = [word for name in study.all_methods for word in ("--method", name)]
    step("evaluate", file, *sets, *methods, "--results", results)
    for method in certified(study):
        target = results / method / "certificates.csv"
        step("prove", file, *sets, "--method", method, "--folder", results / method, "-o", target)
    if study.arm and not study.arm.repeats:
        step("floor", file, *sets, "-o", results / "floor" / "errors.parquet")
    step("map", file, "--results", results)
    step("collect", file, "--results", results)
    if paper:
        step("bounds", file, *sets, "--folder", results / networks(study)[0])
        step("table", file, "--results", results)
    step("answer", file, "--results", results)
    return study
