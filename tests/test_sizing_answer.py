"""The answer: which number of samples, how sure, and in which words."""

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import validate

from iksamples.answer.answer import answer_schema, read_answer, recommend
from iksamples.answer.finding import samples_needed
from iksamples.answer.ladder import judge, needed_on_ladder, standing
from iksamples.answer.size import answer
from iksamples.errors import IksamplesError
from iksamples.study import parse_study


METHODS = {
    "tanh": {"network": {"activation": "tanh"}, "training": {"steps": 32000}},
    "table": {"kind": "multilinear"},
    "analytic": {"kind": "analytic"},
}


def make_study(tolerance=None, **settings):
    return parse_study({"name": "s", "tolerance": tolerance or {}, **settings})


def make_rows(errors, method="network", design="grid", certified=False, lower=None):
    """Outcomes of one line: points per axis -> errors of seeds 0, 1, ..."""
    return pd.DataFrame(
        [
            {
                "method": method,
                "design": design,
                "label": f"{design}{m}",
                "n_samples": m**3,
                "seed": seed,
                "error_mm": float(error),
                "certified": certified,
                "attained_mm": float(error if lower is None else lower),
            }
            for m, seeds in errors.items()
            for seed, error in enumerate(seeds)
        ]
    )


def met(n_met, n=20, good=1.0, bad=3.0):
    return [good] * n_met + [bad] * (n - n_met)


def told(one):
    return " ".join(one.sentences)


def test_the_smallest_rung_that_meets_the_wish_is_the_answer():
    one = answer(make_study(), make_rows({2: met(0), 3: met(19), 4: met(20), 5: met(20)}), [])
    network = one.method("network")
    assert (network.status, network.n_samples) == ("answered", 64)
    # 19 of 20 are not enough for 80 % with 95 % confidence, 20 of 20 are.
    assert network.below.n_samples == 27
    assert network.below.short == pytest.approx(0.8 - 0.78389, abs=1e-5)
    assert network.below.excess_mm == pytest.approx(1)
    assert network.rungs[2].success_lower == pytest.approx(0.05 ** (1 / 20))
    assert network.more_than is None
    assert network.kept_mm == 1
    assert one.ladder == [8, 27, 64, 125]


def test_a_lucky_rung_is_no_answer_and_is_named():
    one = answer(make_study(), make_rows({2: met(0), 3: met(20), 4: met(15), 5: met(20)}), [])
    network = one.method("network")
    assert (network.n_samples, network.not_counted) == (125, [27])
    assert "27 samples meet the wish as well, but 64 do not" in told(network)
    last = answer(make_study(), make_rows({2: met(20), 3: met(10)}), []).method("network")
    assert (last.status, last.n_samples, last.more_than) == ("open", None, 27)
    assert last.not_counted == [8]


def test_too_few_trainings_are_said_with_how_many_it_takes():
    one = answer(make_study(), make_rows({2: met(0, 10), 3: met(10, 10)}), [])
    network = one.method("network")
    assert (network.status, network.seeds_needed, network.n_samples) == ("more-seeds", 14, None)
    assert network.rungs[1].kept_mm is None
    assert "14 would be enough" in told(network)
    # One failure in twenty: with one, 22 would do, and a twentieth of 22 is one again.
    again = answer(make_study(), make_rows({2: met(0), 3: met(19)}), []).method("network")
    assert again.seeds_needed == 22


def test_the_best_of_several_needs_fewer_to_succeed():
    study = make_study({"best_of": 3})
    network = answer(study, make_rows({2: met(9), 3: met(13)}), []).method("network")
    # Share of single trainings at 95 %: 0.2586 and 0.4420; the best of 3: 0.593 and 0.826.
    assert network.rungs[0].success_lower == pytest.approx(0.593, abs=1e-3)
    assert network.rungs[1].success_lower == pytest.approx(0.826, abs=1e-3)
    assert network.n_samples == 27


