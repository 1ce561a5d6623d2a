"""The answer: which number of samples, how sure, and in which words."""

import json
import os

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import validate

from iksamples.answer.answer import Answer, newest, read_answer, recommend
from iksamples.answer.assess import answer, samples_needed
from iksamples.answer.collect import variants
from iksamples.answer.sizes import answer_of, judge
from iksamples.errors import IksamplesError
from iksamples.study import parse_study
from iksamples.text import millimetres


METHODS = {
    "tanh": {"network": {"activation": "tanh"}, "training": {"steps": 32000}},
    "table": {"kind": "multilinear"},
    "nominal": {"kind": "nominal"},
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
                "region_share": 1.0,
                "n_points": 8200,
                "attained_mm": float(error if lower is None else lower),
                "failed": "" if np.isfinite(error) else "it diverged",
            }
            for m, seeds in errors.items()
            for seed, error in enumerate(seeds)
        ]
    )


def met(n_met, n=20, good=1.0, bad=3.0):
    return [good] * n_met + [bad] * (n - n_met)


def sizes_of(study, rows):
    """The sizes of the only variant."""
    (sizes,) = judge(study, variants(rows))[1].values()
    return sizes


def told(one):
    return " ".join(one.sentences)


def test_the_smallest_size_that_meets_the_tolerance_is_the_answer():
    one = answer(make_study(), make_rows({2: met(0), 3: met(19), 4: met(20), 5: met(20)}))
    network = one.variant("network")
    assert (network.status, network.n_samples) == ("answered", 64)
    # 19 of 20 are not enough for 80 % with 95 % confidence, 20 of 20 are.
    assert network.smaller.n_samples == 27
    assert network.smaller.success_rate_lcb == pytest.approx(0.78389, abs=1e-5)
    assert network.smaller.tolerance_bound_mm == 3
    assert network.sizes[2].success_rate_lcb == pytest.approx(0.05 ** (1 / 20))
    assert network.shown == network.found == network.sizes[2]
    assert network.found.tolerance_bound_mm == 1
    assert one.sizes == [8, 27, 64, 125]


def test_a_lucky_size_is_no_answer_and_is_named():
    one = answer(make_study(), make_rows({2: met(0), 3: met(20), 4: met(15), 5: met(20)}))
    network = one.variant("network")
    assert network.n_samples == 125
    assert "27 samples meet it as well, but a larger size does not" in told(network)
    last = answer(make_study(), make_rows({2: met(20), 3: met(10)})).variant("network")
    assert (last.status, last.n_samples, last.shown.n_samples) == ("open", None, 27)
    assert "8 samples meet it as well" in told(last)


def test_too_few_trainings_are_said_with_how_many_it_takes():
    one = answer(make_study(), make_rows({2: met(0, 10), 3: met(10, 10)}))
    network = one.variant("network")
    assert (network.status, network.seeds_needed, network.n_samples) == ("more-seeds", 14, None)
    assert np.isinf(network.sizes[1].tolerance_bound_mm)
    assert "14 would (training.seeds)" in told(network)
    # One failure in twenty: with one, 22 would do, and a twentieth of 22 is one again.
    again = answer(make_study(), make_rows({2: met(0), 3: met(19)})).variant("network")
    assert again.seeds_needed == 22


def test_the_best_of_several_needs_fewer_to_succeed():
    study = make_study({"best_of": 3})
    network = answer(study, make_rows({2: met(9), 3: met(13)})).variant("network")
    # Share of single trainings at 95 %: 0.2586 and 0.4420; the best of 3: 0.593 and 0.826.
    assert network.sizes[0].success_rate_lcb == pytest.approx(0.593, abs=1e-3)
    assert network.sizes[1].success_rate_lcb == pytest.approx(0.826, abs=1e-3)
    assert network.n_samples == 27


