"""What a recording shows of a grid: the network of one seed on one path, what is proved of it."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from iksamples.arm.chain import MM_PER_M, Floats
from iksamples.evaluation.errors import Reached, median_seed, networks_over_epochs, send
from iksamples.evaluation.paths import count_waypoints
from iksamples.results import PROOFS, Cell, proofs, require_own
from iksamples.task import Task
from iksamples.text import domain, percent, percent_down, percent_up


@dataclass(frozen=True, eq=False)
class ShownGrid:
    """One grid on one path, at the end of training and on the way there.

    Attributes:
        label: Name of the grid, such as ``grid5``.
        samples_mm: Its training points [mm], shape (n, 3).
        n_seeds: Networks trained on it.
        seed: The one that is shown.
        target_mm: The path [mm], shape (waypoints, 3).
        breaks: Waypoints before which the pen is lifted.
        joints: What the network answers [rad or mm], shape (waypoints, joints).
        reached_mm: Where that takes the tool [mm], shape (waypoints, 3).
        error_mm: Distance between the two [mm], shape (waypoints,).
        epochs: Epochs at which weights were kept, shape (epochs,).
        learning: What the network answered then, with the epochs in place of the seeds.
    """

    label: str
    samples_mm: Floats
    n_seeds: int
    seed: int
    target_mm: Floats
    breaks: NDArray[np.int64]
    joints: Floats
    reached_mm: Floats
    error_mm: Floats
    epochs: NDArray[np.int64]
    learning: Reached

    @property
    def n_samples(self) -> int:
        """Number of training points."""
        return len(self.samples_mm)

    @property
    def finite(self) -> bool:
        """Whether the network's answers are numbers throughout."""
        return bool(np.all(np.isfinite(self.joints)) and np.all(np.isfinite(self.learning.joints)))


def read_grid(task: Task, path_name: str, cell: Cell) -> ShownGrid:
    """Reads what a recording shows of one grid.

    Args:
        task: The study's task.
        path_name: Which path.
        cell: The grid's results.

    Raises:
        IksamplesError: The results know no such path.
    """
    study, table = cell.study, cell.table("waypoints")
    table = table[table["path"] == path_name]
    file, n = cell.folder / "waypoints.parquet", count_waypoints(study.evaluation.paths[path_name])
    require_own(study, file, "waypoint", table["waypoint"], range(n))
    seed = median_seed(table)
    rows = table[table["seed"] == seed].sort_values("waypoint")
    target = rows[task.x.columns("target_")].to_numpy(float)
    pen_up = rows["pen_up"].to_numpy(bool)
    epochs, networks = networks_over_epochs(cell, seed)
    return ShownGrid(
        label=cell.label,
        samples_mm=task.positions_mm(cell.samples.x),
        n_seeds=table["seed"].nunique(),
        seed=seed,
        target_mm=task.positions_mm(target),
        breaks=np.flatnonzero(pen_up),
        joints=rows[task.q.columns("q_")].to_numpy(float),
        reached_mm=rows[[f"reached_{axis}_mm" for axis in "xyz"]].to_numpy(float),
        error_mm=rows["error_mm"].to_numpy(float),
        epochs=epochs,
        learning=send(networks, task, target),
    )


Colour = tuple[int, int, int]

RED: Colour = (214, 39, 40)
BLACK: Colour = (0, 0, 0)
GREY: Colour = (150, 150, 150)
ORANGE: Colour = (214, 110, 10)
_LIGHT_BLUE, _DARK_BLUE = np.array([140, 200, 255]), np.array([10, 40, 140])


def log_scene(recording: rr.RecordingStream, task: Task, grid: ShownGrid) -> None:
    """What does not depend on a network: the path and the workspace."""
    recording.log(
        "path/target",
        rr.LineStrips3D(
            np.split(grid.target_mm / MM_PER_M, grid.breaks),
            colors=RED,
            radii=rr.Radius.ui_points(1.5),
        ),
        static=True,
    )
    lower, upper = task.positions_mm([task.x.lower, task.x.upper])
    recording.log(
        "workspace",
        rr.Boxes3D(
            mins=[lower / MM_PER_M],
            sizes=[(upper - lower) / MM_PER_M],
            colors=GREY,
            radii=rr.Radius.ui_points(0.75),
            fill_mode="majorwireframe",
        ),
        static=True,
    )


