"""
The study, validated before any job, and what the rules share.
"""

import json
import os
import shlex
import sys
from pathlib import Path

from iksamples.errors import IksamplesError
from iksamples.results import certified, networks, sample_sets
from iksamples.sources import source_digest
from iksamples.study import parse_study


def stop(message):
    """Ends with lines for people; a WorkflowError would add where in this file it was raised."""
    for line in str(message).splitlines():
        print(f"Error: {line}", file=sys.stderr)
    sys.exit(2)


def lock_this_folder():
    """Lets one run at a time work here.

    Snakemake's own lock outlives a killed run and has to be removed by hand; this one is the
    operating system's and ends with the process (profiles/default switches the other one off).
    """
    from filelock import FileLock, Timeout

    global LOCK  # kept, since the lock ends with the object
    LOCK = FileLock(".snakemake/iksamples.lock")
    try:
        LOCK.acquire(timeout=0)
    except Timeout:
        stop("another run is working in this folder; wait for it or stop it.")


def write_study():
    """Writes the study, defaults filled in, for the jobs to read.

    It is not an input of theirs: each re-runs when the settings among its params change. (As an
    `ancient` output of a rule, a changed study would hide the jobs below that rule from Snakemake.)
    """
    file = Path(f"results/{STUDY.name}/study.json")
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(".unfinished")
    unfinished.write_text(STUDY.model_dump_json(indent=2) + "\n", encoding="utf-8")
    unfinished.replace(file)


def settings(*sections):
    """The named sections of the study as text; a rule re-runs when they change."""
    return STUDY.model_dump_json(include=set(sections))


def typed_command():
    """What a user types in this folder to run this study."""
    files = [os.path.relpath(file) for file in workflow.overwrite_configfiles]
    return shlex.join(
        ["snakemake", "--cores", "2", *(["--configfile", *files] if files else [])]
    )


def where_to_look():
    """The last lines of a run: what there is now, and how to look at it."""
    made = {
        f"reports/{STUDY.name}/index.html": "Report     ",
        f"results/{STUDY.name}/table.csv": "Table      ",
        **{
            f"results/{STUDY.name}/recordings/{path}.rrd": "Recording   rerun"
            for path in STUDY.evaluation.paths
        },
    }
    lines = [f"  {what} {path}" for path, what in made.items() if Path(path).exists()]
    tracked = Path(f"results/{STUDY.name}/tracking.json")
    if tracked.exists():
        page = json.loads(tracked.read_text())["page"]
        lines.append(
            f"  Runs        mlflow ui    and then http://127.0.0.1:5000/{page}"
        )
    return "\n".join(["", f"{STUDY.name}: done.", *lines, ""])


try:
    STUDY = parse_study(
        dict(config), ", ".join(map(str, workflow.configfiles)) or "config"
    )
except IksamplesError as error:
    stop(error)

LABELS = list(sample_sets(STUDY))
FIRST_LABELS = list(sample_sets(STUDY, STUDY.samples.design))
KINDS = {name: method.kind for name, method in STUDY.all_methods.items()}


wildcard_constraints:
    study=STUDY.name,
    samples="|".join(LABELS),
    method="|".join(STUDY.all_methods),
    path="|".join(STUDY.evaluation.paths),