def test_a_diverged_training_counts_as_failed():
    (rung,) = (
        answer(make_study(), make_rows({2: [*met(19, 19), np.inf]}), []).method("network").rungs
    )
    assert (rung.n_seeds, rung.n_met, rung.meets) == (20, 19, False)
    assert rung.error_worst_mm is None
    all_of_them = answer(make_study(), make_rows({2: [np.inf] * 20}), [])
    assert json.loads(all_of_them.to_json())["methods"][0]["rungs"][0]["kept_mm"] is None


def test_a_certificate_between_whose_bounds_the_tolerance_lies_decides_nothing():
    rows = make_rows({2: met(20), 3: met(18, bad=2.2)}, certified=True, lower=1.9)
    network = answer(make_study(), rows, []).method("network")
    assert network.rungs[1].n_undecided == 2
    assert (network.status, network.seeds_needed) == ("more-seeds", 37)
    assert "2 trainings counted as failed may succeed" in told(network)


def test_a_method_without_chance_meets_it_or_does_not():
    study = make_study(methods=METHODS)
    rows = pd.concat([make_rows({2: met(0)}), make_rows({2: [5], 3: [2.5], 4: [1.9]}, "table")])
    table = answer(study, rows, []).method("table")
    assert (table.status, table.n_samples, table.kept_mm) == ("answered", 64, 1.9)
    assert table.rungs[0].success_lower is None
    assert table.below.short is None
    assert table.below.excess_mm == pytest.approx(0.5)
    assert "confidence" not in told(table)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.floats(0.1, 10), min_size=15, max_size=15), min_size=1, max_size=5),
    st.floats(0.1, 10),
)
def test_what_a_rung_keeps_to_answers_every_tolerance(errors, tolerance_mm):
    rows = make_rows({2 + i: seeds for i, seeds in enumerate(errors)})
    rungs = judge(rows, make_study().tolerance, True)
    asked = judge(rows, make_study({"error_mm": tolerance_mm}).tolerance, True)
    expected = standing(asked)
    found = needed_on_ladder(rungs, tolerance_mm)
    assert (found and found.n_samples) == (expected and expected.n_samples)


def falling(floor, rng, ms=range(2, 9), seeds=20, spread=0.05, scale=30):
    """Errors that fall to a floor as a grid's do."""
    return {m: (floor + scale / (m - 1) ** 2) * np.exp(spread * rng.normal(size=seeds)) for m in ms}


def test_beyond_the_ladder_the_curve_is_used_and_says_so(rng):
    one = answer(make_study({"error_mm": 0.5}), make_rows(falling(0, rng)), [])
    network = one.method("network")
    assert network.status == "extrapolated"
    # 30 / (m - 1)^2 is 0.5 at m = 8.7; the scatter of four trainings in five adds a little.
    assert network.n_samples in [m**3 for m in range(9, 13)]
    assert network.more_than == 512
    assert network.kept_mm is None
    assert network.extrapolation.n_fit <= network.extrapolation.n_upper <= network.n_samples
    assert f"needs more than 512 (extrapolated: {network.n_samples}" in one.headline.replace(
        "\u202f", ""
    )
    assert "Extrapolated, not tried" in told(network)
    assert "fitted without the 512 samples" in told(network)


def test_a_floor_above_the_tolerance_is_not_reachable(rng):
    rows = make_rows(falling(2.5, rng))
    steps = make_study(training={"steps": 32000})
    network = answer(steps, rows, []).method("network")
    assert (network.status, network.n_samples) == ("unreachable", None)
    assert "Not reachable with this method, however many samples" in told(network)
    assert network.extrapolation.level_mm.low > 2
    assert network.extrapolation.reachable <= 0.05
    # With a number of epochs the training gets longer with the samples: no floor can be claimed.
    epochs = answer(make_study(), rows, []).method("network")
    assert epochs.status == "open"
    assert "more samples also train it longer" in told(epochs)


def test_a_curve_that_fails_its_test_is_not_extrapolated(rng):
    errors = falling(0, rng)
    errors[8] = errors[8] * 3
    network = answer(make_study({"error_mm": 0.5}), make_rows(errors), []).method("network")
    assert network.status == "open"
    assert "its learning curve misses them by" in told(network)


def test_two_rungs_are_no_learning_curve():
    network = answer(make_study(), make_rows({2: met(0), 3: met(0)}), []).method("network")
    assert network.status == "open"
    assert "too few numbers of samples for a learning curve" in told(network)


