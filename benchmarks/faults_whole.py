"""The trials of faults.py that need more than one step: whole runs, mounts, damage, a server."""

import contextlib
import logging
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from faults_folder import (
    COMMAND,
    PATIENCE_S,
    ROOT,
    Shim,
    content,
    damaged,
    differences,
    project,
    restore,
    said_plainly,
    store_content,
)


WHOLE = {
    "run-SIGKILL": ("a whole run killed at a file operation", 12),
    "run-SIGTERM": ("a whole run told to end (SIGTERM) at one", 6),
    "run-SIGINT": ("Ctrl-C in a whole run at one", 6),
    "one-SIGKILL": ("one process of a run killed at one of its file operations", 8),
    "cut": ("a file of the finished study cut to half", 0),
    "flipped": ("one bit of a file turned, its time left as it was", 0),
    "deleted": ("a file deleted", 0),
    "read-only": ("a step in a folder mounted read-only", 0),
    "small-disk": ("a step on a file system with room for half of what it writes", 0),
    "together": ("two runs at once", 6),
    "server-refuse": ("a tracking server that answers 500 to a request, and to every tenth", 0),
    "server-lost": ("one that does what it is asked and answers 500", 0),
    "server-away": ("one that is gone from a request on", 0),
}
"""Kinds of trials: what goes wrong, and how many there are where that is not counted."""
_SPACE = 4.0
"""Whole runs take so much longer than steps; so many turns lie between two of a kind."""


