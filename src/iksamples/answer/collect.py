"""One tidy table per study: what every training came to, what is proved, and how it is judged.

It is the only place where certificates are joined to errors and where what failed is marked.
"""

from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from iksamples.arm.chain import Floats
from iksamples.columns import ANGLES, ERRORS, RUNS, stored_table
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import send
from iksamples.evaluation.paths import count_waypoints
from iksamples.methods.predictor import in_parts
from iksamples.methods.registry import KINDS
from iksamples.network import StackedMLP
from iksamples.results import (
    CUBE,
    PROOFS,
    Cell,
    all_cells,
    certified,
    own_cells,
    proofs,
    require_own,
)
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study, Tolerance
from iksamples.task import Task, study_task


FILE = "runs.parquet"
WORKSPACE = "workspace"
"""The region that is the whole workspace; every other region is a path, by its name."""

_KEYS = ["method", "label", "seed"]
_RUN = ["method", "design", "n_samples", "seed", "region"]
_SUP = ["sup_lower_mm", "sup_upper_mm", "angle_lower_deg", "angle_upper_deg"]
_MEAN = ["mean_lower_mm", "mean_upper_mm"]
_AT_ONCE = 2**20
"""Samples of all networks whose errors are held at once."""
_DIVERGED = "the training diverged: its weights are not finite"
_NO_ANSWER = "at some points there is no finite answer"
_ROUNDING = 1e-4
"""Errors over the workspace are kept in single precision."""


class Variant(NamedTuple):
    """What is compared: a method, on samples placed by a design."""

    method: str
    design: str


def collect(study: Study, results: str | Path) -> pd.DataFrame:
    """Every training of a study, as one table.

    Args:
        study: The study.
        results: Its results folder, such as ``results/paper``.

    Returns:
        Columns ``columns.RUNS``, a row per method, design, set of samples, seed and region, in the
        study's order of methods and designs, fewest samples first. A method that is not made for
        some samples has no row there; one that failed on them has, with the reason.

    Raises:
        IksamplesError: The study is not finished, or a certificate contradicts what was measured.
    """
    sets: dict[str, SampleSet] = {}
    frames = []
    for cell in all_cells(study, results):
        if cell.label not in sets:
            sets[cell.label] = cell.samples
        frames.append(_measured(study, cell, sets[cell.label]))
    rows = pd.concat(frames, ignore_index=True)
    if rows.empty:
        raise IksamplesError(f"{study.name}: no method has results. Run the study to its end.")
    bounds = _bounds(certificates(study, results))
    rows = rows.merge(bounds, on=[*_KEYS, "region"], how="left")
    rows["verified"] = rows["verified"].eq(True) & rows["failed"].eq("")
    rows.loc[~rows["verified"], _SUP] = np.nan
    rows["unproved"] = rows["unproved"].fillna("")
    _require_agreement(rows)
    return rows[list(RUNS)]


def certificates(study: Study, results: str | Path) -> pd.DataFrame:
    """The certificates of all methods that can have some, a row per network.

    Raises:
        IksamplesError: A file is missing, has a network twice, or is of another run.
    """
    files = [Path(results) / name / PROOFS for name in certified(study)]
    frames = [proofs(study, file) for file in files]
    nothing = pd.DataFrame(columns=[*_KEYS, "verified", "failed"])
    return pd.concat(frames or [nothing], ignore_index=True)


def read_runs(study: Study, results: str | Path) -> pd.DataFrame:
    """What ``collect`` found, from the results folder of a finished study.

    Raises:
        IksamplesError: There is no such file, it is of another version or run, or a row is no run.
    """
    file = Path(results) / FILE
    table = stored_table(file, tuple(RUNS), _RUN)
    n_samples, share = table["n_samples"], table["region_share"]
    whole = (n_samples >= 0) & (n_samples < 2**53) & (n_samples % 1 == 0)
    sound = len(table) > 0 and whole.all() and ((share > 0) & (share <= 1)).all()
    if not sound:
        raise IksamplesError(f"{file}: not as it was written. Run the study again.")
    own = own_cells(study, file, set(zip(table["method"], table["label"], strict=True)))
    if own:
        regions = (WORKSPACE, *study.evaluation.paths)
        wanted = [(one.method, one.label, *at) for one in own for at in product(one.seeds, regions)]
        found = table[[*_KEYS, "region"]].itertuples(index=False, name=None)
        require_own(study, file, "a run of", found, wanted)
    return table