def blues(n: int) -> list[Colour]:
    """Colours of n grids, from few samples (light) to many (dark)."""
    shades = _LIGHT_BLUE + np.linspace(0, 1, n)[:, None] * (_DARK_BLUE - _LIGHT_BLUE)
    return [(int(red), int(green), int(blue)) for red, green, blue in shades]


ENTITY = "proof"
"""Everything in 3D about the proof is below this entity."""
_GLASS = 25  # opacity of a box, of 255: several lie behind each other


@dataclass(frozen=True, eq=False)
class Proof:
    """What is proved of one network.

    Attributes:
        lower_mm: Lower corners of boxes in which the error is above the tolerance [mm], (boxes, 3).
        upper_mm: Their upper corners [mm], shape (boxes, 3).
        tolerance_mm: The tolerance [mm].
        place: What is proved over, in words.
        safe: Least and largest share of it that can be under the tolerance.
        drawn: The boxes' share of it.
        epochs: Epochs at which the network was kept, shape (epochs,).
        sup_mm: Its certified worst case then [mm], shape (epochs,).
        worst_mm: Where the trained network's error is largest [mm], shape (3,), if known.
        worst_error_mm: The error that is taken there [mm].
    """

    lower_mm: Floats
    upper_mm: Floats
    tolerance_mm: float
    place: str
    safe: tuple[float, float]
    drawn: float
    epochs: NDArray[np.int64]
    sup_mm: Floats
    worst_mm: Floats | None
    worst_error_mm: float


def read_proof(task: Task, cell: Cell, seed: int) -> Proof | None:
    """Reads what is proved of one network; None where that was not worked out.

    Args:
        task: The study's task.
        cell: The grid's results.
        seed: Which network.
    """
    found = [cell.folder / f"{name}.parquet" for name in ("unsafe", "training_bound")]
    if not all(file.exists() for file in found):
        return None
    corners = [*task.x.columns("lower_"), *task.x.columns("upper_")]
    unsafe, training = (
        _of_seed(cell.table(file.stem, needed), seed)
        for file, needed in zip(found, (corners, ()), strict=True)
    )
    if unsafe.empty or training.empty:
        return None
    head = unsafe.iloc[0]
    lower, upper = (
        task.positions_mm(unsafe[task.x.columns(f"{end}_")].dropna().to_numpy(float))
        for end in ("lower", "upper")
    )
    worst_mm, worst_error_mm = _worst_point(task, cell, seed)
    return Proof(
        lower,
        upper,
        float(head["tolerance_mm"]),
        domain(task.region_share),
        (float(head["safe_lower"]), float(head["safe_upper"])),
        float(head["drawn"]),
        training["epoch"].to_numpy(np.int64),
        training["sup_upper_mm"].to_numpy(float),
        worst_mm,
        worst_error_mm,
    )


def log_proof(
    recording: rr.RecordingStream, proof: Proof, n_samples: int, timeline: str, curves: str
) -> None:
    """Logs the boxes, the worst point, and the worst case over the training.

    Args:
        recording: Where to.
        proof: What is proved.
        n_samples: Training points of the network, for the curve's name.
        timeline: Timeline of the training.
        curves: Entity below which the timeline's curves are.
    """
    if len(proof.lower_mm):
        recording.log(
            f"{ENTITY}/above_tolerance",
            rr.Boxes3D(
                mins=proof.lower_mm / MM_PER_M,
                sizes=(proof.upper_mm - proof.lower_mm) / MM_PER_M,
                colors=ORANGE,
                radii=rr.Radius.ui_points(0.3),
                fill_mode="majorwireframe",
            ),
            static=True,
        )
        # The viewer fills translucent boxes with grey; a mesh keeps its colour.
        recording.log(f"{ENTITY}/above_tolerance/fill", _glass(proof), static=True)
    if proof.worst_mm is not None:
        recording.log(
            f"{ENTITY}/worst_point",
            rr.Points3D(
                proof.worst_mm[None] / MM_PER_M,
                colors=RED,
                radii=rr.Radius.ui_points(9.0),
                labels=f"{proof.worst_error_mm:.2f} mm",
                show_labels=True,
            ),
            static=True,
        )
    curve = f"{curves}/worst_case"
    name = f"worst case proved, {n_samples} samples"
    recording.log(curve, rr.SeriesLines(names=name, colors=ORANGE, widths=2.0), static=True)
    recording.send_columns(
        curve,
        [rr.TimeColumn(timeline, sequence=proof.epochs)],
        rr.Scalars.columns(scalars=proof.sup_mm),
    )


