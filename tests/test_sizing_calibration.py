"""Whether answers keep their word on trainings they have not seen."""

import json
import subprocess

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from iksamples.answer.calibration import calibrate, read_calibrations
from iksamples.answer.collect import Variant, collect
from iksamples.answer.ladder import judge, standing
from iksamples.answer.outcomes import all_cells
from iksamples.answer.size import answer_study
from iksamples.certify.step import certify
from iksamples.errors import IksamplesError
from iksamples.evaluation.step import evaluate
from iksamples.results import cells
from iksamples.study import parse_study
from iksamples.task import study_task


VARIANT = Variant("network", "grid")


def tolerance_of(**settings):
    return parse_study({"name": "s", "tolerance": settings}).tolerance


def fresh(shares, n=200, good=1.0, bad=9.0):
    """Fresh trainings: number of samples -> how many of them meet it."""
    return pd.DataFrame(
        [
            {"label": f"n{samples}", "n_samples": samples, "error_mm": good if i < met else bad}
            for samples, met in shares.items()
            for i in range(n)
        ]
    )


def test_an_answer_that_keeps_its_word():
    found = calibrate(tolerance_of(), fresh({27: 90, 64: 190}), VARIANT, 64, 27)
    assert found.kept
    assert found.sharp
    assert found.at.success.value == 0.95
    assert found.statement == (
        "The answer keeps its word: with 64 samples, 190 of 200 fresh trainings meet the tolerance "
        "(95 %, 95 % interval 91 % to 97.6 %); promised were 80 %. One rung below, with 27 samples,"
        " 90 of 200 fresh trainings meet the tolerance (45 %, 95 % interval 38 % to 52.2 %): too "
        "few."
    )


def test_an_answer_that_does_not():
    found = calibrate(tolerance_of(), fresh({27: 90, 64: 120}), VARIANT, 64, 27)
    assert found.kept is False
    assert found.statement.startswith("The answer does not keep its word: with 64 samples, 120 of")


def test_a_rung_below_that_does_as_well_was_caution():
    found = calibrate(tolerance_of(), fresh({27: 180, 64: 190}), VARIANT, 64, 27)
    assert found.kept
    assert found.sharp is False
    assert found.statement.endswith("so the answer was more careful than it had to be.")


def test_what_the_interval_leaves_open_is_not_decided():
    found = calibrate(tolerance_of(), fresh({27: 161, 64: 159}), VARIANT, 64, 27)
    assert found.kept is None
    assert found.sharp is None
    assert found.statement.startswith(
        "Whether the answer keeps its word cannot be told from so few"
    )
    assert found.statement.endswith("it cannot be told whether that is enough.")


def test_the_best_of_three_and_no_rung_below():
    found = calibrate(tolerance_of(best_of=3), fresh({8: 100}), VARIANT, 8, None)
    assert found.at.success.value == pytest.approx(7 / 8)
    assert found.kept
    assert found.below is found.sharp is None
    assert "the best of 3 87.5 % of the time" in found.statement


def test_fresh_trainings_that_are_missing_are_named():
    with pytest.raises(IksamplesError, match="no fresh trainings with 27 samples"):
        calibrate(tolerance_of(), fresh({64: 190}), VARIANT, 64, 27)


@pytest.mark.slow
def test_a_study_checks_itself(command, tmp_path, chain):
    """Fresh networks lie beside the study's, are others than those, and are counted right."""
    results = tmp_path / "results"
    settings = {
        "name": "self",
        "samples": {"points_per_axis": [2, 3]},
        "training": {"seeds": 8, "epochs": 400},
        "methods": {"tanh": {"network": {"activation": "tanh"}, "training": {"seeds": 9}}},
        "evaluation": {"cube_points": 100},
        "tolerance": {"error_mm": 30, "success_share": 0.5},
        "calibration": {"seeds": 12},
    }
    study, file = parse_study(settings), tmp_path / "self.json"
    file.write_text(json.dumps(settings))
    subprocess.run([command, "samples", file, "--output", results / "samples"], check=True)
    sets = [results / f"samples/{label}.parquet" for label in ("grid2", "grid3")]
    subprocess.run([command, "train", file, *sets, "--output", results], check=True)
    for cell in all_cells(study, results):
        tables, _ = evaluate(study, study_task(study), cell.samples, cell.method, cell.folder)
        for name, table in tables.items():
            table.to_parquet(cell.folder / f"{name}.parquet")
    for method in study.all_methods:
        proofs = [
            certify(study, study_task(study), method, cell.samples, cell.folder)
            for cell in cells(study, results, method)
        ]
        pd.concat(proofs).to_csv(results / method / "certificates.csv", index=False)
    collect(study, results).to_parquet(results / "runs.parquet")
    found = answer_study(study, results)
    (results / "answer.json").write_text(found.to_json())
    output = results / "calibration.json"
    subprocess.run(
        [command, "calibrate", file, "--results", results, "--output", output], check=True
    )
    checks = read_calibrations(results)
    answered = [one for one in found.methods if one.status == "answered"]
    assert answered
    assert [check.method for check in checks] == [one.method for one in answered]
    for check in checks:
        fresh = results / "fresh" / f"{check.method}-grid"
        proofs = pd.read_csv(fresh / check.method / "certificates.csv")
        proofs = proofs[proofs["n_samples"] == check.at.n_samples]
        # Seeds 0 to 8 gave the answer, of whichever method.
        assert sorted(proofs["seed"]) == list(range(9, 21))
        assert check.at.n_seeds == 12
        assert check.at.n_met == (proofs["sup_upper_mm"] <= 30).sum()
        assert check.at.success.value == check.at.n_met / 12
        # Promised were 50 %.
        expected = {True: check.at.success.low >= 0.5, False: check.at.success.high < 0.5}
        assert check.kept is None or expected[check.kept]


