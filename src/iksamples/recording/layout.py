"""How the viewer opens a recording, and the text that says what is shown."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from iksamples import __version__
from iksamples.arm.chain import MM_PER_M, Floats
from iksamples.recording.proofs import ENTITY, Proof, proof_text, proof_view
from iksamples.recording.shown import ShownGrid
from iksamples.study import Study
from iksamples.task import Task


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
    diverged = "".join(
        f"Not shown, since its median seed diverged: {grid.n_samples} samples.\n"
        for grid in left_out
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

{diverged}
Of the {arm.n_seeds} seeds trained on each set of samples the one with the median error on this path
is shown. The second tab above the scene has every network by itself with its own training points.
{proved}
Lengths in the scene are in metres. Joint values outside the joint limits are drawn as they are.
Study {study.digest()}, iksamples {__version__}, Rerun {rr.__version__}.
"""


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
