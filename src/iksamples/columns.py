"""Every column of the tables that leave the package, its unit and meaning, and reading them."""

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from iksamples.errors import IksamplesError, in_a_line
from iksamples.files import checked


if TYPE_CHECKING:
    import pandas as pd


UNITS = {
    "mm": {"mm": 1.0, "cm": 10.0, "m": 1000.0},
    "rad": {"rad": 1.0, "deg": pi / 180, "degrees": pi / 180, "°": pi / 180},
    "": {"": 1.0},
}
"""Unit here -> units that a name may say, and what a value in it is multiplied by."""


class Column(NamedTuple):
    """A column's unit ("-" for none) and meaning."""

    unit: str
    meaning: str


_OVER_SEEDS = {
    "error_mean_mm": Column("mm", "mean position error, mean over seeds"),
    "error_sd_mm": Column("mm", "standard deviation over seeds of a seed's mean position error"),
    "error_p95_mm": Column("mm", "95th percentile of the position error, mean over seeds"),
    "error_max_mm": Column("mm", "largest position error of any seed"),
    "error_over_spacing": Column("-", "mean position error divided by the grid's spacing"),
}

TABLE: dict[str, Column] = {
    "samples_per_axis": Column("-", "m, grid points along each axis"),
    "n_samples": Column("-", "samples recorded"),
    "n_trained": Column("-", "samples that really trained (held-out points taken off)"),
    "spacing_mm": Column("mm", "d, distance between neighbours of the grid"),
    "fill_distance_mm": Column("mm", "largest distance from a point to its nearest sample"),
    "n_seeds": Column("-", "networks trained"),
    "n_diverged": Column("-", "networks whose weights are not finite; left out of the statistics"),
    **_OVER_SEEDS,
    "estimate_mm": Column("mm", "the paper's Eq. 25 with this study's weights, mean over seeds"),
    "wbar": Column("-", "average weight in that estimate, mean over seeds"),
    "above_estimate": Column("-", "share of the workspace where the error exceeds the estimate"),
    "sup_median_mm": Column("mm", "certified worst case over the workspace, median of the seeds"),
    "sup_worst_mm": Column("mm", "certified worst case over the workspace, worst seed"),
    "paper_error_mm": Column("mm", "mean error in the paper's Table 1"),
    "paper_error_sd_mm": Column("mm", "its ± in the paper's Table 1"),
    "paper_estimate_mm": Column("mm", "estimate in the paper's Table 1"),
    "paper_error_over_spacing": Column("-", "e/d in the paper's Table 1"),
    "reading_error_mm": Column(
        "mm", "mean error of the reading of the paper that comes nearest to its Table 1"
    ),
    "reading_error_sd_mm": Column("mm", "its standard deviation over seeds"),
    "wbar_for_paper": Column("-", "average weight that Eq. 25 needs to give the paper's estimate"),
    **{f"cube_{name}": column for name, column in _OVER_SEEDS.items()},
}
"""``table.csv``: errors on the study's first path; over the whole workspace with prefix cube_."""

CERTIFICATES: dict[str, Column] = {
    "method": Column("-", "name of the method"),
    "label": Column("-", "name of the set of samples"),
    "samples_per_axis": Column("-", "m of the design"),
    "n_samples": Column("-", "samples recorded"),
    "seed": Column("-", "seed of the network"),
    "region_share": Column("-", "share of the workspace that can be used, which all else is over"),
    "sup_lower_mm": Column("mm", "an error that is taken at the position argmax"),
    "sup_upper_mm": Column("mm", "no position of the workspace has a larger error"),
    "angle_lower_deg": Column("deg", "an angle that the tool is off by somewhere; where asked for"),
    "angle_upper_deg": Column("deg", "nowhere is the tool off by a larger angle; where asked for"),
    "argmax_<input>": Column("mm or rad", "the input with the largest known error, as argmax_x_mm"),
    "mean_lower_mm": Column("mm", "the mean error over the workspace is at least this"),
    "mean_upper_mm": Column("mm", "the mean error over the workspace is at most this"),
    "boxes": Column("-", "boxes bounded in the search"),
    "seconds": Column("s", "time of the search"),
    "complete": Column("-", "whether the worst case's bounds met as closely as asked"),
    "verified": Column("-", "whether the separate, outward-rounded checker proved it again"),
    "failed": Column("-", "why nothing is proved; empty: it is"),
}
"""``certificates.csv``: one row per network."""


def certificate_columns(inputs: Sequence[str], turns: bool = False) -> list[str]:
    """Columns of ``certificates.csv`` for a task with some inputs, such as ``x_mm``.

    Args:
        inputs: The inputs' columns.
        turns: Whether the tool's orientation is asked for as well.
    """
    argmax = [f"argmax_{name}" for name in inputs]
    return [
        column
        for name in CERTIFICATES
        if turns or not name.startswith("angle_")
        for column in (argmax if name == "argmax_<input>" else [name])
    ]


ERRORS: dict[str, Column] = {
    "error_mean_mm": Column("mm", "mean position error"),
    "error_p95_mm": Column("mm", "95th percentile of the position error"),
    "error_p99_mm": Column("mm", "99th percentile of the position error"),
    "error_max_mm": Column("mm", "largest position error measured"),
}
"""Statistics of one training's errors over a region."""