def proof_view(
    proof: Proof,
    label: str,
    background: tuple[int, int, int],
    spatial_information: rrb.SpatialInformation,
    eye: rrb.EyeControls3D,
) -> rrb.Spatial3DView:
    """The workspace with the boxes, the path and the worst point.

    Args:
        proof: What is proved.
        label: The grid whose network it is about.
        background: Colour behind the scene.
        spatial_information: Frame of the scene.
        eye: From where it is seen.
    """
    contents = ["workspace", "path/target", f"path/reached/{label}", f"{ENTITY}/**"]
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"+ /{entity}" for entity in contents],
        name=f"Error above {proof.tolerance_mm:g} mm",
        background=background,
        spatial_information=spatial_information,
        eye_controls=eye,
    )


def proof_text(proof: Proof, n_samples: int) -> str:
    """What the text panel says of it (Markdown)."""
    least, most = proof.safe
    lines = [
        f"Proved for the network of {n_samples} samples that moves the arm, for every point of "
        f"{proof.place} and not only for points tested: between {percent_down(least)} and "
        f"{percent_up(most)} of it has an error of at most {proof.tolerance_mm:g} mm."
    ]
    if len(proof.lower_mm):
        lines.append(
            "In the **orange** boxes of the third tab the error is larger everywhere; they fill "
            f"{percent(proof.drawn)} of {proof.place}, smaller ones are left out."
        )
    if proof.worst_mm is not None:
        x, y, z = proof.worst_mm
        lines.append(
            f"The **red** dot there is the worst point, ({x:.1f}, {y:.1f}, {z:.1f}) mm, with "
            f"{proof.worst_error_mm:.2f} mm."
        )
    lines.append("The orange curve over the epochs bounds the error of any point.")
    return "\n".join(lines)


def _glass(proof: Proof) -> rr.Mesh3D:
    """The boxes' faces as one translucent mesh."""
    corner = np.array(list(product((0, 1), repeat=3)))
    size = proof.upper_mm - proof.lower_mm
    vertices = proof.lower_mm[:, None] + corner * size[:, None]
    # Corner number is 4 x + 2 y + z; each face as two triangles.
    faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    first = 8 * np.arange(len(size))
    return rr.Mesh3D(
        vertex_positions=vertices.reshape(-1, 3) / MM_PER_M,
        triangle_indices=(first[:, None, None] + triangles).reshape(-1, 3),
        albedo_factor=(*ORANGE, _GLASS),
    )


def _of_seed(table: pd.DataFrame, seed: int) -> pd.DataFrame:
    return table[table["seed"] == seed]


def _worst_point(task: Task, cell: Cell, seed: int) -> tuple[Floats | None, float]:
    """Where the largest known error is, and how large it is."""
    file, place = cell.folder.parent / PROOFS, task.x.columns("argmax_")
    if not file.exists():
        return None, float("nan")
    table = proofs(cell.study, file, [*place, "sup_lower_mm"])
    rows = table[(table["label"] == cell.label) & (table["seed"] == seed)]
    if rows.empty:
        return None, float("nan")
    at = rows[place].to_numpy(float)[0]
    return task.positions_mm(at), float(rows["sup_lower_mm"].iloc[0])
