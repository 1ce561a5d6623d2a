"""The report's answer, its comparisons, its certificates and its page of claims."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lxml import html
from test_report import ROOT, SMALL, cells_of, finished, random_features

from iksamples.answer.answer import Answer, read_answer
from iksamples.answer.calibration import calibrate, to_json
from iksamples.answer.collect import Variant, certificates, collect, read_runs
from iksamples.answer.finding import samples_needed
from iksamples.answer.outcomes import outcomes
from iksamples.answer.size import answer_study
from iksamples.arm.workspace import study_chain
from iksamples.certify.step import certify
from iksamples.evaluation.step import evaluate
from iksamples.report import (
    figures_answer,
    sections_answer,
    sections_certified,
    sections_changes,
    sections_claims,
    sections_methods,
)
from iksamples.report.blocks import Number, Table, Text
from iksamples.report.data import ReportData, read_report_data
from iksamples.report.verdict import verdict
from iksamples.report.wording import typeset
from iksamples.report.write import write_report
from iksamples.results import cells
from iksamples.study import Calibration, Method, Study, parse_study


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, Path, Path]]:
    """A study of two networks and a look-up table, with its answer."""
    folder = tmp_path_factory.mktemp("answered")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "config").symlink_to(ROOT / "config")
        results = folder / "results/small"
        study = finished(
            {
                "name": "small",
                "samples": {"points_per_axis": [2, 3, 4, 5]},
                "methods": {
                    "other": {"network": {"hidden": [12]}},
                    "table": {"kind": "multilinear"},
                },
                "training": {"seeds": 6},
                "tolerance": {"success_share": 0.5},
                **SMALL,
            },
            results,
        )
        chain = study_chain(study)
        for method in ("other", "table"):
            proofs = []
            for cell in cells(study, results, method):
                cell.folder.mkdir(parents=True)
                if method == "other":
                    network = random_features(cell.samples, study.seeds)
                    network.save(cell.folder / "weights.safetensors")
                    own = results / "network" / cell.label
                    for name in ("members", "history"):
                        table = pd.read_parquet(own / f"{name}.parquet")
                        table.to_parquet(cell.folder / f"{name}.parquet")
                tables, _ = evaluate(study, chain, cell.samples, method, cell.folder)
                for name, table in tables.items():
                    table.to_parquet(cell.folder / f"{name}.parquet")
                proofs.append(certify(study, chain, method, cell.samples, cell.folder))
            pd.concat(proofs).to_csv(results / method / "certificates.csv", index=False)
        certificates(study, results).to_csv(results / "certificates.csv", index=False)
        collect(study, results).to_parquet(results / "runs.parquet")
        (results / "answer.json").write_text(answer_study(study, results).to_json())
        rows = outcomes(study, read_runs(results))
        samples_needed(study, rows).to_csv(results / "samples-needed.csv", index=False)
        write_report(study, results, "reports/small")
        yield study, results, folder / "reports/small"


@pytest.fixture
def data(answered: tuple[Study, Path, Path]) -> ReportData:
    return read_report_data(*answered, "snakemake --cores 2")


def table_of(section: object, name: str) -> Table:
    return next(b for b in section.blocks if isinstance(b, Table) and b.name == name)  # type: ignore[attr-defined]


def with_answer(data: ReportData, answer: Answer | None) -> ReportData:
    other = replace(data)
    other.__dict__["answer"] = answer  # where the cached property keeps it
    return other


def test_the_answer_comes_first(answered: tuple[Study, Path, Path], data: ReportData) -> None:
    page = html.parse(answered[2] / "index.html").getroot()
    lines = [p.text_content() for p in page.xpath("//section[@id='verdict']/p")]
    headline = read_answer(answered[1]).headline
    lines = [line.replace("\u00a0", " ") for line in lines]
    assert lines[0] == headline.replace("'", "’")
    assert "125 samples and a look-up table of the same samples" in lines[0]
    assert lines[1:] == verdict(with_answer(data, None))
    assert page.xpath("//main/section/@id")[:3] == ["verdict", "answer", "methods"]
    text = (answered[2] / "README.md").read_text(encoding="utf-8")
    assert f"> {lines[0]}" in text
    assert len((answered[2] / "index.html").read_bytes()) < 3_000_000


def test_a_method_without_any_answer_is_an_empty_line(data: ReportData) -> None:
    """Too few seeds for any tolerance, beside a method that needs none."""
    needed = data.samples_needed
    assert needed is not None
    silent = needed.assign(
        n_samples=needed["n_samples"].where(needed["method"] != "other"), status="more-seeds"
    )
    axis = figures_answer.samples_needed(data, silent).axes[0]
    assert axis.lines
    alone = silent.assign(n_samples=float("nan"))
    assert figures_answer._stairs(axis, alone.iloc[:0], {}) is None


def test_no_answer_no_section(data: ReportData) -> None:
    assert sections_answer.how_many_samples(with_answer(data, None)) is None


def test_the_table_says_what_the_answer_says(data: ReportData) -> None:
    assert data.answer is not None
    section = sections_answer.how_many_samples(data)
    rows = {
        str(row[0]): [str(cell) for cell in row[1:]]
        for row in table_of(section, "table-answer").rows
    }
    table = rows["a look-up table of the same samples"]
    found = data.answer.method("table")
    assert found.kept_mm is not None
    assert table[:4] == [
        "**125**",
        "tried, and enough",
        f"{found.kept_mm:.2f}",
        "measured",
    ]
    assert found.below is not None
    assert table[4:] == ["64", f"{found.below.excess_mm:.2f}"]
    own = data.answer.method("network")
    kept = own.rungs[-1].kept_mm
    assert kept is not None
    network = rows[typeset(own.description)]
    assert network[0] == "> 125"
    assert network[4:] == ["125", f"{kept - 2:.2f}"]
    changed = own.model_copy(update={"status": "unreachable"})
    other = data.answer.model_copy(update={"methods": [changed]})
    again = table_of(sections_answer.how_many_samples(with_answer(data, other)), "table-answer")
    assert again.rows[0][1:3] == ["—", "not reachable, however many"]


def test_the_answers_text_is_set_with_care() -> None:
    assert typeset("A curve (a + b n^-c, a + b / (m - 1)^2) of the paper's") == (
        "A curve (a + b n^−c^, a + b / (m − 1)^2^) of the paper’s"
    )
    assert typeset("Levenberg-Marquardt, 16-16 neurons, relu-64") == (
        "Levenberg-Marquardt, 16-16 neurons, relu-64"
    )


def test_medians_of_the_methods_are_those_of_the_files(data: ReportData) -> None:
    section = sections_methods.methods_and_designs(data)
    mean, worst = (table_of(section, name) for name in ("table-mean", "table-worst"))
    errors = pd.read_parquet(data.results / "other/grid4/errors.parquet")
    middle = errors[errors["region"] == "cube"]["error_mean_mm"].median()
    row = next(row for row in mean.rows if row[0] == "other")
    assert isinstance(row[3], Number)
    assert row[3].value == pytest.approx(middle)
    proofs = pd.read_csv(data.results / "certificates.csv")
    own = proofs[(proofs["method"] == "network") & (proofs["label"] == "grid5")]
    row = next(row for row in worst.rows if row[0] == "the study’s network")
    assert isinstance(row[4], Number)
    assert row[4].value == pytest.approx(own["sup_upper_mm"].median())
    assert [row[0] for row in worst.rows][-1] == "look-up table (baseline)"


def test_one_method_on_one_design_is_not_compared(data: ReportData) -> None:
    alone = replace(data, study=data.study.model_copy(update={"methods": {}}))
    assert sections_methods.methods_and_designs(alone) is None
    assert sections_methods.readings(alone) is None


def test_readings_within_the_papers_spread_are_marked(data: ReportData) -> None:
    paper = data.table.set_index("n_samples")
    errors = data.every_error.copy()
    here = errors["method"] == "other"
    shift = np.where(errors["n_samples"] == 64, 2.0, 0.5)  # in units of the paper's ±
    target = errors["n_samples"].map(paper["paper_error_mm"])
    errors.loc[here, "path_mm"] = (
        target + shift * errors["n_samples"].map(paper["paper_error_sd_mm"])
    )[here]
    other = replace(data)
    other.__dict__["every_error"] = errors
    table = table_of(sections_methods.readings(other), "table-readings")
    row = next(row for row in table.rows if row[0] == "other")
    assert [str(cell).startswith("**") for cell in row[1:5]] == [True, True, False, True]
    assert str(row[5]) == "3"


def with_errors(data: ReportData, factors: dict[int, float], scatter: float = 0.0) -> ReportData:
    """The other network's errors as multiples of the study's own, by number of samples."""
    errors = data.every_error.copy()
    here, own = errors["method"] == "other", errors["method"] == "network"
    wobble = 1 + scatter * (-1.0) ** errors["seed"]
    for quantity in ("path_mm", "worst_mm"):
        base = errors[own].set_index(["n_samples", "seed"])[quantity]
        mine = base.reindex(pd.MultiIndex.from_frame(errors[["n_samples", "seed"]])).to_numpy()
        factor = errors["n_samples"].map(factors) * wobble
        errors.loc[here, quantity] = (mine * factor)[here]
    changed = replace(data)
    changed.__dict__["every_error"] = errors
    return changed


def test_each_change_gets_its_ratio_and_its_paragraph(data: ReportData) -> None:
    section = sections_changes.what_each_change_does(
        with_errors(data, {8: 0.5, 27: 1.0, 64: 1.3, 125: 0.8})
    )
    assert section is not None
    [row] = table_of(section, "table-changes").rows
    assert row == ["other", *(["**50**", "100", "**130**", "**80**"] * 2)]
    paragraph = str([block for block in section.blocks if isinstance(block, Text)][1].text)
    assert paragraph.startswith("**other**: 12 neurons instead of 16 neurons. Its mean error on ")
    assert (
        "is 50 % (50 % to 50 %) of the study’s own with 8 samples and 80 % (80 % to 80" in paragraph
    )
    assert "It is smaller at 2 of 4 sizes, larger at 1 and equal at 1." in paragraph


def test_a_difference_within_the_scatter_is_none(data: ReportData) -> None:
    section = sections_changes.what_each_change_does(
        with_errors(data, dict.fromkeys((8, 27, 64, 125), 1.0), scatter=0.2)
    )
    assert section is not None
    [row] = table_of(section, "table-changes").rows
    assert not any("**" in str(cell) for cell in row)
    assert "lost in the scatter of the seeds at 4" in str(section.blocks[-1])


def test_no_other_network_no_changes(data: ReportData) -> None:
    methods = {"table": data.study.methods["table"]}
    alone = replace(data, study=data.study.model_copy(update={"methods": methods}))
    assert sections_changes.what_each_change_does(alone) is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"network": {"hidden": [8, 8]}}, ["8-8 neurons instead of 16 neurons"]),
        ({"network": {"activation": "tanh"}}, ["tanh instead of ReLU"]),
        (
            {"training": {"steps": 32000}},
            ["32\u202f000 steps at every size instead of 500 epochs"],
        ),
        (
            {"training": {"batch_size": 1, "learning_rate": 0.01}},
            ["a learning rate of 0.01 instead of 0.001", "batches of 1 instead of 8"],
        ),
        (
            {"training": {"early_stopping": {"patience": 7}}},
            [
                "early stopping (patience 7, threshold 1e-05 rad²) instead of no early stopping",
            ],
        ),
        (
            {"training": {"held_out": {"source": "grid"}}},
            ["validation and test points among the samples instead of at fresh points"],
        ),
        ({"training": {"seeds": 3, "engine": "reference"}}, []),
    ],
)
def test_differences_in_words(changed: dict[str, object], words: list[str]) -> None:
    other = parse_study({"name": "s", "methods": {"other": changed}}).methods["other"]
    assert sections_changes.differences(Method(), other) == words


def test_fresh_trainings_are_printed(data: ReportData) -> None:
    assert sections_answer.fresh_trainings(data) is None
    study = data.study.model_copy(update={"calibration": Calibration(seeds=200)})
    fresh = pd.DataFrame(
        [
            {"label": f"grid{m}", "n_samples": m**3, "error_mm": 1.0 if seed < met else 9.0}
            for m, met in ((3, 40), (4, 190))
            for seed in range(200)
        ]
    )
    found = calibrate(study.tolerance, fresh, Variant("other", "grid"), 64, 27)
    file = data.results / "calibration.json"
    file.write_text(to_json([found]))
    try:
        section = sections_answer.fresh_trainings(replace(data, study=study))
    finally:
        file.unlink()
    assert section is not None
    rows = [[str(cell) for cell in row] for row in table_of(section, "table-fresh").rows]
    assert [row[1:6] for row in rows] == [
        ["64", "the answer", "200", "190", "95.0"],
        ["27", "one rung below", "200", "40", "20.0"],
    ]
    assert "The answer keeps its word" in str(section.blocks[0])


def test_the_certificates_are_printed(answered: tuple[Study, Path, Path]) -> None:
    page = html.parse(answered[2] / "index.html").getroot()
    shown = cells_of(page, "table-certified")
    table = pd.read_csv(answered[1] / "table.csv")
    for printed, (_, row) in zip(shown, table.iterrows(), strict=True):
        assert printed["sup_upper_mm"] == f"{row['sup_median_mm']:.2f}"
        assert printed["sup_worst_mm"] == f"{row['sup_worst_mm']:.2f}"
    text = page.xpath("//section[@id='certified']")[0].text_content()
    assert (
        "proved for the stored float32 weights read as exact real numbers, over the closed box, in "
        "real arithmetic; checked by a separate outward-rounded program."
    ) in text


def test_what_is_not_checked_or_not_finished_is_said(data: ReportData) -> None:
    assert data.proofs is not None
    own = data.proofs["method"] == "network"
    first = own & (data.proofs["seed"] == 0)
    other = replace(data)
    other.__dict__["proofs"] = data.proofs.assign(
        verified=data.proofs["verified"] & ~first, complete=~first
    )
    section = sections_certified.certified_worst_case(other)
    assert section is not None
    text = str(section.blocks[0])
    assert "for 20 of 24 networks checked by a separate outward-rounded program" in text
    assert "For 4 networks the search ended early" in text


def test_the_claims_follow_the_certificates(data: ReportData) -> None:
    def row(of: ReportData) -> list[str]:
        table = table_of(sections_claims.claims(of), "table-claims")
        return next([str(c) for c in row] for row in table.rows if "middle point" in str(row[0]))

    assert data.proofs is not None
    centre = data.proofs.copy()
    for axis, low in zip("xyz", data.study.workspace.lower_mm, strict=True):
        centre[f"argmax_{axis}_mm"] = low + 30 / (centre["samples_per_axis"] - 1)
    other = replace(data)
    other.__dict__["proofs"] = centre
    assert row(other)[2] == "**holds**"
    assert "24 have their worst point" in row(other)[3]
    corner = centre.assign(argmax_x_mm=20.0, argmax_y_mm=20.0, argmax_z_mm=0.0)
    other.__dict__["proofs"] = corner
    assert row(other)[2] == "**does not hold**"
    assert "24 of these at a corner" in row(other)[3]
    assert len(json.dumps(row(other))) < 1000
