"""Where a report comes from: commit, versions, machine. For the page only, never for results."""

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path


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
