"""What each seed of each method came to, in the one error that the study's tolerance is about."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import CUBE
from iksamples.results import Cell, cells
from iksamples.study import Study, Tolerance


if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    "method",
    "label",
    "n_samples",
    "points_per_axis",
    "seed",
    "error_mm",
    "certified",
    "attained_mm",
)
"""Columns of the outcomes; ``outcomes`` says what they hold."""

_KEYS = ["method", "samples_per_axis", "n_samples", "seed"]
_PROOF = ["sup_lower_mm", "sup_upper_mm", "verified"]
_ROUNDING = 1e-4
"""Errors over the workspace are kept in single precision."""


def all_cells(study: Study, results: str | Path) -> Iterator[Cell]:
    """Every method of a study on every set of samples."""
    for method in study.all_methods:
        yield from cells(study, results, method)


def certificates(results: str | Path) -> "pd.DataFrame | None":
    """A study's certified worst cases, or None where it has none."""
    import pandas as pd

    path = Path(results) / "certificates.csv"
    if not path.exists():
        return None
    table = pd.read_csv(path)
    missing = [name for name in (*_KEYS, *_PROOF) if name not in table.columns]
    if missing:
        raise IksamplesError(
            f"{path}: no column {', '.join(missing)}. Delete the file and run the study again."
        )
    return table


def is_certifiable(tolerance: Tolerance) -> bool:
    """Whether the tolerance is about the worst case over the workspace, which can be proved."""
    return tolerance.of == "worst" and tolerance.where == "workspace"


def measured_column(tolerance: Tolerance) -> str:
    """Column of ``errors.parquet`` that measures what the tolerance is about."""
    return f"error_{'max' if tolerance.of == 'worst' else tolerance.of}_mm"


def outcomes(
    study: Study, cells: Iterable[Cell], proofs: "pd.DataFrame | None" = None
) -> "pd.DataFrame":
    """One row for each seed of each method on each set of samples.

    The error is the one the study's tolerance is about. For the worst case over the workspace it is
    the certificate's upper bound where there is one that the independent checker has verified, and
    else the largest error measured, which is less than the true worst case. Everything else is
    measured. A seed that diverged has an infinite error: it counts as a training that failed.

    Args:
        study: The study; its ``tolerance`` says which error.
        cells: Methods on sets of samples. A cell of a method that is no network may have no errors
            (the method could not use those samples); it is left out.
        proofs: What ``certificates`` returned.

    Returns:
        Columns ``COLUMNS``, sorted by method (in the study's order), samples and seed. ``error_mm``
        is what is held against the tolerance, ``certified`` whether it is a proved upper bound, and
        ``attained_mm`` an error that is known to occur: the certificate's lower bound, or what was
        measured.

    Raises:
        IksamplesError: Errors are missing, or a certificate contradicts what was measured.
    """
    import pandas as pd

    frames = [_measured(study, cell) for cell in cells]
    rows = pd.concat([frame for frame in frames if frame is not None], ignore_index=True)
    rows["certified"] = False
    rows["attained_mm"] = rows["error_mm"]
    if proofs is not None and is_certifiable(study.tolerance):
        rows = _with_proofs(rows, proofs)
    order = {name: i for i, name in enumerate(study.all_methods)}
    rows["_order"] = rows["method"].map(order)
    rows = rows.sort_values(["_order", "n_samples", "seed"], kind="stable")
    return rows.reset_index(drop=True)[list(COLUMNS)]


def by_rung(rows: "pd.DataFrame", method: str) -> "list[tuple[int, pd.DataFrame]]":
    """A method's outcomes for each number of samples, fewest first.

    Raises:
        IksamplesError: Two sets of samples of the method have the same number of samples.
    """
    of_method = rows[rows["method"] == method]
    groups = []
    for n in sorted(of_method["n_samples"].unique()):
        group = of_method[of_method["n_samples"] == n]
        if group["label"].nunique() > 1:
            labels = " and ".join(group["label"].unique())
            raise IksamplesError(
                f"{method}: {labels} have {n} samples both; hand over one design at a time."
            )
        groups.append((int(n), group))
    return groups


