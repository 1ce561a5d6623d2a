"""What the campaign of faults.py works on: a small study in a folder, its steps, its content."""

import contextlib
import ctypes
import hashlib
import json
import mmap
import os
import re
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pandas as pd

from iksamples.files import is_intact


ROOT = Path(__file__).parents[1]

STUDY = """
name: faults
robot: {urdf: config/robots/planar2r.urdf, home_rad: {shoulder: 0.3, elbow: 1.4}}
task: {inputs: [x, y]}
workspace: {lower_mm: [60, 20], upper_mm: [120, 100]}
samples: {sizes: [9, 16]}
network: {hidden: [4], activation: tanh}
training: {optimizer: levenberg-marquardt, epochs: 10, seeds: 2, snapshots: 3}
methods:
  relu: {network: {activation: relu}, training: {optimizer: adam, epochs: 20}}
  cubic: {kind: cubic}
evaluation:
  cube_points: 64
  paths: {heart: {shape: heart, waypoints: 8}}
bounds: {sup_rtol: 0.5, mean_rtol: 0.5, mean_atol_mm: 5}
tolerance: {error_mm: 500, success_share: 0.1, confidence: 0.6}
replication: {seeds: 2}
"""
RESULTS = Path("results/faults")
SNAKEMAKE = [sys.executable, "-P", "-m", "snakemake"]
COMMAND = [*SNAKEMAKE, "--cores", "2", "--configfile", "faults.yaml"]
PATIENCE_S = 900.0
"""After this a command is said to hang."""


class State(ctypes.Structure):
    """What faults.c shares with every process of a command."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("armed", "count", "at", "action", "lasting")),
        *((name, ctypes.c_long) for name in ("group", "stopped")),
        *((name, ctypes.c_char * 1024) for name in ("root", "log", "what")),
    )


class Shim:
    """The compiled library, and the state that it reads."""

    def __init__(self, folder: Path) -> None:
        """Compiles it into a folder, or takes what is there."""
        self.library, self.file = folder / "faults.so", folder / "state"
        if "FAULTS_STATE" not in os.environ:
            compile_it = ["gcc", "-shared", "-fPIC", "-O2", "-o", self.library]
            subprocess.run([*compile_it, ROOT / "benchmarks/faults.c"], check=True)
            self.file.write_bytes(bytes(ctypes.sizeof(State)))
        with self.file.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 0)
        self.state = State.from_buffer(self._map)

    def environment(self) -> dict[str, str]:
        """For processes that are to be watched."""
        return {"LD_PRELOAD": str(self.library), "FAULTS_STATE": str(self.file)}

    def arm(self, root: Path, action: int = 0, at: int = 0, lasting: bool = False) -> None:
        """Counts from here on what is done below a folder, and does something at one operation.

        Args:
            root: The folder.
            action: 0: nothing; below 0: a signal to the group; above: this error.
            at: The operation, from 0.
            lasting: Whether every later operation fails, too.
        """
        state = self.state
        state.count, state.at, state.action, state.lasting = 0, at, action, lasting
        state.root, state.log, state.what = f"{root}/".encode(), b"", b""
        state.stopped = 0
        state.armed = 1

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """Lets it watch something else for a while."""
        kept = bytes(self.state)
        self.state.armed = 0
        yield
        ctypes.memmove(ctypes.addressof(self.state), kept, len(kept))

    def disarm(self) -> int:
        """Stops counting; operations so far."""
        self.state.armed = 0
        return self.state.count


def project(folder: Path) -> Path:
    """What a run needs of the project and the study, in a new folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in ("workflow", "profiles", "config"):
        shutil.copytree(ROOT / name, folder / name)
    shutil.copy(ROOT / "Snakefile", folder)
    (folder / "faults.yaml").write_text(STUDY, encoding="utf-8")
    return folder