def test_a_diverged_training_counts_as_failed():
    (size,) = sizes_of(make_study(), make_rows({2: [*met(19, 19), np.inf]}))
    assert (size.n_seeds, size.n_met, size.meets) == (20, 19, False)
    assert np.isinf(size.error_worst_mm)
    assert (size.n_failed, size.why) == (1, "it diverged")
    some = answer(make_study(), make_rows({2: [*met(19, 19), np.inf], 3: met(20)}))
    assert len(some.failures) == 2
    assert some.failures[0].startswith("1 of 2 combinations")
    assert "grid2: 1 of 20 trainings" in some.failures[1]
    assert answer(make_study(), make_rows({2: met(3)})).failures == []
    all_of_them = answer(make_study(), make_rows({2: [np.inf] * 20}))
    content = json.loads(all_of_them.to_json())
    assert content["variants"][0]["sizes"][0]["tolerance_bound_mm"] is None


def test_a_certificate_between_whose_bounds_the_tolerance_lies_decides_nothing():
    rows = make_rows({2: met(20), 3: met(18, bad=2.2)}, certified=True, lower=1.9)
    network = answer(make_study(), rows).variant("network")
    assert network.sizes[1].n_undecided == 2
    assert (network.status, network.seeds_needed) == ("more-seeds", 37)
    assert "2 trainings counted as failed may succeed" in told(network)


def test_a_method_without_chance_meets_it_or_does_not():
    study = make_study(methods=METHODS)
    rows = pd.concat([make_rows({2: met(0)}), make_rows({2: [5], 3: [2.5], 4: [1.9]}, "table")])
    table = answer(study, rows).variant("table")
    assert (table.status, table.n_samples) == ("answered", 64)
    assert table.found.tolerance_bound_mm == 1.9
    assert table.sizes[0].success_rate_lcb is None
    assert table.smaller.tolerance_bound_mm == 2.5
    assert "confidence" not in told(table)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.floats(0.1, 10), min_size=15, max_size=15), min_size=1, max_size=5),
    st.floats(0.1, 10),
)
def test_the_tolerance_bounds_of_the_sizes_answer_every_tolerance(errors, tolerance_mm):
    rows = make_rows({2 + i: seeds for i, seeds in enumerate(errors)})
    bounds = [size.tolerance_bound_mm for size in sizes_of(make_study(), rows)]
    found = answer_of(sizes_of(make_study({"error_mm": tolerance_mm}), rows))
    fitting = [bound <= tolerance_mm for bound in bounds]
    expected = None
    for position in reversed(range(len(fitting))):
        if not fitting[position]:
            break
        expected = (2 + position) ** 3
    assert (found and found.n_samples) == expected


def falling(floor, rng, ms=range(2, 9), seeds=20, spread=0.02, scale=30):
    """Errors that fall to a floor as a grid's do."""
    return {m: (floor + scale / (m - 1) ** 2) * np.exp(spread * rng.normal(size=seeds)) for m in ms}


def test_beyond_the_sizes_tried_the_curve_is_used_and_says_so(rng):
    errors = {m: 30 / m**2 * np.exp(0.01 * rng.normal(size=20)) for m in range(2, 9)}
    one = answer(make_study({"error_mm": 0.4}), make_rows(errors))
    network = one.variant("network")
    assert network.status == "extrapolated"
    # 30 / m^2 is 0.4 at m = 8.66; the scatter of four trainings in five adds a little.
    assert network.n_samples in (9**3, 10**3)
    needed = network.extrapolation.needed
    assert needed.low <= 8.7**3 <= needed.high <= network.n_samples
    assert f"needs more than 512 (extrapolated: {network.n_samples}" in one.headline.replace(
        "\u202f", ""
    )
    assert "Extrapolated, not tried" in told(network)


def test_a_curve_that_levels_off_asks_for_more_samples_first(rng):
    network = answer(make_study(), make_rows(falling(2.5, rng))).variant("network")
    assert (network.status, network.n_samples) == ("open", None)
    assert network.extrapolation.reason in told(network)
    assert "Record more first, for example 1\u202f000 samples" in told(network)


def test_two_sizes_are_no_learning_curve():
    network = answer(make_study(), make_rows({2: met(0), 3: met(0)})).variant("network")
    assert network.status == "open"
    assert network.curve is None
    assert "no learning curve" in told(network)