class Whole:
    """A finished study in a folder, and what can happen to it."""

    def __init__(self, folder: Path, shim: Shim, on_steps) -> None:
        """Runs the study once undisturbed."""
        self.shim, self.on_steps, self.work = shim, on_steps, folder / "work"
        self.new, self.finished, self.say = folder / "new", folder / "finished", folder / "run.txt"
        project(self.new)
        restore(self.new, self.work)
        code, said = self.run()
        if code:
            sys.exit(f"the study fails undisturbed: {said}")
        self.operations = shim.state.count
        restore(self.work, self.finished)
        self.wanted = content(self.work)
        self.requests = 0

    def trials(self) -> Iterator[tuple[float, str]]:
        """When the turn of each is, and its name."""
        names = {kind: [] for kind in WHOLE}
        for kind, (_, n) in WHOLE.items():
            if "SIG" in kind:
                names[kind] = [(2 * i + 1) * self.operations // (2 * n) for i in range(n)]
        for kind in ("cut", "flipped", "deleted"):
            names[kind] = self.kinds_of_files()
        for kind in ("read-only", "small-disk"):
            names[kind] = list(self.on_steps.commands)
        names["together"] = ["same-folder", "two-studies", *(f"one-store-{i}" for i in range(6))]
        self.requests = self.count_requests()
        for kind in ("server-refuse", "server-lost", "server-away"):
            names[kind] = list(range(0, self.requests, 3))
        for kind, each in names.items():
            space = _SPACE if kind[:3] in ("run", "one", "cut", "fli", "del", "tog") else 1.5
            for turn, name in enumerate(each):
                yield space * (turn + 0.5), f"{kind}/{name}"

    def trial(self, kind: str, name: str) -> tuple[str, str]:
        """One trial: what was hit, and what is wrong afterwards."""
        if "SIG" in kind:
            return self.stopped(kind, int(name))
        if kind in ("cut", "flipped", "deleted"):
            return self.damage(kind, name)
        if kind.startswith("server"):
            return self.server(kind, int(name))
        if kind == "together":
            return name, self.together(name)
        return self.mounted(kind, name)

    def run(self, action: int = 0, at: int = 0, group: bool = True) -> tuple[int, str]:
        """Types the study's command, and lets something happen at an operation."""
        with self.say.open("w") as say:
            self.shim.arm(self.work, action, at)
            process = _start(self.work, say)
            self.shim.state.group = process.pid if group else 0
            code = _end(process)
            self.shim.disarm()
        return code, self.say.read_text(errors="replace")

    def again(self) -> str:
        """What is wrong after the same command again."""
        code, said = self.run()
        if code:
            return f"again: exit {code}: {said.strip()[-300:]}"
        return "; ".join(differences(content(self.work), self.wanted)[:3])

    def stopped(self, kind: str, at: int) -> tuple[str, str]:
        """A run, or one of its processes, ended at an operation."""
        restore(self.new, self.work)
        who, _, name = kind.partition("-")
        code, said = self.run(-getattr(signal, name), at, who == "run")
        hit = self.shim.state.what.decode(errors="replace")
        if not hit:
            return "", ""
        if code == 0 and (left := differences(content(self.work), self.wanted)):
            return hit, f"exit 0, but {left[0]}"
        if code == -1000 or "Traceback" in said:
            return hit, "hangs" if code == -1000 else said_plainly(said)
        return hit, self.again()

    # Damage

    def kinds_of_files(self) -> list[str]:
        """One file of each kind that the study wrote, but for what nothing reads afterwards."""
        found = {}
        for file in sorted([*self.work.glob("results/**/*"), *self.work.glob("reports/**/*")]):
            place = file.relative_to(self.work)
            if not file.is_file() or {"logs", "benchmarks", "cache", "fresh"} & set(place.parts):
                continue
            if file.suffix in (".sha256", ".lock") or not file.stat().st_size:
                continue
            # Of a set of samples, a method and a figure one stands for all.
            kind = re.sub(r"grid\d|(?<=/)(relu|cubic)(?=/)|(?<=figures/)[^.]+", "", str(place))
            found.setdefault(kind, str(place))
        return list(found.values())

    def damage(self, how: str, name: str) -> tuple[str, str]:
        """A file of the finished study changed, and the command typed until it has no error."""
        restore(self.finished, self.work)
        file, before = self.work / name, (self.work / name).stat()
        if how == "deleted":
            file.unlink()
        else:
            file.write_bytes(damaged(how, file.read_bytes()))
        if how == "flipped":
            os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
        for _ in range(3):
            code, said = self.run()
            if code == 0 or "Traceback" in said:
                break
        if code or "Traceback" in said:
            return how, f"exit {code}: {said_plainly(said) or said.strip()[-200:]}"
        found = {k: v for k, v in content(self.work).items() if ".damaged" not in k}
        return how, "; ".join(differences(found, self.wanted)[:3])

    # File systems

    def mounted(self, kind: str, step: str) -> tuple[str, str]:
        """A step on a real file system that is read-only or too small."""
        on = self.on_steps
        restore(on.before(step), self.work)
        _mount("--bind", self.work, self.work)
        try:
            if kind == "read-only":
                _mount("-o", "remount,bind,ro", self.work)
                code, said = on.run(step)
                _mount("-o", "remount,bind,rw", self.work)
            else:
                code, said = self.fill(step)
            if code == 0 and "Warning: " not in said:
                return kind, f"exit 0 on a {kind} file system"
            if wrong := said_plainly(said):
                return kind, wrong
            return kind, on.recovers(step)
        finally:
            while subprocess.run(["umount", self.work], capture_output=True).returncode == 0:
                pass

    def fill(self, step: str) -> tuple[int, str]:
        """A step with half the room it needs, on a file system that is then enlarged."""
        on = self.on_steps
        before = _pages(self.work)
        on.run(step)
        needed = _pages(self.work) - before
        _mount("-t", "tmpfs", "-o", f"size={before + needed // 2}k", "tmpfs", self.work)
        subprocess.run(["cp", "-a", f"{on.before(step)}/.", self.work], check=True)
        code, said = on.run(step)
        _mount("-o", "remount,size=200m", self.work)
        return code, said

    # Two at once

    def together(self, name: str) -> str:
        """Two runs at the same time, in one folder or on one store."""
        restore(self.new, self.work)
        if name.startswith("one-store"):
            return self.one_store()
        with self.say.open("w") as say:
            first = _start(self.work, say)
            while not (self.work / ".snakemake/iksamples.lock").exists() and first.poll() is None:
                time.sleep(0.05)
            time.sleep(1.0)
            other = [*COMMAND, "--config", "name=other"] if name == "two-studies" else COMMAND
            second = subprocess.run(other, cwd=self.work, capture_output=True, text=True)
            code = _end(first)
        if second.returncode != 2 or "another run is working" not in second.stderr:
            return f"the second ends with {second.returncode}: {second.stderr[-200:]}"
        if code:
            return f"the first ends with {code}"
        return "; ".join(differences(content(self.work), self.wanted)[:3])

    def one_store(self) -> str:
        """The runs of two folders logged to one new store at the same time."""
        on, folders = self.on_steps, [self.work, self.work.with_name("beside")]
        database = self.work.with_name("shared.db")
        for file in database.parent.glob("shared.db*"):
            file.unlink()
        for folder in folders:
            restore(on.before("track"), folder)
        processes = [
            subprocess.Popen(
                [sys.executable, "-P", "-m", "iksamples", *on.commands["track"]],
                cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                env={**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{database}"},
            )
            for folder in folders
        ]  # fmt: skip
        said = [process.communicate()[0] for process in processes]
        if any(process.returncode for process in processes) or "Warning: " in "".join(said):
            return f"{said}"
        found = store_content(database, self.work / "mlruns")
        n_runs = sum(one.startswith("MLflow run") for one in self.wanted)
        if len(found) != 2 * n_runs or any(not v.startswith("FINISHED") for v in found.values()):
            return f"{len(found)} runs instead of {2 * n_runs}, or not all finished"
        left = [one.name for one in database.parent.glob("*shared.db*") if one != database]
        return f"left behind: {left}" if left else ""

    # A server

    def count_requests(self) -> int:
        """Requests of one undisturbed logging, which also says what the server then holds."""
        with self.served() as (server, database, artifacts):
            self.log_to(server.uri)
            self.on_server = store_content(database, artifacts)
            return server.asked

    @contextlib.contextmanager
    def served(self):
        """An empty store behind a server with faults."""
        sys.path.insert(0, str(ROOT / "tests"))
        from tracking_server import mlflow_server

        restore(self.on_steps.before("track"), self.work)
        logging.disable()  # of what the server thinks of its faults
        # A new folder each time: MLflow keeps a database of the same name open.
        with (
            tempfile.TemporaryDirectory(dir=self.work.parent) as folder,
            mlflow_server(Path(folder), f"sqlite:///{folder}/served.db") as server,
        ):
            yield server, Path(folder) / "served.db", Path(folder) / "artifacts"

    def log_to(self, uri: str) -> tuple[int, str]:
        """Logs the study to a server."""
        done = subprocess.run(
            [sys.executable, "-P", "-m", "iksamples", *self.on_steps.commands["track"]],
            cwd=self.work, capture_output=True, text=True,
            env={**os.environ, "MLFLOW_TRACKING_URI": uri},
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    def server(self, kind: str, at: int) -> tuple[str, str]:
        """Logs to a server with a fault at a request, then again without it."""
        with self.served() as (server, database, artifacts):

            def fault(n: int, path: str):
                if kind == "server-away":
                    return "refuse" if n >= at else None
                if n < at or (n - at) % 10:
                    return None
                return "refuse" if kind == "server-refuse" else "lose the answer"

            server.fault = fault
            code, said = self.log_to(server.uri)
            server.fault = lambda n, path: None
            if code or ("Warning: " in said and (wrong := said_plainly(said))):
                return kind, f"exit {code}: {wrong if code == 0 else said[-200:]}"
            code, said = self.log_to(server.uri)
            if code or "Warning: " in said:
                return kind, f"again: exit {code}: {said[-200:]}"
            return kind, "; ".join(
                differences(store_content(database, artifacts), self.on_server)[:3]
            )


def _start(folder: Path, say: IO[str]) -> subprocess.Popen:
    return subprocess.Popen(COMMAND, cwd=folder, stdout=say, stderr=say, start_new_session=True)


def _end(process: subprocess.Popen) -> int:
    """Waits for a run, and for all of it."""
    try:
        code = process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        code = -1000
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    return code


def _mount(*arguments: str | Path) -> None:
    subprocess.run(["mount", *arguments], check=True)


def _pages(folder: Path) -> int:
    """Room that a folder takes on a tmpfs [kB]."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    return sum(-(-file.stat().st_size // 4096) * 4 for file in files)
