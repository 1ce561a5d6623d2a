"""The page of claims: what the paper says, and what the study's data say to that."""

from collections import Counter

import numpy as np
import pandas as pd

from iksamples.answer.curves import Curve, fit_published, fit_seeds
from iksamples.answer.statistics import draws
from iksamples.arm.closed_form import yaw_pitch_pitch
from iksamples.evaluation.errors import send
from iksamples.paper.audit import input_jacobian, scale_mm
from iksamples.paper.claims import judge_claims
from iksamples.paper.evidence import Ends, Evidence, GridEvidence
from iksamples.paper.table import paper_table
from iksamples.report.blocks import Block, Column, Section, Table, Text
from iksamples.report.data import Grid, ReportData
from iksamples.report.figures_error import AVERAGE_NAMES
from iksamples.report.statistics import fall_interval
from iksamples.report.verdict import levelling_pair, paper_recipe, paper_task
from iksamples.report.wording import joined
from iksamples.results import Cell, cells
from iksamples.samples.record import region_points


_POINTS = 512
"""Points of the workspace at which slopes are looked at; a slope found is one that occurs."""
_PAPER_SIDE_MM = 60.0
_STREAM = 20260523
_VERBS = {
    "holds": ("holds", "hold"),
    "does not hold": ("does not hold", "do not hold"),
    "holds in part": ("holds in part", "hold in part"),
    "cannot be tested": ("cannot be tested", "cannot be tested"),
}


def claims(data: ReportData) -> Section | None:
    """What the paper claims, and what holds; None for samples that are not on a grid."""
    if data.study.samples.design != "grid":
        return None
    rows = judge_claims(gather(data))
    tally = Counter(row.verdict for row in rows)
    said = joined([f"{n} {_VERBS[v][n > 1]}" for v, n in tally.items()])
    blocks: list[Block] = [
        Text(f"Of {len(rows)} claims: {said}. A claim that nothing here contradicts “holds”."),
        Table(
            [
                Column("The paper’s claim", text=True),
                Column("where", text=True),
                Column("verdict", text=True, ours=True),
                Column("number or counter-example", text=True),
            ],
            [[row.claim, row.where, f"**{row.verdict}**", row.evidence] for row in rows],
            f"Every verdict is computed from this study’s networks{_other(data)} and the paper’s "
            f"Table 1. Data: `{data.source('bounds')}`, "
            f"`{(data.results / 'certificates.csv').as_posix()}`, "
            f"`{(data.results / 'table.csv').as_posix()}`.",
            "table-claims",
        ),
    ]
    return Section("claims", "What the paper claims, and what holds", blocks)


def gather(data: ReportData) -> Evidence:
    """The evidence of a study whose samples lie on grids."""
    study, chain = data.study, data.chain
    of_label = {cell.label: cell for cell in cells(study, data.results)}
    points = region_points(study, chain, _POINTS)
    angles = yaw_pitch_pitch(chain, points, study.robot.elbow)
    jacobians = np.abs(chain.jacobian_mm(angles))
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)
    normalised = jacobians * np.ptp(angles, axis=0) / sides[:, None]
    fall, fall_n = None, (0, 0)
    if len(data.grids) > 1:
        before, after = levelling_pair(data.grids)
        fall_n = before.n, after.n
        found = fall_interval(
            before.seed_errors(data.first_path), after.seed_errors(data.first_path)
        )
        fall = Ends(*found)
    published = paper_table()
    curves = {"the paper’s column": _paper_curve(published), "here": _our_curve(data)}
    known = {name: curve for name, curve in curves.items() if curve is not None}
    return Evidence(
        grids=[_grid(data, grid, of_label[grid.samples.label], points) for grid in data.grids],
        chosen=study.bounds.average_weight,
        names=AVERAGE_NAMES,
        row_sums_mm=jacobians.sum(axis=-1).max(axis=-1),
        row_sums_by_range=normalised.sum(axis=-1).max(axis=-1),
        scale_mm=scale_mm(study),
        fall=fall,
        fall_n=fall_n,
        paper_n=published["n_samples"].to_numpy(float),
        paper_error_mm=published["paper_error_mm"].to_numpy(float),
        paper_estimate_mm=published["paper_estimate_mm"].to_numpy(float),
        paper_scale_mm=_PAPER_SIDE_MM,
        floors_mm={name: Ends(*curve.floor_mm) for name, curve in known.items()},
        tails_mm={name: curve.scale_mm.value for name, curve in known.items()},
        misfits={name: _misfit(curve) for name, curve in known.items()},
    )


