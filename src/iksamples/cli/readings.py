"""The steps of a study of readings: which reading of the paper gives its Table 1."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.cli.common import Output, Results, StudyFile, app, read
from iksamples.errors import IksamplesError
from iksamples.files import kept_file


if TYPE_CHECKING:
    import pandas as pd

    from iksamples.study import Readings

readings = typer.Typer(help="Search for the reading of the paper that gives its Table 1.")
app.add_typer(readings, name="readings")

Part = Annotated[int, typer.Option(min=0, help="Which of the study's `readings.jobs` parts.")]


@readings.command()
def search(study_file: StudyFile, part: Part, output: Output) -> None:
    """Train one part of the readings that the study draws."""
    from iksamples.paper.readings import search_part

    _write(search_part(_wanted(study_file), part), output)


@readings.command()
def confirm(
    study_file: StudyFile,
    searched: Annotated[list[Path], typer.Argument(metavar="SEARCH...", help="All parts of it.")],
    part: Part,
    output: Output,
) -> None:
    """Train one part of the best readings again, with fresh seeds."""
    from iksamples.paper.readings import confirm_part, read_parts

    _write(confirm_part(_wanted(study_file), read_parts(searched), part), output)


@readings.command()
def rank(
    confirmed: Annotated[list[Path], typer.Argument(metavar="FRESH...", help="All parts of it.")],
    output: Output,
    best: Annotated[
        Path,
        typer.Option(help="Gets the best reading (JSON), as src/iksamples/paper/reading.json is."),
    ],
) -> None:
    """Rank the readings by how far their fresh networks are from Table 1."""
    from iksamples.paper.readings import best_reading, read_parts
    from iksamples.paper.readings import rank as ranked

    rows = read_parts(confirmed)
    _write(ranked(rows), output)
    with kept_file(best) as file:
        file.write_text(best_reading(rows), encoding="utf-8")


@readings.command()
def report(
    study_file: StudyFile,
    results: Results,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the report.")],
) -> None:
    """Say which of the paper's words must be wrong for its Table 1 to come out."""
    from iksamples.report.readings import write_page
    from iksamples.report.write import write_front_page

    write_page(read(study_file), results, output)
    write_front_page(output.parent, output.parent.parent / "docs" / "studies")


def _wanted(study_file: Path) -> "Readings":
    wanted = read(study_file).readings
    if wanted is None:
        raise IksamplesError(
            f"{study_file}: no `readings` section; config/studies/readings.yaml has one."
        )
    return wanted


def _write(table: "pd.DataFrame", output: Path) -> None:
    with kept_file(output) as file:
        table.to_csv(file, index=False)
