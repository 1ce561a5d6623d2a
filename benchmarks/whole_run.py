"""Measures where the time of the paper's study goes, from a cold start to the finished report.

    python benchmarks/whole_run.py           # about 4 minutes; writes docs/whole-run.md

In a clone with nothing compiled the study runs three times: first as for a new user, then with its
results removed, so that only the compiled training loop is there already, then with nothing to be
done. Machines differ twofold, so the last two are also said as multiples of what importing the
libraries takes on the same machine. Time and processor of
jobs are Snakemake's (``benchmark:`` files); what imports take is Python's own account of a third
run (``PYTHONPROFILEIMPORTTIME``).
"""

import argparse
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from iksamples.report.data import read_benchmarks


ROOT = Path(__file__).parents[1]

WHAT = {
    "samples": "recording the samples",
    "train": "training the networks, and writing their histories",
    "evaluate": "paths and workspace of every network",
    "bounds": "the paper's bounds",
    "prove": "worst case and mean of every network, proved and checked",
    "map": "error map, and the worst case along the training",
    "collect": "joining errors and proofs in one table",
    "table": "the paper's table and claims",
    "answer": "the answer",
    "track": "logging to MLflow",
    "record": "recordings for Rerun",
    "report": "drawing and writing the report",
}

LIBRARIES = "import pytorch_lightning, mlflow, rerun, pandas, matplotlib.pyplot"
"""What a run cannot do without: the measure of a machine."""


def main() -> None:
    """Runs, reads and writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the page")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "iksamples"
        subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
        cold, cold_jobs = _run(clone)
        warm, warm_jobs = _run(clone)
        snakemake = [Path(sys.executable).with_name("snakemake"), "--cores", "2"]
        idle_s = min(_seconds(clone, snakemake) for _ in range(3))
        libraries_s = min(_seconds(clone, [sys.executable, "-c", LIBRARIES]) for _ in range(3))
        _, _ = _run(clone, PYTHONPROFILEIMPORTTIME="1")
        imports = _imports(clone)
    page = _page(cold, cold_jobs, warm, warm_jobs, imports, idle_s, libraries_s)
    (options.out / "whole-run.md").write_text(page, encoding="utf-8")
    print(f"written: {options.out / 'whole-run.md'}")


def _run(clone: Path, **more: str) -> tuple[dict[str, float], pd.DataFrame]:
    """The whole study from nothing; its wall clock and processor, and its jobs."""
    for name in ("results", "reports", ".snakemake", "mlflow.db", "mlartifacts"):
        path = clone / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall = _seconds(clone, [Path(sys.executable).with_name("snakemake"), "--cores", "2"], **more)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = sum(getattr(after, key) - getattr(before, key) for key in ("ru_utime", "ru_stime"))
    jobs = read_benchmarks(clone / "results/paper/benchmarks")
    return {"wall_s": wall, "cpu_s": spent}, jobs


def _seconds(clone: Path, command: list[str | Path], **more: str) -> float:
    """Wall clock of a command in the clone [s]."""
    environment = os.environ | {"PYTHONPATH": str(clone / "src"), **more}
    began = time.perf_counter()
    subprocess.run(command, cwd=clone, env=environment, check=True, stderr=subprocess.DEVNULL)
    return time.perf_counter() - began


def _imports(clone: Path) -> dict[str, float]:
    """What imports took in each step, all its jobs together [s]."""
    logs = clone / "results/paper/logs"
    texts: dict[str, str] = {}
    for file in sorted(logs.rglob("*.log")):
        step = file.relative_to(logs).parts[0].removesuffix(".log")
        texts[step] = texts.get(step, "") + file.read_text(encoding="utf-8")
    # Training and logging report on the terminal instead, so once more by hand.
    results = clone / "results/paper"
    study, sets = results / "study.json", sorted((results / "samples").glob("*.parquet"))
    again = clone / "again"
    commands = {
        "train": ["train", study, *sets, "--output", again],
        "track": ["track", study, "--results", results, "--output", again / "tracking.json"],
    }
    for step, arguments in commands.items():
        if step not in texts:
            done = subprocess.run(
                [Path(sys.executable).with_name("iksamples"), *arguments],
                cwd=clone,
                env=os.environ | {"PYTHONPATH": str(clone / "src"), "PYTHONPROFILEIMPORTTIME": "1"},
                check=True,
                capture_output=True,
                text=True,
            )
            texts[step] = done.stderr
    line = re.compile(r"^import time:\s+(\d+) \|", re.MULTILINE)
    return {step: sum(map(int, line.findall(text))) / 1e6 for step, text in texts.items()}


def _page(
    cold: dict[str, float],
    cold_jobs: pd.DataFrame,
    warm: dict[str, float],
    warm_jobs: pd.DataFrame,
    imports: dict[str, float],
    idle_s: float,
    libraries_s: float,
) -> str:
    spent = warm_jobs.groupby("step")["cpu_s"].sum()
    rows = {
        "imports, all jobs together": sum(imports.values()),
        "compiling the training loop, on the first run only": float(
            cold_jobs.set_index("step").loc["train", "cpu_s"] - spent["train"]
        ),
    }
    for step, what in WHAT.items():
        rows[what] = max(0.0, float(spent[step]) - imports[step])
    rows["Snakemake, and what its benchmarks do not see"] = cold["cpu_s"] - sum(rows.values())
    total = cold["cpu_s"]
    lines = [
        "# Where the time of the whole run goes",
        "",
        "Written by `python benchmarks/whole_run.py`; do not edit.",
        "",
        f"The paper's study (`config/config.yaml`), {os.cpu_count()} cores, "
        f"{platform.platform()}, load {os.getloadavg()[0]:.1f} at the end.",
        "",
        f"* From a clone with nothing compiled to the finished report: **{cold['wall_s']:.0f} s**, "
        f"{cold['cpu_s']:.0f} s of processor.",
        f"* The same again with its results removed: {warm['wall_s']:.0f} s, "
        f"{warm['cpu_s']:.0f} s of processor; {warm['wall_s'] / libraries_s:.1f} times what "
        f"`{LIBRARIES}` takes ({libraries_s:.1f} s).",
        f"* With nothing to be done: {idle_s:.1f} s; {idle_s / libraries_s:.2f} times that.",
        "",
        "| what | processor [s] | share [%] |",
        "|---|---:|---:|",
        *(
            f"| {what} | {seconds:.1f} | {100 * seconds / total:.0f} |"
            for what, seconds in sorted(rows.items(), key=lambda row: -row[1])
        ),
        f"| all | {total:.1f} | 100 |",
        "",
        "Jobs, as Snakemake measures them (first run):",
        "",
        "| step | jobs | wall clock [s] | processor [s] | of it imports [s] | memory [MB] |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    by_step = cold_jobs.groupby("step")
    for step in WHAT:
        jobs = by_step.get_group(step)
        lines.append(
            f"| {step} | {len(jobs)} | {jobs['s'].sum():.1f} | {jobs['cpu_s'].sum():.1f} | "
            f"{imports[step]:.1f} | {jobs['max_rss_mb'].max():.0f} |"
        )
    lines += [
        "",
        "Python counts its imports a little high when it is asked to count them.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