@pytest.mark.slow
def test_samples_needed_is_the_answer_for_every_tolerance(rng):
    study = make_study({"error_mm": 1.0}, methods=METHODS)
    table = {m: [25 / (m - 1) ** 2] for m in range(2, 9)}
    rows = pd.concat([make_rows(falling(0, rng)), make_rows(table, "table")])
    tolerances = np.array([0.3, 0.48, 0.6, 0.63, 1.0, 4.0, 50.0])
    needed = samples_needed(study, rows, tolerances)
    assert list(needed.columns) == [
        "method", "design", "tolerance_mm", "n_samples", "status", "certified",
    ]  # fmt: skip
    assert needed["tolerance_mm"].tolist() == [*tolerances, *tolerances]
    for name, part in needed.groupby("method", sort=False):
        known = part["n_samples"].dropna()
        assert (np.diff(known) <= 0).all()
        for row in part.itertuples():
            asked = make_study({"error_mm": row.tolerance_mm}, methods=METHODS)
            one = answer(asked, rows).variant(name)
            assert one.status == row.status
            assert (one.n_samples or 0) == np.nan_to_num(row.n_samples)
    # The table's own law, on the sizes tried and beyond.
    by_table = needed[needed["method"] == "table"].set_index("tolerance_mm")["n_samples"]
    assert by_table[0.6] == 8**3
    assert by_table[0.48] in (9**3, 10**3)  # 25 / (m - 1)^2 = 0.48 at m = 8.2
    default = samples_needed(study, rows)
    assert default["tolerance_mm"].nunique() == 60
    assert default.groupby("method")["tolerance_mm"].max().nunique() == 1


NETWORKS = {f"n{i}": {"network": {"hidden": [i + 1]}} for i in range(4)}


class TestTogether:
    """The confidence holds for all variants at once."""

    def rows(self, errors):
        return pd.concat([make_rows(of_one, name) for name, of_one in errors.items()])

    def test_it_is_shared_by_the_variants_that_chance_has_a_part_in(self):
        methods = {**NETWORKS, "table": {"kind": "multilinear"}}
        names = ["network", *NETWORKS]
        rows = self.rows({name: {2: met(0), 3: met(20)} for name in names} | {"table": {3: [1.0]}})
        one = answer(make_study(methods=methods), rows)
        assert one.confidence.n_variants == 5
        # 0.8^20 = 0.0115 is more than 0.05 / 5: no training in twenty is one too few.
        assert one.confidence.each == pytest.approx(0.99)
        assert {two.status for two in one.variants if two.kind == "network"} == {"more-seeds"}
        assert {two.seeds_needed for two in one.variants if two.kind == "network"} == {21}
        assert one.variant("table").status == "answered"
        four = answer(make_study(methods=methods), rows[rows["method"] != "n3"])
        assert four.variant("n0").n_samples == 27
        assert "for all 4 variants of networks together" in four.headline

    def test_a_variant_confirmed_at_every_size_hands_its_share_on(self):
        # 38 of 40 have a probability of 0.0079 at most, 37 of 0.0285.
        one_size = {"network": {3: met(38, 40)}, "n0": {3: met(37, 40)}, "n1": {3: met(0, 40)}}
        study = make_study(methods=NETWORKS)
        both = answer(study, self.rows(one_size | {"n1": {3: met(40, 40)}}))
        assert both.confidence.each == pytest.approx(0.95)
        assert both.variant("n0").status == "answered"
        alone = answer(study, self.rows(one_size))
        assert alone.confidence.each == pytest.approx(0.975)
        assert alone.variant("n0").status == "more-seeds"

    def test_trainings_too_few_for_any_answer_take_no_share(self):
        errors = {"network": {2: met(0), 3: met(20)}}
        errors |= {name: {2: met(0, 9), 3: met(9, 9)} for name in NETWORKS}
        one = answer(make_study(methods=NETWORKS), self.rows(errors))
        assert one.confidence.n_variants == 5
        assert one.confidence.each == pytest.approx(0.95)
        assert one.variant("network").n_samples == 27
        assert one.variant("n0").status == "more-seeds"


