"""Readings of the paper: their options, the search, and the one that is shipped."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from iksamples.errors import IksamplesError
from iksamples.paper.equations import kept_reading, paper_table, reading_table
from iksamples.paper.options import QUESTIONS
from iksamples.paper.readings import (
    DENIABLE,
    FRESH_SEED,
    ROWS,
    Reading,
    best_reading,
    choose,
    compare,
    draw_readings,
    path_errors,
    rank,
    read_parts,
)
from iksamples.study import Readings, parse_study, read_study


ROOT = Path(__file__).parents[1]
SNAKEMAKE = [str(Path(sys.executable).with_name("snakemake")), "--cores", "1"]


def test_every_question_has_an_answer_that_contradicts_nothing() -> None:
    for question, options in QUESTIONS.items():
        assert options[0].standing != "contradicts", question
        assert len({option.name for option in options}) == len(options)
        assert all(option.words and option.where for option in options)
    assert Reading.named().contradicted == []
    against = Reading.named(activation="tanh", epochs="1000")
    assert against.contradicted == ["activation", "epochs"]


def test_the_letter_is_how_the_papers_study_reads_it() -> None:
    letter, paper = Reading.named().study(20), read_study(ROOT / "config/config.yaml")
    assert (letter.workspace, letter.network) == (paper.workspace, paper.network)
    assert letter.samples == paper.samples
    assert letter.training.model_copy(update={"snapshots": 50}) == paper.training
    rectangles = paper.evaluation.paths["rectangles"]
    assert next(iter(letter.evaluation.paths.values())) == rectangles


def test_a_draw_is_different_readings_that_all_can_be_trained() -> None:
    wanted = Readings(count=300)
    drawn = draw_readings(wanted)
    assert drawn == draw_readings(wanted)
    assert drawn != draw_readings(wanted.model_copy(update={"seed": 1}))
    assert len(set(drawn)) == len(drawn) == 300
    assert drawn[0] == Reading.named()
    for reading in drawn:
        reading.study(2)
    counts = np.bincount([len(reading.contradicted) for reading in drawn])
    assert len(counts) == 4
    assert counts.min() > 300 / 10
    for question, options in QUESTIONS.items():
        assert {reading.names[question] for reading in drawn} == {o.name for o in options}


def test_more_readings_than_are_found_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iksamples.paper.readings._ENOUGH_DRAWS", 1)
    with pytest.raises(IksamplesError, match="ask for fewer"):
        draw_readings(Readings(count=20_000))


def table_of(reading: Reading, away: float) -> pd.DataFrame:
    """Rows that are ``away`` of the paper's ± above its Table 1."""
    paper = paper_table()
    rows = pd.DataFrame(
        {
            "n_samples": paper["n_samples"],
            "n_seeds": 16,
            "n_diverged": 0,
            "error_mean_mm": paper["paper_error_mm"] + away * paper["paper_error_sd_mm"],
            "error_sd_mm": 0.1,
        }
    )
    return rows.assign(**reading.names)


@pytest.mark.parametrize(("away", "within", "twice"), [(0.0, 7, 7), (1.5, 0, 7), (-2.5, 0, 0)])
def test_the_distance_counts_in_units_of_the_papers_spread(
    away: float, within: int, twice: int
) -> None:
    found = compare(table_of(Reading.named(), away))
    assert found["off_sd"] == pytest.approx(abs(away))
    assert (found["within"], found["within_twice"]) == (within, twice)
    paper = paper_table()
    ratio = 1 + away * paper["paper_error_sd_mm"] / paper["paper_error_mm"]
    assert found["log_ratio"] == pytest.approx(np.sqrt(np.mean(np.log(ratio) ** 2)))


