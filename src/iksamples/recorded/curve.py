"""A learning curve from anybody: a table of (n, seed, error), sized as our own runs are."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iksamples.answer.collect import WORKSPACE
from iksamples.columns import ERRORS, RUNS, UNITS
from iksamples.errors import IksamplesError
from iksamples.samples.measured import Place, read_columns, with_units
from iksamples.samples.table import read_table
from iksamples.study import NETWORK, RECORDED


if TYPE_CHECKING:
    import pandas as pd

_N = ("n", "n_samples", "samples", "n_train", "size")
_SEED = ("seed", "run", "trial", "repeat")
FAILED = "there is no finite error"
"""Why a training has no result of which only its error is known."""


def runs_table(records: Iterable[dict[str, Any]]) -> "pd.DataFrame":
    """Records as the table that ``answer.collect`` makes of a study; what they lack is empty."""
    import pandas as pd

    plain = {"design": RECORDED, "failed": "", "region": WORKSPACE, "region_share": 1.0}
    plain |= {"verified": False, "unproved": ""}
    table = pd.DataFrame([plain | one for one in records])
    table = table.reindex(columns=list(RUNS))
    table["label"] = table["design"] + table["n_samples"].astype(str)
    table["n_trained"] = table["n_trained"].fillna(table["n_samples"]).astype("int64")
    return table


def read_curve(path: str | Path) -> "tuple[pd.DataFrame, str]":
    """Reads a learning curve: a row per training, with columns n, seed and error.

    The error's unit stands in its name (``error_mm``, ``error_m``, ``error [deg]``) or in a row
    below the names; one without a unit is taken as it is. ``inf`` is a training that failed.

    Args:
        path: The file (``samples.table.read_table``).

    Returns:
        A table as ``runs_table``'s, its errors in the unit; and that unit: mm, deg, or nothing.

    Raises:
        IksamplesError: A column is missing or twice, a row is no training, or stands twice.
    """
    table = read_table(path)
    said = dict(with_units(table)[0]).get("error", "")
    kind = next(unit for unit, known in UNITS.items() if said in known)
    # An angle is found in radians and told in degrees.
    unit = {"rad": "deg"}.get(kind, kind)
    places = [Place("n", "", _N), Place("seed", "", _SEED), Place("error", kind, ["error"])]
    remedy = "Name them so, error_mm where it is in mm."
    values, table, _ = read_columns(table, places, remedy, most=np.inf)
    n, seed, error = values.T
    error = np.degrees(error) if unit == "deg" else error
    for fault, wrong in {
        "is no number of samples": (n < 0) | (n != np.round(n)) | (n > 2**53),
        "is no whole seed": (seed != np.round(seed)) | (np.abs(seed) > 2**53),
        "has an error below zero": error < 0,
    }.items():
        if wrong.any():
            raise IksamplesError(f"{path}: {table.place(int(np.argmax(wrong)))} {fault}.")
    seen: dict[tuple[float, float], int] = {}
    for i, pair in enumerate(zip(n, seed, strict=True)):
        first = seen.setdefault(pair, i)
        if first < i:
            raise IksamplesError(
                f"{path}: {table.place(i)} has the n and the seed of {table.place(first)}; "
                "a seed is one training of each size."
            )
    return runs_table(
        {
            "method": NETWORK,
            "n_samples": int(size),
            "seed": int(one),
            "n_points": 0,
            "failed": "" if np.isfinite(value) else FAILED,
            **dict.fromkeys(ERRORS, float(value)),
        }
        for size, one, value in zip(n, seed, error, strict=True)
    ), unit
