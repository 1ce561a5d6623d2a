"""Sections that compare: methods and designs on the same samples, and readings of the paper."""

import numpy as np
import pandas as pd

from iksamples.answer.finding import STREAM
from iksamples.answer.statistics import compare
from iksamples.answer.words import placed_as
from iksamples.report import figures_answer
from iksamples.report.blocks import Block, Column, Figure, Number, Section, Table, Text
from iksamples.report.data import ReportData
from iksamples.report.figures_answer import QUANTITIES, legend_name
from iksamples.report.wording import count, joined, path_name, ratio_cells, thousands
from iksamples.study import DRAWN


def methods_and_designs(data: ReportData) -> Section | None:
    """Errors of all methods and designs; None where the study has one of each."""
    study = data.study
    designs = list(study.samples.designs)
    if len(study.all_methods) == 1 and len(designs) == 1:
        return None
    certified = data.every_error.groupby("method")["certified"].all()
    proved = [legend_name(study, name) for name in study.all_methods if certified.get(name)]
    caption = (
        "over the whole workspace against number of samples: median over the seeds, band: its 95 % "
        "interval."
    )
    how = (
        f" The worst error is certified for {joined(proved)}, else the largest at "
        f"{thousands(data.grids[0].n_workspace)} points."
        if proved
        else f" The worst error is the largest at {thousands(data.grids[0].n_workspace)} points."
    )
    source = f"{(data.results / '*' / '*' / 'errors.parquet').as_posix()}"
    if proved:
        source += f", {(data.results / 'certificates.csv').as_posix()}"
    drawn_by = f"{figures_answer.__name__}.errors_of_methods"
    blocks: list[Block] = []
    if len(designs) == 1:
        drawing = figures_answer.errors_of_methods(data, list(QUANTITIES))
        text = f"Mean and worst error {caption}{how}"
        blocks.append(Figure("methods", "", text, drawing, source, drawn_by))
    else:
        for quantity in QUANTITIES:
            drawing = figures_answer.errors_of_methods(data, [quantity])
            name = "Mean" if quantity == "mean_mm" else "Worst"
            more = how if quantity == "worst_mm" else ""
            text = (
                f"{name} error {caption} A panel for each method, a line for each way of placing "
                f"the samples.{more}"
            )
            figure = Figure(f"methods-{name.lower()}", "", text, drawing, source, drawn_by)
            blocks.append(figure)
    baseline = _baseline(data)
    if baseline:
        blocks.insert(0, Text(baseline))
    blocks += [_table(data, quantity) for quantity in QUANTITIES]
    title = "Methods" if len(designs) == 1 else "Methods and designs"
    return Section("methods", f"{title} side by side", blocks)


def placing(data: ReportData) -> Section | None:
    """Every design against the first, method by method; None where the study has one design."""
    designs = data.study.samples.designs
    if len(designs) == 1:
        return None
    table = data.every_error.rename(columns={"worst_mm": "error_mm"})
    sizes = sorted(table["n_samples"].unique())
    rows: list[list[str | Number]] = []
    texts: list[Block] = []
    for name, method in data.study.all_methods.items():
        own = table[table["method"] == name]
        reference = own[own["design"] == designs[0]]
        if method.kind == "analytic" or reference.empty:
            continue
        for design in designs[1:]:
            rng = np.random.default_rng(STREAM)
            chance = (method.kind == "network",) * 2
            found = ratio_cells(compare(own[own["design"] == design], reference, rng, chance))
            if found:
                cells = [found.get(int(n), "") for n in sizes]
                rows.append([legend_name(data.study, name), design, *cells])
        texts.append(Text(_best_design(legend_name(data.study, name), own, designs[0])))
    columns = [
        Column("method", text=True),
        Column("samples placed", text=True),
        *(Column(str(int(n)), group="worst error in the workspace [%], by samples") for n in sizes),
    ]
    text = (
        f"Each row holds a way of placing the samples against samples {placed_as(designs[0])}: "
        "equally many, the same method, the same seeds. Below 100 % is better."
    )
    drawn = [name for name in designs if name in DRAWN]
    if drawn:
        text += (
            f" The points of {joined(drawn)} are drawn once for all seeds; another `samples.seed` "
            "draws others, so small differences between these say little."
        )
    caption = (
        f"Worst error as a share of that with samples {placed_as(designs[0])}: median over paired "
        "seeds; bold: its 95 % interval leaves out 100 % (a method without chance has no interval)."
    )
    return Section(
        "placing",
        "Where the samples are",
        [Text(text), Table(columns, rows, caption, "table-placing"), *texts],
    )


def _best_design(name: str, own: pd.DataFrame, first: str) -> str:
    """The design with the smallest median at every size, beside the first design."""
    medians = own.groupby(["n_samples", "design"])["error_mm"].median().unstack()
    parts = []
    for n, row in medians.iterrows():
        best = str(row.idxmin())
        # Masked designs may differ in size, so that the first has none of this one.
        alone = best == first or not np.isfinite(row[first])
        beside = "" if alone else f", {first} {row[first]:.2f} mm"
        parts.append(f"{n}: {best} ({row[best]:.2f} mm{beside})")
    return (
        f"**{name}.** Smallest worst error (median over the seeds), by samples: {'; '.join(parts)}."
    )