class TestWords:
    def test_certified_measured_and_more_than(self):
        study = make_study(methods=METHODS)
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(0), 5: met(0)}, certified=True),
                make_rows({3: met(0), 4: met(20, good=1.6), 5: met(20)}, "tanh", certified=True),
                make_rows({3: [3], 4: [2.1], 5: [1.41]}, "table"),
                make_rows({3: [0], 4: [0], 5: [0]}, "nominal"),
            ]
        )
        said = answer(study, rows).headline
        assert said.startswith("For every point of the workspace within 2 mm, with 95 % confidence")
        parts = said.split("; ")
        assert "64 samples and tanh (" in parts[0]
        assert parts[0].endswith("(certified: 1.60 mm)")
        assert parts[1:] == [
            "the paper's training needs more than 125",
            "a look-up table of the same samples needs 125 (measured at 8\u202f200 points, not "
            "certified: 1.41 mm).",
        ]

    def test_the_papers_training_is_said_of_the_papers_arm_alone(self):
        """On another arm a newcomer wants to know the network, not who has used it."""
        other = {"robot": {"urdf": "config/robots/ur5e.urdf"}}
        rows = make_rows({3: met(0), 4: met(20)})
        assert "the paper's training" in answer(make_study(), rows).headline
        said = answer(make_study(**other), rows).headline
        assert "the study's own network (16 ReLU neurons, 500 epochs of Adam)" in said
        assert "paper" not in said

    def test_of_equal_samples_the_method_with_the_smaller_error_is_named(self):
        study = make_study(methods={"rbf": {"kind": "rbf"}, "cubic": {"kind": "cubic"}})
        rows = [
            make_rows({3: [1.3]}, "rbf"),
            make_rows({3: [0.5]}, "cubic"),
            make_rows({3: met(0)}),
        ]
        assert "27 samples and a cubic spline" in answer(study, pd.concat(rows)).headline

    @given(st.floats(1e-6, 1e4))
    def test_an_error_is_never_said_to_be_smaller_than_it_is(self, error_mm):
        said = float(millimetres(error_mm).removesuffix(" mm"))
        assert error_mm <= said <= 1.011 * error_mm

    def test_a_part_of_the_workspace_is_named(self):
        """What holds over a part of the box alone must not read as if it held over the box."""
        rows = make_rows({3: met(20), 4: met(20)}).assign(region_share=0.874)
        found = answer(make_study(), rows)
        assert found.region_share == 0.874
        assert "the usable part of the workspace (87.4 % of the box)" in found.headline

    def test_what_a_proof_takes_is_said_where_the_best_is_only_measured(self):
        study = make_study(methods={**METHODS, "cubic": {"kind": "cubic"}})
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(0), 5: met(0)}, certified=True),
                make_rows({3: [1.5], 4: [0.4], 5: [0.1]}, "cubic"),
                make_rows({3: [3], 4: [2.1], 5: [1.41]}, "table", certified=True),
            ]
        )
        assert answer(study, rows).headline.endswith(
            "27 samples and a cubic spline through the same samples (measured at 8\u202f200 "
            "points, not certified: 1.50 mm); a look-up table of the same samples needs 125 "
            "(certified: 1.41 mm); the paper's training needs more than 125."
        )

    def test_nothing_certified(self):
        one = answer(make_study(), make_rows({2: met(0), 3: met(20)}))
        assert one.headline.startswith("For all 8\u202f200 points measured in the workspace within")
        text = told(one.variant("network"))
        for part in (
            "With 27 samples, 20 of 20 trainings succeed; with 95 % confidence at least 86 % of",
            "1.00 mm (measured at 8\u202f200 points, not certified)",
            "with 8 samples, 0 of 20 trainings succeed, where 80 % are required",
            "3.00 mm, 1.00 mm too much",
        ):
            assert part in text

    def test_one_certificate_missing_is_not_certified(self):
        rows = make_rows({2: met(20)}, certified=True)
        rows.loc[3, "certified"] = False
        assert "not certified" in answer(make_study(), rows).headline

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
    def test_what_is_asked(self, tolerance, head):
        rows = make_rows({2: met(0), 3: met(20)})
        rows["n_points"] = 200 if "where" in tolerance else 8200
        assert answer(make_study(tolerance), rows).headline.startswith(head)

    def test_a_lower_end_never_reads_as_more_than_it_is(self):
        # 18 of 20: 0.7174; 199 of 200: 0.97651.
        for n_met, n, text in ((18, 20, "71.7 %"), (199, 200, "97.6 %")):
            rows = make_rows({2: met(0, n), 3: met(n_met, n)})
            study = make_study({"success_share": 0.7})
            assert f"at least {text} of trainings" in told(answer(study, rows).variant("network"))

    def test_designs_are_named_where_there_are_several(self):
        study = make_study(samples={"designs": ["grid", "sobol"]})
        rows = pd.concat(
            [
                make_rows({3: met(0), 4: met(20)}),
                make_rows({3: met(20), 4: met(20)}, design="sobol"),
            ]
        )
        one = answer(study, rows)
        assert "27 samples at Sobol points and the paper's training" in one.headline
        assert "the paper's training on an even grid needs 64" in one.headline
        assert one.variant("network", "sobol").n_samples == 27
        assert {(c.design, c.other_design) for c in one.comparisons} == {("sobol", "grid")}

    def test_the_exact_inverse_is_not_recommended(self):
        study = make_study(methods=METHODS)
        rows = pd.concat([make_rows({2: met(0)}), make_rows({2: [0]}, "nominal")])
        assert answer(study, rows).headline.endswith("the paper's training needs more than 8.")


