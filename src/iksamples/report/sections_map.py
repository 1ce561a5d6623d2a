"""The section about where the error is too large, and how its bound fell during training."""

import pandas as pd

from iksamples.report import figures_map
from iksamples.report.blocks import Figure, Section, Text
from iksamples.report.data import Grid, ReportData
from iksamples.report.wording import minus, percent, shown_network
from iksamples.results import Cell
from iksamples.study import NETWORK


_SAME = 1.05
"""Below this ratio two errors are said to be the same, to within what they differ by."""


def where_and_when(data: ReportData) -> Section | None:
    """The error map of the largest grid and the bound along the training; None without them."""
    trainings = [
        (grid, rows) for grid in data.grids if len(rows := _rows(data, grid, "training_bound"))
    ]
    grid = data.grids[-1]
    unsafe = _rows(data, grid, "unsafe")
    if unsafe.empty or not trainings or trainings[-1][0] is not grid:
        return None
    network = _cell(data, grid).network
    seed = grid.median_seed(data.first_path)
    parts = figures_map.slices(data, network.select([network.seeds.index(seed)]))
    tolerance_mm = float(unsafe["tolerance_mm"].iloc[0])
    folder = (data.results / NETWORK / grid.samples.label).as_posix()
    return Section(
        "map",
        "Where the error is too large, and since when",
        [
            Text(_coverage(data, grid, unsafe)),
            Figure(
                "error-map",
                "",
                f"Position error on three slices through the workspace, {grid.n} samples: bottom, "
                f"middle and top. Red line: the tolerance of {tolerance_mm:g} mm; red dot: the "
                f"slice’s worst of the points drawn (seed {seed}{shown_network(data)}).",
                figures_map.error_map(data, parts, tolerance_mm),
                f"{folder}/weights.safetensors",
                f"{figures_map.__name__}.error_map",
            ),
            Figure(
                "bound-against-epochs",
                "",
                "Certified worst case along the training, beside the error at the training points: "
                "both axes logarithmic, the network before its first epoch left out"
                f"{shown_network(data)}.",
                figures_map.bound_against_epochs(_few(trainings)),
                data.source("training_bound"),
                f"{figures_map.__name__}.bound_against_epochs",
            ),
            Text(_along_the_training(trainings[-1][1], grid)),
        ],
    )


def _cell(data: ReportData, grid: Grid) -> Cell:
    return Cell(data.results, NETWORK, grid.samples.label)


def _rows(data: ReportData, grid: Grid, name: str) -> pd.DataFrame:
    """A table's rows of the network shown; empty where there are none."""
    cell = _cell(data, grid)
    if not (cell.folder / f"{name}.parquet").exists():
        return pd.DataFrame()
    table = cell.table(name)
    return table[table["seed"] == grid.median_seed(data.first_path)]


def _few(parts: list[tuple[Grid, pd.DataFrame]]) -> list[tuple[Grid, pd.DataFrame]]:
    """The fewest, the middle and the most samples."""
    return [parts[i] for i in sorted({0, len(parts) // 2, len(parts) - 1})]


def _coverage(data: ReportData, grid: Grid, unsafe: pd.DataFrame) -> str:
    """The share of the workspace under the tolerance, and where the worst point is."""
    head = unsafe.iloc[0]
    least, most = float(head["safe_lower"]), float(head["safe_upper"])
    text = (
        f"Between {percent(least, 1)} and {percent(most, 1)} of the workspace has an error of at "
        f"most {head['tolerance_mm']:g} mm with the network shown of {grid.n} samples: proved for "
        "every point, not counted among tested ones."
    )
    if data.proofs is not None and "label" in data.proofs:
        own = data.proofs[
            (data.proofs["method"] == NETWORK)
            & (data.proofs["label"] == grid.samples.label)
            & (data.proofs["seed"] == int(head["seed"]))
        ]
        if len(own):
            row = own.iloc[0]
            at = ", ".join(f"{row[f'argmax_{axis}_mm']:.1f}" for axis in "xyz")
            text += minus(f" Its worst point is ({at}) mm, with {row['sup_lower_mm']:.2f} mm.")
    return text


def _along_the_training(rows: pd.DataFrame, grid: Grid) -> str:
    """How worst case, training error and Lip(h - id) moved."""
    rows = rows.sort_values("epoch")
    last, best = rows.iloc[-1], rows.iloc[int(rows["sup_upper_mm"].argmin())]
    ratio = last["sup_upper_mm"] / last["training_max_mm"]
    beside = (
        f"which is the largest error at a training point to within {percent(ratio - 1, 1)}"
        if ratio < _SAME
        else f"{ratio:.1f} times the largest error at a training point"
    )
    text = (
        f"With {grid.n} samples the certified worst case ends at {last['sup_upper_mm']:.1f} mm, "
        f"{beside}, and {last['sup_upper_mm'] / last['training_mean_mm']:.1f} times the mean error "
        "at the training points."
    )
    # Two bounds within their tolerance of each other do not tell which network is better.
    if best["sup_upper_mm"] < last["sup_lower_mm"]:
        text += (
            f" It was lower before: at most {best['sup_upper_mm']:.1f} mm at epoch "
            f"{int(best['epoch'])}, so training on did not make the worst point better."
        )
    return text
