"""Holds plans against runs: memory and processor time of each step, for studies of all shapes.

    python benchmarks/plan.py                # about 25 minutes of one core; writes docs/plan.md
    python benchmarks/plan.py --kept FOLDER  # runs only what has not run in FOLDER yet

Each study runs by Snakemake, one job at a time, and every process says at its end what it has used
(``getrusage``): memory at its largest, and time of the processor, user and system, which a loaded
machine changes less than time on the clock. Snakemake itself is not in it.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from iksamples.methods.registry import KINDS
from iksamples.plan import plan_study
from iksamples.study import Study, read_study
from iksamples.study.reading import read_settings
from iksamples.study.study import overlay


ROOT = Path(__file__).parents[1]

GROUPS: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load(
    (ROOT / "benchmarks/plan.yaml").read_text(encoding="utf-8")
)
GROUPS_TOLD = {
    "held-out": (
        "Studies that had no part in the estimate",
        "Neither its constants nor its terms were chosen with them",
    ),
    "corrected": (
        "Studies that showed what it lacked",
        "They had no part in it at first: memory of the largest job was then within 4.7 times "
        "(adaptive samples import what trains), time of the longest step within 3.6 and of all "
        "steps within 4.4 (proofs in a plane), and later one step of theirs within 3.8 (proofs of "
        "deep networks). What was missing was added; with that",
    ),
    "fitted": (
        "Studies that its constants were read off",
        "Farthest off are scara's pictures: 50 epochs of a training are searched together, where "
        "the last takes 78 400 boxes, and 1080 alone, which no estimate foresees. Of these",
    ),
}
"""Groups of studies -> heading, and what is said of them."""
STEPS_TOLD = (
    "How many times too large or too small the estimate of a step is, at most, over all studies. "
    "Short steps count as much as long ones here."
)
STUDIES = {name: study for group in GROUPS.values() for name, study in group.items()}


WATCH = """
import atexit, json, resource, sys

def note():
    if "iksamples" in sys.argv[0] and len(sys.argv) > 1:
        used = resource.getrusage(resource.RUSAGE_SELF)
        with open({file!r}, "a") as out:
            job = {{"step": sys.argv[1], "arguments": sys.argv[2:]}}
            job |= {{"max_rss_mb": used.ru_maxrss / 1e3, "cpu_s": used.ru_utime + used.ru_stime}}
            print(json.dumps(job), file=out)

