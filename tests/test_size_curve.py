"""Anybody's learning curve: read in every usual form, sized as our own, faults named by row."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest
from typer.testing import CliRunner

from iksamples.answer.assess import answer
from iksamples.answer.collect import outcomes
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.curve import read_curve
from iksamples.recorded.told import number
from iksamples.study import parse_study


SIZES = (8, 27, 64, 125, 216, 343)


def curve(seeds=20, scale=40.0, exponent=0.7, scatter=0.05):
    rng = np.random.default_rng(1)
    return pd.DataFrame(
        [
            (n, seed, scale * n**-exponent * np.exp(scatter * rng.normal()))
            for n in SIZES
            for seed in range(seeds)
        ],
        columns=["n", "seed", "error_mm"],
    )


def size(path, table, *options):
    path.write_text(table if isinstance(table, str) else table.to_csv(index=False))
    return CliRunner().invoke(app, ["size", "--curve", str(path), *options])


def test_the_answer_and_its_confidence(tmp_path):
    table = curve()
    said = size(tmp_path / "runs.csv", table, "--tolerance-mm", "1.5")
    assert said.exit_code == 0
    met = table.assign(met=table["error_mm"] <= 1.5).groupby("n")["met"].sum()
    enough = {n: binomtest(k, 20, 0.8, "greater").pvalue <= 0.05 for n, k in met.items()}
    least = min(n for n in SIZES if all(enough[m] for m in SIZES if m >= n))
    below = SIZES[SIZES.index(least) - 1]
    assert f"with 95 % confidence: {least} samples will do; {below} do not." in said.output
    middle = table[table["n"] == least]["error_mm"].median()
    row = next(
        line.split() for line in said.output.splitlines() if line.split()[:1] == [str(least)]
    )
    assert row[:3] == [str(least), "20", str(met[least])]
    assert float(row[-3]) == pytest.approx(middle, rel=5e-3)
    assert "nothing more has to be recorded" in said.output


def test_beyond_the_sizes_there_are(tmp_path):
    # A power law to the letter: 0.6 mm is reached at (40 / 0.6)^(1 / 0.7) = 403 samples.
    said = size(tmp_path / "runs.csv", curve(scatter=1e-3), "--tolerance-mm", "0.6")
    assert "more than 343 samples" in said.output
    low, high = (
        int(one) for one in said.output.split("between ")[1].split(" samples")[0].split(" and ")
    )
    assert 343 <= low < 403 < high < 2 * 343
    flat = curve(exponent=0.01, scale=3)
    said = size(tmp_path / "runs.csv", flat, "--tolerance-mm", "0.5").output
    assert "Not extrapolated: its learning curve" in said
    assert "record until there are 515" in said  # half more than the most there are


def test_too_few_runs_are_no_answer(tmp_path):
    said = size(tmp_path / "runs.csv", curve(seeds=3), "--tolerance-mm", "50").output
    assert "more runs are within than have to be, but too few to be sure; 14 runs would" in said
    assert 0.8**13 > 0.05 >= 0.8**14


FORMS = {
    "metres": (lambda t: t.assign(error_m=t.error_mm / 1000).drop(columns="error_mm"), "mm", 1),
    "brackets": (lambda t: t.rename(columns={"error_mm": "Error [mm]"}), "mm", 1),
    "degrees": (lambda t: t.rename(columns={"error_mm": "error_deg"}), "deg", 1),
    "radians": (lambda t: t.rename(columns={"error_mm": "error_rad"}), "deg", 180 / np.pi),
    "no unit": (lambda t: t.rename(columns={"error_mm": "error"}), "", 1),
    "other names": (lambda t: t.rename(columns={"n": "n_samples", "seed": "run"}), "mm", 1),
    "another order": (
        lambda t: t.sample(frac=1, random_state=0)[["seed", "error_mm", "n"]],
        "mm",
        1,
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_units_and_names(tmp_path, form):
    change, unit, factor = FORMS[form]
    table, path = curve(), tmp_path / "runs.csv"
    path.write_text(change(table).to_csv(index=False))
    runs, found = read_curve(path)
    assert found == unit
    both = runs.merge(table, left_on=["n_samples", "seed"], right_on=["n", "seed"])
    assert len(both) == len(table)
    np.testing.assert_allclose(both["error_max_mm"], factor * both["error_mm"])


def test_a_unit_below_the_names(tmp_path):
    (tmp_path / "runs.csv").write_text("n,seed,error\n,,cm\n8,0,1.5\n8,1,2\n")
    runs, unit = read_curve(tmp_path / "runs.csv")
    assert (unit, list(runs["error_max_mm"])) == ("mm", [15, 20])


def test_a_training_that_failed_counts(tmp_path):
    (tmp_path / "runs.csv").write_text("n,seed,error_mm\n8,0,inf\n8,1,2\n")
    runs, _ = read_curve(tmp_path / "runs.csv")
    size = answer(parse_study({"name": "s"}), outcomes(parse_study({"name": "s"}), runs))
    (one,) = size.variants[0].sizes
    assert (one.n_seeds, one.n_met, one.error_worst_mm) == (2, 1, np.inf)


REFUSED = {
    "a run twice": ("8,0,1\n8,1,1\n8,0,2\n", "row 3 (line 4) has the n and the seed of row 1"),
    "half a sample": ("8.5,0,1\n", "row 1 (line 2) is no number of samples"),
    "a negative error": ("8,0,1\n8,1,-1\n", "row 2 (line 3) has an error below zero"),
    "NaN": ("8,0,1\n8,1,nan\n", "row 2 (line 3) has 'nan' as error_mm"),
    "nothing": ("8,0,\n", "row 1 (line 2) has nothing as error_mm"),
    "a size in mm": ("8,0,1\n", "n_mm: mm is no unit of n; it has none"),
    "a unit that is none": ("-,-,mm\n8,0,1\n8,0,1\n", "has the n and the seed of row 1"),
    "half a seed": ("8,0.5,1\n", "row 1 (line 2) is no whole seed"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_faults_are_named_by_row(tmp_path, fault):
    rows, message = REFUSED[fault]
    names = "n_mm,seed,error_mm" if fault == "a size in mm" else "n,seed,error_mm"
    (tmp_path / "runs.csv").write_text(f"{names}\n{rows}")
    with pytest.raises(IksamplesError) as caught:
        read_curve(tmp_path / "runs.csv")
    assert message in str(caught.value)


def test_a_missing_column_and_a_tolerance_of_another_unit(tmp_path):
    (tmp_path / "runs.csv").write_text("n,error_mm\n8,1\n")
    with pytest.raises(IksamplesError, match="no column seed"):
        read_curve(tmp_path / "runs.csv")
    said = size(tmp_path / "runs.csv", curve(), "--of", "mean", "--robot", "arm.urdf")
    assert "--robot, --of: of no use to a learning curve" in str(said.exception)
    said = size(tmp_path / "runs.csv", curve(), "--tolerance-deg", "1")
    assert isinstance(said.exception, IksamplesError)
    assert "its errors are in mm; say what is allowed with --tolerance-mm" in str(said.exception)


@pytest.mark.parametrize(
    ("value", "text"), [(0, "0"), (1.2345, "1.23"), (123456, "1.23e+05"), (float("inf"), "none")]
)
def test_three_figures(value, text):
    assert number(value) == text


def test_sizes_with_seeds_of_their_own_are_judged_as_others_are(tmp_path):
    """A curve whose seeds are numbered through has none that all sizes have."""
    table = curve()
    through = table.assign(seed=np.arange(len(table)))
    same = [size(tmp_path / "c.csv", one, "--tolerance-mm", "1.5") for one in (table, through)]
    assert [one.exit_code for one in same] == [0, 0]
    for line in same[0].output.splitlines()[:2]:
        assert line in same[1].output
