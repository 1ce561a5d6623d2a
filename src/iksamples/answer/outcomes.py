"""What each training came to, in the one error that the study's tolerance is about."""

from typing import TYPE_CHECKING

import numpy as np

from iksamples.answer.collect import WORKSPACE
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
    "n_points",
    "error_mm",
    "certified",
    "attained_mm",
)
"""Columns of the outcomes; ``outcomes`` says what they hold."""


def outcomes(study: Study, runs: "pd.DataFrame") -> "pd.DataFrame":
    """One row for each training, with the error that the study's tolerance is about.

    For the worst case over the workspace that is the proved upper bound where there is one, and
    else the largest error measured, which is less than the true worst case. Everything else is
    measured. Where the tolerance has an angle, a degree counts as so many millimetres that both are
    allowed as much. A training that diverged has an infinite error: it failed.

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
    statistic = "max" if tolerance.of == "worst" else tolerance.of
    # What is measured, what of it is proved, and millimetres for each unit of it.
    parts = [(f"error_{statistic}_mm", "sup_lower_mm", "sup_upper_mm", 1.0)]
    mm_per_deg = _mm_per_deg(tolerance)
    if mm_per_deg is not None:
        parts.append((f"angle_{statistic}_deg", "angle_lower_deg", "angle_upper_deg", mm_per_deg))
    rows[["error_mm", "attained_mm"]] = -np.inf
    rows["certified"] = tolerance.certifiable
    for measured, lower, upper, mm in parts:
        seen = rows[measured].where(~rows["diverged"], np.inf).fillna(np.inf)
        proved = rows[upper].notna() & tolerance.certifiable
        attained = seen.clip(lower=rows[lower].fillna(0)).clip(upper=rows[upper].fillna(np.inf))
        rows["error_mm"] = np.fmax(rows["error_mm"], mm * rows[upper].where(proved, seen))
        rows["attained_mm"] = np.fmax(rows["attained_mm"], mm * attained.where(proved, seen))
        rows["certified"] &= proved
    return rows[list(COLUMNS)]


def errors_at_samples(study: Study, cell: Cell) -> "np.ndarray | None":
    """The error of each sound seed at the very samples it was trained on.

    Args:
        study: The study; its tolerance says which statistic over the samples.
        cell: A network on a set of samples.

    Returns:
        One error per seed [mm], an angle counted as in ``outcomes``; None where this cannot be
        said, since the tolerance is about a path or samples were held out.
    """
    from iksamples.evaluation.errors import send
    from iksamples.task import study_task

    tolerance = study.tolerance
    held_out = study.all_methods[cell.method].training.held_out.source == "grid"
    if tolerance.where != WORKSPACE or held_out:
        return None
    at = send(cell.network, study_task(study, cell.samples.region), cell.samples.x)
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
