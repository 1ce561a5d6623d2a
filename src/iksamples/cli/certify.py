"""`iksamples certify`: the largest error of anybody's network on anybody's arm, proved."""

from pathlib import Path
from typing import Annotated

import typer

from iksamples.cli.common import app


@app.command()
def certify(
    weights: Annotated[
        Path,
        typer.Option(help="Networks: .safetensors, .pt (a state dict of Linear layers) or .onnx."),
    ],
    robot: Annotated[Path, typer.Option(help="URDF of the arm.")],
    box: Annotated[
        tuple[float, float, float, float, float, float],
        typer.Option(help="Workspace [mm]: lower x y z, upper x y z."),
    ],
    activation: Annotated[
        str | None, typer.Option(help="relu or tanh, where the file does not say.")
    ] = None,
    offset_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="What the network's user subtracts from a position first [mm]."),
    ] = None,
    scale_mm: Annotated[
        tuple[float, float, float] | None, typer.Option(help="And then divides it by [mm].")
    ] = None,
    rtol: Annotated[float, typer.Option(min=1e-6, max=1, help="Gap of the bounds.")] = 1e-3,
) -> None:
    """Prove the largest position error of any networks over a box, and check the proof."""
    from iksamples.arm.load import load_arm
    from iksamples.certify.checker import Claim, verify
    from iksamples.certify.external import load_network
    from iksamples.certify.printing import point, rounded_down, rounded_up
    from iksamples.certify.rounding import inference_slack_mm
    from iksamples.certify.search import certify_stack
    from iksamples.errors import IksamplesError
    from iksamples.region import Region

    network = load_network(weights, activation=activation, offset_mm=offset_mm, scale_mm=scale_mm)
    chain = load_arm(robot)
    region = Region.box(box[:3], box[3:])
    slack_mm = inference_slack_mm(network, chain, region)
    proofs = certify_stack(network, chain, region, rtol=rtol, keep_leaves=True)
    for row, proof in enumerate(proofs):
        claim = Claim(network, row, chain, region, proof.upper, proof.lower, proof.argmax)
        if not verify(claim, proof.leaves).verified:
            raise IksamplesError(
                f"{weights}: seed {network.seeds[row]}: the search's bound could not be checked, "
                "so it is none."
            )
        typer.echo(
            f"seed {network.seeds[row]}: no position of the box is missed by more than "
            f"{rounded_up(proof.upper)} mm; "
            f"at {point(proof.argmax)} mm it is missed by {rounded_down(proof.lower)} mm "
            f"(checked, {proof.boxes} boxes{'' if proof.complete else ', search not finished'})"
        )
    if offset_mm is None and scale_mm is None and weights.suffix != ".safetensors":
        typer.echo("Positions go into the network as they are, in mm (no --offset-mm, --scale-mm).")
    typer.echo(
        "Proved for the stored weights read as exact real numbers, in real arithmetic, over the "
        "closed box; evaluating a network in float32 adds at most "
        f"{rounded_up(float(slack_mm.max()))} mm."
    )