def test_samples_needed_is_the_answer_for_every_tolerance(rng):
    study = make_study({"error_mm": 1.0}, methods=METHODS)
    table = {m: [25 / (m - 1) ** 2] for m in range(2, 9)}
    rows = pd.concat([make_rows(falling(0, rng)), make_rows(table, "table")])
    tolerances = np.array([0.3, 0.6, 1.0, 4.0, 50.0])
    needed = samples_needed(study, rows, tolerances)
    assert list(needed.columns) == [
        "method", "design", "tolerance_mm", "n_samples", "status", "certified",
    ]  # fmt: skip
    for name, part in needed.groupby("method", sort=False):
        known = part["n_samples"].dropna()
        assert (np.diff(known) <= 0).all()
        for row in part.itertuples():
            asked = make_study({"error_mm": row.tolerance_mm}, methods=METHODS)
            one = answer(asked, rows, []).method(name)
            assert one.status == row.status
            assert (one.n_samples or 0) == np.nan_to_num(row.n_samples)
    # The table's own law, on the ladder and beyond.
    by_table = needed[needed["method"] == "table"].set_index("tolerance_mm")["n_samples"]
    assert by_table[0.6] == 8**3
    assert by_table[0.3] == 11**3  # 25 / (m - 1)^2 = 0.3 at m = 10.1
    default = samples_needed(study, rows)
    assert default["tolerance_mm"].nunique() == 60
    assert default.groupby("method")["tolerance_mm"].max().nunique() == 1


class TestWords:
    def test_certified_measured_and_more_than(self):
        study = make_study(methods=METHODS)
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(0), 5: met(0)}, certified=True),
                make_rows({3: met(0), 4: met(20, good=1.6), 5: met(20)}, "tanh", certified=True),
                make_rows({3: [3], 4: [2.1], 5: [1.41]}, "table"),
                make_rows({3: [0], 4: [0], 5: [0]}, "analytic"),
            ]
        )
        assert answer(study, rows, []).headline == (
            "For every point of the workspace within 2 mm, with 95 % confidence that at least 80 % "
            "of trainings succeed: 64 samples and tanh (16 tanh neurons, 32\u202f000 steps of Adam;"
            " certified: 1.60 mm); the paper's training needs more than 125; a look-up table of "
            "the same samples needs 125 (measured at 8\u202f200 points, not certified: 1.41 mm)."
        )

    def test_what_a_proof_takes_is_said_where_the_best_is_only_measured(self):
        study = make_study(methods={**METHODS, "cubic": {"kind": "cubic"}})
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(0), 5: met(0)}, certified=True),
                make_rows({3: [1.5], 4: [0.4], 5: [0.1]}, "cubic"),
                make_rows({3: [3], 4: [2.1], 5: [1.41]}, "table", certified=True),
            ]
        )
        assert answer(study, rows, []).headline.endswith(
            "27 samples and a cubic spline through the same samples (measured at 8\u202f200 "
            "points, not certified: 1.50 mm); a look-up table of the same samples needs 125 "
            "(certified: 1.41 mm); the paper's training needs more than 125."
        )

    def test_nothing_certified(self):
        one = answer(make_study(), make_rows({2: met(0), 3: met(20)}), [])
        assert one.headline == (
            "For all 8\u202f200 points measured in the workspace within 2 mm, with 95 % confidence "
            "that at least 80 % of trainings succeed: 27 samples and the paper's training "
            "(measured at 8\u202f200 points, not certified: 1.00 mm)."
        )
        assert one.method("network").sentences == [
            "With 27 samples 20 of 20 trainings succeed; with 95 % confidence at least 86 % of all "
            "trainings do. As sure as wished, it keeps to 1.00 mm (measured at 8\u202f200 points, "
            "not certified).",
            "One rung below it fails: with 8 samples 0 of 20 trainings succeed, where 80 % are "
            "wished. As sure as wished, it keeps to 3.00 mm, 1.00 mm too much.",
        ]

    def test_one_certificate_missing_is_not_certified(self):
        rows = make_rows({2: met(20)}, certified=True)
        rows.loc[3, "certified"] = False
        assert "not certified" in answer(make_study(), rows, []).headline

    @pytest.mark.parametrize(
        ("tolerance", "head"),
        [
            ({"of": "mean"}, "For a mean error of at most 2 mm over the workspace, with"),
            ({"of": "p99"}, "For 99 % of the workspace within 2 mm, with"),
            (
                {"where": "heart", "error_mm": 0.25},
                "For all 200 waypoints measured along the path heart within 0.25 mm, with",
            ),
            (
                {"best_of": 5, "success_share": 0.999, "confidence": 0.9},
                "For all 8\u202f200 points measured in the workspace within 2 mm, with 90 % "
                "confidence that the best of 5 trainings succeeds at least 99.9 % of the time: ",
            ),
        ],
    )
    def test_the_wish(self, tolerance, head):
        rows = make_rows({2: met(0), 3: met(20)})
        assert answer(make_study(tolerance), rows, []).headline.startswith(head)

    def test_a_lower_end_never_reads_as_more_than_it_is(self):
        # 18 of 20: 0.7174; 199 of 200: 0.97651.
        for n_met, n, text in ((18, 20, "71.7 %"), (199, 200, "97.6 %")):
            rows = make_rows({2: met(0, n), 3: met(n_met, n)})
            study = make_study({"success_share": 0.7})
            assert f"at least {text} of all" in told(answer(study, rows, []).method("network"))

    def test_designs_are_named_where_there_are_several(self):
        study = make_study(samples={"designs": ["grid", "sobol"]})
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(20)}),
                make_rows({3: met(20), 4: met(20)}, design="sobol"),
            ]
        )
        one = answer(study, rows, [])
        assert "27 samples at Sobol points and the paper's training" in one.headline
        assert "the paper's training on an even grid needs 64" in one.headline
        assert one.method("network", "sobol").n_samples == 27
        assert {(c.design, c.other_design) for c in one.comparisons} == {("sobol", "grid")}

    def test_the_exact_inverse_is_not_recommended(self):
        study = make_study(methods=METHODS)
        rows = pd.concat([make_rows({2: met(0)}), make_rows({2: [0]}, "analytic")])
        assert answer(study, rows, []).headline.endswith("the paper's training needs more than 8.")


