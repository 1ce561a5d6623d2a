"""Stops and breaks a small study in every way we could think of, and looks at what is left.

    python benchmarks/faults.py --minutes 40 --page docs/trust.md
    python benchmarks/faults.py --only SIGKILL/track/117         # one trial, as the table names it

Each trial starts from what lay there before a step or a run, lets one thing go wrong, types the
same command again, and compares every file and every MLflow run with what an undisturbed run left.
What a step does to files is counted by faults.c, so that the fault can come at each operation. The
trials come in an order that is spread evenly whenever the time ends; those in `--log` are not
repeated, so that the same command goes on. Needs gcc, and Linux.
"""

import argparse
import errno
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from statistics import fmean
from tempfile import gettempdir

from faults_folder import (
    RESULTS,
    ROOT,
    Shim,
    call,
    content,
    differences,
    project,
    restore,
    said_plainly,
    steps,
)
from faults_stops import Folder, Stops, fingerprint
from faults_whole import WHOLE, Whole

from iksamples.study import read_study


FAULTS = {
    "SIGKILL": -signal.SIGKILL,
    "SIGTERM": -signal.SIGTERM,
    "SIGINT": -signal.SIGINT,
    "EIO": errno.EIO,
    "ENOSPC": errno.ENOSPC,
    "EROFS": errno.EROFS,
}
OFTEN = {"SIGKILL": 4}
"""Of every kind of fault one trial, of these more, before the next of each."""
LASTING = {"ENOSPC", "EROFS"}
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "PYTHONPATH": str(Path(__file__).parents[1] / "src"),
}
WORDS = {
    "state": "a step stopped at a file operation, its folder as a kill leaves it",
    "SIGKILL": "a step killed at a file operation",
    "SIGTERM": "a step told to end (SIGTERM) at one",
    "SIGINT": "Ctrl-C in a step at one",
    "EIO": "an input/output error at one",
    "ENOSPC": "disk full from one on",
    "EROFS": "file system read-only from one on",
    **{kind: words for kind, (words, _) in WHOLE.items()},
}


class Steps:
    """The study's steps, and what the folder was before and after each."""

    def __init__(self, folder: Path, shim: Shim, until: str = "") -> None:
        """Sets the study up, without what comes after a step if one is named."""
        self.folder, self.shim, self.work = folder, shim, folder / "work"
        self.say = folder / "said.txt"
        project(self.work)
        self.commands = steps(self.work)
        if until:
            last = list(self.commands).index(until) + 1
            self.commands = dict(list(self.commands.items())[:last])
        study = read_study(self.work / "faults.yaml").model_dump_json(indent=2)
        (self.work / RESULTS).mkdir(parents=True)
        (self.work / RESULTS / "study.json").write_text(study, encoding="utf-8")
        self.initial: dict[str, dict[str, str]] = {}
        self.after: dict[str, dict[str, str]] = {}
        self.operations: dict[str, int] = {}
        self.left = ""

    def prepare(self) -> None:
        """Runs every step twice, in their order, and loads what they load into this process.

        What differs between two undisturbed runs could not be compared: it ends the campaign.
        """
        loaded = self.folder / "modules.txt"
        for name, command in self.commands.items():
            restore(self.work, self.before(name))
            self.initial[name] = content(self.work)
            for again in (False, True):
                restore(self.before(name), self.work)
                self.shim.arm(self.work)
                code, said = call(
                    command, self.work, self.shim, self.say,
                    lambda: loaded.write_text("\n".join(sorted(sys.modules))),
                )  # fmt: skip
                self.operations[name] = self.shim.disarm()
                found = content(self.work)
                if code or (again and (other := differences(found, self.after[name]))):
                    sys.exit(f"{name}, undisturbed: {said if code else other}")
                self.after[name] = found
                load(loaded.read_text().splitlines())

    def before(self, name: str) -> Path:
        """What the folder was before a step."""
        return self.folder / "before" / name

    def run(self, name: str) -> tuple[int, str]:
        """A step, undisturbed."""
        return call(self.commands[name], self.work, self.shim, self.say)

    def trial(self, fault: str, name: str, at: int) -> tuple[str, str]:
        """One fault at one operation of a step: what was hit, and what is wrong afterwards."""
        restore(self.before(name), self.work)
        self.shim.arm(self.work, FAULTS[fault], at, fault in LASTING)
        code, said = self.run(name)
        self.shim.disarm()
        hit = self.shim.state.what.decode(errors="replace")
        if not hit:
            return "", ""
        self.left = fingerprint(Folder(self.work).files())
        if wrong := self.first_look(fault, name, code, said):
            return hit, wrong
        return hit, self.recovers(name)

    def first_look(self, fault: str, name: str, code: int, said: str) -> str:
        """What is wrong right after a fault."""
        if code == -1000:
            return "hangs"
        if code == 0 and "Warning: " not in said:
            return "; ".join(differences(content(self.work), self.after[name])[:3])
        left, whole = content(self.work, store=False), (self.initial[name], self.after[name])
        for file, digest in left.items():
            if ".unfinished" in file:
                # What an error leaves is removed at once; after a kill nobody is there to do it.
                if fault == "ENOSPC":
                    return f"left over: {file}"
            elif not may_be_halfway(file) and digest not in [one.get(file) for one in whole]:
                return f"half-written: {file}"
        if fault == "SIGINT" and "Traceback" in said:
            return said_plainly(said)
        return said_plainly(said) if FAULTS[fault] > 0 else ""

    def recovers(self, name: str) -> str:
        """What is wrong after the same command again."""
        code, said = self.run(name)
        if code or "Warning: " in said:
            return f"again: exit {code}: {said.strip()[-300:]}"
        return "; ".join(differences(content(self.work), self.after[name])[:3])