def errors_matrix(rows: "pd.DataFrame", method: str) -> "pd.DataFrame":
    """A method's errors [mm], a row per seed and a column per number of samples.

    Only the seeds that every number of samples has, so that a row is the same seed all along.
    """
    of_method = rows[rows["method"] == method]
    matrix = of_method.pivot(index="seed", columns="n_samples", values="error_mm")
    return matrix.dropna()


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
    from iksamples.robot.workspace import study_chain

    tolerance = study.tolerance
    held_out = study.all_methods[cell.method].training.held_out.source == "grid"
    if tolerance.where != "workspace" or held_out:
        return None
    error = send(cell.network, study_chain(study), cell.samples.positions_mm).error_mm
    error = error[np.isfinite(error).all(axis=1)]
    if tolerance.of == "mean":
        return error.mean(axis=1)
    share = {"worst": 1.0, "p99": 0.99, "p95": 0.95}[tolerance.of]
    return np.quantile(error, share, axis=1)


def _measured(study: Study, cell: Cell) -> "pd.DataFrame | None":
    """A cell's measured errors."""
    import pandas as pd

    file = cell.folder / "errors.parquet"
    is_network = study.all_methods[cell.method].kind == "network"
    if not file.exists():
        if not is_network:
            return None
        raise IksamplesError(f"{file} is missing: the study is not finished. Run it to its end.")
    errors, column = cell.table("errors"), measured_column(study.tolerance)
    if column not in errors.columns:
        raise IksamplesError(
            f"{file}: no column {column}; it is from an earlier version. Run the study again."
        )
    where = study.tolerance.where
    region = CUBE if where == "workspace" else where
    errors = errors[errors["region"] == region]
    error = errors[column].to_numpy(float)
    seeds = errors["seed"].fillna(0).to_numpy(int)
    failed = ~np.isfinite(error)
    if is_network:
        members = cell.table("members")
        failed |= np.isin(seeds, members.loc[members["diverged"].astype(bool), "seed"])
    return pd.DataFrame(
        {
            "method": cell.method,
            "label": cell.label,
            "n_samples": cell.samples.n_samples,
            "points_per_axis": cell.samples.points_per_axis,
            "seed": seeds,
            "error_mm": np.where(failed, np.inf, error),
        }
    )


def _with_proofs(rows: "pd.DataFrame", proofs: "pd.DataFrame") -> "pd.DataFrame":
    """Puts the certified upper bound in the place of what was measured."""
    on = proofs.rename(columns={"samples_per_axis": "points_per_axis"})
    keys = ["method", "points_per_axis", "n_samples", "seed"]
    rows = rows.merge(on[[*keys, *_PROOF]], on=keys, how="left", validate="one_to_one")
    upper = rows["sup_upper_mm"].to_numpy(float)
    measured = rows["error_mm"].to_numpy(float)
    proved = (rows["verified"] == True) & np.isfinite(upper) & np.isfinite(measured)  # noqa: E712
    broken = rows[proved & (measured > upper * (1 + _ROUNDING))]
    if len(broken):
        first = broken.iloc[0]
        raise IksamplesError(
            f"{first['method']} on {first['label']}, seed {first['seed']}: measured "
            f"{first['error_mm']:.4g} mm, above its certified bound {first['sup_upper_mm']:.4g} mm."
            " The certificates are not of these networks; delete certificates.csv and run again."
        )
    rows["certified"] = proved.to_numpy(bool)
    # The better of two errors that are known to occur.
    attained = np.fmax(measured, rows["sup_lower_mm"].to_numpy(float))
    rows["attained_mm"] = np.where(proved, np.minimum(attained, upper), measured)
    rows["error_mm"] = np.where(proved, upper, measured)
    return rows
