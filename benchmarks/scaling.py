"""Measures what a seed costs from 1 to 1000 of them, and what Snakemake costs from 10 to 1000 jobs.

    python benchmarks/scaling.py seeds    # a minute or two of one core
    python benchmarks/scaling.py jobs

Prints the tables of docs/cluster.md: processor time, since other work on the machine hardly changes
it. One grid of 125 samples and 16 neurons; the studies for the second are generated, and their
results are empty files that Snakemake is told are up to date.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import yaml


ROOT = Path(__file__).parents[1]
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
    print("| jobs | to plan them (`-n`) [s] | with nothing to be done [s] |")
    print("|---:|---:|---:|")
    for parts in (1, 45, 495):
        study = write(
            folder, samples={"points_per_axis": [2]}, training={"seeds": 50 * parts},
            seeds_per_job=50,
        )  # fmt: skip
        shutil.rmtree(folder / "results", ignore_errors=True)
        shutil.rmtree(folder / ".snakemake", ignore_errors=True)
        typed = [SNAKEMAKE, "--cores", "2", "--configfile", study]
        plan = [spent(folder, [*typed, "-n"])[0] for _ in range(3)]
        listed = subprocess.run(
            [*typed, "--summary"], cwd=folder, capture_output=True, text=True, check=True
        ).stdout.splitlines()[1:]
        for line in listed:
            file = folder / line.split("\t")[0]
            if {"parts", "certificates"} & set(file.parts):
                continue  # gone once they are joined
            file.parent.mkdir(parents=True, exist_ok=True)
            file.mkdir(exist_ok=True) if file.name == "figures" else file.touch()
        spent(folder, [*typed, "--touch"])
        idle = [spent(folder, typed)[0] for _ in range(3)]
        n_jobs = 11 + (2 * parts if parts > 1 else 0)
        print(f"| {n_jobs} | {min(plan):.1f} | {min(idle):.1f} |", flush=True)


if __name__ == "__main__":
    main()
