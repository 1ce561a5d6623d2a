"""The study's table: one row per grid, beside the paper's Table 1."""

import json
from collections.abc import Iterable
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from iksamples.evaluation.errors import CUBE
from iksamples.paper import equations as paper
from iksamples.paper.audit import scale_mm
from iksamples.results import Cell
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd


def paper_table() -> "pd.DataFrame":
    """The paper's Table 1, indexed by samples_per_axis."""
    import pandas as pd

    with files("iksamples.paper").joinpath("table1.csv").open() as file:
        table = pd.read_csv(file)
    return table.set_index("samples_per_axis").rename(
        columns={
            "error_measured_mm": "paper_error_mm",
            "error_measured_sd_mm": "paper_error_sd_mm",
            "error_estimated_mm": "paper_estimate_mm",
            "error_over_spacing": "paper_error_over_spacing",
        }
    )


def kept_reading() -> dict[str, Any]:
    """The reading that comes nearest to the paper's Table 1, as ``readings.best_reading`` left it.

    Returns:
        ``options`` (the option of each question), ``contradicts`` (the questions answered against
        the paper's words), ``first_seed``, and ``rows`` with the columns ``readings.ROWS``.
    """
    found: dict[str, Any] = json.loads(
        files("iksamples.paper").joinpath("reading.json").read_text()
    )
    return found


def reading_table() -> "pd.DataFrame":
    """The rows of that reading, indexed by samples_per_axis."""
    import pandas as pd

    rows = pd.DataFrame(kept_reading()["rows"])
    rows.index = pd.Index(np.cbrt(rows["n_samples"]).round().astype(int), name="samples_per_axis")
    names = {"error_mean_mm": "reading_error_mm", "error_sd_mm": "reading_error_sd_mm"}
    return rows[list(names)].rename(columns=names)


def study_table(
    study: Study, cells: Iterable[Cell], certificates: "pd.DataFrame"
) -> "pd.DataFrame":
    """Aggregates the errors and estimates of every grid over its seeds.

    Means over seeds; ``error_sd_mm`` is the standard deviation over seeds of a seed's mean error
    along the study's first path (the paper does not say what its ± is). A seed that diverged is
    counted in ``n_diverged`` and left out of everything else.

    Args:
        study: The study.
        cells: One cell per grid.
        certificates: Certified worst cases, columns as in ``columns.CERTIFICATES``.

    Returns:
        One row per grid, columns as in ``columns.COLUMNS``.
    """
    import pandas as pd

    published = paper_table().join(reading_table())
    first_path = next(iter(study.evaluation.paths))
    rows = []
    for cell in cells:
        samples, members = cell.samples, cell.table("members")
        sound = members.loc[~members["diverged"], "seed"]
        errors = cell.sound_errors.set_index("region")
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
        row |= over_seeds(errors.loc[[first_path]], "", spacing_mm)
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
        row |= over_seeds(errors.loc[[CUBE]], "cube_", spacing_mm)
        rows.append(row)
    return pd.DataFrame(rows)


def over_seeds(errors: "pd.DataFrame", prefix: str, spacing_mm: float) -> dict[str, float]:
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