class TestFile:
    @pytest.fixture
    def results(self, tmp_path):
        rows = make_rows({2: met(0), 3: met(20)}, certified=True)
        folder = tmp_path / "results" / "s"
        folder.mkdir(parents=True)
        self.answer = answer(make_study(), rows)
        (folder / "answer.json").write_text(self.answer.to_json(), encoding="utf-8")
        return folder

    def test_it_comes_back_as_it_was_and_follows_its_schema(self, results):
        assert read_answer(results).to_json() == self.answer.to_json()
        validate(
            json.loads((results / "answer.json").read_text("utf-8")), Answer.model_json_schema()
        )

    def test_recommending_needs_nothing_but_the_file(self, results):
        text = recommend(results)
        assert text.startswith(self.answer.headline)
        for sentence in self.answer.variant("network").sentences:
            assert sentence in text

    def test_a_method_that_is_not_there(self, results):
        with pytest.raises(IksamplesError, match="no method 'rbf'; there are network on grid"):
            read_answer(results).variant("rbf")

    def test_an_unfinished_study(self, results):
        (results.parent / "other").mkdir()
        with pytest.raises(IksamplesError, match=r"other: no answer.json yet.*snakemake"):
            recommend(results.parent / "other")
        with pytest.raises(IksamplesError, match=r"no such results folder. Studies.*there: s\."):
            recommend(results.parent / "nowhere")

    def test_the_study_answered_last_is_found(self, results):
        with pytest.raises(IksamplesError, match="no finished study"):
            newest(results)
        other = results.parent / "a"
        other.mkdir()
        (other / "answer.json").write_text(self.answer.to_json(), encoding="utf-8")
        os.utime(other / "answer.json", (1, 1))
        assert newest(results.parent) == results
        os.utime(results / "answer.json", (0, 0))
        assert newest(results.parent) == other

    def test_a_broken_file_or_another_version(self, results):
        path = results / "answer.json"
        content = json.loads(path.read_text("utf-8"))
        path.write_text(json.dumps({**content, "version": 3}), encoding="utf-8")
        with pytest.raises(IksamplesError, match="layout version 3"):
            recommend(results)
        for text in ("{", "[]", json.dumps({**content, "variants": 3})):
            path.write_text(text, encoding="utf-8")
            with pytest.raises(IksamplesError, match="Run the study again"):
                recommend(results)
