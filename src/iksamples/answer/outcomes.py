"""What each seed of each method came to, in the one error that the study's tolerance is about."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import CUBE
from iksamples.results import Cell, cells
from iksamples.study import Study, Tolerance


if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    "method",
    "design",
    "label",
    "n_samples",
    "points_per_axis",
    "seed",
    "error_mm",
    "certified",
    "verified",
    "attained_mm",
)
"""Columns of the outcomes; ``outcomes`` says what they hold."""

_KEYS = ["method", "samples_per_axis", "n_samples", "seed"]
_PROOF = ["sup_lower_mm", "sup_upper_mm", "verified"]
_VERIFIED = "verified_proof"
_ROUNDING = 1e-4
"""Errors over the workspace are kept in single precision."""


class Line(NamedTuple):
    """A line of the comparison: a method, on samples placed by a design."""

    method: str
    design: str


def all_cells(study: Study, results: str | Path) -> Iterator[Cell]:
    """Every method of a study on every set of samples."""
    for method in study.all_methods:
        for design in study.samples.designs:
            yield from cells(study, results, method, design)


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
    the certificate's upper bound where there is one, and else the largest error measured, which is
    less than the true worst case. Everything else is measured. A seed that diverged has an infinite
    error: it counts as a training that failed.

    Args:
        study: The study; its ``tolerance`` says which error.
        cells: Methods on sets of samples. A cell of a method that is no network may have no errors
            (the method could not use those samples); it is left out.
        proofs: What ``certificates`` returned.

    Returns:
        Columns ``COLUMNS``, sorted by method and design (in the study's order), samples and seed.
        ``error_mm`` is what is held against the tolerance, ``certified`` whether it is a proved
        upper bound, ``verified`` whether the independent checker has been through that proof, and
        ``attained_mm`` an error that is known to occur: the certificate's lower bound, or what was
        measured.

    Raises:
        IksamplesError: Errors are missing, or a certificate contradicts what was measured.
    """
    import pandas as pd

    measured = [_measured(study, cell) for cell in cells]
    frames = [frame for frame in measured if frame is not None]
    if not frames:
        raise IksamplesError(f"{study.name}: no method has results. Run the study to its end.")
    rows = pd.concat(frames, ignore_index=True)
    rows["certified"] = rows["verified"] = False
    rows["attained_mm"] = rows["error_mm"]
    if proofs is not None and is_certifiable(study.tolerance):
        rows = _with_proofs(rows, proofs)
    names, designs = list(study.all_methods), list(study.samples.designs)
    order = {"method": names.index, "design": designs.index}
    rows = rows.sort_values(
        ["method", "design", "n_samples", "seed"],
        key=lambda column: column.map(order[column.name]) if column.name in order else column,
    )
    return rows.reset_index(drop=True)[list(COLUMNS)]


def lines(rows: "pd.DataFrame") -> "list[tuple[Line, pd.DataFrame]]":
    """The outcomes of each method on each design, in their order."""
    found = []
    for method, design in dict.fromkeys(zip(rows["method"], rows["design"], strict=True)):
        of_line = rows[(rows["method"] == method) & (rows["design"] == design)]
        found.append((Line(method, design), of_line))
    return found


def by_rung(of_line: "pd.DataFrame") -> "list[tuple[int, pd.DataFrame]]":
    """The outcomes of one line for each number of samples, fewest first.

    Raises:
        IksamplesError: Two sets of its samples have the same number of samples.
    """
    groups = []
    for n in sorted(of_line["n_samples"].unique()):
        group = of_line[of_line["n_samples"] == n]
        if group["label"].nunique() > 1:
            labels = " and ".join(group["label"].unique())
            raise IksamplesError(f"{labels} have {n} samples both; leave one of them out.")
        groups.append((int(n), group))
    return groups


def errors_matrix(of_line: "pd.DataFrame") -> "pd.DataFrame":
    """Errors of one line [mm], a row per seed and a column per number of samples.

    Only the seeds that every number of samples has, so that a row is the same seed all along.
    """
    return of_line.pivot(index="seed", columns="n_samples", values="error_mm").dropna()


def errors_at_samples(study: Study, cell: Cell) -> "np.ndarray | None":
    """The error of each sound seed at the very samples it was trained on.

    Args:
        study: The study; its tolerance says which statistic over the samples.
        cell: A network on a set of samples.

    Returns:
        One error per seed [mm]; None where this cannot be said, since the tolerance is about a path
        or samples were held out.
    """
    from iksamples.arm.workspace import study_chain
    from iksamples.evaluation.errors import send

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
            "design": cell.samples.design,
            "label": cell.label,
            "n_samples": cell.samples.n_samples,
            "points_per_axis": cell.samples.points_per_axis,
            "seed": seeds,
            "error_mm": np.where(failed, np.inf, error),
        }
    )


def _with_proofs(rows: "pd.DataFrame", proofs: "pd.DataFrame") -> "pd.DataFrame":
    """Puts the certified upper bound in the place of what was measured."""
    keys = ["method", "label", "seed"]
    if "label" not in proofs.columns:
        if rows["design"].nunique() > 1:
            raise IksamplesError(
                "certificates.csv: no column label, which a study of several designs needs. Delete "
                "the file and run the study again."
            )
        keys = ["method", "points_per_axis", "n_samples", "seed"]
    on = proofs.rename(columns={"samples_per_axis": "points_per_axis", "verified": _VERIFIED})
    on = on[[*keys, "sup_lower_mm", "sup_upper_mm", _VERIFIED]]
    if on.duplicated(keys).any():
        raise IksamplesError(
            "certificates.csv: a network is in it twice. Delete the file and run the study again."
        )
    rows = rows.merge(on, on=keys, how="left")
    upper, lower = rows["sup_upper_mm"].to_numpy(float), rows["sup_lower_mm"].to_numpy(float)
    measured = rows["error_mm"].to_numpy(float)
    proved = np.isfinite(upper) & np.isfinite(measured)
    broken = rows[proved & (measured > upper * (1 + _ROUNDING))]
    if len(broken):
        first = broken.iloc[0]
        raise IksamplesError(
            f"{first['method']} on {first['label']}, seed {first['seed']}: measured "
            f"{first['error_mm']:.4g} mm, above its certified bound {first['sup_upper_mm']:.4g} mm."
            " The certificates are not of these networks; delete certificates.csv and run again."
        )
    rows["certified"] = proved
    rows["verified"] = proved & _is_true(rows[_VERIFIED])
    # The better of two errors that are known to occur.
    attained = np.fmin(np.fmax(measured, lower), upper)
    rows["attained_mm"] = np.where(proved, attained, measured)
    rows["error_mm"] = np.where(proved, upper, measured)
    return rows


def _is_true(column: "pd.Series") -> "np.ndarray":
    """Truth of a column that was text, numbers or truth values in a CSV, with gaps."""
    return column.astype(str).str.lower().isin(["true", "1", "1.0"]).to_numpy(bool)