def may_be_halfway(file: str) -> bool:
    """Whether that is told by what is in it: a store has transactions, a digest is compared."""
    return "mlflow.db" in file or file.endswith((".sha256", ".lock"))


def load(modules: list[str]) -> None:
    """Imports modules, so that a fork need not."""
    for module in modules:
        if module not in sys.modules and not module.startswith("__"):
            with suppress(Exception):
                import_module(module)


def spread(n: int) -> list[int]:
    """0 to n - 1 so that any first part of them lies evenly."""
    bits = max(n - 1, 1).bit_length()
    turned = (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits))
    return [i for i in turned if i < n]


def step_trials(operations: dict[str, int]) -> Iterator[tuple[float, str]]:
    """Every fault at every operation of every step: when its turn is, and its name."""
    for (step, n), fault in itertools.product(operations.items(), FAULTS):
        for turn, at in enumerate(spread(n)):
            yield (turn // OFTEN.get(fault, 1)), f"{fault}/{step}/{at}"


def main() -> None:
    """Plans, tries, writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--minutes",
        type=float,
        default=40.0,
        help="time for all trials; 0: the table of the log alone",
    )
    parser.add_argument("--part", default="1/1", help="as 3/8: every eighth trial from the third")
    parser.add_argument("--only", default="", help="trials whose name has this (a pattern)")
    parser.add_argument("--until", default="", metavar="STEP", help="no later step, no whole run")
    parser.add_argument("--page", type=Path, help="Markdown page whose section is written anew")
    folder = Path(gettempdir()) / "iksamples-faults"
    parser.add_argument("--folder", type=Path, default=folder, help="where to work")
    parser.add_argument("--log", type=Path, help="trials done, a line of JSON each")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    shim = Shim(folder)
    if "FAULTS_STATE" not in os.environ:
        again = [sys.executable, *sys.argv]
        os.execve(sys.executable, again, {**os.environ, **ENVIRONMENT, **shim.environment()})
    log = options.log or folder / "trials.jsonl"
    log.touch()
    done = {one["name"]: one for one in map(json.loads, log.read_text().splitlines())}
    if options.minutes:
        campaign(options, folder, shim, log, done)
    print(table(done))
    if options.page:
        commits = sorted({one["commit"] for one in done.values()})
        write_page(options.page, f"at commit {' and '.join(commits)}:\n\n{table(done)}")
    sys.exit(int(any(one["wrong"] for one in done.values())))


def campaign(options, folder, shim, log, done) -> None:
    """Tries what there is time for."""
    start = time.monotonic()
    only = re.compile(options.only)
    on_steps = Steps(folder, shim, options.until)
    on_steps.prepare()
    trials = {name: turn for turn, name in step_trials(on_steps.operations)}
    if not options.until:
        whole = Whole(folder, shim, on_steps)
        trials |= {name: turn for turn, name in whole.trials()}
    k, n = map(int, options.part.split("/"))
    planned = sorted(filter(only.search, trials), key=lambda name: trials[name])[k - 1 :: n]
    of = Counter(name.split("/")[0] for name in trials)
    of["state"] = sum(on_steps.operations.values())
    print(f"{len(planned)} trials planned; undisturbed runs took {time.monotonic() - start:.0f} s")
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()

    def tell(trial: dict) -> None:
        name = trial["name"]
        done[name] = {**trial, "of": of[name.split("/")[0]], "commit": commit}
        with log.open("a") as file:
            file.write(json.dumps(done[name]) + "\n")
        if trial["wrong"] and "as" not in trial:
            print(f"FAILED {name} ({trial['hit']}): {trial['wrong']}", flush=True)

    end = start + 60 * options.minutes
    for name in planned:
        if name in done and not done[name]["wrong"]:
            continue
        if time.monotonic() > end:
            return
        kind, _, rest = name.partition("/")
        began = time.monotonic()
        if kind in FAULTS:
            step, _, at = rest.rpartition("/")
            hit, wrong = on_steps.trial(kind, step, int(at))
        else:
            hit, wrong = whole.trial(kind, rest)
        trial = {"name": name, "hit": hit, "wrong": wrong, "s": round(time.monotonic() - began, 2)}
        tell(trial | ({"left": on_steps.left} if kind == "SIGKILL" else {}))
    stops = Stops(on_steps, shim, end)
    for step, operations in on_steps.operations.items():

        def wanted(at: int, step: str = step) -> bool:
            return at % n == k - 1 and bool(only.search(f"state/{step}/{at}"))

        if any(map(wanted, range(operations))) and time.monotonic() < end:
            counted = stops.each(step, wanted, done, tell)
            of["state"] += counted - operations
            if last := done.get(f"state/{step}/{counted - 1}"):
                tell(last)  # how many there are is known now


def table(done: dict[str, dict]) -> str:
    """What was tried and what came of it, in Markdown."""
    kinds = defaultdict(list)
    for trial in done.values():
        if trial["hit"]:
            kinds[trial["name"].split("/")[0]].append(trial)
    heads = ["fault", "tried", "of", "recovered", "failed", "s each"]
    lines = [f"| {' | '.join(heads)} |", "|---" + "|--:" * 5 + "|"]
    for kind, words in WORDS.items():
        if trials := kinds[kind]:
            failed = sum(bool(trial["wrong"]) for trial in trials)
            mean_s = fmean(trial["s"] for trial in trials if "as" not in trial)
            counts = [len(trials), trials[-1]["of"], len(trials) - failed, failed]
            lines.append(f"| {words} | {' | '.join(map(str, counts))} | {mean_s:.1f} |")
    if states := kinds["state"]:
        distinct = sum("as" not in trial for trial in states)
        lines += ["", f"The {len(states)} stops left {distinct} different folders; each was tried."]
    pairs = [(t, done.get(t["name"].replace("SIGKILL", "state"))) for t in kinds["SIGKILL"]]
    pairs = [(kill, stop) for kill, stop in pairs if stop and kill["commit"] == stop["commit"]]
    if pairs:
        same = sum(kill["left"] == stop["left"] for kill, stop in pairs)
        lines.append(f"Of {len(pairs)} kills {same} left what the stop at the same operation did.")
    bad = [t for t in done.values() if t["wrong"] and "as" not in t]
    lines += ["", *(f"- `{t['name']}` ({t['hit']}): {t['wrong']}" for t in bad)]
    return "\n".join(lines) + "\n"


BEGIN, END = "<!-- faults: begin -->\n", "<!-- faults: end -->\n"


def write_page(page: Path, text: str) -> None:
    """Puts the table between its marks in a page."""
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    when = f"Tried on {datetime.now(UTC):%d %B %Y}, on {os.cpu_count()} cores, "
    page.write_text(f"{before}{BEGIN}\n{when}{text}\n{END}{rest.partition(END)[2]}", "utf-8")


if __name__ == "__main__":
    main()
