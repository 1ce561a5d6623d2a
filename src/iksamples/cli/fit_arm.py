"""`iksamples fit-arm`: a drawing fitted to records, as a URDF to take away."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.cli.common import (
    Columns,
    Output,
    app,
    arm_settings,
    columns_of,
    say,
)
from iksamples.errors import IksamplesError
from iksamples.files import whole_file


if TYPE_CHECKING:
    from iksamples.recorded.fitted import ArmFit


@app.command("fit-arm")
def fit_arm(
    robot: Annotated[
        Path, typer.Option(help="The arm as drawn: a URDF, or a Denavit-Hartenberg table.")
    ],
    samples: Annotated[
        Path,
        typer.Option(
            help="Records of the arm (CSV or Parquet): x_mm, y_mm, z_mm and q1_rad, q2_rad, ..., "
            "or in other units that the names say, such as x_m and q1_deg."
        ),
    ],
    output: Output,
    tip_link: Annotated[str | None, typer.Option(help="Link whose origin was measured.")] = None,
    column: Columns = None,
    deviation_mm: Annotated[
        float, typer.Option(help="Displacement to expect of each link, standard deviation [mm].")
    ] = 1.0,
    deviation_rad: Annotated[
        float, typer.Option(help="Turn to expect of each link, standard deviation [rad].")
    ] = 0.01745,
    noise_mm: Annotated[float, typer.Option(help="Noise of a measured position [mm].")] = 0.1,
    parameters: Annotated[
        Path | None, typer.Option(help="Gets every parameter with its uncertainty (CSV).")
    ] = None,
) -> None:
    """Fit a drawing to records and write it as a URDF, with what is known of it.

    Printed: how far the arm is off as drawn and as fitted, on records that had no part in the fit;
    each joint's deviation with its uncertainty; and what more records would bring.
    """
    from iksamples.calibration.urdf import fitted_urdf, require_agreement
    from iksamples.recorded.fitted import fit_recording
    from iksamples.study import parse_study

    if parameters and parameters.resolve() == output.resolve():
        raise IksamplesError(f"--parameters {parameters}: gets the URDF; name another file.")
    assumed = {"deviation_mm": deviation_mm, "deviation_rad": deviation_rad, "noise_mm": noise_mm}
    recorded = {"path": str(samples), "columns": columns_of(column), "assumed": assumed}
    study = parse_study(
        {
            "name": "recorded",
            "samples": {"recorded": recorded},
            **arm_settings(robot, tip_link),
        },
        "--deviation-mm, --deviation-rad or --noise-mm",
    )
    found = fit_recording(study)
    text, tip = fitted_urdf(robot, found.fitted, None, tip_link)
    with ExitStack() as both:
        file = both.enter_context(whole_file(output))
        file.write_text(text, encoding="utf-8")
        require_agreement(file, found.fitted, None, tip)
        if parameters is not None:
            found.parameters().to_csv(both.enter_context(whole_file(parameters)), index=False)
    say("\n".join(_told(found)))
    named = f" Its tool is the link {tip}." if tip not in (None, tip_link) else ""
    say(f"\n{output}: written; read back it agrees with the fit.{named}")


def _told(found: "ArmFit") -> list[str]:
    import numpy as np

    from iksamples.recorded.fitted import PARTS, TIMES
    from iksamples.recorded.told import number

    held, drawn = found.held_out_mm, found.drawn_mm
    lines = [f"{found.recording.table.path}: {len(held)} records."]
    lines += [f"Note: {doubt}" for doubt in found.doubts]
    by = ", ".join(
        f"with {times} times as many {number(value)}" if times > 1 else f"{number(value)} now"
        for times, value in zip(TIMES, found.model_mm, strict=True)
    )
    lines += [
        f"As drawn the tool is off by {number(float(drawn.mean()))} mm in the mean, "
        f"{number(float(drawn.max()))} mm at most.",
        f"As fitted, on records held out ({PARTS} parts, each judged by a fit to the others): "
        f"{number(float(held.mean()))} mm in the mean, "
        f"{number(float(np.quantile(held, 0.95)))} mm for 95 %, "
        f"{number(float(held.max()))} mm at most.",
        f"Of that, noise of the measurement: {number(found.fitted.noise_mm)} mm along each axis.",
        f"What the fit leaves uncertain of the tool's position [mm, root mean square over the "
        f"records]: {by}.",
        "",
        "Deviations: a displacement and a turn along the base's axes, all joints at zero; known: "
        "share of what was uncertain before that the records took away.",
    ]
    table = found.parameters()
    width = max(map(len, table["joint"]))
    for joint, own in table.groupby("joint", sort=False):
        for unit, shown, factor in (("mm", "mm", 1.0), ("rad", "mrad", 1e3)):
            rows = own[own["unit"] == unit]
            values = ", ".join(
                f"{factor * value:+.3f} ± {factor * sd:.3f}"
                for value, sd in zip(rows["value"], rows["sd"], strict=True)
            )
            known = max(0.0, 1 - float((rows["sd"] ** 2).sum() / (rows["prior_sd"] ** 2).sum()))
            lines.append(f"  {joint!s:<{width}}  {values} {shown}, known {100 * known:.0f} %")
    return lines