def variants(runs: pd.DataFrame) -> dict[Variant, pd.DataFrame]:
    """The rows of each method on each design, in their order."""
    groups = runs.groupby(["method", "design"], sort=False)
    return {Variant(str(method), str(design)): rows for (method, design), rows in groups}


def _measured(study: Study, cell: Cell, samples: SampleSet) -> pd.DataFrame:
    """A cell's measured errors: a row per seed and region, none if the method has no results."""
    errors = cell.table("errors", tuple(ERRORS)).reset_index(drop=True)
    finite = np.isfinite(errors[list(ERRORS)].to_numpy(float)).all(axis=1)
    failed = np.where(finite, "", _NO_ANSWER)
    if "failed" in errors:
        failed = np.where(errors["failed"].ne(""), errors["failed"], failed)
    learns = KINDS[study.all_methods[cell.method].kind].needs_samples
    n_samples = n_trained = samples.n_samples if learns else 0
    if cell.trained:
        members = cell.table("members", ("n_trained", "diverged")).set_index("seed")
        n_trained = int(members["n_trained"].iloc[0])
        failed = np.where(errors["seed"].map(members["diverged"]), _DIVERGED, failed)
    rows = pd.DataFrame(
        {
            "method": cell.method,
            "design": samples.design,
            "label": cell.label,
            "n_samples": n_samples,
            "n_trained": n_trained,
            "spacing_mm": samples.spacing_mm,
            "fill_distance_mm": samples.fill_distance_mm,
            "seed": errors["seed"].astype("int64"),
            "failed": failed,
            "region": errors["region"].replace({CUBE: WORKSPACE}).astype(str),
            "region_share": samples.region_share,
            "n_points": [_points_measured(study, where) for where in errors["region"]],
        }
    )
    return rows.join(errors.reindex(columns=[*ERRORS, *ANGLES, "confident_mm"]).astype(float))


def _points_measured(study: Study, where: str) -> int:
    if where == CUBE:
        return study.evaluation.cube_points + 2 ** len(study.task.inputs)
    return count_waypoints(study.evaluation.paths[where])


def _bounds(certificates: pd.DataFrame) -> pd.DataFrame:
    """The certificates' columns, ready to be joined to the rows of the workspace."""
    # There are no angles where the tool's orientation is not asked for.
    table = certificates.reindex(columns=[*_KEYS, *_SUP, *_MEAN, "verified", "failed"])
    table = table.rename(columns={"failed": "unproved"}).assign(region=WORKSPACE)
    # A file without any certificate has no types.
    return table.astype(dict.fromkeys([*_SUP, *_MEAN], "float64")).astype(
        {"verified": "bool", "seed": "int64", "unproved": "str"}
    )


def _require_agreement(rows: pd.DataFrame) -> None:
    """No error was measured above its bound."""
    for measured, bound in (("error_max_mm", "sup_upper_mm"), ("angle_max_deg", "angle_upper_deg")):
        broken = rows[rows[measured] > rows[bound] * (1 + _ROUNDING)]
        if len(broken):
            first, unit = broken.iloc[0], bound.rpartition("_")[2]
            raise IksamplesError(
                f"{first['method']} on {first['label']}, seed {first['seed']}: measured "
                f"{first[measured]:.4g} {unit}, above its certified bound {first[bound]:.4g} "
                f"{unit}. The certificates are not of these networks; delete "
                f"{first['method']}/certificates.csv and run again."
            )


COLUMNS = (
    "method",
    "design",
    "label",
    "n_samples",
    "seed",
    "region_share",
    "n_points",
    "error_mm",
    "certified",
    "attained_mm",
    "confident_mm",
    "failed",
)
"""Columns of the outcomes; ``outcomes`` says what they hold."""


