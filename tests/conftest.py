"""Shared fixtures: one small study, run once."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from iksamples.arm.chain import SerialChain
from iksamples.study import Study, parse_study
from iksamples.task import Task, study_chain, study_task


# A slow machine is no failure, and the same examples are tried everywhere.
settings.register_profile("iksamples", deadline=None, derandomize=True)
# What pytest tests/test_fuzz.py --hypothesis-profile=nightly asks for: others each time.
settings.register_profile(
    "nightly", deadline=None, max_examples=10_000, database=None, print_blob=True
)
settings.load_profile("iksamples")

ROOT = Path(__file__).parents[1]


# All kinds of joints, turned in every direction.
WRIST = """<?xml version="1.0"?>
<robot name="wrist">
  <link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/>
  <joint name="j1" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.7 1.1"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0 0.05 0.2" rpy="1.2 0 -0.4"/><axis xyz="1 0 0"/>
    <limit lower="-0.1" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="held" type="fixed"><parent link="c"/><child link="d"/>
    <origin xyz="0.02 0 0.1" rpy="0 0.5 0"/></joint>
  <joint name="j3" type="continuous"><parent link="d"/><child link="e"/>
    <origin xyz="0 0 0.15"/><axis xyz="0 0.6 0.8"/></joint>
  <joint name="tool" type="fixed"><parent link="e"/><child link="f"/>
    <origin xyz="0.07 0.01 0.09" rpy="0 0 1"/></joint>
</robot>
"""


@pytest.fixture
def wrist_file(tmp_path: Path) -> Path:
    """An arm with a revolute, a prismatic, a fixed and a continuous joint, as a URDF."""
    file = tmp_path / "wrist.urdf"
    file.write_text(WRIST)
    return file


@pytest.fixture(autouse=True)
def _in_the_project(monkeypatch: pytest.MonkeyPatch) -> None:
    """Study files name their robot relative to the project's root."""
    monkeypatch.chdir(ROOT)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator of the test's own, the same in every run."""
    return np.random.default_rng(list(request.node.name.encode()))


@pytest.fixture
def study() -> Study:
    """The paper's study."""
    return parse_study({"name": "paper"})


@pytest.fixture
def chain(study: Study) -> SerialChain:
    """The paper's arm."""
    return study_chain(study)


@pytest.fixture
def task(study: Study) -> Task:
    """The paper's task."""
    return study_task(study)


@pytest.fixture(scope="session")
def command() -> str:
    """The installed command line."""
    return str(Path(sys.executable).with_name("iksamples"))


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium: the system's, or the one Playwright brings."""
    from playwright.sync_api import Error, sync_playwright

    arguments = [
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-background-networking",
    ]
    names = ("chromium", "chromium-browser", "google-chrome")
    system = next((path for name in names if (path := shutil.which(name))), None)
    with sync_playwright() as playwright:
        try:
            chromium = playwright.chromium.launch(executable_path=system, args=arguments)
        except Error as error:
            pytest.skip(f"no Chromium here: {error.message.splitlines()[0]}")
        yield chromium
        chromium.close()