def restore(kept: Path, folder: Path) -> None:
    """Puts back what a folder was, times of files too."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(kept, folder, symlinks=True)


def steps(folder: Path) -> dict[str, list[str]]:
    """The arguments of `iksamples` in every job of the study, by name, in their order."""
    dry = [*COMMAND, "-n", "-p", "--quiet", "host"]
    done = subprocess.run(dry, cwd=folder, capture_output=True, text=True, check=True)
    found = {}
    for line in re.findall(r'"\$IKSAMPLES_PYTHON" -P -m iksamples (.*)', done.stdout + done.stderr):
        words = shlex.split(line.partition(" 2> >(")[0])
        method = [w.removeprefix("--method=") for w in words if w.startswith("--method=")]
        if "--method" in words:
            method = [words[words.index("--method") + 1]]
        found["-".join([words[0], *method])] = words
    return found


def call(
    arguments: list[str],
    folder: Path,
    shim: Shim,
    say: Path,
    then: Callable[[], None] = lambda: None,
    at_stop: Callable[[], bool] = lambda: True,
) -> tuple[int, str]:
    """Runs a command of iksamples in a fork of this process, which has the libraries loaded.

    Args:
        arguments: What is typed after `iksamples`.
        folder: The working folder.
        shim: Its group is set to the command's.
        say: File for what the command says.
        then: Called in the fork after the command.
        at_stop: Called whenever the command is stopped; says whether it may go on.

    Returns:
        Its exit status (below 0: the signal that ended it; -1000 where it had to be stopped), and
        what it said.
    """
    say.unlink(missing_ok=True)
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            os.setsid()
            shim.state.group = os.getpid()
            os.chdir(folder)
            to = os.open(say, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.dup2(to, 1)
            os.dup2(to, 2)
            code = _main(arguments)
            then()
        finally:
            os._exit(code)
    end = time.monotonic() + PATIENCE_S
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG | os.WUNTRACED)
        if ended and os.WIFSTOPPED(status):
            goes_on, end = at_stop(), time.monotonic() + PATIENCE_S
            shim.state.group, shim.state.stopped = pid, 0
            os.killpg(pid, signal.SIGCONT if goes_on else signal.SIGKILL)
        elif ended:
            break
        elif time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return -1000, _read(say)
        time.sleep(0.001)
    with contextlib.suppress(ProcessLookupError):  # its children
        os.killpg(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(status), _read(say)


def _main(arguments: list[str]) -> int:
    """As Python runs `iksamples`: what it prints and returns at the end."""
    import atexit

    from iksamples.cli import main

    sys.argv = ["iksamples", *arguments]
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8", errors="replace") if file.exists() else ""


def said_plainly(text: str) -> str:
    """What is wrong with how an error was told; nothing if it was told in a line or two."""
    if "Traceback" in text:
        return f"traceback, ending: {text.strip().splitlines()[-1][:160]}"
    lines = [line for line in text.splitlines() if line.startswith(("Error: ", "Warning: "))]
    if not lines:
        return f"no line that says what is wrong: {text.strip()[-160:]!r}"
    return f"{len(lines)} lines of errors" if len(lines) > 2 else ""


# What a folder holds

_ASIDE = {".snakemake", "logs", "benchmarks", "workflow", "profiles", "config"}
_NEVER = (".unfinished", "-journal", "-wal", "-shm")


def content(folder: Path, store: bool = True) -> dict[str, str]:
    """Every file of a folder with a digest of what it holds, and every run of its MLflow store.

    Bytes, but for: the column of seconds in certificates, when a recording was made and its ids,
    ids of runs, and of index.html the numbers (which has times; README.md has the same numbers) and
    the section of costs, whose rows are sorted by time.

    Args:
        folder: The folder.
        store: Whether to look into the store. To open one that was killed mends it.
    """
    found = {}
    for file in sorted(folder.rglob("*")):
        place = file.relative_to(folder)
        if file.is_dir() or _ASIDE & set(place.parts):
            continue
        if place.parts[0] in ("mlruns", "mlflow.db"):
            continue
        if "mlflow.db" in str(place):
            found[str(place)] = "not SQLite's file itself"
        elif file.name.endswith(".sha256"):
            kept = file.with_name(file.name[1:-7])
            found[str(place)] = "as written" if is_intact(kept) else "not that of its file"
        else:
            found[str(place)] = _digest(file)
    if store and (folder / "mlflow.db").exists():
        found |= store_content(folder / "mlflow.db", folder / "mlruns")
    return found


def _digest(file: Path) -> str:
    data = file.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    with contextlib.suppress(ValueError, LookupError, RuntimeError):  # a part of a file
        if file.suffix == ".rrd" and not file.name.startswith(".unfinished"):
            return _recording(digest, file)
        if file.name == "certificates.csv":
            data = pd.read_csv(file).drop(columns="seconds").to_csv().encode()
        elif file.name == "index.html":
            data = re.sub(rb'<h2 id="cost">.*?<h2 ', b"", data, flags=re.DOTALL)
            data = re.sub(rb"\d+(\.\d+)?", b"#", data)
        elif file.name == "tracking.json":
            kept = json.loads(data)
            data = json.dumps({**kept, "runs": sorted(kept["runs"]), "tracking_uri": ""}).encode()
        return hashlib.sha256(data).hexdigest()
    return digest


@cache
def _recording(digest: str, file: Path) -> str:
    """Of all that a recording holds, but for ids and times."""
    from rerun.experimental import RrdReader

    parts = []
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [n for n in sorted(batch.schema.names) if not n.startswith("rerun.controls")]
        columns = {name: str(batch.column(name).to_pylist()) for name in names}
        parts.append(json.dumps([str(chunk.entity_path), columns]))
    return hashlib.sha256("\n".join(sorted(parts)).encode()).hexdigest()


def store_content(database: Path, artifacts: Path) -> dict[str, str]:
    """Every run of a store by its name, and what it holds; doubled ones and orphans too."""
    found: dict[str, str] = {}
    with contextlib.closing(sqlite3.connect(database)) as store:
        names = dict(store.execute("SELECT run_uuid, name FROM runs").fetchall())
        for run, name in names.items():
            [(status, stage)] = store.execute(
                "SELECT status, lifecycle_stage FROM runs WHERE run_uuid = ?", [run]
            )
            parts = [status, stage]
            for table in ("params", "tags"):
                rows = store.execute(f"SELECT key, value FROM {table} WHERE run_uuid = ?", [run])
                parts += [f"{key}={names.get(value, value)}" for key, value in sorted(rows)]
            rows = store.execute("SELECT key, step, value FROM metrics WHERE run_uuid = ?", [run])
            parts += map(str, sorted(rows))
            parts += store.execute(
                "SELECT count(*) FROM inputs WHERE destination_id = ?", [run]
            ).fetchone()
            files = [file for place in artifacts.glob(f"*/{run}") for file in place.rglob("*")]
            for file in sorted(file for file in files if file.is_file()):
                where = file.relative_to(artifacts).parts[2:]
                # MLflow's own description has the time and a new id.
                parts.append(f"{where} {'' if file.name == 'MLmodel' else _digest(file)}")
            place = f"MLflow run {name}"
            while place in found:
                place += " again"
            found[place] = "\n".join(map(str, parts))
    for folder in artifacts.glob("*/*"):
        if folder.name not in names:
            found[f"MLflow artifacts of no run {folder.name}"] = "orphan"
    return found


def differences(found: dict[str, str], wanted: dict[str, str]) -> list[str]:
    """What two folders' contents differ in, in words."""
    said = [f"missing: {name}" for name in wanted.keys() - found.keys()]
    said += [f"left over: {name}" for name in found.keys() - wanted.keys()]
    both = found.keys() & wanted.keys()
    said += [f"differs: {name}" for name in both if found[name] != wanted[name]]
    said += [f"unfinished: {n}" for n in wanted if any(mark in n for mark in _NEVER)]
    return sorted(said)


def damaged(name: str, data: bytes) -> bytes:
    """A file's bytes as a fault leaves them: "cut" or "flipped" in one bit."""
    if name == "cut":
        return data[: len(data) // 2]
    at = len(data) // 2
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
