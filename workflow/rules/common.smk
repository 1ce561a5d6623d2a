"""
The study, validated before any job, and what the rules share.
"""

import contextlib
import hashlib
import json
import os
import shlex
import sys
from pathlib import Path

from filelock import FileLock, Timeout

from iksamples.errors import IksamplesError
from iksamples.files import (
    is_damaged,
    is_intact,
    put_aside,
    require_plain,
    whole_file,
)
from iksamples.jobs import parts
from iksamples.plan import require_affordable
from iksamples.plan import resources as asked
from iksamples.results import certified, networks, sample_sets
from iksamples.sources import source_digest
from iksamples.study import parse_study, read_study
from iksamples.study.reading import typed

LOCK = FileLock(".snakemake/iksamples.lock")

# What the rules run, so that no environment needs to be active. Among the params, Snakemake would
# take another place of the same Python for another way to do things.
os.environ.update(IKSAMPLES_PYTHON=sys.executable)


def stop(message):
    """Ends with lines for people; a WorkflowError would add where in this file it was raised."""
    for line in str(message).splitlines():
        print(f"Error: {line}", file=sys.stderr)
    sys.exit(2)


def digest_of(file, key):
    """Of a file that the study names: the path of an input would be a pattern to Snakemake."""
    try:
        require_plain(file)
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]
    except OSError as error:
        stop(f"{key}: cannot read {file} ({error.strerror}).")


def recording_digest():
    """Of the study's recording, a file or a folder of files."""
    place = Path(STUDY.samples.recorded.path)
    if not place.exists():
        stop(STUDY.samples.recorded.missing())
    files = sorted(place.rglob("*")) if place.is_dir() else [place]
    content = hashlib.sha256()
    for file in filter(Path.is_file, files):
        content.update(str(file.relative_to(place)).encode() + file.read_bytes())
    return content.hexdigest()[:12]


def study_files():
    """The study's files, as from this folder."""
    return [os.path.relpath(file) for file in workflow.configfiles]


def study_changes():
    """What `--config` says besides."""
    return typed(dict(workflow.config_settings.config))


def the_study():
    """The study, read as `iksamples check` does: Snakemake itself reads YAML more laxly."""
    given = (
        workflow.modifier.skip_configfile
    )  # to a module, by the workflow that uses it
    if given and config is not workflow.modifier_stack[0].globals["config"]:
        return parse_study(dict(config), "the module's config")
    return read_study(*study_files(), changes=study_changes())


def start_run():
    """Lets one run at a time work here, and writes the study, defaults filled in, for its jobs.

    Snakemake's own lock outlives a killed run and has to be removed by hand; this one is the
    operating system's and ends with the process (profiles/default switches the other one off).

    The study is not an input of the jobs: each re-runs when the settings among its params change.
    (As an `ancient` output of a rule, a changed study would hide the jobs below that rule.)
    """
    try:
        LOCK.acquire(timeout=0)
    except Timeout:
        stop("another run is working in this folder; wait for it or stop it.")
    except OSError as error:
        stop(f"cannot write into this folder, {os.getcwd()} ({error.strerror}).")
    write_study()


def write_study():
    """Writes the study, unless it is there already."""
    path = Path(f"results/{STUDY.name}/study.json")
    text = (STUDY.model_dump_json(indent=2) + "\n").encode()
    if not path.is_file() or path.read_bytes() != text:
        with whole_file(path) as file:
            file.write_bytes(text)


def make_again(files):
    """Has results made again that a disk or a hand has changed, and what could not be logged.

    Snakemake looks at times and not at what is in a file; so a result that no job reads again, or
    one whose time is the same, would stay as it is. A run takes these files out of the way; a dry
    run changes nothing, so it plans their jobs as if these were about to do something else.
    """
    if not workflow.is_main_process:
        return
    # Beside another run, whose files may be on their way, nothing is looked at.
    with contextlib.suppress(Timeout, OSError), LOCK.acquire(timeout=0):
        damaged = {file for file in files if is_damaged(Path(file))}
        for file in sorted(damaged):
            print(
                f"Note: {file}: not as it was written (SHA-256); a run makes it again.",
                file=sys.stderr,
            )
        if workflow.output_settings.dryrun:
            AGAIN.update(damaged, {str(MANIFEST)} if "command" in tracked() else ())
            return
        for file in damaged:
            put_aside(Path(file))
        if "command" in tracked():
            MANIFEST.unlink()
        if not Path(f"reports/{STUDY.name}/index.html").exists():
            return
        # Of a finished study, two files are no rule's output: its settings, as a run starts with
        # them, and the page of all studies, which is written with that of each.
        try:
            write_study()
            if not is_intact(Path("reports/index.html")):
                from iksamples.report.write import write_front_page

                write_front_page("reports", "docs/studies")
        except IksamplesError as error:
            stop(error)


def results_folder(wildcards):
    """The study's folder of results."""
    return f"results/{wildcards.study}"


def told(rule, *modules):
    """What the command of a rule is told, and a digest of its sources."""
    digest = source_digest(*modules)

    def code(wildcards):
        made = expand(getattr(rules, rule).output, **dict(wildcards.items()))
        return digest if AGAIN.isdisjoint(made) else "made again"

    return {
        "study": "results/{study}/study.json",
        "results": results_folder,
        "code": code,
    }


