"""The section that answers the study's question: how many samples, by which method, how sure."""

from iksamples.answer.answer import MethodAnswer
from iksamples.answer.words import described
from iksamples.report import figures_answer
from iksamples.report.blocks import Block, Column, Figure, Number, Section, Table, Text
from iksamples.report.data import ReportData
from iksamples.report.wording import percent, thousands, typeset
from iksamples.study import Tolerance


_STATUS = {
    "answered": "tried, and enough",
    "extrapolated": "extrapolated, not tried",
    "unreachable": "not reachable, however many",
    "more-seeds": "too few trainings to tell",
    "open": "not enough; how many would be is not known",
}
_FEW = 4
"""So many methods are told about in the Markdown twin, too."""


def how_many_samples(data: ReportData) -> Section | None:
    """The answer for every method; None where the study has none yet."""
    answer = data.answer
    if answer is None:
        return None
    blocks: list[Block] = [Text(_question(answer.tolerance))]
    needed = data.samples_needed
    if needed is not None and needed["n_samples"].notna().any():
        lines = "one line per method"
        if len(data.study.samples.designs) > 1:
            lines = "a panel per method and a line for each way of placing the samples"
        blocks.append(
            Figure(
                "samples-needed",
                "",
                f"Samples needed against tolerance ({figures_answer.error_words(data.study)}), "
                f"{lines}, at the share of trainings and the confidence asked for. Solid: tried "
                "and certified; dashed: tried and measured; dotted: extrapolated. A line ends "
                "where no number of samples is known to be enough, or at the largest tolerance "
                "asked about.",
                figures_answer.samples_needed(data, needed),
                (data.results / "samples-needed.csv").as_posix(),
                f"{figures_answer.__name__}.samples_needed",
            )
        )
    blocks.append(_table(data, answer.methods))
    brief = len(answer.methods) <= _FEW
    for one in answer.methods:
        where = f" ({one.design})" if len(data.study.samples.designs) > 1 else ""
        name = typeset(f"{one.description[0].upper()}{one.description[1:]}{where}")
        blocks.append(Text(f"**{name}.** {typeset(' '.join(one.sentences))}", in_readme=brief))
    return Section("answer", "How many samples", blocks)


def fresh_trainings(data: ReportData) -> Section | None:
    """How often trainings that had no part in the answer meet it; None where there are none."""
    found, study = data.calibrations, data.study
    if not study.calibration.seeds:
        return None
    if not found:
        nothing = "No network has an answer among the samples tried, so there is none to check."
        return Section("fresh-trainings", "Does the answer keep its word?", [Text(nothing)])
    several = len(study.samples.designs) > 1
    columns = [
        Column("method", text=True),
        *([Column("samples placed", text=True)] if several else []),
        Column("samples"),
        Column("", text=True),
        Column("fresh trainings"),
        Column("meet it", ours=True),
        Column("share", "%", ours=True),
        Column("95 % interval", "%", text=True),
    ]
    blocks: list[Block] = []
    rows: list[list[str | Number]] = []
    for one in found:
        name = typeset(described(study, one.method))
        head = [name, *([one.design] if several else [])]
        where = f" ({one.design})" if several else ""
        blocks.append(Text(f"**{name[0].upper()}{name[1:]}{where}.** {typeset(one.statement)}"))
        for rate, what in ((one.at, "the answer"), (one.below, "one rung below")):
            if rate:
                share = rate.success
                rows.append(
                    [
                        *head,
                        Number(rate.n_samples, 0),
                        what,
                        Number(rate.n_seeds, 0),
                        Number(rate.n_met, 0),
                        Number(100 * share.value, 1),
                        f"{100 * share.low:.1f} to {100 * share.high:.1f}",
                    ]
                )
    tolerance = study.tolerance
    best = "" if tolerance.best_of == 1 else f" by the best of {tolerance.best_of}"
    caption = (
        f"Trainings with seeds that had no part in the answer. Promised: {tolerance.error_mm:g} mm "
        f"met{best} at least {percent(tolerance.success_share)} of the time. Data: "
        f"`{(data.results / 'calibration.json').as_posix()}`."
    )
    blocks.append(Table(columns, rows, caption, "table-fresh"))
    return Section("fresh-trainings", "Does the answer keep its word?", blocks)


def _question(tolerance: Tolerance) -> str:
    what = {"worst": "worst error", "mean": "mean error"}.get(tolerance.of)
    where = "the workspace" if tolerance.where == "workspace" else f"path {tolerance.where}"
    luck = "any one training" if tolerance.best_of == 1 else f"the best of {tolerance.best_of}"
    return (
        f"Asked for: a {what or f'{tolerance.of} of the error'} over {where} of at most "
        f"{tolerance.error_mm:g} mm, by {luck}, at least {percent(tolerance.success_share)} of the "
        f"time, with {percent(tolerance.confidence)} confidence. The answer is the smallest number "
        "of samples that meets this together with all larger ones."
    )


def _table(data: ReportData, methods: list[MethodAnswer]) -> Table:
    several = len(data.study.samples.designs) > 1
    columns = [
        Column("method", text=True),
        *([Column("samples placed", text=True)] if several else []),
        Column("samples needed", text=True, ours=True),
        Column("", text=True),
        Column("keeps to", "mm"),
        Column("shown by", text=True),
        Column("samples", group="the rung below"),
        Column("fails by", "mm", group="the rung below"),
    ]
    rows: list[list[str | Number]] = []
    for one in methods:
        # Without an answer, the most samples tried are what fails.
        tried = one.rungs[-1]
        rung = next((r for r in one.rungs if r.n_samples == one.n_samples), tried)
        below = one.below.n_samples if one.below else None
        excess = one.below.excess_mm if one.below else None
        if one.status != "answered":
            below = tried.n_samples
            kept = tried.kept_mm
            excess = None if kept is None else kept - data.study.tolerance.error_mm
        how = "certified" if rung.n_certified == rung.n_seeds else "measured"
        rows.append(
            [
                typeset(one.description),
                *([one.design] if several else []),
                _needed(one),
                _STATUS[one.status],
                _number(one.kept_mm),
                how,
                Number(below if below else float("nan"), 0),
                _number(excess),
            ]
        )
    points = thousands(data.answer.n_points if data.answer else 0)
    caption = (
        "Keeps to: the smallest tolerance that is met at the share and confidence asked for. Where "
        "no number of samples tried is enough, the rung below is the largest tried. Certified: "
        f"proved for every point of the workspace; measured: at {points} points"
        + (", where the true worst case may not be" if data.study.tolerance.of == "worst" else "")
        + f". Data: `{(data.results / 'answer.json').as_posix()}`."
    )
    return Table(columns, rows, caption, "table-answer")


def _needed(one: MethodAnswer) -> str:
    if one.kind == "analytic":
        return "none"
    if one.status == "answered" and one.n_samples:
        return f"**{thousands(one.n_samples)}**"
    if one.status == "extrapolated" and one.n_samples:
        return f"about {thousands(one.n_samples)}"
    return "—" if one.status == "unreachable" else f"> {thousands(one.more_than or 0)}"


def _number(value: float | None) -> Number:
    return Number(float("nan") if value is None else value, 2)
