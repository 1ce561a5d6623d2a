"""What each change to the study's network and training does: a paragraph of result each."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from iksamples.answer.finding import STREAM
from iksamples.answer.statistics import compare
from iksamples.answer.words import OPTIMIZERS
from iksamples.report.blocks import Block, Column, Number, Section, Table, Text
from iksamples.report.data import ReportData
from iksamples.report.statistics import fall_interval
from iksamples.report.verdict import levelling_pair
from iksamples.report.wording import (
    ACTIVATION_NAMES,
    budget,
    joined,
    path_name,
    percent,
    ratio_cells,
    thousands,
)
from iksamples.results import Cell
from iksamples.study import NETWORK, Method, Training


_QUANTITIES = ("path_mm", "worst_mm")


def what_each_change_does(data: ReportData) -> Section | None:
    """Every other network against the study's own, seed by seed; None where there is no other."""
    study = data.study
    table = data.every_error
    table = table[table["design"] == study.samples.design]
    own = table[table["method"] == NETWORK]
    others = [
        name
        for name, method in study.methods.items()
        if method.kind == "network" and (table["method"] == name).any()
    ]
    if not others or own.empty:
        return None
    blocks: list[Block] = [Text(_how_compared(data))]
    rows = []
    for name in others:
        theirs = table[table["method"] == name]
        pairs = {quantity: _pairs(theirs, own, quantity) for quantity in _QUANTITIES}
        if any(pair.empty for pair in pairs.values()):
            continue
        blocks.append(Text(_paragraph(data, name, theirs, own, pairs)))
        rows.append(_row(data, name, pairs))
    sizes = [grid.n for grid in data.grids]
    columns = [
        Column("change", text=True),
        *(Column(thousands(n), group="mean error on the path [%]") for n in sizes),
        *(Column(thousands(n), group="worst error in the workspace [%]") for n in sizes),
    ]
    caption = (
        "Error as a share of the study’s own network’s, by samples: median over paired seeds; "
        "bold: its 95 % interval leaves out 100 %. Data: "
        f"`{(data.results / '*' / '*' / 'errors.parquet').as_posix()}`."
    )
    if not rows:
        return None
    # Before the paragraphs: the eye goes down a column faster than through a text.
    blocks.insert(1, Table(columns, rows, caption, "table-changes"))
    return Section("changes", "What each change does", blocks)


def differences(own: Method, other: Method) -> list[str]:
    """In what a network and its training differ from the study's own, in words."""
    return list(_differences(own, other))


def _differences(own: Method, other: Method) -> Iterator[str]:
    if other.network.hidden != own.network.hidden:
        yield f"{_layers(other)} instead of {_layers(own)}"
    if other.network.activation != own.network.activation:
        names = (ACTIVATION_NAMES[m.network.activation] for m in (other, own))
        yield " instead of ".join(names)
    ours, theirs = own.training, other.training
    if theirs.optimizer != ours.optimizer:
        yield f"{OPTIMIZERS[theirs.optimizer]} instead of {OPTIMIZERS[ours.optimizer]}"
    if (theirs.steps, theirs.epochs) != (ours.steps, ours.epochs):
        yield f"{budget(theirs)} instead of {budget(ours)}"
    if theirs.learning_rate != ours.learning_rate:
        yield f"a learning rate of {theirs.learning_rate:g} instead of {ours.learning_rate:g}"
    if theirs.schedule != ours.schedule:
        yield f"a {theirs.schedule} learning rate instead of a {ours.schedule} one"
    if theirs.plateau_patience != ours.plateau_patience and theirs.schedule == "plateau":
        yield f"a plateau of {theirs.plateau_patience} epochs instead of {ours.plateau_patience}"
    if theirs.batch_size != ours.batch_size:
        yield f"batches of {theirs.batch_size} instead of {ours.batch_size}"
    if theirs.early_stopping != ours.early_stopping:
        yield f"{_stopping(theirs)} instead of {_stopping(ours)}"
    if theirs.held_out != ours.held_out:
        if theirs.held_out.source != ours.held_out.source:
            where = {"grid": "among the samples", "fresh": "at fresh points"}
            yield (
                f"validation and test points {where[theirs.held_out.source]} instead of "
                f"{where[ours.held_out.source]}"
            )
        else:
            yield "other shares of validation and test points"


def _stopping(training: Training) -> str:
    stop = training.early_stopping
    if stop is None:
        return "no early stopping"
    kept = ", best epoch kept" if stop.restore_best else ""
    return (
        f"early stopping (patience {stop.patience}, threshold {stop.min_delta_rad2:g} rad²{kept})"
    )


def _layers(method: Method) -> str:
    hidden = method.network.hidden
    if not hidden:
        return "no hidden layer"
    return f"{'-'.join(map(str, hidden))} neurons"


def _how_compared(data: ReportData) -> str:
    return (
        "Each row changes the study’s own network or training in what it says, and keeps the "
        "samples. Errors are compared seed by seed: below 100 % is better than the study’s "
        f"own. On {path_name(data, data.first_path)} it is the mean error, in the workspace the "
        "worst."
    )