ANGLES: dict[str, Column] = {
    "angle_mean_deg": Column("deg", "mean angle to how the tool is to be turned"),
    "angle_p95_deg": Column("deg", "95th percentile of that angle"),
    "angle_p99_deg": Column("deg", "99th percentile of that angle"),
    "angle_max_deg": Column("deg", "largest such angle measured"),
}
"""The same of the tool's orientation; empty where that is free."""

RUNS: dict[str, Column] = {
    "method": Column("-", "name of the method"),
    "design": Column("-", "how the samples are placed; method and design make a variant"),
    "label": Column("-", "name of the set of samples"),
    "n_samples": Column("-", "samples recorded"),
    "n_trained": Column("-", "samples that really trained (held-out points taken off)"),
    "spacing_mm": Column("mm", "distance between neighbours of an even grid; empty for others"),
    "fill_distance_mm": Column("mm", "largest distance from a point to its nearest sample"),
    "seed": Column("-", "seed of the network; 0 for a method that leaves nothing to chance"),
    "failed": Column("-", "why there is no result, which meets no tolerance; empty: there is one"),
    "region": Column("-", "`workspace`, or the name of a path"),
    "region_share": Column("-", "share of the workspace that can be used, which all else is over"),
    "n_points": Column("-", "points at which errors are measured"),
    **ERRORS,
    **ANGLES,
    "confident_mm": Column("mm", "worst error not exceeded with 95 % confidence, by samples alone"),
    "sup_lower_mm": Column("mm", "proved: an error that is taken in the workspace"),
    "sup_upper_mm": Column("mm", "proved: no position of the workspace has a larger error"),
    "angle_lower_deg": Column("deg", "proved: an angle that the tool is off by somewhere"),
    "angle_upper_deg": Column("deg", "proved: nowhere is the tool off by a larger angle"),
    "verified": Column("-", "whether the separate checker proved that; empty bounds where not"),
    "mean_lower_mm": Column("mm", "the mean error over the workspace is at least this"),
    "mean_upper_mm": Column("mm", "the mean error over the workspace is at most this"),
    "unproved": Column("-", "why a proof failed; empty: it did not, or none was tried"),
}
"""``runs.parquet``: one row per variant, set of samples, seed and region."""

TEXTS = {
    *("claim", "design", "evidence", "failed", "label", "method", "path", "region", "slice"),
    *("status", "unproved", "verdict", "where"),
}
TRUTHS = {"certified", "complete", "diverged", "pen_up", "verified"}
COUNTS = {"epoch", "n_points", "n_trained", "point", "seed", "waypoint"}
"""Columns of tables of results that hold words, true or false, and whole numbers; others: numbers.
"""


def stored_table(
    path: str | Path, needed: Sequence[str] = (), key: Sequence[str] = (), **how: Any
) -> "pd.DataFrame":
    """A table of results: CSV where its name says so, else Parquet.

    Args:
        path: The file.
        needed: Columns that have to be there.
        key: Columns of which no two rows have the same.
        **how: What else its reader needs to know. With ``dtype`` its columns are as that says, else
            as ``TEXTS``, ``TRUTHS`` and ``COUNTS`` say.

    Raises:
        IksamplesError: There is none, or it is damaged, no such table, or of another version.
    """
    import pandas as pd
    from pyarrow import parquet

    path = checked(path)
    try:
        if path.suffix == ".csv":
            # Nothing is a missing number, but a word as any: and so is NA.
            kinds: dict[str, Any] = {"dtype": dict.fromkeys(TEXTS, str)} | how
            csv = pd.read_csv(path, keep_default_na=False, na_values=[""], **kinds)
            table: pd.DataFrame = csv.fillna({name: "" for name in TEXTS & {*csv.columns}})
        else:
            whole = parquet.read_table(path, **how)
            whole.validate(full=True)  # words that are no UTF-8, which would end a later step
            table = whole.to_pandas()
    except FileNotFoundError:
        raise IksamplesError(
            f"{path}: there is no such file. Either the name is wrong, or the study is not "
            "finished: run it to its end first."
        ) from None
    # pandas and pyarrow each raise kinds of their own for what is not whole.
    except Exception as error:
        raise IksamplesError(
            f"{path}: cannot be read ({in_a_line(error)}). Run the study again."
        ) from None
    missing = [name for name in (*needed, *key) if name not in table.columns]
    if missing:
        raise IksamplesError(
            f"{path}: no column {', '.join(missing)}; it is from another version. Run the study "
            "again."
        )
    strange = [] if "dtype" in how or table.empty else _strange_columns(table)
    if strange or (key and table.duplicated(list(key)).any()):
        where = f"column {strange[0]}" if strange else f"two rows of one {', '.join(key)}"
        raise IksamplesError(f"{path}: not as it was written ({where}). Run the study again.")
    return table


def _strange_columns(table: "pd.DataFrame") -> list[str]:
    """Names of the columns that do not hold what their names say, or that stand there twice."""
    from pandas.api import types

    strange = list(table.columns[table.columns.duplicated()])
    if strange:
        return strange
    for name, column in table.items():
        if name in TEXTS:
            sound = types.is_string_dtype(column) and not column.isna().any()
        elif name in TRUTHS:
            sound = types.is_bool_dtype(column)
        else:
            sound = types.is_numeric_dtype(column) and column.dtype != "float16"
            sound = sound and (name not in COUNTS or bool((column % 1 == 0).all()))
        if not sound:
            strange.append(str(name))
    return strange
