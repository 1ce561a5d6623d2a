"""Writes a path's recording: the arm, the target and every grid's path, in one Rerun file.

Lengths are in metres, as in the URDF; only the error curves are in millimetres. Two timelines:
``waypoint`` moves the arm along the path as the trained network sends it, ``epoch`` replays how the
networks came to draw the path. The viewer opens on a finished layout, with a text that says what is
shown.
"""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.urdf import UrdfTree

from iksamples import __version__
from iksamples.arm.chain import MM_PER_M, Floats, SerialChain
from iksamples.arm.drawing import drawn_urdf, shows_bodies
from iksamples.recording.shown import (
    BLACK,
    ENTITY,
    Colour,
    Proof,
    ShownGrid,
    blues,
    log_proof,
    log_scene,
    proof_text,
    proof_view,
    read_grid,
    read_proof,
)
from iksamples.results import Cell
from iksamples.study import Study
from iksamples.task import Task, study_task


APPLICATION = "iksamples"
"""Key under which the viewer keeps a layout: the same for all recordings."""

WAYPOINT, EPOCH = "waypoint", "epoch"
"""The two timelines."""

WHITE = (255, 255, 255)
# Behind the plots: dark blue shows, and so does the viewer's white time cursor.
PALE = (214, 218, 224)
# From which side the arm is seen: turned away from the direction in which it reaches, from above.
_TURN_RAD, _RISE_RAD = -1.1, 0.4


def layout(
    path_name: str,
    task: Task,
    shown: Sequence[ShownGrid],
    proof: Proof | None,
) -> rrb.Blueprint:
    """The layout a recording opens with, playing.

    Args:
        path_name: The path that is shown.
        task: The study's task.
        shown: The grids, by size; the arm follows the last.
        proof: What is proved of the network that moves the arm, if anything.
    """
    arm = shown[-1]
    lower, upper = task.positions_mm([task.x.lower, task.x.upper])
    box = np.stack([lower, upper])
    body = np.concatenate([box, task.chain_of(arm.seed).skeleton_mm(arm.joints).reshape(-1, 3)])
    # Else the viewer measures from the URDF's root, which need not be the base link.
    scene_frame = rrb.SpatialInformation(target_frame="tf#/")
    everything = rrb.Spatial3DView(
        origin="/",
        contents=[
            "+ /**",
            "- /samples/**",
            f"+ /samples/{arm.label}",
            "- /error/**",
            f"- /{ENTITY}/**",
            "- /about",
        ],
        name=f"Arm and all networks: {path_name}",
        background=WHITE,
        # The viewer draws a URDF's boxes and cylinders as glass unless told otherwise.
        defaults=[
            rr.Boxes3D.from_fields(fill_mode="solid"),
            rr.Cylinders3D.from_fields(fill_mode="solid"),
        ],
        spatial_information=scene_frame,
        eye_controls=_eye(body, (lower + upper) / 2),
    )
    one_by_one = [
        rrb.Spatial3DView(
            origin="/",
            contents=[
                "+ /workspace",
                "+ /path/target",
                f"+ /path/reached/{grid.label}",
                f"+ /tool/{grid.label}",
                f"+ /samples/{grid.label}",
            ],
            name=f"{grid.n_samples} samples",
            background=WHITE,
            spatial_information=scene_frame,
            eye_controls=_eye(box, (lower + upper) / 2),
        )
        for grid in shown
    ]
    tabs: list[rrb.View | rrb.Container] = [
        everything,
        rrb.Grid(*one_by_one, name="Each network by itself"),
    ]
    if proof is not None:
        eye = _eye(box, (lower + upper) / 2)
        tabs.append(proof_view(proof, arm.label, WHITE, scene_frame, eye))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*tabs, active_tab=0),
            rrb.Vertical(
                rrb.TimeSeriesView(
                    origin="/error",
                    name="Distance from the path [mm]",
                    background=rrb.archetypes.PlotBackground(color=PALE, show_grid=False),
                    plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
                ),
                rrb.TextDocumentView(origin="/about", name="What is shown"),
                row_shares=[2, 3],
            ),
            column_shares=[5, 3],
        ),
        rrb.TimePanel(
            state="collapsed", timeline=WAYPOINT, fps=30, play_state="playing", loop_mode="all"
        ),
        collapse_panels=True,
    )


