"""What the report says of the run: the study in a line, paths, cost, and how it was made."""

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from iksamples.report import views
from iksamples.report.data import ReportData
from iksamples.report.markdown import code, percent
from iksamples.report.views import scene
from iksamples.study import Arm, Study
from iksamples.task import study_task
from iksamples.text import OPTIMIZERS


_PATH_SETS = 4
"""So many sets of samples are shown on a path."""


def facts(data: ReportData) -> list[str]:
    """The study in a line: arm, workspace, network, training, samples."""
    study, samples = data.study, data.sets[0]
    n = [one.n_samples for one in data.sets]
    space, joints, training = samples.space, samples.joint_space, study.training
    ranges = ", ".join(
        f"{name} {low:g} to {high:g} {unit}"
        for name, unit, low, high in zip(
            space.names, space.units, space.lower, space.upper, strict=True
        )
    )
    share = samples.region.volume / float(np.prod(space.upper - space.lower))
    budget = f"{training.steps} steps" if training.steps else f"{training.epochs} epochs"
    return [
        f"arm {Path(study.robot.urdf).stem}: {', '.join(joints.names)}",
        f"workspace {ranges}"
        + (f", of which the arm can use {percent(share, 1, 'down')}" if share < 1 - 1e-9 else ""),
        f"network {'-'.join(map(str, [len(space), *study.network.hidden, len(joints)]))}, "
        f"{study.network.activation}",
        f"{OPTIMIZERS[training.optimizer]}, {budget}",
        f"{min(n)} to {max(n)} samples ({', '.join(study.samples.designs)})",
        f"{training.seeds} arms, each with a training of its own"
        if study.arm
        else f"{training.seeds} trainings each",
    ]


def paths(data: ReportData) -> dict[str, Any]:
    """The paths as the networks draw them, and the commands that open the recordings."""
    uri = str(data.tracking.get("tracking_uri", ""))
    local = "" if uri in ("", "sqlite:///mlflow.db") else f" --backend-store-uri {shlex.quote(uri)}"
    return (_drawn(data) if data.cells else {}) | {
        "recordings": [
            shlex.join(["rerun", (data.results / "recordings" / f"{name}.rrd").as_posix()])
            for name in data.study.evaluation.paths
        ],
        "put_off": data.tracking.get("command"),
        "server": uri if uri.startswith("http") else None,
        "mlflow": f"MLFLOW_DISABLE_TELEMETRY=true mlflow ui{local}",
    }


def _drawn(data: ReportData) -> dict[str, Any]:
    """The pictures of the paths."""
    chain_of = study_task(data.study, data.sets[0].region).chain_of
    waypoints = data.table("waypoints")
    box = np.array(data.study.workspace.lower_mm), np.array(data.study.workspace.upper_mm)
    labels = list(data.cells)
    spread = np.unique(np.linspace(0, len(labels) - 1, min(_PATH_SETS, len(labels))).round())
    few = [labels[int(i)] for i in spread]
    names = list(data.study.evaluation.paths)

    def panel(label: str, path: str) -> tuple[int, views.Strokes, Any]:
        rows = waypoints[(waypoints["label"] == label) & (waypoints["path"] == path)]
        strokes = views.Strokes(rows[rows["seed"] == data.shown[label]])
        samples = data.samples_mm(label)
        return len(samples), strokes, samples

    return {
        "scene": scene(data, chain_of, waypoints),
        "arm": views.arm(chain_of, box, [panel(label, names[-1]) for label in (few[0], few[-1])]),
        "plans": views.plans([panel(label, names[0]) for label in few]),
        "arm_path": names[-1],
    }


def cost(data: ReportData) -> dict[str, Any]:
    """Time and memory of every step, from Snakemake's benchmark files."""
    jobs = data.benchmarks
    if jobs.empty:
        return {}
    total = jobs["s"].sum()
    by = jobs.groupby("step")
    table = pd.DataFrame(
        {
            "Jobs": by.size(),
            "Wall clock [s]": by["s"].sum(),
            "Share [%]": 100 * by["s"].sum() / total if total else np.nan,
            "Longest job [s]": by["s"].max(),
            "Processor [s]": by["cpu_s"].sum(min_count=1),
            "Peak memory [MB]": by["max_rss_mb"].max(),
        }
    )
    members = data.table("members")
    return {
        "table": table.sort_values("Wall clock [s]", ascending=False).reset_index(names="Step"),
        "total": total,
        "peak": jobs["max_rss_mb"].max(),
        "networks": len(members),
        "steps": members["steps"].sum() if len(members) else 0,
    }


def made(data: ReportData) -> dict[str, Any]:
    """What was run, on what, from which state of the code."""
    study = data.study
    about = {"name", "title", "tracking", "methods"}
    paper = Study(name="paper", arm=Arm() if study.arm else None)
    theirs, ours = (one.model_dump(mode="json", exclude=about) for one in (paper, study))
    changed = list(differing(theirs, ours))
    facts = {
        "Git commit": commit(),
        "Built": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "Versions": versions(),
        "Machine": machine(),
    }
    return {
        "command": data.command,
        "digest": study.digest(),
        "settings": (data.results / "study.json").as_posix(),
        "changed": pd.DataFrame(changed, columns=["Setting", "Paper study", "Here"], dtype=object),
        "facts": pd.DataFrame(facts.items(), columns=["What", "Value"]),
    }


def differing(there: Any, here: Any, key: str = "") -> Iterator[tuple[Markup, Markup, Markup]]:
    """Settings that differ, as the study file writes them: dotted key, there and here."""
    if there == here:
        return
    if not (isinstance(there, dict) and isinstance(here, dict)):
        yield code(key), code(_yaml(there)), code(_yaml(here))
        return
    for name in [*there, *(name for name in here if name not in there)]:
        yield from differing(there.get(name), here.get(name), f"{key}.{name}" if key else name)


def _yaml(value: Any) -> str:
    import yaml

    return yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n...")[0].strip()


_PACKAGES = (
    "iksamples",
    "torch",
    "pytorch-lightning",
    "numba",
    "numpy",
    "scipy",
    "pandas",
    "snakemake",
    "mlflow",
    "rerun-sdk",
    "matplotlib",
)


def commit() -> str:
    """The working folder's git commit, and whether files differ from it."""
    head = _git("rev-parse", "--short=12", "HEAD")
    if not head:
        return "not under version control, or nothing committed yet"
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return f"{head}, with changes that are not committed" if changed else head


def versions() -> str:
    """Python and the packages that take part, with their versions."""
    found = [f"Python {platform.python_version()}"]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def machine() -> str:
    """Processor, cores, memory and operating system."""
    parts = [_processor(), f"{os.cpu_count()} cores", _memory(), platform.platform()]
    return ", ".join(part for part in parts if part)


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _memory() -> str:
    if sys.platform == "win32":
        return ""
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return ""
    return f"{size / 2**30:.0f} GiB memory"
