"""Sections about the run itself: what it cost, how to look closer, and where it comes from."""

from datetime import UTC, datetime

import numpy as np

from iksamples.report import provenance
from iksamples.report.blocks import Column, Commands, Number, Section, Table, Text
from iksamples.report.data import ReportData
from iksamples.report.wording import count, thousands


def cost(data: ReportData) -> Section | None:
    """Time and memory of every step, from Snakemake's benchmark files."""
    if data.benchmarks.empty:
        return None
    columns = [
        Column("step", text=True),
        Column("jobs"),
        Column("wall clock", "s"),
        Column("share", "%"),
        Column("longest job", "s"),
        Column("processor", "s"),
        Column("peak memory", "MB"),
    ]
    total = float(data.benchmarks["s"].sum())
    by_step = data.benchmarks.groupby("step")
    order = by_step["s"].sum().sort_values(ascending=False).index
    rows: list[list[str | Number]] = []
    for step in order:
        jobs = by_step.get_group(step)
        seconds = float(jobs["s"].sum())
        rows.append(
            [
                str(step),
                Number(len(jobs), 0),
                Number(seconds, 1),
                Number(100 * seconds / total if total else np.nan, 0),
                Number(float(jobs["s"].max()), 1),
                Number(float(jobs["cpu_s"].sum(min_count=1)), 1),
                Number(float(jobs["max_rss_mb"].max()), 0),
            ]
        )
    rows.append(
        [
            "all",
            Number(len(data.benchmarks), 0),
            Number(total, 1),
            Number(100, 0),
            Number(float(data.benchmarks["s"].max()), 1),
            Number(float(data.benchmarks["cpu_s"].sum(min_count=1)), 1),
            Number(float(data.benchmarks["max_rss_mb"].max()), 0),
        ]
    )
    networks = sum(len(grid.members) for grid in data.grids)
    steps = sum(float(grid.members["steps"].sum()) for grid in data.grids)
    text = (
        f"{count(networks, 'network')} took {thousands(steps)} optimiser steps in all. Jobs run "
        "side by side, so the whole run is shorter than the sum. The report’s own job and those "
        "that end after it began are not in it."
    )
    caption = (
        f"Cost of each step. Data: `{(data.results / 'benchmarks').as_posix()}`; a job that ends "
        "before Snakemake first looks has no memory reading."
    )
    return Section(
        "cost",
        "Cost",
        [
            Text(text, in_readme=False),
            Table(columns, rows, caption, "table-cost", in_readme=False),
        ],
    )


def look_closer(data: ReportData) -> Section:
    """Commands that open the recordings and the runs."""
    recordings = [f"rerun {path.as_posix()}" for path in data.recordings]
    uri = data.tracking_uri
    remote = uri is not None and uri.startswith("http")
    server = [] if remote else ["mlflow ui" + (f" --backend-store-uri {uri}" if uri else "")]
    text = (
        "In the project’s folder, with its environment active: each recording holds one path with "
        "all grids, the arm moving along it, and a second timeline that replays the training; "
    )
    text += (
        f"the runs are on the MLflow server at {uri}."
        if remote
        else "MLflow shows the runs of every grid and seed side by side, by default at "
        "http://127.0.0.1:5000."
    )
    return Section("look", "Look closer", [Text(text), Commands([*recordings, *server])])


def origin(data: ReportData) -> Section:
    """What was run, on what, from which state of the code."""
    here = [
        ["study", f"{data.study.name}, digest `{data.study.digest()}`"],
        ["settings", f"`{(data.results / 'study.json').as_posix()}`"],
        ["made by", f"`{data.command}`"],
    ]
    on_page = [
        *here,
        ["git commit", provenance.commit()],
        ["built", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")],
        ["versions", provenance.versions()],
        ["machine", provenance.machine()],
    ]
    columns = [Column("", text=True), Column("", text=True)]
    return Section(
        "origin",
        "Where this comes from",
        [
            Table(columns, on_page, "", "table-origin", in_readme=False),
            Text("; ".join(f"{name}: {value}" for name, value in here) + ".", in_page=False),
        ],
    )
