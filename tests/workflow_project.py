"""The project as a user has it, in a folder of its own, and Snakemake typed there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path


ROOT = Path(__file__).parents[1]
TINY = "tests/studies/tiny.yaml"


def snakemake(folder, *arguments, check=True, base=os.environ, **environment):
    """Runs Snakemake in a folder, as typed there."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name("snakemake")), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        # No environment is active: the command line is found by the Python that runs Snakemake.
        env={**base, "PATH": "/usr/bin:/bin"} | environment,
    )
    if check and done.returncode:
        raise AssertionError(done.stdout + done.stderr)
    return done


def project_copy(folder):
    """What a run needs of the project, in a folder of its own."""
    for name in ("Snakefile", "workflow", "profiles", "config", TINY):
        source, target = ROOT / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, target)
    return folder
