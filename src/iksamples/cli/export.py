"""`iksamples export`: a network of a finished study to take away."""

from pathlib import Path
from typing import Annotated

import typer

from iksamples.cli.common import app


@app.command()
def export(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the files.", file_okay=False)
    ],
    results: Annotated[
        Path | None,
        typer.Option(
            help="Results folder of the study; by default the one in results/ answered last.",
            file_okay=False,
        ),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="Method; by default the one that needs the fewest samples.")
    ] = None,
    samples: Annotated[
        str | None,
        typer.Option(help="Set of samples, such as grid5; by default the study's answer."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed; by default the one with the smallest proved worst case."),
    ] = None,
    input_unit: Annotated[str, typer.Option(help="What positions are given in: mm or m.")] = "mm",
    output_unit: Annotated[
        list[str] | None,
        typer.Option(
            help="What joint values come in: rad (default) or deg; mm (default) or m for "
            "prismatic joints."
        ),
    ] = None,
) -> None:
    """Write a trained network as ONNX and as C, and a certificate of it beside them."""
    from iksamples.answer.answer import newest
    from iksamples.export.write import C_FILE, CERTIFICATE, ONNX_FILE, choose
    from iksamples.export.write import export as write

    choice = choose(results or newest("results"), method, samples, seed)
    certificate = write(choice, output, input_unit, output_unit or ())
    errors = [
        certificate[name] for name in ("position_error", "angle_error") if name in certificate
    ]
    typer.echo(
        f"{choice.study.name}, {choice.cell.method}, {choice.cell.label}, seed {choice.seed}: "
        f"{choice.why}.\n"
        + "".join(f"{error['says']}\n" for error in errors)
        + f"Written to {output}: {ONNX_FILE}, {C_FILE}, {CERTIFICATE}"
    )