def readings(data: ReportData) -> Section | None:
    """Networks of the study beside the paper's Table 1; None without others or without paper."""
    study = data.study
    names = [name for name, method in study.all_methods.items() if method.kind == "network"]
    paper = data.on_paper.set_index("n_samples")
    table = data.every_error
    table = table[(table["design"] == study.samples.design) & table["n_samples"].isin(paper.index)]
    if len(names) == 1 or table.empty:
        return None
    theirs, spread = paper["paper_error_mm"], paper["paper_error_sd_mm"]
    rows: list[list[str | Number]] = [
        [
            "the paper, Table 1",
            *(Number(theirs[n], 2, spread[n]) for n in theirs.index),
            Number(np.nan),
        ]
    ]
    landed: dict[str, int] = {}
    for name in names:
        own = table[table["method"] == name]
        if own.empty:
            continue
        by_n = own.groupby("n_samples")["path_mm"]
        mean, sd = by_n.mean().reindex(theirs.index), by_n.std(ddof=1).reindex(theirs.index)
        inside = (mean - theirs).abs() <= spread
        landed[name] = int(inside.sum())
        cells = [_reading(mean[n], sd[n], bool(inside[n])) for n in theirs.index]
        rows.append([legend_name(study, name), *cells, Number(landed[name], 0)])
    columns = [
        Column("reading", text=True),
        *(Column(str(int(n)), group="mean error [mm], by samples") for n in theirs.index),
        Column("in ±", ours=True),
    ]
    most = max(landed.values())
    best = [name for name, count in landed.items() if count == most]
    text = (
        "The paper leaves much of its recipe unsaid. Each row reads it differently; its own ± is "
        "met"
    )
    text += (
        f" most often, at {most} of {len(theirs)} sizes, by "
        f"{joined([legend_name(study, name) for name in best])}."
        if most
        else " by no reading at any size."
    )
    caption = (
        f"Mean error along {path_name(data, data.first_path)}, ± standard deviation over seeds; "
        "bold: within the paper’s ±, which the paper does not define. Data: "
        f"`{(data.results / '*' / '*' / 'errors.parquet').as_posix()}`."
    )
    return Section(
        "readings",
        "Readings of the paper, beside its Table 1",
        [Text(text), Table(columns, rows, caption, "table-readings")],
    )


def _reading(mean: float, sd: float, inside: bool) -> str:
    if not np.isfinite(mean):
        return ""
    text = f"{mean:.2f}" + (f"\u00a0±\u00a0{sd:.2f}" if np.isfinite(sd) else "")
    return f"**{text}**" if inside else text


def _medians(data: ReportData, quantity: str) -> dict[tuple[str, str], dict[int, float]]:
    """Median over the seeds by number of samples, for each method and design."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    keys = ["method", "design", "n_samples"]
    for row in data.every_error.groupby(keys)[quantity].median().reset_index().itertuples():
        _, method, design, n, value = row
        found.setdefault((str(method), str(design)), {})[int(n)] = float(value)
    return found


def _table(data: ReportData, quantity: str) -> Table:
    study = data.study
    several = len(study.samples.designs) > 1
    medians = _medians(data, quantity)
    sizes = sorted({n for values in medians.values() for n in values})
    columns = [
        Column("method", text=True),
        *([Column("samples placed", text=True)] if several else []),
        *(Column(str(n), group=f"{QUANTITIES[quantity]}, by samples") for n in sizes),
    ]
    rows: list[list[str | Number]] = []
    for name, method in study.all_methods.items():
        for design in study.samples.designs:
            if method.kind != "analytic" and (name, design) in medians:
                head = [legend_name(study, name), *([design] if several else [])]
                values = [medians[name, design].get(n, np.nan) for n in sizes]
                rows.append([*head, *(Number(value, _digits(value)) for value in values)])
    caption = f"{QUANTITIES[quantity].split(' [')[0].capitalize()} over the whole workspace, "
    caption += "median over the seeds; empty: the method cannot use these samples."
    diverged = data.diverged
    if diverged:
        caption += f" {count(diverged, 'network')} diverged and {_are(diverged)} left out."
    return Table(columns, rows, caption, f"table-{quantity.split('_')[0]}", in_readme=not several)


def _are(n: int) -> str:
    return "is" if n == 1 else "are"


def _digits(value: float) -> int:
    """Decimals that show two figures of a small error."""
    if not np.isfinite(value) or value >= 0.1 or value < 1e-4:
        return 2
    return int(np.ceil(-np.log10(value))) + 1


def _baseline(data: ReportData) -> str:
    """Which networks are worse than a look-up table of the very same samples, and how often."""
    study = data.study
    tables = [name for name, method in study.all_methods.items() if method.kind == "multilinear"]
    design = study.samples.design
    medians = _medians(data, "mean_mm")
    if not tables or (tables[0], design) not in medians:
        return ""
    baseline = medians[tables[0], design]
    parts, always = [], True
    for name, method in study.all_methods.items():
        if method.kind == "network" and (name, design) in medians:
            own = {n: v for n, v in medians[name, design].items() if n in baseline}
            worse = sum(value > baseline[n] for n, value in own.items())
            always = always and worse == len(own)
            parts.append(f"{legend_name(study, name)} at {worse} of {len(own)}")
    if not parts:
        return ""
    networks = "every network" if len(parts) > 1 else "the study’s network"
    whom = f"{networks} at every size tried" if always else f"{joined(parts)} sizes"
    return (
        "What a learned answer has to beat is a look-up table of the very same samples, "
        f"interpolated linearly. Its mean error is smaller than that of {whom}."
    )