atexit.register(note)
"""


def run(name: str, place: Path) -> Path:
    """Runs a study in a folder of its own; a file with what each of its processes has used."""
    place.mkdir(parents=True, exist_ok=True)
    if not (place / "config").exists():
        (place / "config").symlink_to(ROOT / "config")
    settings = dict(STUDIES[name])
    base, records = settings.pop("base", None), settings.pop("records", None)
    if settings.pop("every-kind", False):
        kinds = {kind: {"kind": kind} for kind, one in KINDS.items() if one.fit}
        settings["methods"] = settings["methods"] | kinds
    if base:
        settings = overlay(read_settings(ROOT / f"config/studies/{base}.yaml"), settings)
    file = place / "study.json"
    file.write_text(json.dumps(settings | {"name": name}), encoding="utf-8")
    if records:
        _records(records).to_csv(place / "records.csv", index=False)
    jobs = place / "jobs.jsonl"
    watch = place / "watch"
    watch.mkdir(exist_ok=True)
    (watch / "sitecustomize.py").write_text(WATCH.format(file=str(jobs)), encoding="utf-8")
    subprocess.run(
        [
            Path(sys.executable).with_name("snakemake"),
            *("--cores", "1", "--directory", place, "--configfile", file),
            *("--snakefile", ROOT / "Snakefile"),
        ],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(watch), str(ROOT / "src")])},
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=(place / "log").open("w"),
    )
    return jobs


def _records(n: int) -> pd.DataFrame:
    """Records of an arm that is not its drawing, as the tests have them."""
    sys.path.append(str(ROOT / "tests"))
    from measured_arms import recorded

    return recorded(n=n)[2]


def compared(name: str, place: Path) -> pd.DataFrame:
    """A study's plan beside what its processes used: a row per step.

    Returns:
        Columns study, step, planned_mb and measured_mb (of the largest job), planned_s and
        measured_s (of all jobs).
    """
    study = read_study(place / "study.json")
    plan = {step.step: step for step in plan_study(study).steps}
    memory, seconds = dict[str, float](), dict[str, float]()
    for line in (place / "jobs.jsonl").read_text(encoding="utf-8").splitlines():
        job = json.loads(line)
        step = _rule(job["step"], job["arguments"], study)
        memory[step] = max(memory.get(step, 0.0), job["max_rss_mb"])
        seconds[step] = seconds.get(step, 0.0) + job["cpu_s"]
    return pd.DataFrame(
        {
            "study": name,
            "step": step,
            "planned_mb": plan[step].memory_mb,
            "measured_mb": memory[step],
            "planned_s": plan[step].seconds,
            "measured_s": seconds[step],
        }
        for step in memory
    )


def _rule(step: str, arguments: list[str], study: Study) -> str:
    """The rule that called a command."""
    if step == "evaluate" and any(one.startswith("--method=") for one in arguments):
        return "evaluate_untrained"
    if step == "readings":
        return {"report": "page"}.get(arguments[0], arguments[0])
    if study.samples.recorded:
        return {"answer": "size", "report": "describe"}.get(step, step)
    return step


def off(planned: Any, measured: Any) -> Any:
    """How many times too large or too small."""
    return np.maximum(planned / measured, measured / planned)


def studies_table(rows: pd.DataFrame) -> list[str]:
    """A row per study: its largest job, its longest step, and all."""
    lines = [
        "| study | largest job | planned [MB] | measured [MB] | longest step | planned [s] | "
        "measured [s] | all planned [s] | all measured [s] |",
        f"|{'---|' * 9}",
    ]
    for name, own in rows.groupby("study", sort=False):
        large, long = (own.loc[own[key].idxmax()] for key in ("measured_mb", "measured_s"))
        lines.append(
            f"| {name} | {large['step']} | {large['planned_mb']:.0f} | {large['measured_mb']:.0f} "
            f"| {long['step']} | {long['planned_s']:.1f} | {long['measured_s']:.1f} "
            f"| {own['planned_s'].sum():.0f} | {own['measured_s'].sum():.0f} |"
        )
    return lines


def within(rows: pd.DataFrame) -> str:
    """How far off the plan is, over some studies."""
    studies = list(rows.groupby("study"))
    large = [own.loc[own["measured_mb"].idxmax()] for _, own in studies]
    long = [own.loc[own["measured_s"].idxmax()] for _, own in studies]
    memory = max(off(one["planned_mb"], one["measured_mb"]) for one in large)
    longest = max(off(one["planned_s"], one["measured_s"]) for one in long)
    total = max(off(own["planned_s"].sum(), own["measured_s"].sum()) for _, own in studies)
    return (
        f"memory of the largest job within {memory:.2f} times, time of the longest step within "
        f"{longest:.2f} and of all steps within {total:.2f}"
    )


def steps_table(rows: pd.DataFrame) -> list[str]:
    """A row per kind of step: how far off over all studies, and where it is farthest off."""
    lines = ["| step | studies | memory | time | farthest off in time |", f"|{'---|' * 5}"]
    rows = rows.assign(
        memory=off(rows["planned_mb"], rows["measured_mb"]),
        time=off(rows["planned_s"], rows["measured_s"]),
    )
    for step, own in rows.groupby("step", sort=False):
        far = own.loc[own["time"].idxmax()]
        lines.append(
            f"| {step} | {len(own)} | {own['memory'].max():.2f} | {far['time']:.2f} | "
            f"{far['study']}: {far['planned_s']:.1f} for {far['measured_s']:.1f} s |"
        )
    return lines


def main() -> None:
    """Runs, reads and writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kept", type=Path, help="folder of runs, which stay")
    parser.add_argument("studies", nargs="*", help=f"which of {', '.join(STUDIES)}; default: all")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        base, frames = options.kept or Path(folder), []
        for name in options.studies or STUDIES:
            if not (base / name / "done").exists():
                run(name, base / name)
                (base / name / "done").touch()
            frames.append(compared(name, base / name))
    rows = pd.concat(frames, ignore_index=True)
    lines = [
        "# Plans against runs",
        "",
        f"Written by `{' '.join(['python benchmarks/plan.py', *options.studies])}`; do not edit.",
        "",
        f"{os.cpu_count()} cores, {platform.platform()}, load {os.getloadavg()[0]:.1f} at the end; "
        "one job at a time. Memory is a process's largest; time is that of the processor, user and "
        "system, by the process's own account, without Snakemake itself. The studies are in "
        "benchmarks/plan.yaml.",
    ]
    for group, told in GROUPS_TOLD.items():
        some = rows[rows["study"].isin(GROUPS[group])]
        lines += ["", f"## {told[0]}", ""]
        if len(some):
            lines += [f"{told[1]}: {within(some)}.", "", *studies_table(some)]
    lines += ["", "## Steps", "", STEPS_TOLD, "", *steps_table(rows)]
    (ROOT / "docs" / "plan.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