def _grid(data: ReportData, grid: Grid, cell: Cell, points: np.ndarray) -> GridEvidence:
    bounds = grid.bounds.set_index("seed")
    seeds = list(bounds.index)
    network = cell.network.select([cell.network.seeds.index(seed) for seed in seeds])
    samples = grid.samples
    slope = np.abs(input_jacobian(network, points)).max(axis=(1, 2, 3))
    at_samples = send(network, data.chain, samples.positions_mm).error_mm
    if data.study.training.held_out.source == "grid":
        at_samples = np.full_like(at_samples, np.nan)  # some of them were not trained on
    proofs = _proofs(data.proofs, cell, seeds)
    place = proofs[["argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]].dropna().to_numpy(float)
    sides = np.subtract(data.study.workspace.upper_mm, data.study.workspace.lower_mm)
    return GridEvidence(
        m=grid.m,
        n=grid.n,
        spacing_mm=samples.spacing_mm,
        fill_mm=samples.fill_distance_mm,
        error_mm=np.asarray(grid.seed_errors(data.first_path).loc[seeds], np.float64),
        estimate_mm={k: bounds[f"estimate_{k}_mm"].to_numpy(float) for k in AVERAGE_NAMES},
        average_weight={k: bounds[f"wbar_{k}"].to_numpy(float) for k in AVERAGE_NAMES},
        above={k: bounds[f"above_{k}"].to_numpy(float) for k in AVERAGE_NAMES},
        lemma_1_squared=bounds["lemma_1_above_squared"].to_numpy(float),
        lemma_1_mm=bounds["lemma_1_above_mm"].to_numpy(float),
        output_weight=np.abs(network.weights[-1]).max(axis=(1, 2)).astype(float),
        slope=slope,
        at_samples_mm=at_samples.max(axis=1),
        at_samples_mean_mm=at_samples.mean(axis=1),
        sup_mm=proofs["sup_upper_mm"].to_numpy(float),
        argmax=(place - data.study.workspace.lower_mm) / sides * (grid.m - 1),
    )


def _proofs(proofs: pd.DataFrame | None, cell: Cell, seeds: list[int]) -> pd.DataFrame:
    """The certificates of some networks; empty cells where there are none."""
    columns = ["sup_upper_mm", "argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]
    if proofs is None or "label" not in proofs:
        return pd.DataFrame(np.nan, index=seeds, columns=columns)
    own = proofs[(proofs["method"] == cell.method) & (proofs["label"] == cell.label)]
    return own.set_index("seed")[columns].reindex(seeds)


def _paper_curve(published: pd.DataFrame) -> Curve | None:
    return fit_published(
        "grid",
        published["n_samples"],
        published.index.to_numpy(float),
        published["paper_error_mm"],
        published["paper_error_sd_mm"],
        np.random.default_rng(_STREAM),
    )


def _our_curve(data: ReportData) -> Curve | None:
    errors = pd.concat(
        {grid.n: grid.seed_errors(data.first_path) for grid in data.grids}, axis=1
    ).dropna()
    if errors.empty:
        return None
    resampled = draws(len(errors), np.random.default_rng(_STREAM))
    m = [grid.m for grid in data.grids]
    return fit_seeds("grid", [grid.n for grid in data.grids], m, errors.to_numpy(float), resampled)


def _misfit(curve: Curve) -> float:
    fitted = curve.at(curve.n_samples, curve.points_per_axis)
    return float(np.max(np.abs(fitted / curve.observed_mm - 1)))


def _other(data: ReportData) -> str:
    if paper_recipe(data) and paper_task(data):
        return ""
    return " (another recipe or task than the paper’s)"