def test_a_study_without_fresh_seeds_says_so(command, tmp_path):
    file = tmp_path / "s.yaml"
    file.write_text("name: s")
    arguments = [command, "calibrate", file, "--results", tmp_path, "-o", tmp_path / "c.json"]
    done = subprocess.run(arguments, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == (
        f"Error: {file}: calibration.seeds is 0; say how many fresh trainings, 200 for example.\n"
    )


def outcomes_of(rng, medians, seeds, spread=0.3):
    """Outcomes that scatter lognormally about a median for 2, 3, ... points per axis."""
    m = np.repeat(np.arange(2, 2 + len(medians)), seeds)
    error = np.repeat(medians, seeds) * np.exp(spread * rng.normal(size=len(m)))
    return pd.DataFrame(
        {
            "label": np.char.add("grid", m.astype(str)),
            "n_samples": m**3,
            "error_mm": error,
            "certified": False,
            "attained_mm": error,
        }
    )


def median_for(share, tolerance_mm, spread=0.3):
    """The median at which this share of trainings keeps to the tolerance."""
    return tolerance_mm * np.exp(-spread * norm.ppf(share))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shares", "seeds"),
    [
        # A learning curve, and curves that lie just below the wish all along: the worst case, in
        # which every rung that is recommended is a false one.
        ((0.05, 0.3, 0.7, 0.79, 0.9, 0.97, 0.99), 14),
        ((0.79,) * 7, 14),
        ((0.99, 0.99, 0.99, 0.79, 0.79, 0.99, 0.99), 30),
    ],
)
def test_answers_are_calibrated(shares, seeds, rng):
    """At the answer at least the promised share succeeds, as often as promised."""
    tolerance = tolerance_of(error_mm=2.0)
    medians = [median_for(share, 2.0) for share in shares]
    true_share = {(m + 2) ** 3: share for m, share in enumerate(shares)}
    repeats, false, any_rung = 500, 0, 0
    for _ in range(repeats):
        rungs = judge(outcomes_of(rng, medians, seeds), tolerance, True)
        found = standing(rungs)
        false += found is not None and true_share[found.n_samples] < 0.8
        lucky = next((rung for rung in rungs if rung.meets), None)
        any_rung += lucky is not None and true_share[lucky.n_samples] < 0.8
    # 1.6 standard errors above one in twenty.
    assert false / repeats <= 0.05 + 1.6 * np.sqrt(0.05 * 0.95 / repeats)
    if shares == (0.79,) * 7:
        # The first rung that meets it, whatever the larger ones do, would break the promise.
        assert any_rung / repeats > 0.15
        assert false > 0


@pytest.mark.slow
def test_fresh_trainings_confirm_the_answer(rng):
    """The whole circle: 40 seeds answer, 200 others check it, there and one rung below."""
    tolerance = tolerance_of(error_mm=2.0)
    medians = [median_for(share, 2.0) for share in (0.01, 0.2, 0.6, 0.97, 0.995)]
    answered, kept, sharp = 0, [], []
    for _ in range(60):
        found = standing(judge(outcomes_of(rng, medians, 40), tolerance, True))
        if found is None:
            continue
        below = (round(found.n_samples ** (1 / 3)) - 1) ** 3
        fresh_ones = outcomes_of(rng, medians, 200)
        result = calibrate(tolerance, fresh_ones, VARIANT, found.n_samples, below)
        answered += 1
        kept.append(result.kept)
        sharp.append(result.sharp)
    assert answered >= 57
    assert np.mean(kept) >= 0.95
    assert np.mean(sharp) >= 0.9