def outcomes(study: Study, runs: pd.DataFrame) -> pd.DataFrame:
    """One row for each training, with the error that the study's tolerance is about.

    For the worst case over the workspace that is the proved upper bound where there is one, and
    else the largest error measured, which is less than the true worst case. Everything else is
    measured. Where the tolerance has an angle, a degree counts as so many millimetres that both are
    allowed as much. What failed has an infinite error.

    Args:
        study: The study; its ``tolerance`` says which error.
        runs: What ``collect`` found.

    Returns:
        Columns ``COLUMNS``, in the order of ``runs``. ``error_mm`` is what is held against the
        tolerance, ``certified`` whether it is a proved upper bound, and ``attained_mm`` an error
        that is known to occur: the largest of what was measured and the proof's lower bound.
        ``confident_mm`` and ``failed`` are as in ``runs``.

    Raises:
        IksamplesError: The runs are another study's.
    """
    tolerance = study.tolerance
    strange = set(runs["method"]) - set(study.all_methods)
    rows = runs[runs["region"] == tolerance.where].reset_index(drop=True)
    if strange or rows.empty:
        what = f"a method '{min(strange)}'" if strange else f"no errors for {tolerance.where}"
        raise IksamplesError(f"{FILE} has {what}: not a run of {study.name}. Run the study again.")
    statistic = "max" if tolerance.of == "worst" else tolerance.of
    # What is measured, what of it is proved, and millimetres for each unit of it.
    parts = [(f"error_{statistic}_mm", "sup_lower_mm", "sup_upper_mm", 1.0)]
    mm_per_deg = _mm_per_deg(tolerance)
    if mm_per_deg is not None:
        parts.append((f"angle_{statistic}_deg", "angle_lower_deg", "angle_upper_deg", mm_per_deg))
    rows[["error_mm", "attained_mm"]] = -np.inf
    rows["certified"] = tolerance.certifiable
    for measured, lower, upper, mm in parts:
        seen = rows[measured].where(rows["failed"].eq(""), np.inf).fillna(np.inf)
        proved = rows[upper].notna() & tolerance.certifiable
        attained = seen.clip(lower=rows[lower].fillna(0)).clip(upper=rows[upper].fillna(np.inf))
        rows["error_mm"] = np.fmax(rows["error_mm"], mm * rows[upper].where(proved, seen))
        rows["attained_mm"] = np.fmax(rows["attained_mm"], mm * attained.where(proved, seen))
        rows["certified"] &= proved
    return rows[list(COLUMNS)]


def errors_at_samples(study: Study, cell: Cell) -> Floats | None:
    """The error of each sound seed at the very samples it was trained on.

    Args:
        study: The study; its tolerance says which statistic over the samples.
        cell: A network on a set of samples.

    Returns:
        One error per seed [mm], an angle counted as in ``outcomes``; None where this cannot be
        said, since the tolerance is about a path or samples were held out.
    """
    tolerance = study.tolerance
    held_out = study.all_methods[cell.method].training.held_out.source == "grid"
    if tolerance.where != WORKSPACE or held_out:
        return None
    task, x = study_task(study, cell.samples.region), cell.samples.x
    parts = in_parts(cell.network, len(x), _AT_ONCE)
    return np.concatenate([_errors_of(part, task, x, tolerance) for part in parts])


def _errors_of(network: StackedMLP, task: Task, x: Floats, tolerance: Tolerance) -> Floats:
    at = send(network, task, x)
    sound = np.isfinite(at.error_mm).all(axis=1)
    worst = np.full(sound.sum(), -np.inf)
    for measured, mm in ((at.error_mm, 1.0), (at.angle_deg, _mm_per_deg(tolerance))):
        if mm is None or measured is None:
            continue
        errors = measured[sound]
        if tolerance.of == "mean":
            found = errors.mean(axis=1)
        else:
            share = {"worst": 1.0, "p99": 0.99, "p95": 0.95}[tolerance.of]
            found = np.quantile(errors, share, axis=1)
        worst = np.maximum(worst, mm * found)
    return worst


def _mm_per_deg(tolerance: Tolerance) -> float | None:
    """Both measures are met where the larger, each as a share of what is allowed, is at most one.

    Returns:
        Millimetres that a degree counts as; None where the angle is not judged.
    """
    return tolerance.error_mm / tolerance.angle_deg if tolerance.angle_deg else None
