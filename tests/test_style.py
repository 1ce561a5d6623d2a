"""Lint, format and types, so that they cannot slip."""

import subprocess
import sys

import pytest


pytestmark = pytest.mark.slow

TOOLS = {
    "lint": ["ruff", "check"],
    "format": ["ruff", "format", "--check"],
    "types": ["mypy"],
    "rules": ["snakefmt", "--check", "workflow", "Snakefile"],
}


@pytest.mark.parametrize("tool", TOOLS)
def test_nothing_to_complain_about(tool):
    done = subprocess.run(
        [sys.executable, "-m", *TOOLS[tool]], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
