"""What the report says of errors: learning curves, and the worst error with its proof."""

from typing import Any

import numpy as np
import pandas as pd

from iksamples.report import figures, views
from iksamples.report.data import ReportData
from iksamples.report.markdown import code, objects, plus_minus
from iksamples.study import NETWORK


MEASURES = {
    "position": {"error_mean_mm": "mean error", "worst_mm": "worst error"},
    "orientation": {"angle_mean_deg": "mean angle", "worst_deg": "worst angle"},
}
"""Columns of the runs by what they measure, and what the report calls them."""

_N, _ERROR = "number of samples", "position error [mm]"


def curves(data: ReportData) -> dict[str, Any]:
    """Errors against the number of samples: every method, and the study's network in detail."""
    measured = {
        measure: columns
        for measure, columns in MEASURES.items()
        if data.compared[list(columns)].notna().to_numpy().any()
    }
    if data.compared.empty:
        return {}
    return (_trainings(data) if data.cells else {}) | {
        "drawings": {one: _curves_drawing(data, one, columns) for one, columns in measured.items()},
        "tables": {
            f"{name} over the workspace [{column.rsplit('_', 1)[1]}]": _by_size(data, column)
            for columns in measured.values()
            for column, name in columns.items()
        },
        "baseline": _baseline(data),
        "on_path": _mean_and_sd(data),
        "source": (data.results / "runs.parquet").as_posix(),
    }


def _trainings(data: ReportData) -> dict[str, Any]:
    """Single trainings of the study's network."""
    regions = data.runs[(data.runs["method"] == NETWORK) & data.runs["label"].isin(data.cells)]
    dots = regions.assign(line=f"{NETWORK}, one mark per seed", tip=_tips(regions))
    return {
        "seeds": figures.lines(
            dots,
            "n_samples",
            "error_mean_mm",
            figures.colours(list(dots["line"].unique())),
            _N,
            "mean position error [mm]",
            panel="region",
        ),
        "regions": _regions(regions),
        "training": _training_drawing(data.table("history"), data.loss_unit),
        "steps": data.table("members").groupby("n_samples")["steps"].median(),
    }


def _curves_drawing(data: ReportData, measure: str, columns: dict[str, str]) -> figures.Drawing:
    """An error's mean and worst, a line per method, or per design in panels of methods."""
    table = data.compared
    frames = []
    for column, name in columns.items():
        method = table["method"].astype(str) + ", " if data.several_designs else ""
        frames.append(table.assign(panel=method + name, error=table[column]))
    hue = "design" if data.several_designs else "method"
    unit = next(iter(columns)).rsplit("_", 1)[1]
    return figures.lines(
        pd.concat(frames), "n_samples", "error", figures.looks(data.study), _N,
        f"{measure} error [{unit}]", hue=hue, panel="panel",
    )  # fmt: skip


def worst(data: ReportData) -> dict[str, Any]:
    """What is proved of the worst error, and where the tolerance is missed."""
    every = data.certificates
    proofs = every[every["verified"].astype(bool)] if len(every) else every
    if proofs.empty:
        return {}
    largest = list(data.cells)[-1]
    unsafe, slices = data.shown_rows("unsafe"), data.shown_rows("slices")
    maps, cover = (one[one["label"] == largest] if len(one) else one for one in (slices, unsafe))
    wish, turns = data.study.tolerance, "angle_upper_deg" in proofs
    allowed = {"error_mm": wish.error_mm} | ({"angle_deg": wish.angle_deg} if turns else {})
    long = pd.concat(
        proofs.assign(line=line, mm=proofs[column])
        for line, column in {
            "proved: worst error, at most": "sup_upper_mm",
            "measured: largest error": "error_max_mm",
            "proved: mean error, at most": "mean_upper_mm",
        }.items()
    )
    looks = {
        "proved: worst error, at most": {"color": figures.NETWORK, "lw": 1.9},
        "measured: largest error": {"color": figures.MUTED, "ls": ":"},
        "proved: mean error, at most": {"color": figures.VALIDATION},
    }
    complete = proofs["complete"].astype(bool)
    gap = (proofs["sup_upper_mm"] / proofs["sup_lower_mm"])[complete].max() - 1
    over_mean = proofs["sup_lower_mm"] / proofs["mean_upper_mm"]
    corner = _at_corner(data, proofs)
    shown = proofs[(proofs["label"] == largest) & (proofs["seed"] == data.shown[largest])]
    drawing = figures.lines(long, "n_samples", "mm", looks, _N, _ERROR, tolerance=wish.error_mm)
    return {
        "drawing": drawing,
        "table": _proof_table(proofs, corner),
        "last": proofs[proofs["label"] == largest],
        "checked": len(proofs),
        "networks": len(every),
        "incomplete": int((~complete).sum()),
        "gap": gap,
        "over_mean": over_mean.groupby(proofs["n_samples"]).median(),
        "found": float((proofs["error_max_mm"] / proofs["sup_lower_mm"]).min()),
        "corner": corner.mean(),
        "place": _place(proofs.loc[corner].filter(regex="^argmax_")),
        "searches": proofs[["seconds", "boxes"]].sum(),
        "maps": {
            "position" if error == "error_mm" else "orientation": {
                "drawing": views.error_map(maps, error, limit),
                "missed": limit is not None and bool((maps[error] > limit).any()),
            }
            for error, limit in allowed.items()
            if len(maps)
        },
        "turns": turns,
        "everywhere": bool((shown["sup_upper_mm"] <= wish.error_mm).any()),
        "shown": data.shown[largest],
        "coverage": cover.iloc[0] if len(cover) else None,
        "epochs": _epochs_drawing(data.shown_rows("training_bound")),
    }  # fmt: skip