def _pairs(theirs: pd.DataFrame, own: pd.DataFrame, quantity: str) -> pd.DataFrame:
    first, second = (side.rename(columns={quantity: "error_mm"}) for side in (theirs, own))
    return compare(first, second, np.random.default_rng(STREAM))


def _row(data: ReportData, name: str, pairs: dict[str, pd.DataFrame]) -> list[str | Number]:
    row: list[str | Number] = [name]
    for quantity in _QUANTITIES:
        cells = ratio_cells(pairs[quantity])
        row += [cells.get(grid.n, "") for grid in data.grids]
    return row


def _paragraph(
    data: ReportData,
    name: str,
    theirs: pd.DataFrame,
    own: pd.DataFrame,
    pairs: dict[str, pd.DataFrame],
) -> str:
    study = data.study
    what = differences(study.all_methods[NETWORK], study.all_methods[name])
    head = f"**{name}**: {joined(what)}" if what else f"**{name}**"
    path = pairs["path_mm"]
    first, last = path.iloc[0], path.iloc[-1]  # fewest and most samples
    errors = f"Its mean error on the path is {_ratio(first)} of the study’s own"
    if len(path) > 1:
        errors += f" with {_samples(first)} and {_ratio(last)} with {_samples(last)}"
    sentences = [f"{head}{_extra_steps(data, name)}.", f"{errors}.", _how_often(path)]
    worst = pairs["worst_mm"].iloc[-1]
    sentences.append(f"Its worst error in the workspace is {_ratio(worst)} with {_samples(worst)}.")
    if len(data.grids) > 1:
        sentences.append(_levelling(data, theirs, own))
    return " ".join(filter(None, sentences))


def _samples(row: "pd.Series[float]") -> str:
    return f"{thousands(row['n_samples'])} samples"


def _ratio(row: "pd.Series[float]") -> str:
    share = percent(float(row["ratio"]))
    if row["ratio_low"] == row["ratio_high"] == 1:
        return f"{share} (the very same networks)"
    if not np.isfinite(row["ratio_low"]):
        return share
    return f"{share} ({percent(float(row['ratio_low']))} to {percent(float(row['ratio_high']))})"


def _how_often(path: pd.DataFrame) -> str:
    """At how many sizes the difference is beyond the scatter of the seeds."""
    sizes = len(path)
    if not np.isfinite(path["ratio_low"]).any():
        return "So few seeds cannot say how sure that is."
    if sizes == 1:
        return ""
    better, worse = int((path["ratio_high"] < 1).sum()), int((path["ratio_low"] > 1).sum())
    if sizes in (better, worse):
        return f"It is {'smaller' if better else 'larger'} at all {sizes} sizes."
    same = int(((path["ratio_low"] == 1) & (path["ratio_high"] == 1)).sum())
    unclear = sizes - better - worse - same
    parts = [f"smaller at {better or 'none'} of {sizes} sizes, larger at {worse or 'none'}"]
    if same:
        parts.append(f"equal at {same}")
    if unclear:
        parts.append(f"lost in the scatter of the seeds at {unclear}")
    return f"It is {joined(parts)}."


def _levelling(data: ReportData, theirs: pd.DataFrame, own: pd.DataFrame) -> str:
    """How far the errors still fall from where the paper sees them level off."""
    before, after = levelling_pair(data.grids)
    falls = []
    for side in (theirs, own):
        by_n = side.set_index("seed").groupby("n_samples")["path_mm"]
        groups = dict(iter(by_n))
        if before.n not in groups or after.n not in groups:
            return ""
        falls.append(fall_interval(groups[before.n], groups[after.n]))
    ours, study_own = falls
    interval = f" (95 % interval {percent(ours.low)} to {percent(ours.high)})" if ours.known else ""
    return (
        f"From {before.n} to {after.n} samples its error {_falls(ours.value)}{interval}; the "
        f"study’s own {_falls(study_own.value)}."
    )


def _falls(value: float) -> str:
    return f"{'falls' if value >= 0 else 'rises'} by {percent(abs(value))}"


def _extra_steps(data: ReportData, name: str) -> str:
    """How many times the study's optimiser steps a network takes, where it is not as many."""
    methods = data.study.all_methods
    if methods[name].training.optimizer != methods[NETWORK].training.optimizer:
        return ""  # steps of different kinds
    ratios = []
    for grid in (data.grids[0], data.grids[-1]):
        cell = Cell(data.results, name, grid.samples.label)
        steps = cell.table("members")["steps"].mean() / grid.members["steps"].mean()
        ratios.append((float(steps), grid.n))
    if all(abs(ratio - 1) < 0.005 for ratio, _ in ratios):
        return ""
    (few, fewest), (many, most) = ratios
    if f"{few:.2g}" == f"{many:.2g}":
        return f", which takes {few:.2g} times the optimiser steps"
    return (
        f", which takes {few:.2g} times the optimiser steps with {fewest} samples and "
        f"{many:.2g} times with {most}"
    )
