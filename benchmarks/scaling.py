"""Measures what a seed costs from 1 to 1000 of them, and what Snakemake costs from 10 to 1000 jobs.

    python benchmarks/scaling.py seeds    # a minute or two of one core
    python benchmarks/scaling.py jobs

Prints the tables of docs/cluster.md: processor time, since other work on the machine hardly changes
it. One grid of 125 samples and 16 neurons for the first. The second has studies of one grid of 8
samples, whose results are zeros of the size that results have, with their digests, that Snakemake
is told are up to date.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import yaml

from iksamples.files import kept_file


ROOT = Path(__file__).parents[1]
OF_A_SEED = 120_000
"""What a network leaves, as the first half measures it: weights, history and errors [bytes]."""
SNAKEMAKE = str(Path(sys.executable).with_name("snakemake"))


def main() -> None:
    """Runs the half that is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=["seeds", "jobs"])
    what = parser.parse_args().what
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("Snakefile", "workflow", "profiles", "config"):
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / part)
        seeds(folder) if what == "seeds" else jobs(folder)


def spent(folder: Path, command: Sequence[str | Path]) -> tuple[float, float]:
    """Processor time [s] and largest memory [MB] of a command."""
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"failed: {' '.join(map(str, command))}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def write(folder: Path, **settings: object) -> str:
    """The file of a study."""
    (folder / "study.yaml").write_text(yaml.safe_dump({"name": "s", **settings}))
    return "study.yaml"


def seeds(folder: Path) -> None:
    """A table of the steps' costs against the number of seeds."""
    print("| seeds | step | processor [s] | of it per seed [ms] | memory [MB] | disk [kB/seed] |")
    print("|---:|---|---:|---:|---:|---:|")
    for n in (1, 1, 10, 100, 1000):  # the first compiles
        study = write(folder, samples={"points_per_axis": [5]}, training={"seeds": n})
        results = folder / f"results-{n}"
        shutil.rmtree(results, ignore_errors=True)
        command = [sys.executable, "-P", "-m", "iksamples"]
        samples, network = results / "samples/grid5.parquet", results / "network"
        spent(folder, [*command, "samples", study, "--output", results / "samples"])
        steps = {
            "train": ["--output", results],
            "evaluate": ["--method", "network", "--results", results],
            "prove": ["--method", "network", "--folder", network, "--output", network / "c.csv"],
        }
        for step, options in steps.items():
            before = size(results)
            took, memory_mb = spent(folder, [*command, step, study, samples, *options])
            kilobytes = (size(results) - before) / n / 1000
            print(
                f"| {n} | {step} | {took:.1f} | {1000 * took / n:.1f} | {memory_mb:.0f} | "
                f"{kilobytes:.0f} |",
                flush=True,
            )


def size(folder: Path) -> int:
    """Bytes of all files of a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def jobs(folder: Path) -> None:
    """A table of Snakemake's own cost against the number of jobs."""
    print("| jobs | seeds | to plan them (`-n`) [s] | results [MB] | nothing to be done [s] |")
    print("|---:|---:|---:|---:|---:|")
    for seeds in (20, 2400, 24_750):
        study = write(
            folder, samples={"points_per_axis": [2]}, training={"seeds": seeds}, seeds_per_job=50
        )
        for name in ("results", "reports", ".snakemake"):
            shutil.rmtree(folder / name, ignore_errors=True)
        typed = [SNAKEMAKE, "--cores", "2", "--configfile", study]
        plan = [spent(folder, [*typed, "-n"])[0] for _ in range(3)]
        n_jobs = int(re.findall(r"^total +(\d+)", said(folder, [*typed, "-n"]), re.MULTILINE)[0])
        listed = said(folder, [*typed, "--summary"]).splitlines()[1:]
        files = [folder / line.split("\t")[0] for line in listed]
        # Gone once they are joined are those of the parts.
        files = [file for file in files if not {"parts", "certificates"} & set(file.parts)]
        for file in files:
            if file.name == "figures":
                file.mkdir()
                continue
            with kept_file(file) as unfinished, unfinished.open("wb") as empty:
                empty.truncate(OF_A_SEED * seeds // len(files))
        spent(folder, [*typed, "--touch"])
        idle = [spent(folder, typed)[0] for _ in range(3)]
        if "Nothing to be done" not in said(folder, typed):
            raise SystemExit("there was something to be done")
        print(
            f"| {n_jobs} | {seeds} | {min(plan):.1f} | {size(folder / 'results') / 1e6:.0f} | "
            f"{min(idle):.1f} |",
            flush=True,
        )


def said(folder: Path, command: Sequence[str | Path]) -> str:
    """What a command prints."""
    return subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
    ).stdout


if __name__ == "__main__":
    main()
