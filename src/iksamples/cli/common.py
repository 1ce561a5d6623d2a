"""What the commands share: the application, its options, and opening and writing files."""

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.errors import IksamplesError, one_line
from iksamples.files import kept_file


if TYPE_CHECKING:
    import pandas as pd

    from iksamples.samples.dataset import SampleSet
    from iksamples.study import Design, Study
    from iksamples.task import Task


app = typer.Typer(
    help="How many samples does a learned inverse kinematics need?\n\n"
    "The whole study runs with `snakemake --cores 2`; these are its steps, in their order.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which would take [mm] for markup
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)

StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="Study file (YAML, or the study.json of a run).")
]
Output = Annotated[Path, typer.Option("--output", "-o", help="File to write.")]
Results = Annotated[
    Path,
    typer.Option(
        "--results", help="Results folder of the study, such as results/paper.", file_okay=False
    ),
]
FinishedStudy = Annotated[
    Path | None,
    typer.Option(
        "--results",
        help="Results folder of the study; by default the one in results/ answered last.",
        file_okay=False,
    ),
]
SamplesFiles = Annotated[
    list[Path], typer.Argument(metavar="SAMPLES...", help="Sets of samples, one file each.")
]
Seeds = Annotated[
    str | None, typer.Option(help="Only these seeds, first and last: 0-49 for 50 of them.")
]
MethodName = Annotated[str, typer.Option(help="Which of the study's methods.")]
MethodFolder = Annotated[
    Path,
    typer.Option(
        "--folder", help="Folder of the method, with a folder for each set of samples in it."
    ),
]


Arm = Annotated[
    Path | None,
    typer.Option("--robot", help="The arm as drawn: a URDF, or a Denavit-Hartenberg table."),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="WANTED=NAME",
        help="What a column is whose name does not say it, such as x_mm='tcp x' or q1_deg=j1; as "
        "often as needed.",
    ),
]


def say(text: str, err: bool = False) -> None:
    """Prints lines; names of others that they hold cannot steer a terminal."""
    typer.echo("\n".join(map(one_line, text.split("\n"))), err=err)


@contextmanager
def shown(what: str, after_s: float = 1.0) -> Iterator[None]:
    """Says on stderr what is taking time, after a while and then every ten seconds."""
    began, done = time.monotonic(), threading.Event()

    def tell() -> None:
        wait_s = after_s
        while not done.wait(wait_s):
            say(f"{time.monotonic() - began:.0f} s: {what} ...", err=True)
            wait_s = 10.0

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()


def refuse_unused(context: typer.Context, names: Iterable[str], why: str) -> None:
    """Stops at options of the command that were given, and would do nothing."""
    given = []
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        if option.name in names and source and source.name == "COMMANDLINE":
            given.append(max(option.opts, key=len))
    if given:
        raise IksamplesError(f"{', '.join(given)}: of no use {why}; leave out.")


def columns_of(said: list[str] | None) -> dict[str, str]:
    """What ``--column`` says."""
    pairs = [one.partition("=") for one in said or []]
    for wanted, equals, name in pairs:
        if not (wanted and equals and name):
            raise IksamplesError(
                f"--column {wanted}{equals}{name}: say what it is and its name, such as x_mm=tcp_x."
            )
    return {wanted: name for wanted, _, name in pairs}


def arm_settings(robot: Path | None, tip_link: str | None) -> dict[str, object]:
    """What ``--robot`` and ``--tip-link`` say, as a study does; nothing where no arm is named."""
    if robot is None:
        if tip_link is not None:
            raise IksamplesError(f"--tip-link {tip_link} is a link of an arm; name it, --robot.")
        return {}
    return {"robot": {"urdf": str(robot), "tip_link": tip_link}}


def record_sets(
    study: "Study", task: "Task", sets: "dict[str, tuple[Design, int]]"
) -> "Iterator[SampleSet]":
    """Samples of several sets; those of the adaptive design grow from one another."""
    from iksamples.samples.record import record_samples

    adaptive = [n for design, n in sets.values() if design == "adaptive"]
    if adaptive:
        from iksamples.answer.adaptive import adaptive_sets

        yield from adaptive_sets(study, task, adaptive).values()
    for design, n in sets.values():
        if design != "adaptive":
            yield record_samples(study, task, design, n)


def load_samples(files: list[Path]) -> "list[SampleSet]":
    """The sets of samples in files."""
    from iksamples.samples.dataset import SampleSet

    return [SampleSet.load(file) for file in files]


def write_tables(folder: Path, parts: "Iterable[dict[str, pd.DataFrame]]") -> None:
    """Writes tables that come some rows at a time, each into a Parquet file of its name.

    Where making them ends with an error, nothing is written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    with ExitStack() as stack:
        writers: dict[str, parquet.ParquetWriter] = {}
        for tables in parts:
            for name, frame in tables.items():
                table = pa.Table.from_pandas(frame)
                if name not in writers:
                    file = stack.enter_context(kept_file(folder / f"{name}.parquet"))
                    writers[name] = stack.enter_context(parquet.ParquetWriter(file, table.schema))
                writers[name].write_table(table)


def read(study_file: Path) -> "Study":
    """A study that takes no more than its budget."""
    from iksamples.plan.budget import require_affordable
    from iksamples.study import read_study

    study = read_study(study_file)
    require_affordable(study)
    return study


def open_study(study_file: Path) -> "tuple[Study, Task]":
    """A study and its task."""
    from iksamples.task import study_task

    study = read(study_file)
    return study, study_task(study)


def advise(study: "Study", task: "Task", sets: "list[SampleSet] | None") -> None:
    """Says what may surprise the author of a study."""
    from iksamples.advice import advice

    for line in advice(study, task, sets):
        say(f"Note: {line}", err=True)


def require_one_of(known: Iterable[str], name: str, what: str) -> None:
    """Stops at a name that is not known."""
    if name not in known:
        raise IksamplesError(f"{what} '{name}'; there are {', '.join(known)}.")


def seed_range(text: str | None) -> range | None:
    """The seeds that ``--seeds`` names; None: all."""
    if text is None:
        return None
    first, dash, last = text.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
        raise IksamplesError(f"--seeds {text}: say the first and the last seed, such as 0-49.")
    return range(int(first), int(last) + 1)


def require_feasible(study: "Study", task: "Task", paths: bool = True) -> None:
    """What a job for one set of samples cannot see of the rest, before anything is trained."""
    from iksamples.evaluation.paths import require_reachable
    from iksamples.samples.record import require_workspace

    if study.samples.recorded:
        raise IksamplesError(
            f"{study.name}: its samples are recorded, and not to be computed; run it by snakemake, "
            "or iksamples learn, answer and report."
        )
    require_workspace(study, task)
    if paths:
        require_reachable(study, task)