def iksamples(*words, logged=True):
    """A command of the package; what it says on the way is also kept in the rule's log."""
    log = " 2> >(tee {log:q} >&2)" if logged else ""
    return f'"$IKSAMPLES_PYTHON" -P -m iksamples {" ".join(words)}{log}'


# What a study says reaches the rules through functions: Snakemake takes braces in plain values,
# such as a title or the path of a URDF, for wildcards of its own.


def settings(*sections, **parts):
    """Sections of the study, or parts of a section, as text; a rule re-runs when it changes."""
    text = STUDY.model_dump_json(include=dict.fromkeys(sections, True) | parts or None)

    def as_text(wildcards):
        return text

    return as_text


def of_each(files, methods):
    """Files of each method on each of its sets of samples; other wildcards stay."""
    return [
        file
        for method in methods
        for file in expand(
            files,
            method=method,
            samples=sample_sets(STUDY, method=method),
            allow_missing=True,
        )
    ]


def samples_of(wildcards):
    """The samples that a method learns from."""
    return expand(
        "results/{study}/samples/{samples}.parquet",
        study=wildcards.study,
        samples=sample_sets(STUDY, method=wildcards.method),
    )


def weights(wildcards):
    """What a method is asked with: a network's weights; the samples alone for any other."""
    if wildcards.method not in networks(STUDY):
        return []
    return expand(
        "results/{study}/{method}/{samples}/weights.safetensors",
        study=wildcards.study,
        method=wildcards.method,
        samples=LABELS,
    )


def proof_parts(wildcards):
    """The proofs of a method in parts; none where one job proves them all."""
    return expand(
        "results/{study}/{method}/certificates/{seeds}.csv",
        study=wildcards.study,
        method=wildcards.method,
        seeds=parts(STUDY, wildcards.method),
    )


def options(name, files):
    """The files of an input as options of a command."""

    def as_options(wildcards, input):
        given = input.get(files, [])
        return [
            f"{name}={file}" for file in ([given] if isinstance(given, str) else given)
        ]

    return as_options


def typed_command(wildcards):
    """What a user types to run this study."""
    command = ["snakemake", "--cores", "2"]
    if workflow.overwrite_configfiles:
        command += ["--configfile", *study_files()]
    # Where the runs are tracked is nobody else's, and may hold a password.
    changes = {k: v for k, v in study_changes().items() if k != "tracking"}
    if changes:
        command += ["--config", *(f"{k}={json.dumps(v)}" for k, v in changes.items())]
    return shlex.join(command)


def tracked():
    """Where the runs were logged, or why not and what logs them; nothing where that is unknown."""
    try:
        return json.loads(MANIFEST.read_text())
    except (OSError, ValueError):
        return {}


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
    found = tracked()
    if "page" in found:
        uri = found["tracking_uri"]
        where = (
            f"{uri}/{found['page']}"
            if uri.startswith("http")
            else "MLFLOW_DISABLE_TELEMETRY=true mlflow ui\n              and then "
            f"http://127.0.0.1:5000/{found['page']}"
        )
        lines.append(f"  Runs        {where}")
    elif found:
        lines.append(f"  Not logged  {found['reason']}\n              Log it later by")
        lines.append(f"              {found['command']}")
    return "\n".join(["", f"{STUDY.name}: done.", *lines, ""])


try:
    STUDY = the_study()
    require_affordable(STUDY)
    STUDY.require_own_arm()
except IksamplesError as error:
    stop(error)
ARM = digest_of(STUDY.robot.urdf, "robot.urdf")

if STUDY.tracking.uri:
    # What is kept of the study lacks its password, so the job that tracks it is told here.
    os.environ.update(MLFLOW_TRACKING_URI=STUDY.tracking.uri)

MANIFEST = Path(f"results/{STUDY.name}/tracking.json")
AGAIN = set()  # what a dry run would make again

# Of networks, and of all methods: one that is not trained can have its own.
LABELS = list(sample_sets(STUDY, method="network"))
ALL_LABELS = list(sample_sets(STUDY))
FIRST_LABELS = list(sample_sets(STUDY, STUDY.samples.design))
KINDS = {name: method.kind for name, method in STUDY.all_methods.items()}
UNTRAINED = {name: kind for name, kind in KINDS.items() if kind != "network"}
FLOOR = STUDY.arm is not None and not STUDY.arm.repeats
ADAPTIVE = "adaptive" in STUDY.designs()

PAGE = {
    "html": report("reports/{study}/index.html", category="Report"),
    "markdown": "reports/{study}/README.md",
    "figures": directory("reports/{study}/figures"),
}

# Of a module, Snakemake calls no `onstart`.
if (
    workflow.is_main_process
    and not workflow.modifier.is_main_snakefile()
    and not workflow.output_settings.dryrun
):
    start_run()


wildcard_constraints:
    seeds=r"\d+-\d+",
    study=STUDY.name,
    network="|".join(networks(STUDY)),
    samples="|".join(ALL_LABELS),
    method="|".join(STUDY.all_methods),
    part=r"\d+",
