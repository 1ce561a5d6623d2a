"""Writes a path's recording: arm, target and every grid's path, over the waypoints and the epochs.

Everything is in metres, as in the URDF; only the error plots are in millimetres. Two timelines:
``waypoint`` moves the arm along the path as the trained network sends it, ``epoch`` replays how
the networks came to draw the path.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.urdf import UrdfTree

from iksamples.errors import IksamplesError
from iksamples.recording.layout import layout
from iksamples.recording.shown import GridFiles, ShownGrid, read_grid
from iksamples.robot.chain import MM_PER_M, Floats, SerialChain
from iksamples.robot.workspace import study_chain
from iksamples.study import Study


APPLICATION = "iksamples"
WAYPOINT, EPOCH = "waypoint", "epoch"

RED, BLACK, GREY = (214, 39, 40), (0, 0, 0), (150, 150, 150)
# Blues of one hue, from few samples to many, that stand out against white.
_LIGHT_BLUE, _DARK_BLUE = np.array([125, 190, 255]), np.array([10, 40, 140])


def record_path(
    study: Study, path_name: str, grids: Sequence[GridFiles], output: str | Path
) -> None:
    """Writes one recording with all grids in it.

    Of each grid the network of the median seed is shown; the arm follows the network of the
    largest grid, even where its joint values leave the joint limits.

    Args:
        study: The study.
        path_name: One of its paths.
        grids: Files of each grid.
        output: The ``.rrd`` file.

    Raises:
        IksamplesError: The path was not evaluated, or no grid is given.
    """
    if not grids:
        raise IksamplesError(f"recording of '{path_name}': no grid to show.")
    chain = study_chain(study)
    shown = sorted((read_grid(chain, path_name, files) for files in grids), key=_by_size)
    output = Path(output)
    # Written beside the output and moved there, so that a stopped run leaves no half recording.
    draft = output.with_name(f".{output.name}.draft")
    try:
        _write(study, path_name, chain, shown, draft)
        draft.replace(output)
    finally:
        draft.unlink(missing_ok=True)


def _by_size(grid: ShownGrid) -> int:
    return grid.n_samples


def _write(
    study: Study, path_name: str, chain: SerialChain, shown: list[ShownGrid], file: Path
) -> None:
    """Logs the whole scene to a file."""
    arm = shown[-1]
    recording = rr.RecordingStream(
        APPLICATION, recording_id=f"{study.name}-{path_name}", send_properties=False
    )
    # Wall-clock times would make two recordings of the same results differ.
    rr.set_log_time_enabled(False, recording=recording)
    recording.save(file, default_blueprint=layout(study, path_name, shown))
    recording.send_recording_name(f"{study.name}: {path_name}")
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log(
        "about", rr.TextDocument(_about(study, path_name, shown), "text/markdown"), static=True
    )
    _log_arm(recording, study, chain, arm)
    _log_box(recording, study)
    target = arm.target_mm / MM_PER_M
    breaks = path_breaks(arm.target_mm)
    recording.log(
        "path/target",
        rr.LineStrips3D(np.split(target, breaks), colors=RED, radii=rr.Radius.ui_points(2.0)),
        static=True,
    )
    for grid, colour in zip(shown, blues(len(shown)), strict=True):
        _log_grid(recording, grid, colour, breaks)
    recording.flush()
    recording.disconnect()


def blues(n: int) -> list[tuple[int, int, int]]:
    """Colours of n grids, from few samples (light) to many (dark)."""
    return [
        tuple(int(round(channel)) for channel in _LIGHT_BLUE + share * (_DARK_BLUE - _LIGHT_BLUE))
        for share in np.linspace(0.0, 1.0, n)
    ]