@pytest.mark.slow
def test_the_best_are_chosen_and_the_best_that_keep_each_word(rng: np.random.Generator) -> None:
    drawn = draw_readings(Readings(count=200))
    away = rng.permutation(np.linspace(0.5, 40, len(drawn)))
    rows = pd.concat(
        [table_of(reading, one) for reading, one in zip(drawn, away, strict=True)],
        ignore_index=True,
    )
    ranked = rank(rows)
    assert list(ranked["off_sd"]) == pytest.approx(sorted(away))
    chosen = choose(rows, 5)
    order = [drawn[i] for i in np.argsort(away)]
    assert chosen[:5] == order[:5]
    assert Reading.named() in chosen
    for question in DENIABLE:
        assert next(r for r in order if question not in r.contradicted) in chosen
    for number in range(4):
        assert next(r for r in order if len(r.contradicted) == number) in chosen
    best = json.loads(best_reading(rows))
    assert best["options"] == order[0].names
    assert [row["n_samples"] for row in best["rows"]] == list(paper_table()["n_samples"])


KNOWN = {
    "16-16 ReLU, 1000 epochs": (
        {"path": "rectangles 5 mm inside", "neurons": "16-16", "epochs": "1000"},
        "points of the grid",
        [19.8, 4.61, 2.72, 2.11, 1.77],
    ),
    "16 tanh": (
        {
            "workspace": "x, y 10 to 70, z 0 to 60",
            "path": "rectangles 15 mm inside",
            "activation": "tanh",
        },
        "fresh points",
        [16.6, 5.46, 4.02, 2.21, 1.65, 1.57, 1.39],
    ),
    "32 ReLU": (
        {
            "workspace": "x, y 20 to 80, z −10 to 50",
            "path": "rectangles 5 mm inside",
            "neurons": "32",
        },
        "points of the grid",
        [20.8, 5.26, 3.32, 2.34, 1.91],
    ),
}
"""Means of 100 networks that another program found for three readings [mm]."""


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN)
def test_readings_that_others_have_trained_come_out_the_same(name: str) -> None:
    options, held_out, known = KNOWN[name]
    study = Reading.named(**options, **{"held out": held_out}).study(32)
    for m, theirs in enumerate(known, start=2):
        ours = path_errors(study, m)
        uncertainty = ours.std(ddof=1) * np.sqrt(1 / len(ours) + 1 / 100)
        assert ours.mean() == pytest.approx(theirs, abs=4 * uncertainty + 0.02)


def test_the_shipped_reading_is_what_training_it_gives() -> None:
    kept = kept_reading()
    reading = Reading.named(**kept["options"])
    assert kept["options"] == reading.names
    assert kept["contradicts"] == reading.contradicted
    assert kept["first_seed"] == FRESH_SEED
    assert all(list(row) == list(ROWS) for row in kept["rows"])
    study = reading.study(kept["rows"][0]["n_seeds"], FRESH_SEED)
    for m in (2, 3):
        error = path_errors(study, m)
        row = reading_table().loc[m]
        # Weights may differ in their last digits between machines.
        assert error.mean() == pytest.approx(row["reading_error_mm"], rel=2e-3)
        assert error.std(ddof=1) == pytest.approx(row["reading_error_sd_mm"], rel=2e-2)


def test_the_shipped_reading_is_near_the_papers_table() -> None:
    rows = pd.DataFrame(kept_reading()["rows"])
    assert compare(rows)["within_twice"] == len(paper_table())


def test_what_the_readings_would_ignore_is_refused() -> None:
    settings = {"name": "few", "title": "Few", "readings": {"count": 3}}
    study = parse_study(settings)
    # As the jobs read it, with every setting said.
    assert parse_study(study.model_dump(mode="json")) == study
    for ignored in (
        {"training": {"seeds": 3}},
        {"robot": {"urdf": "other.urdf"}},
        {"methods": {"spline": {"kind": "cubic"}}},
    ):
        with pytest.raises(
            IksamplesError, match=f"'readings' .* leave out '{next(iter(ignored))}'"
        ):
            parse_study(settings | ignored)


