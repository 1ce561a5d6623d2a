"""The report's section on the paper: its Table 1, its claims and its estimate beside this study."""

from typing import Any

import numpy as np
import pandas as pd

from iksamples.columns import stored_table
from iksamples.paper.equations import AVERAGE_NAMES, kept_reading, scale_mm
from iksamples.report import figures
from iksamples.report.data import ReportData
from iksamples.report.figures import lines
from iksamples.report.markdown import plus_minus
from iksamples.study import NETWORK, DoubleRectangle, Robot, Workspace
from iksamples.text import is_paper_recipe


TABLE, CLAIMS = "table.csv", "claims.csv"
TEMPLATE = "paper.md.j2"

_PAPER = "the paper, Table 1"
_N, _ERROR = "number of samples", "mean position error [mm]"


def values(data: ReportData) -> dict[str, Any]:
    """Named values for the template.

    Args:
        data: A study that was held against the paper.
    """
    study, results = data.study, data.results
    table = stored_table(results / TABLE)
    table["ratio"] = table["error_mean_mm"] / table["paper_error_mm"]
    measured = table[table["error_mean_mm"].notna()]
    spaced = bool(table["spacing_mm"].notna().all())
    claims = stored_table(results / CLAIMS)
    claims.columns = pd.Index(["Claim", "Where", "Verdict", "Number or counter-example"])
    bounds, members = data.table("bounds"), data.table("members")
    path = study.evaluation.paths[data.first_path]
    held = members.groupby("n_samples")[["n_validation", "n_test"]].first()
    return {
        "table": table,
        "results": results,
        "path": data.first_path,
        "own_task": study.robot == Robot()
        and study.workspace == Workspace()
        and isinstance(path, DoubleRectangle),
        "own_recipe": is_paper_recipe(study.all_methods[NETWORK]),
        "below": int((measured["estimate_mm"] < measured["error_mean_mm"]).sum()),
        "sizes": len(measured),
        "claims": claims,
        "verdicts": claims["Verdict"].value_counts().to_dict(),
        "one": _table_one(table),
        "contradicted": kept_reading()["contradicts"],
        "beside": _beside(data, table, False),
        "averages": AVERAGE_NAMES,
        "chosen": study.bounds.average_weight,
        "scale": scale_mm(study),
        "estimate": _estimate(table, bounds, study.bounds.average_weight),
        "exceeded": _exceeded(bounds, study.bounds.average_weight),
        "weights": _weights(table, bounds, scale_mm(study)),
        "spaced": spaced,
        "over_spacing": _beside(data, table, True) if spaced else None,
        "urdf": study.robot.urdf,
        "network": f"{' and '.join(map(str, study.network.hidden)) or 'no'} "
        f"{study.network.activation}",
        "fresh": study.training.held_out.source == "fresh",
        "held": [int(one) for one in (*held.iloc[0], *held.iloc[-1])],
        "stopping": study.training.early_stopping is not None,
    }


def _table_one(table: pd.DataFrame) -> pd.DataFrame:
    """Table 1 with this study's columns beside the paper's."""
    pairs = {
        "Paper [mm]": "paper_error",
        "Here [mm]": "error",
        "Nearest reading [mm]": "reading_error",
    }
    columns: dict[str, Any] = {"Samples": table["n_samples"], "d [mm]": table["spacing_mm"]}
    for title, prefix in pairs.items():
        mean = f"{prefix}_mean_mm" if prefix == "error" else f"{prefix}_mm"
        columns[title] = [
            plus_minus(*row) for row in table[[mean, f"{prefix}_sd_mm"]].to_numpy(float)
        ]
    return pd.DataFrame(
        columns
        | {
            "Ratio": table["ratio"],
            "Paper's estimate [mm]": table["paper_estimate_mm"],
            "Eq. 25 here [mm]": table["estimate_mm"],
            "Paper's e/d": table["paper_error_over_spacing"],
            "e/d here": table["error_over_spacing"],
        }
    )