def about(
    study: Study,
    path_name: str,
    shown: Sequence[ShownGrid],
    left_out: Sequence[ShownGrid] = (),
    proof: Proof | None = None,
) -> str:
    """The text panel (Markdown).

    Args:
        path_name: The path that is shown.
        shown: The grids, by size; the arm follows the last.
        left_out: Grids that cannot be drawn since their median seed diverged.
        proof: What is proved of the network that moves the arm, if anything.
    """
    arm = shown[-1]
    rows = "\n".join(
        f"| {grid.n_samples} | {grid.seed} | {grid.error_mm.mean():.2f} "
        f"| {grid.error_mm.max():.2f} |"
        for grid in shown
    )
    proved = f"\n{proof_text(proof, arm.n_samples)}\n" if proof else ""
    return f"""\
# {path_name}, study {study.name}

**Red** is the path the tool is to follow, **blue** where the networks' answers take it: light for
few samples, dark for many. **Black** are the {arm.n_samples} training points of the network that
moves the arm, and the box is the workspace.

Two timelines, to choose from at the lower left:

- **waypoint**: the network of {arm.n_samples} samples moves the arm along the path; the dots are
  the tools of all networks. Plot: the error at each waypoint.
- **epoch**: the training once more, at {len(arm.epochs)} epochs. The arm stands at the first
  waypoint. Plot: the mean error over the path.

| samples | seed shown | mean error [mm] | largest [mm] |
|---:|---:|---:|---:|
{rows}

{_missing(left_out)}
Of the {arm.n_seeds} seeds trained on each set of samples the one with the median error on this path
is shown. The second tab above the scene has every network by itself with its own training points.
{proved}
Lengths in the scene are in metres. Joint values outside the joint limits are drawn as they are.
Study {study.digest()}, iksamples {__version__}, Rerun {rr.__version__}.
"""


def _missing(left_out: Sequence[ShownGrid]) -> str:
    return "".join(
        f"Not shown, since its median seed diverged: {grid.n_samples} samples.\n"
        for grid in left_out
    )


def _eye(points_mm: Floats, towards_mm: Floats) -> rrb.EyeControls3D:
    """An orbiting eye that has all points in view.

    Args:
        points_mm: What is to be seen [mm], shape (points, 3).
        towards_mm: Where the arm reaches [mm], shape (3,).
    """
    lower, upper = points_mm.min(axis=0) / MM_PER_M, points_mm.max(axis=0) / MM_PER_M
    middle, size = (lower + upper) / 2, np.linalg.norm(upper - lower)
    azimuth = np.arctan2(towards_mm[1], towards_mm[0]) + _TURN_RAD
    direction = np.array(
        [
            np.cos(_RISE_RAD) * np.cos(azimuth),
            np.cos(_RISE_RAD) * np.sin(azimuth),
            np.sin(_RISE_RAD),
        ]
    )
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + 1.1 * size * direction,
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )


# Smooth enough for the eye, few enough for a small file.
MAX_WAYPOINTS = 600


def record_path(study: Study, path_name: str, cells: Iterable[Cell], output: str | Path) -> None:
    """Writes one recording of a path with all grids in it.

    Of each grid the network of the median seed is shown; a grid whose median seed diverged is left
    out, and the recording says so. The arm follows the network of the largest grid shown, also
    where its joint values leave the joint limits; what is proved of that network is shown where the
    results hold it. A path of more than 600 waypoints is thinned. Where no grid is left, the
    recording says so beside the path.

    Args:
        study: The study.
        path_name: One of its paths.
        cells: The results of each grid, smallest first.
        output: The ``.rrd`` file.

    Raises:
        IksamplesError: The path was not evaluated, or the results are of another run.
    """
    by_label = {cell.label: cell for cell in cells}
    task = study_task(study, next(iter(by_label.values())).samples.region)
    read = [read_grid(task, path_name, cell) for cell in by_label.values()]
    shown = [grid for grid in read if grid.finite]
    left_out = [grid for grid in read if not grid.finite]
    if shown:
        proof = read_proof(task, by_label[shown[-1].label], shown[-1].seed)
        _write(study, path_name, task, shown, left_out, proof, Path(output))
        return
    text = (
        f"# {path_name}, study {study.name}\n\n{_missing(left_out)}\nSo there is no network to "
        "draw, only the path and the workspace. The report says why.\n"
    )
    views = rrb.Spatial3DView(origin="/", background=WHITE), rrb.TextDocumentView(origin="/about")
    with _opened(study, path_name, rrb.Blueprint(*views), text, Path(output)) as recording:
        log_scene(recording, task, left_out[-1])


@contextmanager
def _opened(
    study: Study, path_name: str, blueprint: rrb.Blueprint, text: str, file: Path
) -> Iterator[rr.RecordingStream]:
    """A recording with its name, layout and text, whole at the end."""
    recording = rr.RecordingStream(
        APPLICATION, recording_id=f"{study.name}-{path_name}", send_properties=False
    )
    # Two recordings of the same results are to hold the same, whatever the clock says.
    rr.set_log_time_enabled(False, recording=recording)
    # Rerun's own writer may wait for ever on a full disk.
    stream = rr.binary_stream(recording)
    recording.send_blueprint(blueprint, make_active=False, make_default=True)
    recording.send_recording_name(f"{study.name}: {path_name}")
    recording.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    yield recording
    written = stream.read()
    assert written is not None
    file.write_bytes(written)
    recording.disconnect()


