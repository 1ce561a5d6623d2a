"""What each training came to, in the one error that the study's tolerance is about."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.answer.collect import WORKSPACE
from iksamples.files import checked
from iksamples.results import Cell
from iksamples.study import Study, Tolerance


if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    "method",
    "design",
    "label",
    "n_samples",
    "seed",
    "region_share",
    "error_mm",
    "certified",
    "attained_mm",
)
"""Columns of the outcomes; ``outcomes`` says what they hold."""


def certificates(results: str | Path) -> "pd.DataFrame | None":
    """What the report and the tracking read of certificates; None where there are none."""
    import pandas as pd

    path = Path(results) / "certificates.csv"
    return pd.read_csv(checked(path)) if path.exists() else None


def is_certifiable(tolerance: Tolerance) -> bool:
    """Whether the tolerance is about the worst case over the workspace, which can be proved."""
    return tolerance.of == "worst" and tolerance.where == WORKSPACE


def measured_column(tolerance: Tolerance) -> str:
    """Column of ``errors.parquet`` that measures what the tolerance is about."""
    return f"error_{'max' if tolerance.of == 'worst' else tolerance.of}_mm"


def outcomes(study: Study, runs: "pd.DataFrame") -> "pd.DataFrame":
    """One row for each training, with the error that the study's tolerance is about.

    For the worst case over the workspace that is the proved upper bound where there is one, and
    else the largest error measured, which is less than the true worst case. Everything else is
    measured, angles too; where the tolerance has one, a degree counts as so many millimetres that
    both are allowed as much. A training that diverged has an infinite error: it failed.

    Args:
        study: The study; its ``tolerance`` says which error.
        runs: What ``collect`` found.

    Returns:
        Columns ``COLUMNS``, in the order of ``runs``. ``error_mm`` is what is held against the
        tolerance, ``certified`` whether it is a proved upper bound, and ``attained_mm`` an error
        that is known to occur: the largest of what was measured and the proof's lower bound.
    """
    tolerance = study.tolerance
    rows = runs[runs["region"] == tolerance.where].reset_index(drop=True)
    measured = rows[measured_column(tolerance)].where(~rows["diverged"], np.inf)
    rows["error_mm"] = rows["attained_mm"] = measured
    rows["certified"] = is_certifiable(tolerance) & rows["verified"] & (not tolerance.angle_deg)
    if is_certifiable(tolerance):
        rows["error_mm"] = rows["sup_upper_mm"].fillna(measured)
        rows["attained_mm"] = np.fmin(np.fmax(measured, rows["sup_lower_mm"]), rows["sup_upper_mm"])
    if tolerance.angle_deg:
        # Both are met where the larger of the two, each over what is allowed of it, is at most one.
        column = measured_column(tolerance).replace("error", "angle").replace("_mm", "_deg")
        turned = rows[column] * (tolerance.error_mm / tolerance.angle_deg)
        turned = turned.where(~rows["diverged"], np.inf)
        rows["error_mm"] = np.fmax(rows["error_mm"], turned)
        rows["attained_mm"] = np.fmax(rows["attained_mm"], turned)
    return rows[list(COLUMNS)]


def errors_at_samples(study: Study, cell: Cell) -> "np.ndarray | None":
    """The error of each sound seed at the very samples it was trained on.

    Args:
        study: The study; its tolerance says which statistic over the samples.
        cell: A network on a set of samples.

    Returns:
        One error per seed [mm]; None where this cannot be said, since the tolerance is about a path
        or samples were held out.
    """
    from iksamples.evaluation.errors import send
    from iksamples.task import study_task

    tolerance = study.tolerance
    held_out = study.all_methods[cell.method].training.held_out.source == "grid"
    if tolerance.where != WORKSPACE or held_out:
        return None
    error = send(cell.network, study_task(study, cell.samples.region), cell.samples.x).error_mm
    error = error[np.isfinite(error).all(axis=1)]
    if tolerance.of == "mean":
        return error.mean(axis=1)
    share = {"worst": 1.0, "p99": 0.99, "p95": 0.95}[tolerance.of]
    return np.quantile(error, share, axis=1)
