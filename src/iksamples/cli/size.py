"""`iksamples size`: how many samples, from recorded ones or from anybody's learning curve."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iksamples.cli.common import (
    Arm,
    Columns,
    app,
    arm_settings,
    columns_of,
    refuse_unused,
    say,
)
from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    from iksamples.study import Study


_TOLERANCES = {"": "--tolerance", "mm": "--tolerance-mm", "deg": "--tolerance-deg"}
_OF_CURVES = {"curve", "tolerance", "tolerance_mm", "tolerance_deg", "success_share", "confidence"}


@app.command()
def size(
    context: typer.Context,
    recording: Annotated[
        Path | None,
        typer.Argument(
            help="Records of an arm (CSV or Parquet): x_mm, y_mm, z_mm and q1_rad, q2_rad, ..., or "
            "in other units that the names say, such as x_m and q1_deg; a LeRobot data set; or a "
            "folder of postures in sockets."
        ),
    ] = None,
    curve: Annotated[
        Path | None,
        typer.Option(
            help="A learning curve (CSV or Parquet) from anywhere: columns n, seed and error_mm, "
            "error_deg or error, a row per training."
        ),
    ] = None,
    robot: Arm = None,
    tip_link: Annotated[str | None, typer.Option(help="Link whose origin was measured.")] = None,
    column: Columns = None,
    joint_unit: Annotated[
        str | None,
        typer.Option(help="Unit of a LeRobot data set's joint values: deg, rad or range."),
    ] = None,
    tool_from_drawing: Annotated[
        bool,
        typer.Option(
            "--tool-from-drawing",
            help="Compute a LeRobot data set's tool poses from the drawing: what is learned then "
            "is the drawing.",
        ),
    ] = False,
    socket_distance_mm: Annotated[
        float | None, typer.Option(help="Distance between the tool's two sockets [mm].")
    ] = None,
    subsets: Annotated[int, typer.Option(help="Random orders of the records.")] = 20,
    seed: Annotated[int, typer.Option(help="Seed of these orders.")] = 0,
    of: Annotated[
        str, typer.Option(help="Which error of the records held out: worst, p99, p95 or mean.")
    ] = "worst",
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

    if (curve is None) == (recording is None):
        raise IksamplesError(
            "name your records, iksamples size recorded.csv, or a learning curve, iksamples size "
            "--curve runs.csv."
        )
    said = {"mm": tolerance_mm, "deg": tolerance_deg, "": tolerance}
    given = {unit: value for unit, value in said.items() if value is not None}
    if len(given) > 1:
        raise IksamplesError("--tolerance-mm, --tolerance-deg and --tolerance: give one of them.")
    asked: dict[str, Any] = {
        "error_mm": next(iter(given.values()), 1.0),
        "success_share": success_share,
        "confidence": confidence,
    }
    where = (
        "--tolerance, --success-share, --confidence, --of, --joint-unit, --socket-distance-mm, "
        "--subsets or --seed"
    )
    if curve is not None:
        refuse_unused(context, context.params.keys() - _OF_CURVES, "to a learning curve")
        study = parse_study({"name": "recorded", "tolerance": asked}, where)
        _size_curve(study, curve, given)
        return
    assert recording is not None
    if set(given) - {"mm"}:
        raise IksamplesError("records are judged in mm; say what is allowed with --tolerance-mm.")
    from iksamples.plan import require_affordable
    from iksamples.recorded.learn import learning_curve, sized_study
    from iksamples.recorded.lerobot import is_lerobot
    from iksamples.recorded.sockets import is_sockets
    from iksamples.recorded.told import told

    if not is_lerobot(recording):
        of_lerobot = ["joint_unit", "tool_from_drawing"]
        refuse_unused(context, of_lerobot, "to records that are no LeRobot data set")
    sockets: dict[str, Any] = {}
    if is_sockets(recording):
        if robot is None or socket_distance_mm is None:
            raise IksamplesError(
                f"{recording}: postures in sockets; name the arm with --robot, and say how far "
                "apart the two sockets are with --socket-distance-mm."
            )
        refuse_unused(context, ["column"], "to postures in sockets")
        sockets = {"kind": "sockets", "socket_distance_mm": socket_distance_mm}
    else:
        refuse_unused(context, ["socket_distance_mm"], "to records that are not of sockets")
    settings = {
        "name": "recorded",
        "tolerance": asked | {"of": of},
        "samples": {
            "seed": seed,
            "recorded": {
                "path": str(recording),
                "columns": columns_of(column),
                "subsets": subsets,
                "joint_unit": joint_unit,
                "tool_from_drawing": tool_from_drawing,
                **sockets,
            },
        },
        **arm_settings(robot, tip_link),
    }
    study = sized_study(settings, where)
    require_affordable(
        study, "Ask for fewer --subsets, or make a study of the recording, with a larger budget."
    )
    say("\n".join(told(study, learning_curve(study, robot is not None), bool(given))))


def _size_curve(study: "Study", curve: Path, given: dict[str, float]) -> None:
    from iksamples.answer.assess import answer
    from iksamples.answer.collect import outcomes
    from iksamples.recorded.curve import read_curve
    from iksamples.recorded.told import asked, beyond, sizes_table, verdict

    runs, unit = read_curve(curve)
    if given and unit not in given:
        raise IksamplesError(
            f"{curve}: its errors are {f'in {unit}' if unit else 'without a unit'}; say what is "
            f"allowed with {_TOLERANCES[unit]}, or the unit in the column's name, such as error_mm."
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
    say("\n".join(lines))