def _write(
    study: Study,
    path_name: str,
    task: Task,
    shown: Sequence[ShownGrid],
    left_out: Sequence[ShownGrid],
    proof: Proof | None,
    file: Path,
) -> None:
    """Logs the whole scene to a file."""
    arm = shown[-1]
    blueprint = layout(path_name, task, shown, proof)
    text = about(study, path_name, shown, left_out, proof)
    waypoints = np.arange(0, len(arm.target_mm), -(-len(arm.target_mm) // MAX_WAYPOINTS))
    with _opened(study, path_name, blueprint, text, file) as recording:
        log_scene(recording, task, arm)
        _log_arm(recording, study, task.chain_of(arm.seed), arm, waypoints)
        for grid, colour in zip(shown, blues(len(shown)), strict=True):
            _log_grid(recording, grid, colour, waypoints)
        if proof is not None:
            log_proof(recording, proof, arm.n_samples, EPOCH, f"error/{EPOCH}")


def _log_arm(
    recording: rr.RecordingStream,
    study: Study,
    chain: SerialChain,
    grid: ShownGrid,
    waypoints: NDArray[np.int64],
) -> None:
    """The links as bodies, and the joints over both timelines."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(study.robot.urdf)
        # The bodies of a file are the drawing's.
        drawn = study.arm is not None or not shows_bodies(path)
        if drawn:
            path = Path(folder) / "arm.urdf"
            path.write_text(drawn_urdf(chain), encoding="utf-8")
        tree = UrdfTree.from_file_path(path, entity_path_prefix="robot")
        tree.log_urdf_to_recording(recording)
    # A URDF's links are frames with names, which nothing ties to the scene until told so. The scene
    # hangs from the base link, not the other way round: that link may hang from another already.
    base = (not drawn and study.robot.base_link) or tree.root_link().name
    recording.log("base", rr.Transform3D(parent_frame=base, child_frame="tf#/"), static=True)
    joints = {joint.name: joint for joint in tree.joints()}
    for i, name in enumerate(chain.joint_names):
        joint = joints[name]
        unit = MM_PER_M if chain.joint_kinds[i] == "prismatic" else 1.0
        # While training is replayed, the arm stands at the start of the path.
        for timeline, times, values in (
            (WAYPOINT, waypoints, grid.joints[waypoints, i]),
            (EPOCH, grid.epochs, grid.learning.joints[:, 0, i]),
        ):
            recording.send_columns(
                rr.new_entity_path(["robot", "joints", name]),
                [rr.TimeColumn(timeline, sequence=times)],
                joint.compute_transform_columns((values / unit).tolist(), clamp=False),
            )


def _log_grid(
    recording: rr.RecordingStream,
    grid: ShownGrid,
    colour: Colour,
    waypoints: NDArray[np.int64],
) -> None:
    """One grid's samples, its path over both timelines and its errors."""
    over_waypoints = [rr.TimeColumn(WAYPOINT, sequence=waypoints)]
    over_epochs = [rr.TimeColumn(EPOCH, sequence=grid.epochs)]
    reached_mm, learning_mm = grid.reached_mm[waypoints], grid.learning.reached_mm[:, waypoints]
    recording.log(
        f"samples/{grid.label}",
        rr.Points3D(grid.samples_mm / MM_PER_M, colors=BLACK, radii=rr.Radius.ui_points(1.5)),
        static=True,
    )

    # One entity on both timelines: on the first the whole path, from the first waypoint on.
    path = f"path/reached/{grid.label}"
    breaks = np.searchsorted(waypoints, grid.breaks)
    line = rr.LineStrips3D.from_fields(colors=colour, radii=rr.Radius.ui_points(1.5))
    recording.log(path, line, static=True)
    at_start = [rr.TimeColumn(WAYPOINT, sequence=waypoints[:1])]
    recording.send_columns(path, at_start, _strips(reached_mm[None], breaks))
    recording.send_columns(path, over_epochs, _strips(learning_mm, breaks))

    tool = f"tool/{grid.label}"
    dot = rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(5.0))
    recording.log(tool, dot, static=True)
    recording.send_columns(
        tool, over_waypoints, rr.Points3D.columns(positions=reached_mm / MM_PER_M)
    )

    curve = rr.SeriesLines(names=f"{grid.n_samples} samples", colors=colour, widths=2.0)
    for timeline, times, error_mm in (
        (WAYPOINT, over_waypoints, grid.error_mm[waypoints]),
        (EPOCH, over_epochs, grid.learning.error_mm.mean(axis=1)),
    ):
        entity = f"error/{timeline}/{grid.label}"
        recording.log(entity, curve, static=True)
        recording.send_columns(entity, times, rr.Scalars.columns(scalars=error_mm))


def _strips(paths_mm: Floats, breaks: NDArray[np.int64]) -> rr.ComponentColumnList:
    """Paths [mm], shape (times, waypoints, 3), as a column of line strips."""
    strips = [strip for path in paths_mm / MM_PER_M for strip in np.split(path, breaks)]
    per_time = [len(breaks) + 1] * len(paths_mm)
    return rr.LineStrips3D.columns(strips=strips).partition(per_time)
