"""What a kill at each file operation of a step leaves, without a kill at each of them.

A step runs once, and is stopped at every operation, with half of a write done: its folder is then
what a SIGKILL leaves there, since what is not in a file dies with the process. While it is stopped,
the same command is typed again in a copy of the folder under its own name.

Of operations that leave the same folder one is tried. Of unfinished files only names count there:
the log of the second command must say that none of them was used before it was emptied or removed.
Of the MLflow store it counts what SQLite finds when it opens it, which may roll a journal back, and
whether that changed it: a transaction has thousands of half-written journals.
"""

import contextlib
import hashlib
import re
import shutil
import signal
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

from faults_folder import Shim, call, restore


Files = dict[str, tuple[int, str]]
"""By their places, sizes [bytes] and digests; of a folder -1 and nothing."""
STORE = "mlflow.db"
_RACY_NS = 100_000_000
"""A file may change twice within a tick of the file system's clock."""
_VARIES = re.compile(r"mlflow\.db|mlruns|tracking\.json|certificates|\.rrd|index\.html|.damaged")
"""What an undisturbed run does not write again byte for byte: ids, times."""


class Folder:
    """A folder that is looked at often; what was not changed since is not read again."""

    def __init__(self, folder: Path) -> None:
        """Nothing is read yet."""
        self.folder = folder
        self._known: dict[Path, tuple[tuple[int, ...], int, str]] = {}

    def files(self) -> Files:
        """All that is in it now."""
        found: Files = {}
        for path in self.folder.rglob("*"):
            place = str(path.relative_to(self.folder))
            found[place] = (-1, "") if path.is_dir() else self._file(path)
        return found

    def _file(self, path: Path) -> tuple[int, str]:
        stat, now = path.stat(), time.time_ns()
        same = (stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
        known, when, digest = self._known.get(path, ((), 0, ""))
        if known != same or max(same[2:]) > when - _RACY_NS:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            self._known[path] = (same, now, digest)
        return stat.st_size, digest


def unfinished(place: str) -> bool:
    """Whether a file was not to be read yet by anybody."""
    return "/.unfinished" in f"/{place}"


def state(files: Files) -> str:
    """Digest of all that a second command can know of a folder, as far as it uses no leftover."""
    return _digest(
        (place, "" if unfinished(place) and size >= 0 else digest, size < 0)
        for place, (size, digest) in files.items()
    )


def fingerprint(files: Files) -> str:
    """Digest of what two runs of a step have in common when they stand at the same operation."""
    return _digest(
        (re.sub("[0-9a-f]{32}", "#", place), "" if _VARIES.search(place) else digest)
        for place, (_, digest) in files.items()
        if not place.startswith(".snakemake")  # what the dry run left that told the steps
    )


def _digest(parts) -> str:
    return hashlib.sha256(repr(sorted(parts)).encode()).hexdigest()[:16]


def store_found(folder: Path, files: Files, aside: Path) -> Files:
    """What SQLite finds in the MLflow store of a folder: before, after, and that it has a journal.

    Args:
        folder: The folder, whose store is not touched.
        files: What is in it.
        aside: A folder to open a copy in.
    """
    if not {STORE, f"{STORE}-journal"} <= files.keys():
        return files
    aside.mkdir(exist_ok=True)
    for name in (STORE, f"{STORE}-journal"):
        shutil.copy(folder / name, aside)
    with contextlib.closing(sqlite3.connect(aside / STORE)) as store:
        store.execute("SELECT count(*) FROM sqlite_master").fetchone()
    found = hashlib.sha256((aside / STORE).read_bytes()).hexdigest()
    mended = "mended " * (found != files[STORE][1])
    return {**files, STORE: (0, mended + found), f"{STORE}-journal": (0, "")}


class Stops:
    """A step, stopped at each of its operations, and what a second command makes of each state."""

    def __init__(self, on_steps, shim: Shim, end: float) -> None:
        """Takes the steps as they are prepared, what counts, and when there is no more time."""
        self.on, self.shim, self.end = on_steps, shim, end
        self.stopped = on_steps.work.with_name("stopped")

    def each(
        self,
        step: str,
        wanted: Callable[[int], bool],
        done: dict[str, dict],
        tell: Callable[[dict], None],
    ) -> int:
        """Stops a step at all of its operations.

        Args:
            step: Its name.
            wanted: Whether the folder is tried that is left at an operation.
            done: Trials by name, with those that were told; what recovered is not repeated.
            tell: Gets every trial: name, what was hit, what is wrong, seconds, digest of what was
                left, and the operation that left the same if that one was tried in its place.

        Returns:
            How many operations there were.
        """
        on, shim = self.on, self.shim
        folder, tried = Folder(on.work), {}

        def look() -> bool:
            at, hit = shim.state.stopped - 1, shim.state.what.decode(errors="replace")
            shim.state.what = b""
            files, name = folder.files(), f"state/{step}/{at}"
            trial = {"name": name, "hit": hit, "left": fingerprint(files), "s": 0.0}
            left = state(store_found(on.work, files, self.stopped.with_name("store")))
            if name in done and not done[name]["wrong"]:
                tried.setdefault(left, name)
            elif same := tried.get(left):
                tell({**trial, "wrong": done[same]["wrong"], "as": same})
            elif wanted(at):
                tried[left] = name
                began = time.monotonic()
                wrong = self.goes_on(step, files)
                tell({**trial, "wrong": wrong, "s": round(time.monotonic() - began, 2)})
            return time.monotonic() < self.end

        shutil.rmtree(self.stopped, ignore_errors=True)  # of a campaign that was ended
        restore(on.before(step), on.work)
        shim.arm(on.work, -signal.SIGSTOP, lasting=True)
        call(on.commands[step], on.work, shim, on.say.with_name("stopped.txt"), at_stop=look)
        return shim.disarm()

    def goes_on(self, step: str, files: Files) -> str:
        """What is wrong in a copy of the stopped folder, now and after the same command again."""
        on, log = self.on, self.on.folder / "operations.txt"
        log.unlink(missing_ok=True)
        with self.shim.aside():
            on.work.rename(self.stopped)
            restore(self.stopped, on.work)
            wrong = on.first_look("SIGKILL", step, -signal.SIGKILL, "")
            self.shim.arm(on.work)
            self.shim.state.log = bytes(log)
            wrong = wrong or on.recovers(step)
            self.shim.disarm()
            shutil.rmtree(on.work)
            self.stopped.rename(on.work)
        first = {}
        for line in log.read_text().splitlines() if log.exists() else []:
            _, what, place = line.split(" ", 2)
            first.setdefault(place, what)
        leftovers = [place for place, (size, _) in files.items() if unfinished(place) and size >= 0]
        used = [place for place in leftovers if first.get(place) == "use"]
        return wrong or "; ".join(f"a leftover is used: {place}" for place in used[:3])