class TestFile:
    @pytest.fixture
    def results(self, tmp_path):
        rows = make_rows({2: met(0), 3: met(20)}, certified=True)
        folder = tmp_path / "results" / "s"
        folder.mkdir(parents=True)
        self.answer = answer(make_study(), rows, [])
        (folder / "answer.json").write_text(self.answer.to_json(), encoding="utf-8")
        return folder

    def test_it_comes_back_as_it_was_and_follows_its_schema(self, results):
        assert read_answer(results) == self.answer
        validate(json.loads((results / "answer.json").read_text("utf-8")), answer_schema())

    def test_recommending_needs_nothing_but_the_file(self, results):
        text = recommend(results)
        assert text.startswith(self.answer.headline)
        for sentence in self.answer.method("network").sentences:
            assert sentence in text

    def test_a_method_that_is_not_there(self, results):
        with pytest.raises(IksamplesError, match="no method 'rbf'; there are network on grid"):
            read_answer(results).method("rbf")

    def test_an_unfinished_study(self, results):
        (results.parent / "other").mkdir()
        with pytest.raises(IksamplesError, match=r"other: no answer.json yet.*snakemake"):
            recommend(results.parent / "other")
        with pytest.raises(IksamplesError, match=r"no such results folder. Studies.*there: s\."):
            recommend(results.parent / "nowhere")

    def test_a_broken_file_or_another_version(self, results):
        path = results / "answer.json"
        content = json.loads(path.read_text("utf-8"))
        path.write_text(json.dumps({**content, "version": 2}), encoding="utf-8")
        with pytest.raises(IksamplesError, match="layout version 2"):
            recommend(results)
        for text in ("{", "[]", json.dumps({**content, "methods": 3})):
            path.write_text(text, encoding="utf-8")
            with pytest.raises(IksamplesError, match="Run the study again"):
                recommend(results)