def _by_size(data: ReportData, quantity: str) -> pd.DataFrame:
    """Median over the seeds, a row per method and design, a column per number of samples."""
    table = data.compared
    keys = ["method", "design"] if data.several_designs else ["method"]
    order = pd.MultiIndex.from_frame(table[keys].drop_duplicates())
    wide = table.pivot_table(index=keys, columns="n_samples", values=quantity, aggfunc="median")
    wide = wide.reindex(order.get_level_values(0) if len(keys) == 1 else order).reset_index()
    return _titled(wide)


def _mean_and_sd(data: ReportData) -> pd.DataFrame:
    """Error on the first path, mean ± standard deviation over the seeds, by method and size."""
    rows = data.runs[data.runs["region"] == data.first_path]
    first = rows["method"].map(lambda name: data.study.designs(name)[0])
    by = rows[rows["design"] == first].groupby(["method", "n_samples"], sort=False)["error_mean_mm"]
    cells = map(plus_minus, by.mean(), by.std(ddof=1))
    table = pd.Series(list(cells), index=by.mean().index).unstack().sort_index(axis=1)
    return _titled(table.reindex(by.mean().index.unique(0)).fillna("").reset_index())


def _baseline(data: ReportData) -> list[tuple[str, int, int]]:
    """Of each network: at how many sizes a look-up table of the same samples has a smaller mean."""
    kinds = {name: method.kind for name, method in data.study.all_methods.items()}
    rows = data.compared[data.compared["design"] == data.study.samples.design]
    medians = rows.groupby(["method", "n_samples"])["error_mean_mm"].median().unstack()
    tables = [name for name in medians.index if kinds[name] == "multilinear"]
    if not tables:
        return []
    better = medians.gt(medians.loc[tables[0]])
    known = medians.notna() & medians.loc[tables[0]].notna()
    return [
        (name, int(np.sum(better.loc[name])), int(np.sum(known.loc[name])))
        for name in kinds
        if kinds[name] == "network" and name in medians.index
    ]


def _regions(rows: pd.DataFrame) -> pd.DataFrame:
    """Errors of the study's network in every region, over its seeds."""
    by = rows.groupby(["region", "n_samples"], sort=False)
    table = pd.DataFrame(
        {
            "Trained on": by["n_trained"].first(),
            "Networks": by.size(),
            "Mean [mm]": by["error_mean_mm"].mean(),
            "Standard deviation [mm]": by["error_mean_mm"].std(ddof=1),
            "95th percentile [mm]": by["error_p95_mm"].mean(),
            "Largest of any seed [mm]": by["error_max_mm"].max(),
        }
    )
    if rows["angle_mean_deg"].notna().any():
        table["Mean [deg]"] = by["angle_mean_deg"].mean()
        table["Largest of any seed [deg]"] = by["angle_max_deg"].max()
    return table.reset_index().rename(columns={"region": "Region", "n_samples": "Samples"})


def _tips(rows: pd.DataFrame) -> list[str]:
    return [
        f"{row.n_samples} samples, seed {row.seed}: mean {row.error_mean_mm:.2f} mm, "
        f"largest {row.error_max_mm:.2f} mm"
        for row in rows.itertuples()
    ]