@pytest.mark.slow
def test_check_and_plan_describe_the_readings(tmp_path: Path, command: str) -> None:
    """Their networks are those that the two trainings leave, counted by hand."""
    study = tmp_path / "few.yaml"
    study.write_text(
        "name: few\nreadings: {count: 3, seeds: 2, best: 1, fresh_seeds: 5, jobs: 2}\n"
    )

    def said(question: str) -> str:
        call = [command, question, str(study)]
        return subprocess.run(call, cwd=ROOT, check=True, capture_output=True, text=True).stdout

    # Three readings on the seven grids of Table 1; no more than all three are trained again.
    assert "few: valid" in said("check")
    for text in (said("check"), said("plan")):
        assert f"{3 * 7 * 2} networks" in text
        assert f"at most {3 * 7 * 5} networks" in text
        assert "methods" not in text


@pytest.mark.slow
def test_a_search_from_its_study_to_its_page(tmp_path: Path, command: str) -> None:
    """The steps by hand, on a search of three readings."""
    folder = tmp_path / "results/few"
    folder.mkdir(parents=True)
    study = tmp_path / "few.yaml"
    study.write_text(
        "name: few\ntitle: Which <b>few</b>?\n"
        "readings: {count: 3, seeds: 2, best: 1, fresh_seeds: 2, jobs: 2, seed: 5}\n"
    )

    def step(*arguments: str | Path) -> None:
        call = [command, "readings", *map(str, arguments)]
        subprocess.run(call, cwd=ROOT, check=True, capture_output=True)

    parts = [folder / f"search/{part}.csv" for part in range(2)]
    for part, file in enumerate(parts):
        step("search", study, "--part", str(part), "--output", file)
    fresh = [folder / f"fresh/{part}.csv" for part in range(2)]
    for part, file in enumerate(fresh):
        step("confirm", study, *parts, "--part", str(part), "--output", file)
    best, ranked = folder / "best.json", folder / "readings.csv"
    step("rank", *fresh, "--output", ranked, "--best", best)
    # What a run with other jobs left is no part of this one.
    strange = pd.read_csv(parts[0]).assign(epochs="1000", error_mean_mm=1e-3)
    for file in (folder / "search/7.csv", folder / "fresh/7.csv"):
        strange.to_csv(file, index=False)
    step("report", study, "--results", folder, "--output", tmp_path / "reports/few")

    table = pd.read_csv(ranked, dtype=dict.fromkeys(QUESTIONS, str))
    assert table["off_sd"].is_monotonic_increasing
    assert json.loads(best.read_text())["options"] == table.iloc[0][list(QUESTIONS)].to_dict()
    page = (tmp_path / "reports/few/README.md").read_text()
    for row in table.to_dict("records"):
        assert f"{row['off_sd']:.2f}" in page
    assert "<b>few" not in page
    assert f"{len(table)} of them again" in page
    assert (tmp_path / "reports/few/index.html").exists()
    assert "few/index.html" in (tmp_path / "reports/index.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "planned", "not_planned"),
    [
        ("paper: true", {"bounds", "table", "report"}, {"search"}),
        ("paper: false", {"report", "track"}, {"bounds", "table", "search"}),
        (
            "readings: {count: 9, jobs: 3}\ntitle: '{x} {wildcards.study} {input}'",
            {"search", "confirm", "rank", "page"},
            {"train"},
        ),
    ],
)
def test_what_is_the_papers_runs_for_its_studies_alone(
    tmp_path: Path, settings: str, planned: set[str], not_planned: set[str]
) -> None:
    study = tmp_path / "some.yaml"
    study.write_text(f"name: some-never-run\n{settings}\n")
    call = [*SNAKEMAKE, "-n", "--configfile", str(study), "--directory", str(tmp_path)]
    (tmp_path / "config").symlink_to(ROOT / "config")
    run = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=True)
    rules = {line.split()[0] for line in run.stdout.splitlines() if line.strip()}
    assert planned <= rules
    assert not not_planned & rules


def test_parts_without_any_reading_are_refused(tmp_path) -> None:
    pd.DataFrame(columns=[*QUESTIONS, *ROWS]).to_csv(tmp_path / "part.csv", index=False)
    with pytest.raises(IksamplesError, match=r"part\.csv: no readings"):
        read_parts([tmp_path / "part.csv"])