def _beside(data: ReportData, table: pd.DataFrame, over_spacing: bool) -> Any:
    """Every training's mean error on the first path, and the paper's; over the grid's spacing."""
    over = table["spacing_mm"] if over_spacing else pd.Series(1.0, table.index)
    rows = data.runs[data.runs["label"].isin(data.cells) & (data.runs["method"] == NETWORK)]
    rows = rows[rows["region"] == data.first_path]
    scale = rows["n_samples"].map(dict(zip(table["n_samples"], over, strict=True)))
    here = pd.DataFrame({"n": rows["n_samples"], "mm": rows["error_mean_mm"] / scale})
    mean, spread = table["paper_error_mm"] / over, table["paper_error_sd_mm"] / over
    ends = {"low": mean - spread, "high": mean + spread}
    theirs = pd.DataFrame({"n": table["n_samples"], "mm": mean, **ends})
    looks = {"here": {"color": figures.NETWORK, "lw": 1.9}, _PAPER: figures.PAPER_LINE}
    long = pd.concat(
        [here.assign(line="here", low=np.nan, high=np.nan), theirs.assign(line=_PAPER)]
    )
    ylabel, linear = ("error over spacing, e/d", "y") if over_spacing else (_ERROR, "")
    return lines(long, "n", "mm", looks, _N, ylabel, linear=linear)


def _estimate(table: pd.DataFrame, bounds: pd.DataFrame, chosen: str) -> Any:
    looks: dict[str, Any] = {"measured": {"color": figures.NETWORK, "lw": 1.9}}
    frames = [_line("measured", table["n_samples"], table["error_mean_mm"])]
    for key, words in AVERAGE_NAMES.items():
        means = bounds.groupby("n_samples")[f"estimate_{key}_mm"].mean()
        frames.append(_line(words, means.index, means))
        looks[words] = _average_look(key, chosen)
    frames.append(_line("the paper's column", table["n_samples"], table["paper_estimate_mm"]))
    looks["the paper's column"] = figures.PAPER_LINE
    return lines(pd.concat(frames), "n", "y", looks, _N, "error, estimate [mm]")


def _exceeded(bounds: pd.DataFrame, chosen: str) -> Any:
    frames, looks = [], {}
    for key, words in AVERAGE_NAMES.items():
        shares = 100 * bounds.groupby("n_samples")[f"above_{key}"].mean()
        frames.append(_line(words, shares.index, shares))
        looks[words] = _average_look(key, chosen)
    title = "share of the workspace [%]"
    return lines(pd.concat(frames), "n", "y", looks, _N, title, linear="y")


def _average_look(key: str, chosen: str) -> dict[str, Any]:
    dashes = dict(zip(AVERAGE_NAMES, ("-", "--", "-.", ":"), strict=True))
    return {"color": figures.ESTIMATE, "ls": dashes[key], "lw": 2.2 if key == chosen else 1.1}


def _line(name: str, n: Any, y: Any) -> pd.DataFrame:
    return pd.DataFrame({"line": name, "n": np.asarray(n), "y": np.asarray(y, float)})


def _weights(table: pd.DataFrame, bounds: pd.DataFrame, scale: float) -> pd.DataFrame:
    means = bounds.groupby("n_samples")[[f"wbar_{key}" for key in AVERAGE_NAMES]].mean()
    means = means.reindex(table["n_samples"]).reset_index(drop=True)
    return pd.DataFrame(
        {
            "Samples": table["n_samples"],
            **{words: means[f"wbar_{key}"] for key, words in AVERAGE_NAMES.items()},
            "for the paper's column": table["wbar_for_paper"],
            "Estimate [mm]": table["estimate_mm"],
            "Root [mm]": np.sqrt(table["estimate_mm"] * scale),
            "Exceeded on [%]": 100 * table["above_estimate"],
        }
    )
