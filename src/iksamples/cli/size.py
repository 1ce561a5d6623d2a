"""`iksamples size`: how many samples, from recorded ones or from anybody's learning curve."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.cli.common import app
from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    from iksamples.study import Study


@app.command()
def size(
    curve: Annotated[
        Path | None,
        typer.Option(
            help="A learning curve (CSV or Parquet) from anywhere: columns n, seed and error_mm, "
            "error_deg or error, a row per training."
        ),
    ] = None,
    tolerance_mm: Annotated[float | None, typer.Option(help="Error allowed [mm].")] = None,
    tolerance_deg: Annotated[float | None, typer.Option(help="Error allowed [deg].")] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Error allowed, of a curve whose errors have no unit.")
    ] = None,
    success_share: Annotated[
        float, typer.Option(help="Share of trainings that must be within it.")
    ] = 0.8,
    confidence: Annotated[float, typer.Option(help="Confidence in that share.")] = 0.95,
) -> None:
    """Say how many samples it takes: answer, learning curve, and what to record next."""
    from iksamples.study import parse_study

    if curve is None:
        raise IksamplesError("name a learning curve: iksamples size --curve runs.csv.")
    said = {"mm": tolerance_mm, "deg": tolerance_deg, "": tolerance}
    given = {unit: value for unit, value in said.items() if value is not None}
    if len(given) > 1:
        raise IksamplesError("--tolerance-mm, --tolerance-deg and --tolerance: give one of them.")
    study = parse_study(
        {
            "name": "recorded",
            "tolerance": {
                "error_mm": next(iter(given.values()), 1.0),
                "success_share": success_share,
                "confidence": confidence,
            },
        },
        "--tolerance, --success-share or --confidence",
    )
    _size_curve(study, curve, given)


def _size_curve(study: "Study", curve: Path, given: dict[str, float]) -> None:
    from iksamples.answer.assess import answer
    from iksamples.answer.outcomes import outcomes
    from iksamples.recorded.curve import read_curve
    from iksamples.recorded.told import asked, beyond, sizes_table, verdict

    runs, unit = read_curve(curve)
    if given and unit not in given:
        option = {"": "--tolerance", "mm": "--tolerance-mm", "deg": "--tolerance-deg"}
        raise IksamplesError(
            f"{curve}: its errors are {f'in {unit}' if unit else 'without a unit'}; say what is "
            f"allowed with {option[unit]}, or the unit in the column's name, such as error_mm."
        )
    one = answer(study, outcomes(study, runs)).variants[0]
    lines = [f"{curve}: {len(runs)} runs of {len(one.sizes)} sizes."]
    if given:
        lines.append(f"For {asked(study.tolerance, unit, 'runs')}: {verdict(one, 'runs')}")
    lines += ["", *sizes_table(one.sizes, unit, bool(given)), ""]
    lines.append(
        f"bound: the error that would be kept by {study.tolerance.success_share:.0%} of runs with "
        f"{study.tolerance.confidence:.0%} confidence; none: too few runs for any."
    )
    if given:
        lines += ["at least: lower end of the share of runs within, at that confidence."]
        lines += beyond(one)
    typer.echo("\n".join(lines))
