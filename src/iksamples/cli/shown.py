"""The steps of the workflow that show results: logged runs, recordings and the report."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from iksamples.cli.common import Results, StudyFile, app, read, require_one_of, say, shown
from iksamples.files import kept_file


@app.command()
def track(
    study_file: StudyFile,
    results: Results,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="What was logged (JSON); by default tracking.json."),
    ] = None,
    or_later: Annotated[
        bool,
        typer.Option(
            "--or-later",
            help="Where the tracking store cannot be used, say how to log the study later, and end "
            "without an error.",
        ),
    ] = False,
) -> None:
    """Log the study, its variants and sizes to MLflow; what is there already is kept."""
    from iksamples.study.sections import without_password
    from iksamples.tracking.store import StoreError
    from iksamples.tracking.track import put_off, tracking_uri
    from iksamples.tracking.track import track as log_study

    study, output = read(study_file), output or results / "tracking.json"
    where = without_password(tracking_uri(study))
    try:
        with shown(f"logging the runs to {where}", after_s=5.0):
            log_study(study, results, output)
    except StoreError as error:
        if not or_later:
            raise
        command = ["iksamples", "track", str(study_file), "--results", str(results)]
        put_off(study, error, shlex.join(command), output)
        say(f"Warning: {error}\nAll else goes on. To log this study later:", err=True)
        say(f"  {shlex.join(command)}", err=True)


@app.command()
def record(
    study_file: StudyFile,
    results: Results,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder that gets a file for each path.")
    ],
    path: Annotated[
        list[str] | None, typer.Option(help="Only this path of the study; can be repeated.")
    ] = None,
) -> None:
    """Record the arm drawing each path, all grids in one file for the Rerun viewer."""
    from iksamples.recording.record import record_path
    from iksamples.results import cells

    study = read(study_file)
    for name in path or ():
        require_one_of(study.evaluation.paths, name, f"{study_file}: no path")
    for name in path or study.evaluation.paths:
        with kept_file(output / f"{name}.rrd") as file:
            record_path(study, name, cells(study, results), file)


@app.command()
def report(
    study_file: StudyFile,
    results: Results,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the report.")],
    command: Annotated[
        str, typer.Option(help="What the report says to type to run the study.")
    ] = "snakemake --cores 2",
) -> None:
    """Build the report: one page that opens offline, a Markdown twin, and the front page of all."""
    from iksamples.report.recorded import write_recorded
    from iksamples.report.write import write_front_page, write_report

    study = read(study_file)
    write = write_recorded if study.samples.recorded else write_report
    write(study, results, output, command)
    write_front_page(output.parent, output.parent.parent / "docs" / "studies")
