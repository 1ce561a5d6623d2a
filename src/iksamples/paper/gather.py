"""What the paper's Table 1 and claims are held against: gathered from a finished study."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from iksamples.answer.curves import GridCurve, fit_published, fit_seeds
from iksamples.arm.chain import Floats
from iksamples.evaluation.errors import send
from iksamples.paper import equations as paper
from iksamples.paper.claims import judge_claims
from iksamples.paper.equations import (
    AVERAGE_NAMES,
    Evidence,
    GridEvidence,
    input_jacobian,
    paper_table,
    reading_table,
    scale_mm,
)
from iksamples.results import CUBE, Cell, cells
from iksamples.samples.record import region_points
from iksamples.stats import FEWEST_SEEDS, Interval, draws
from iksamples.study import NETWORK, Study
from iksamples.task import Task


def study_table(study: Study, cells: Iterable[Cell], certificates: pd.DataFrame) -> pd.DataFrame:
    """Aggregates the errors and estimates of every grid over its seeds.

    Means over seeds; ``error_sd_mm`` is the standard deviation over seeds of a seed's mean error
    along the study's first path (the paper does not say what its ± is). A seed that diverged is
    counted in ``n_diverged`` and left out of everything else.

    Args:
        study: The study.
        cells: One cell per grid.
        certificates: Certified worst cases, columns as in ``columns.CERTIFICATES``.

    Returns:
        One row per grid, columns as in ``columns.TABLE``.
    """
    published = paper_table().join(reading_table())
    first_path = next(iter(study.evaluation.paths))
    rows = []
    for cell in cells:
        samples, members = cell.samples, cell.table("members")
        sound = members.loc[~members["diverged"], "seed"]
        errors = cell.sound_errors
        bounds = cell.table("bounds").query("seed in @sound.values")
        name = study.bounds.average_weight
        spacing_mm = samples.spacing_mm
        m = samples.points_per_axis
        row: dict[str, object] = {
            "samples_per_axis": m,
            "n_samples": samples.n_samples,
            "n_trained": int(members["n_trained"].iloc[0]),
            "spacing_mm": spacing_mm,
            "fill_distance_mm": samples.fill_distance_mm,
            "n_seeds": len(members),
            "n_diverged": len(members) - len(sound),
        }
        row |= over_seeds(errors[errors["region"] == first_path], "", spacing_mm)
        row["estimate_mm"] = bounds[f"estimate_{name}_mm"].mean()
        row["wbar"] = bounds[f"wbar_{name}"].mean()
        row["above_estimate"] = bounds[f"above_{name}"].mean()
        proved = certificates.query("method == @cell.method and label == @cell.label")
        row["sup_median_mm"] = proved["sup_upper_mm"].median()
        row["sup_worst_mm"] = proved["sup_upper_mm"].max()
        on_paper = published.loc[m] if m in published.index else None
        for column in published.columns.drop("n_samples"):
            row[column] = np.nan if on_paper is None else on_paper[column]
        row["wbar_for_paper"] = (
            np.nan
            if on_paper is None
            else float(
                paper.average_weight_of(on_paper["paper_estimate_mm"], m**3, scale_mm(study))
            )
        )
        row |= over_seeds(errors[errors["region"] == CUBE], "cube_", spacing_mm)
        rows.append(row)
    return pd.DataFrame(rows)


def over_seeds(errors: pd.DataFrame, prefix: str, spacing_mm: float) -> dict[str, float]:
    """Statistics over seeds of one region's errors.

    Args:
        errors: Rows of ``errors.parquet`` of one region, one per sound seed.
        prefix: Put before each name.
        spacing_mm: Spacing of the grid [mm].
    """
    mean = errors["error_mean_mm"].mean()
    return {
        f"{prefix}error_mean_mm": mean,
        f"{prefix}error_sd_mm": errors["error_mean_mm"].std(ddof=1),
        f"{prefix}error_p95_mm": errors["error_p95_mm"].mean(),
        f"{prefix}error_max_mm": errors["error_max_mm"].max(),
        f"{prefix}error_over_spacing": mean / spacing_mm,
    }


_POINTS = 512
"""Points of the workspace at which slopes are looked at; a slope found is one that occurs."""
_PAPER_SIDE_MM = 60.0
_SATURATION_M = 5
"""The paper sees no further improvement beyond 5 points per axis (abstract and introduction)."""
_STREAM = 20260523
_RESAMPLES = 4000


def claims_table(
    study: Study, task: Task, results: str | Path, proofs: pd.DataFrame
) -> pd.DataFrame:
    """Every claim of the paper with its verdict; no row where the samples are not on grids.

    Args:
        study: The study.
        task: Its task.
        results: Its results folder.
        proofs: Its certificates.

    Returns:
        Columns claim, where, verdict, evidence.
    """
    columns = ["claim", "where", "verdict", "evidence"]
    sound = [cell for cell in cells(study, results) if len(cell.sound_errors)]
    if study.samples.design != "grid" or not sound:
        return pd.DataFrame(columns=columns)
    rows = judge_claims(_gather(study, task, sound, proofs))
    return pd.DataFrame([vars(row) for row in rows], columns=columns)


def fall(before: Floats, after: Floats) -> Interval:
    """By which share the mean falls from one group of seeds to another, with its 95 % interval."""
    share = 1 - float(after.mean() / before.mean())
    if min(len(before), len(after)) < FEWEST_SEEDS:
        return Interval(share, np.nan, np.nan)
    first, second = (
        values[draws(len(values), np.random.default_rng([i, len(values)]), _RESAMPLES)].mean(axis=1)
        for i, values in enumerate((before, after))
    )
    return Interval(share, *(float(q) for q in np.quantile(1 - second / first, [0.025, 0.975])))


def _gather(study: Study, task: Task, sound: Sequence[Cell], proofs: pd.DataFrame) -> Evidence:
    points = region_points(task.region, _POINTS)
    angles = task.reach(points).joints
    jacobians = np.abs(task.drawing.jacobian_mm(angles))
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)
    normalised = jacobians * np.ptp(angles, axis=0) / sides[:, None]
    grids = [_grid(study, task, cell, proofs, points) for cell in sound]
    levelling = None
    if len(grids) > 1:
        before = next((one for one in grids[:-1] if one.m == _SATURATION_M), grids[-2])
        levelling = before, grids[-1]
    published = paper_table()
    curves = {"the paper’s column": _paper_curve(published), "here": _our_curve(study, sound)}
    known = {name: curve for name, curve in curves.items() if curve is not None}
    return Evidence(
        grids=grids,
        chosen=study.bounds.average_weight,
        names=AVERAGE_NAMES,
        row_sums_mm=jacobians.sum(axis=-1).max(axis=-1),
        row_sums_by_range=normalised.sum(axis=-1).max(axis=-1),
        scale_mm=scale_mm(study),
        fall=fall(*(one.error_mm for one in levelling)) if levelling else None,
        fall_n=(levelling[0].n, levelling[1].n) if levelling else (0, 0),
        paper_n=published["n_samples"].to_numpy(float),
        paper_error_mm=published["paper_error_mm"].to_numpy(float),
        paper_estimate_mm=published["paper_estimate_mm"].to_numpy(float),
        paper_scale_mm=_PAPER_SIDE_MM,
        floors_mm={name: curve.floor_mm for name, curve in known.items()},
        tails_mm={name: curve.scale_mm.value for name, curve in known.items()},
        misfits={name: _misfit(curve) for name, curve in known.items()},
    )


def _path_errors(study: Study, cell: Cell) -> "pd.Series[float]":
    """Mean error of each sound seed on the first path [mm]."""
    rows = cell.sound_errors
    rows = rows[rows["region"] == next(iter(study.evaluation.paths))]
    return rows.set_index("seed")["error_mean_mm"]


def _grid(
    study: Study, task: Task, cell: Cell, proofs: pd.DataFrame, points: Floats
) -> GridEvidence:
    errors = _path_errors(study, cell)
    seeds = [int(seed) for seed in errors.index]
    bounds = cell.table("bounds").set_index("seed").loc[seeds]
    network = cell.network.select([cell.network.seeds.index(seed) for seed in seeds])
    samples = cell.samples
    slope = np.abs(input_jacobian(network, points)).max(axis=(1, 2, 3))
    at_samples = send(network, task, samples.x).error_mm
    if study.training.held_out.source == "grid":
        at_samples = np.full_like(at_samples, np.nan)  # some of them were not trained on
    own = proofs[(proofs["method"] == NETWORK) & (proofs["label"] == cell.label)]
    own = own.set_index("seed").reindex(seeds)
    place = own[["argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]].dropna().to_numpy(float)
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)

    def by_average(prefix: str, suffix: str = "") -> Mapping[str, Floats]:
        return {k: bounds[f"{prefix}_{k}{suffix}"].to_numpy(float) for k in AVERAGE_NAMES}

    return GridEvidence(
        m=samples.points_per_axis,
        n=samples.n_samples,
        spacing_mm=samples.spacing_mm,
        fill_mm=samples.fill_distance_mm,
        error_mm=np.asarray(errors, np.float64),
        estimate_mm=by_average("estimate", "_mm"),
        average_weight=by_average("wbar"),
        above=by_average("above"),
        lemma_1_squared=bounds["lemma_1_above_squared"].to_numpy(float),
        lemma_1_mm=bounds["lemma_1_above_mm"].to_numpy(float),
        output_weight=np.abs(network.weights[-1]).max(axis=(1, 2)).astype(float),
        slope=slope,
        at_samples_mm=at_samples.max(axis=1),
        at_samples_mean_mm=at_samples.mean(axis=1),
        sup_mm=own["sup_upper_mm"].to_numpy(float),
        argmax=(place - study.workspace.lower_mm) / sides * (samples.points_per_axis - 1),
    )


def _paper_curve(published: pd.DataFrame) -> GridCurve | None:
    return fit_published(
        published.index.to_numpy(float),
        published["paper_error_mm"],
        published["paper_error_sd_mm"],
        np.random.default_rng(_STREAM),
    )


def _our_curve(study: Study, sound: Sequence[Cell]) -> GridCurve | None:
    sets = {cell.samples.n_samples: cell.samples.points_per_axis for cell in sound}
    columns = [_path_errors(study, cell) for cell in sound]
    errors = pd.concat(dict(zip(sets, columns, strict=True)), axis=1).dropna()
    if errors.empty:
        return None
    resampled = draws(len(errors), np.random.default_rng(_STREAM))
    return fit_seeds(list(sets.values()), errors.to_numpy(float), resampled)


def _misfit(curve: GridCurve) -> float:
    fitted = curve.at(curve.points_per_axis)
    return float(np.max(np.abs(fitted / curve.observed_mm - 1)))