def _training_drawing(history: pd.DataFrame, unit: str) -> figures.Drawing:
    """Losses over the epochs, a panel for each number of samples."""
    last = history["epoch"].max()
    kept = np.unique(np.linspace(1, last, 90).round())
    history = history[history["epoch"].isin(kept)]
    columns = {"training": "train_loss", "validation": "validation_loss"}
    long = pd.concat(
        history.assign(line=line, loss=history[column]) for line, column in columns.items()
    )
    long["panel"] = long["n_samples"].astype(str) + " samples"
    looks = {"training": {"color": figures.NETWORK}, "validation": {"color": figures.VALIDATION}}
    return figures.lines(
        long.sort_values("n_samples", kind="stable"),
        "epoch", "loss", looks, "epoch", f"loss{unit}", panel="panel", linear="x",
    )  # fmt: skip


def _epochs_drawing(bounds: pd.DataFrame) -> figures.Drawing | None:
    """The proved worst error along the training, beside the errors at the samples."""
    if bounds.empty:
        return None
    sizes = sorted(bounds["n_samples"].unique())
    few = sorted({sizes[0], sizes[len(sizes) // 2], sizes[-1]})
    rows = bounds[bounds["n_samples"].isin(few) & (bounds["epoch"] > 0)]
    looks = {
        "worst error over the workspace, proved": {"color": figures.NETWORK, "lw": 3},
        "largest error at a sample": {"color": figures.SAMPLE, "lw": 1},
        "mean error at the samples": {"color": figures.SAMPLE, "lw": 1.2, "ls": ":"},
    }
    columns = ("sup_upper_mm", "training_max_mm", "training_mean_mm")
    long = pd.concat(
        rows.assign(line=line, mm=rows[column]) for line, column in zip(looks, columns, strict=True)
    )
    long["panel"] = long["n_samples"].astype(str) + " samples"
    return figures.lines(
        long.sort_values("n_samples", kind="stable"),
        "epoch", "mm", looks, "epoch", _ERROR, panel="panel",
    )  # fmt: skip


def _proof_table(proofs: pd.DataFrame, corner: "pd.Series[bool]") -> pd.DataFrame:
    by = proofs.assign(corner=corner).groupby("n_samples")
    middle = by.median(numeric_only=True)
    table = pd.DataFrame(
        {
            "Worst error ≥ [mm]": middle["sup_lower_mm"],
            "Worst error ≤ [mm]": middle["sup_upper_mm"],
            "Worst seed ≤ [mm]": by["sup_upper_mm"].max(),
            "Largest measured [mm]": middle["error_max_mm"],
            **(
                {
                    "Angle ≥ [deg]": middle["angle_lower_deg"],
                    "Angle ≤ [deg]": middle["angle_upper_deg"],
                    "Worst seed ≤ [deg]": by["angle_upper_deg"].max(),
                }
                if "angle_upper_deg" in proofs
                else {}
            ),
            "Mean ≥ [mm]": middle["mean_lower_mm"],
            "Mean ≤ [mm]": middle["mean_upper_mm"],
            "At a corner [%]": 100 * by["corner"].mean(),
            "Boxes": middle["boxes"],
            "Networks": by.size(),
        }
    ).reset_index(names="Samples")
    # Of many inputs no mean is enclosed.
    return table.dropna(axis="columns", how="all")


def _at_corner(data: ReportData, proofs: pd.DataFrame) -> "pd.Series[bool]":
    """Whether a network's worst point is a corner of the workspace."""
    place = proofs.filter(regex="^argmax_").to_numpy(float)
    box = data.study.workspace
    gap = np.minimum(np.abs(place - box.lower), np.abs(place - box.upper))
    return pd.Series((gap <= 1e-6).all(axis=1), index=proofs.index)


def _place(places: pd.DataFrame) -> str:
    """The most frequent of some points: ``x 80 mm, y 20 mm``."""
    often = places.value_counts().index[:1].to_frame()
    cells = ((str(column).split("_"), value) for column in often for value in often[column])
    return ", ".join(f"{name} {value:g} {unit}" for (_, name, unit), value in cells)


def _titled(wide: pd.DataFrame) -> pd.DataFrame:
    """A table with a method (and a design) in front, ready to be shown."""
    wide = wide.astype(object)
    wide["method"] = objects(map(code, wide["method"]))
    return wide.rename(columns={"method": "Method", "design": "Samples placed"})
