"""Holds plans against runs: memory and processor time of each step, for studies of all shapes.

    python benchmarks/plan.py                # about 10 minutes of one core; writes docs/plan.md
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

import pandas as pd

from iksamples.plan import plan_study
from iksamples.study import Study, read_study
from iksamples.study.reading import read_settings
from iksamples.study.study import overlay


ROOT = Path(__file__).parents[1]

TANH = {"network": {"activation": "tanh"}}
SECOND = {"training": {"optimizer": "levenberg-marquardt", "epochs": 100, "seeds": 6}}
BEGUN = {"pose": "ur5e-pose", "scara": "scara"}
"""Study -> the one of config/studies that it is but for what it says."""
STUDIES: dict[str, dict[str, Any]] = {
    "paper": {"paper": True},
    "many-seeds": {"samples": {"points_per_axis": [3]}, "training": {"seeds": 300}},
    "many-points": {
        "samples": {"points_per_axis": [3]},
        "training": {"seeds": 8},
        "evaluation": {"cube_points": 1_000_000},
    },
    "wide": {
        "samples": {"points_per_axis": [3, 4]},
        "network": {"hidden": [256]},
        "training": {"seeds": 4},
    },
    "pose": {
        "samples": {"designs": ["sobol"], "sizes": [64, 256]},
        "training": {**SECOND["training"], "seeds": 3},
    },
    "scara": {"samples": {"sizes": [36, 144]}, "training": {**SECOND["training"], "seeds": 4}},
    "arms": {
        "arm": {"deviation_mm": 1, "deviation_rad": 0.01745, "noise_mm": 0.1},
        "samples": {"sizes": [27, 125]},
        "training": {"seeds": 10},
        "methods": {"calibrated": {"kind": "calibrated"}, "cubic": {"kind": "cubic"}},
        "bounds": {"sup_rtol": 0.02, "mean_rtol": 0.05},
    },
    "recorded": {
        "robot": {"urdf": "config/robots/rrr70.urdf"},
        "samples": {
            "sizes": [8, 30, 100, 300],
            "recorded": {"path": "records.csv", "subsets": 6},
        },
        **{key: {**TANH, **SECOND}[key] for key in ("network", "training")},
        "methods": {
            "gaussian-process": {"kind": "gaussian-process"},
            "calibrated": {"kind": "calibrated"},
        },
    },
    "methods": {
        "samples": {"points_per_axis": [3, 5, 8]},
        "training": {"seeds": 4},
        "methods": {
            "tanh": TANH,
            "converged": {**TANH, **SECOND},
            "converged-deep": {
                "network": {"activation": "tanh", "hidden": [16, 16]},
                "training": SECOND["training"],
            },
            **{
                kind: {"kind": kind}
                for kind in (
                    "multilinear",
                    "cubic",
                    "polynomial",
                    "rbf",
                    "gaussian-process",
                    "nominal",
                )
            },
        },
    },
    "large-grid": {
        "samples": {"points_per_axis": [8, 16, 24]},
        "training": {"seeds": 4, "epochs": 60},
        "methods": {"cubic": {"kind": "cubic"}, "table": {"kind": "multilinear"}},
    },
    "many-sizes": {
        "samples": {"designs": ["sobol", "latin"], "sizes": list(range(20, 220, 20))},
        "training": {"seeds": 4},
    },
    "readings": {"readings": {"count": 8, "best": 1, "fresh_seeds": 16, "jobs": 1}},
}


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
    base = ROOT / f"config/studies/{BEGUN.get(name)}.yaml"
    settings = overlay(read_settings(base) if base.exists() else {}, STUDIES[name])
    file = place / "study.json"
    file.write_text(json.dumps(settings | {"name": name}), encoding="utf-8")
    if name == "recorded":
        _records().to_csv(place / "records.csv", index=False)
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


def _records() -> pd.DataFrame:
    """Records of an arm that is not its drawing, as the tests have them."""
    sys.path.append(str(ROOT / "tests"))
    from measured_arms import recorded

    return recorded(n=420)[2]


def compared(name: str, place: Path) -> dict[str, Any]:
    """A study's plan beside what its processes used: its largest job, its longest step, all."""
    study = read_study(place / "study.json")
    plan = {step.step: step for step in plan_study(study).steps}
    memory, seconds = dict[str, float](), dict[str, float]()
    for line in (place / "jobs.jsonl").read_text(encoding="utf-8").splitlines():
        job = json.loads(line)
        step = _rule(job["step"], job["arguments"], study)
        memory[step] = max(memory.get(step, 0.0), job["max_rss_mb"])
        seconds[step] = seconds.get(step, 0.0) + job["cpu_s"]
    large, long = max(memory, key=memory.__getitem__), max(seconds, key=seconds.__getitem__)
    return {
        "study": name,
        "largest job": large,
        "planned [MB]": round(plan[large].memory_mb),
        "measured [MB]": round(memory[large]),
        "longest step": long,
        "planned [s]": round(plan[long].seconds, 1),
        "measured [s]": round(seconds[long], 1),
        "all planned [s]": round(sum(plan[step].seconds for step in seconds)),
        "all measured [s]": round(sum(seconds.values())),
    }


def _rule(step: str, arguments: list[str], study: Study) -> str:
    """The rule that called a command."""
    if step == "evaluate" and any(one.startswith("--method=") for one in arguments):
        return "evaluate_untrained"
    if step == "readings":
        return {"report": "page"}.get(arguments[0], arguments[0])
    if study.samples.recorded:
        return {"answer": "size", "report": "describe"}.get(step, step)
    return step


def main() -> None:
    """Runs, reads and writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kept", type=Path, help="folder of runs, which stay")
    parser.add_argument("studies", nargs="*", help=f"which of {', '.join(STUDIES)}; default: all")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        base, rows = options.kept or Path(folder), []
        for name in options.studies or STUDIES:
            if not (base / name / "done").exists():
                run(name, base / name)
                (base / name / "done").touch()
            rows.append(compared(name, base / name))
    head = list(rows[0])
    lines = [
        "# Plans against runs",
        "",
        f"Written by `{' '.join(['python benchmarks/plan.py', *options.studies])}`; do not edit.",
        "",
        f"{os.cpu_count()} cores, {platform.platform()}, load {os.getloadavg()[0]:.1f} at the end; "
        "one job at a time. Memory is a process's largest; time is that of the processor, user and "
        "system, by the process's own account, without Snakemake itself. The constants of the plan "
        "were read off runs of these studies on this machine: this says how well one formula fits "
        "all these shapes, not how well it foretells others.",
        "",
        f"| {' | '.join(head)} |",
        f"|{'---|' * len(head)}",
        *(f"| {' | '.join(str(value) for value in row.values())} |" for row in rows),
    ]
    (ROOT / "docs" / "plan.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
