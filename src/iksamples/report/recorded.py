"""The page of a recorded study: how many records a method needs, and which of them are odd."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iksamples.columns import stored_table
from iksamples.files import stored_object
from iksamples.recorded.learn import ABOUT, JUDGED
from iksamples.report import answers, figures, markdown, run
from iksamples.report.data import ReportData, read_report_data
from iksamples.report.markdown import code
from iksamples.report.write import Pictures, page, save, text_environment
from iksamples.study import Study


_SHARES = {"Median [mm]": 0.5, "95th percentile [mm]": 0.95, "Largest [mm]": 1.0}


def write_recorded(
    study: Study, results: str | Path, output: str | Path, command: str = "snakemake --cores 2"
) -> None:
    """Writes ``index.html`` and ``README.md`` of a finished recorded study.

    Args:
        study: The study, with ``samples.recorded``.
        results: Its results folder.
        output: Folder of the report.
        command: What a user types to run the study.

    Raises:
        IksamplesError: A result is missing or unreadable.
    """
    data = read_report_data(study, Path(results), command)
    judged = stored_table(data.results / JUDGED)
    pictures = Pictures()
    title = study.title or f"Study {study.name}"
    values: dict[str, Any] = {
        "data": data,
        "title": title,
        "about": stored_object(
            data.results / ABOUT, {"head": str, "doubts": list, "left_out": dict}
        ),
        "answer": answers.answer(data),
        "recorded": study.samples.recorded,
        "curve": _curve(data),
        "records": _records(judged),
        "distances": "apart_mm" in judged,
        "made": run.made(data),
        "figure": pictures,
    }
    template = text_environment().get_template("recorded.md.j2")
    text = markdown.tidy(template.render(values))
    save(Path(output), text, page(title, markdown.to_html(text, pictures.inline())), pictures)


@figures.styled
def _curve(data: ReportData) -> figures.Drawing:
    """Error of the records held out against what was learned from; what needs none lies across."""
    rows = data.workspace
    few, many = data.compared["n_samples"].min(), data.compared["n_samples"].max()
    without = rows[~rows["method"].map(data.learns)]
    across = [without.assign(n_samples=n) for n in (few, many)]
    table = pd.concat([data.compared, *across])
    long = pd.concat(
        table.assign(panel=panel, error=table[column])
        for column, panel in {
            "error_mean_mm": "mean of the records held out",
            "error_max_mm": "largest of the records held out",
        }.items()
    )
    of = data.study.tolerance
    return figures.lines(
        long, "n_samples", "error", figures.looks(data.study), "records learned from",
        "position error [mm]", hue="method", panel="panel", tolerance=of.error_mm,
    )  # fmt: skip


def _records(judged: pd.DataFrame) -> pd.DataFrame:
    """Each record held out, once: its median over the orders in which it judged."""
    rows = []
    for (method, n), own in judged.groupby(["method", "n_samples"], sort=False):
        each = own.groupby("record")[["error_mm", "joint_deg"]].median()
        row: dict[str, Any] = {"Method": code(str(method)), "Learned from": n, "Judge": len(each)}
        row["Mean [mm]"] = float(each["error_mm"].mean())
        row |= {
            name: float(np.quantile(each["error_mm"], share)) for name, share in _SHARES.items()
        }
        if judged["joint_deg"].notna().any():
            row["Joint off farthest, median [deg]"] = float(each["joint_deg"].median())
        if "apart_mm" in own:
            row["Distance of sockets off by [mm]"] = float(
                own.groupby("seed")["apart_mm"].first().median()
            )
        rows.append(row)
    return pd.DataFrame(rows, dtype=object)
