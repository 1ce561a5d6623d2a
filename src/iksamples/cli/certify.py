"""`iksamples certify`: the largest error of anybody's network on anybody's arm, proved."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from iksamples.cli.common import (
    app,
    refuse_unused,
    say,
    shown,
)
from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from iksamples.arm.target import Target
    from iksamples.region import Region


_NUMBERS = {
    "--box",
    "--reference-rpy-rad",
    "--offset-mm",
    "--scale-mm",
    "--output-offset",
    "--output-scale",
    "--tool-offset-mm",
}
"""Options that take as many numbers as follow."""


class NumbersCommand(TyperCommand):
    """A command some options of which take as many numbers as follow them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Joins the numbers behind such an option into one word."""
        joined: list[str] = []
        for word in args:
            if len(joined) > 1 and joined[-2] in _NUMBERS and _is_number(word):
                joined[-1] += f" {word}"
            else:
                joined.append(word)
        return super().parse_args(ctx, joined)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@app.command(cls=NumbersCommand)
def certify(
    context: typer.Context,
    weights: Annotated[
        Path,
        typer.Option(help="Networks: .onnx, or a state dict (.pt, .pth, .ckpt, .safetensors)."),
    ],
    robot: Annotated[Path, typer.Option(help="URDF of the arm, or its Denavit-Hartenberg table.")],
    box: Annotated[
        str,
        typer.Option(
            metavar="NUMBERS",
            help="Workspace: the lower ends of all inputs, then the upper ends [mm; angles: rad], "
            "such as 20 20 0 80 80 60.",
        ),
    ],
    inputs: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C",
            help="What the network is given, out of x,y,z,roll,pitch,yaw; two are x,y and three "
            "x,y,z where this is left out.",
        ),
    ] = None,
    orientation: Annotated[
        Literal["free", "axis", "fixed"] | None,
        typer.Option(
            help="The tool may turn as it comes (free), its z axis is asked for (axis), or its "
            "whole rotation (fixed). Default: fixed with an angle among the inputs, else free."
        ),
    ] = None,
    reference_rpy_rad: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS",
            help="Roll, pitch and yaw of the tool where the angles among the inputs are zero "
            "[rad]; default 0 0 0.",
        ),
    ] = None,
    activation: Annotated[
        str | None, typer.Option(help="relu or tanh, where the file does not say.")
    ] = None,
    layers: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="A state dict's layers in the order of their use."),
    ] = None,
    key: Annotated[
        str | None, typer.Option(help="Which state dict of a checkpoint that holds several.")
    ] = None,
    offset_mm: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="What is subtracted from the inputs first [mm; angles: rad]."
        ),
    ] = None,
    scale_mm: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="And what they are divided by then [mm; angles: rad]."
        ),
    ] = None,
    input_unit: Annotated[
        list[str] | None,
        typer.Option(
            help="What the network takes: positions in mm (default) or m, angles in rad (default) "
            "or deg."
        ),
    ] = None,
    output_unit: Annotated[
        list[str] | None,
        typer.Option(
            help="What its answer is in: rad (default) or deg; mm (default) or m for prismatic "
            "joints."
        ),
    ] = None,
    output_scale: Annotated[
        str | None,
        typer.Option(metavar="NUMBERS", help="What its answer is multiplied by first."),
    ] = None,
    output_offset: Annotated[
        str | None,
        typer.Option(metavar="NUMBERS", help="What is added then [the output's unit]."),
    ] = None,
    base_link: Annotated[
        str | None, typer.Option(help="First link of the arm; by default the URDF's root.")
    ] = None,
    tip_link: Annotated[
        str | None,
        typer.Option(help="Link at the tool centre point; by default the URDF's only end."),
    ] = None,
    tool_offset_mm: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="Tool centre point in that link's frame [mm]; default 0 0 0."
        ),
    ] = None,
    rtol: Annotated[
        float, typer.Option(min=1e-6, max=1, help="Gap of the bounds, as a share.")
    ] = 1e-3,
    atol_deg: Annotated[
        float, typer.Option(min=0, max=180, help="Gap of an angle's bounds that may stay [deg].")
    ] = 0.01,
    time_limit: Annotated[
        float,
        typer.Option(
            min=0,
            help="Time for each search, per network [s]; checking what it found comes on top.",
        ),
    ] = 60.0,
    max_boxes: Annotated[
        int, typer.Option(min=1, help="Boxes that each search may bound, per network.")
    ] = 1_000_000,
) -> None:
    """Prove the largest error of any networks over a box, and check the proof.

    The error is of the tool's position and, unless its orientation is free, of its angle. Exits
    with 1 if a bound is not proved. A search that is cut short ends with a wider bound.
    """
    import numpy as np

    from iksamples.arm.load import load_arm
    from iksamples.certify.readers.layers import fed_as, read_as
    from iksamples.certify.readers.network import float32_in_words, load_network, prove

    region = _box(box)
    target = _target(region.n_inputs, inputs, orientation, reference_rpy_rad)
    if target.orientation == "free":
        refuse_unused(context, ["atol_deg"], "where the tool may turn as it comes")
    tool = _numbers("--tool-offset-mm", tool_offset_mm)
    if tool is not None and (tool.shape != (3,) or not np.isfinite(tool).all()):
        raise IksamplesError("--tool-offset-mm: give x, y and z, three numbers [mm].")
    chain = load_arm(robot, base_link, tip_link, (0, 0, 0) if tool is None else tool)
    fed = fed_as(
        target.units,
        input_unit or (),
        _numbers("--offset-mm", offset_mm),
        _numbers("--scale-mm", scale_mm),
    )
    reading = load_network(
        weights,
        (region.n_inputs, chain.n_joints),
        activation=activation,
        layers=None if layers is None else layers.split(","),
        key=key,
        fed=fed,
        read=read_as(
            chain.joint_units,
            output_unit or (),
            _numbers("--output-offset", output_offset),
            _numbers("--output-scale", output_scale),
        ),
    )
    network = reading.network
    say(f"Read {weights}: {reading.order}.")
    searches = network.n_seeds * (1 if target.orientation == "free" else 2)
    most = f"the search takes at most {time_limit * searches:g} s, its check comes on top"
    with shown(f"proving; {most}"):
        proved = prove(
            reading,
            chain,
            region,
            target,
            rtol=rtol,
            atol_deg=atol_deg,
            time_limit_s=time_limit,
            max_boxes=max_boxes,
        )
    for row, seed in enumerate(network.seeds):
        for found in proved.values():
            one, how = found[row], ""
            if one.upper < math.inf:
                early = "" if one.complete else "; stopped early, so the bound may be far above"
                how = f" (checked, {one.boxes} boxes{early})"
            say(f"seed {seed}: {one.in_words()}{how}.", err=one.upper == math.inf)
    every = [one for found in proved.values() for one in found]
    if any(one.upper == math.inf for one in every):
        raise typer.Exit(1)
    inputs_of = zip(target.coordinates, target.units, strict=True)
    names = ", ".join(f"{name} [{unit}]" for name, unit in inputs_of)
    if not network.offset.any() and (network.scale == 1).all():
        units = " and ".join(dict.fromkeys(target.units))
        say(f"Inputs go into the network as they are, in {units} (no option says otherwise).")
    folded = " (as folded here; the file's own operations round more often)"
    say(
        "Proved for the stored weights read as exact real numbers, in real arithmetic, over the "
        f"closed box ({names}); {float32_in_words(every)}{folded if reading.folded else ''}."
    )


def _target(
    n_inputs: int,
    inputs: str | None,
    orientation: Literal["free", "axis", "fixed"] | None,
    reference_rpy_rad: str | None,
) -> "Target":
    """What is asked of the tool."""
    import numpy as np

    from iksamples.arm.chain import roll_pitch_yaw
    from iksamples.arm.target import COORDINATES, Target

    if inputs is None and n_inputs > 3:
        raise IksamplesError(
            f"--box has {n_inputs} coordinates; name them: --inputs "
            f"{','.join(COORDINATES[:n_inputs])}, for example."
        )
    names = COORDINATES[:n_inputs] if inputs is None else tuple(inputs.replace(" ", "").split(","))
    if len(names) != n_inputs:
        raise IksamplesError(
            f"--inputs names {len(names)} coordinates, and --box has {n_inputs}; give two ends for "
            "each."
        )
    if orientation is None:
        orientation = "fixed" if set(names) & set(COORDINATES[3:]) else "free"
    rpy = _numbers("--reference-rpy-rad", reference_rpy_rad)
    if rpy is None:
        rpy = np.zeros(3)
    elif orientation == "free":
        raise IksamplesError(
            "--reference-rpy-rad: the tool's orientation is free; leave it out, or say "
            "--orientation axis or fixed."
        )
    elif rpy.shape != (3,) or not np.isfinite(rpy).all():
        raise IksamplesError("--reference-rpy-rad: give roll, pitch and yaw, three numbers [rad].")
    try:
        return Target(names, orientation, roll_pitch_yaw(rpy))
    except IksamplesError as error:
        raise IksamplesError(str(error).replace("task.", "--", 1)) from None


def _box(text: str) -> "Region":
    """The box of ``--box``."""
    from iksamples.region import Region

    ends = _numbers("--box", text)
    assert ends is not None
    d = len(ends) // 2
    if len(ends) % 2 or not 2 <= d <= 6:
        raise IksamplesError(
            f"--box has {len(ends)} numbers; give all lower ends, then all upper ends, of 2 to 6 "
            "coordinates, such as --box 20 20 0 80 80 60."
        )
    try:
        return Region.box(ends[:d], ends[d:])
    except IksamplesError as error:
        raise IksamplesError(f"--box: {error}") from None


def _numbers(option: str, text: str | None) -> "NDArray[np.float64] | None":
    """The numbers behind an option."""
    import numpy as np

    if text is None:
        return None
    words = text.replace(",", " ").split()
    strange = next((word for word in words if not _is_number(word)), None)
    if strange is not None or not words:
        raise IksamplesError(f"{option}: '{strange or text}' is not a number.")
    return np.array([float(word) for word in words])
