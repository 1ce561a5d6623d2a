"""The answer over arms that are not their drawing: what no samples can beat, and who needs none."""

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lxml import html
from report_study import finished

from iksamples.answer.answer import Answer, read_answer, recommend
from iksamples.answer.assess import answer, read_floor
from iksamples.answer.next_poses import next_poses
from iksamples.answer.replication import fresh_study
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import OwnInverse, repeatability
from iksamples.export.write import choose
from iksamples.report.write import write_report
from iksamples.results import certified
from iksamples.samples.record import grid_samples, on_arms
from iksamples.study import parse_study
from iksamples.task import study_task
from iksamples.text import known


DEVIATES = {"deviation_mm": 1.0, "deviation_rad": 0.0175, "noise_mm": 0.1}
SLIPS = {**DEVIATES, "backlash_rad": 0.004, "encoder_step_rad": 0.001}


def arm_study(arm, seeds=3, **sections):
    return parse_study({
        "name": "arms", "arm": dict(arm), "training": {"seeds": seeds},
        "samples": {"points_per_axis": [2, 3]}, "evaluation": {"cube_points": 512}, **sections,
    })  # fmt: skip


def outcomes_of(method, errors, confident_mm=np.nan):
    """Numbers of samples -> errors of arms 0, 1, ..."""
    return pd.DataFrame([
        {
            "method": method, "design": "grid", "label": f"grid{round(n ** (1 / 3))}",
            "n_samples": n, "seed": seed, "error_mm": float(error), "certified": False,
            "region_share": 1.0, "n_points": 520, "attained_mm": float(error),
            "confident_mm": confident_mm, "failed": "",
        }
        for n, arms in errors.items()
        for seed, error in enumerate(arms)
    ])  # fmt: skip


def test_what_an_arms_own_inverse_leaves_is_within_what_its_joints_can_make_of_it():
    study = arm_study({"backlash_rad": 0.01})
    task = study_task(study)
    x = np.array([[30.0, 40.0, 10.0], [70.0, 25.0, 50.0]])
    joints = OwnInverse(task, study.arms).predict(x)
    errors = repeatability(study, task)
    assert sorted(errors["region"].unique()) == ["cube", "heart", "rectangles"]
    assert errors["error_max_mm"].min() > 0
    # All sides that three joints can rest on, at each point; what is measured is one of them.
    off = [
        np.linalg.norm(task.drawing.forward_mm(joints[0] + 0.005 * np.array(sides)) - x, axis=1)
        for sides in product((-1, 1), repeat=3)
    ]
    measured = task.target.position_error_mm(task.arm_of(0), joints[0], x)
    for point, one in enumerate(measured):
        assert min(abs(each[point] - one) for each in off) < 1e-9


def test_steps_leave_at_most_half_of_them_at_every_joint():
    study = arm_study({"encoder_step_rad": 0.002}, seeds=1)
    task = study_task(study)
    worst = repeatability(study, task).set_index("region").loc["cube", "error_max_mm"]
    points = grid_samples(study, task, 6)
    levers = np.linalg.norm(task.drawing.jacobian_mm(points.joints), axis=1).sum(axis=1)
    assert 0.2 * 0.001 * levers.max() < worst < 1.05 * 0.001 * levers.max()


def test_sag_that_is_known_leaves_nothing():
    study = arm_study({**DEVIATES, "payload_kg": 0.1, "stiffness_nm_per_rad": 5.0})
    assert not study.arm.is_chain
    assert study.arm.repeats
    task = study_task(study)
    assert repeatability(study, task)["error_max_mm"].max() < 1e-9
    x = np.array([[50.0, 50.0, 30.0]])
    assert task.target.position_error_mm(task.arm_of(0), task.reach(x).joints, x) > 0.1


def test_the_floor_is_in_the_answer_and_printed_first(tmp_path):
    study = arm_study(SLIPS, tolerance={"error_mm": 0.05})
    (tmp_path / "floor").mkdir()
    errors = repeatability(study, study_task(study))
    errors.to_parquet(tmp_path / "floor" / "errors.parquet")
    floor = read_floor(study, tmp_path)
    of_cube = errors[errors["region"] == "cube"]["error_max_mm"]
    assert floor.n_arms == 3
    assert floor.error_worst_mm == of_cube.max()
    assert floor.error_median_mm == of_cube.median()
    assert "no number of samples can beat" in floor.sentence
    assert "more than the 0.05 mm asked for" in floor.sentence
    one = answer(study, outcomes_of("network", {8: [1, 1, 1]}), floor=floor)
    assert Answer.model_validate_json(one.to_json()).floor == floor
    (tmp_path / "answer.json").write_text(one.to_json())
    assert recommend(tmp_path).startswith("Repeatability of the 3 simulated arms")


def test_arms_that_repeat_have_no_floor_and_a_drawing_none_at_all(tmp_path):
    floor = read_floor(arm_study(DEVIATES), tmp_path)
    assert (floor.error_worst_mm, floor.n_arms) == (0, 3)
    assert read_floor(parse_study({"name": "plain"}), tmp_path) is None


def test_the_answer_is_over_arms_also_for_methods_without_chance():
    study = arm_study(DEVIATES, 20, methods={"spline": {"kind": "cubic"}})
    rows = pd.concat([
        outcomes_of("network", {8: [5] * 20, 27: [3] * 20}),
        outcomes_of("spline", {8: [5] * 20, 27: [1] * 16 + [3] * 4}),
    ])  # fmt: skip
    one = answer(study, rows)
    spline = one.variant("spline")
    assert one.confidence.n_variants == 2
    assert (spline.status, spline.shown.n_met) == ("open", 16)
    assert "16 of 20 arms succeed" in " ".join(spline.sentences)
    assert "at least 80 % of arms succeed" in one.headline
    assert "training" not in " ".join(spline.sentences)
    sure = answer(study, pd.concat([rows, rows.assign(seed=rows["seed"] + 20, error_mm=1.0)]))
    assert sure.variant("spline").shown.success_rate_lcb < 36 / 40


@pytest.mark.parametrize(("error", "status", "n"), [(1.0, "answered", 0), (3.0, "open", None)])
def test_the_drawing_needs_no_samples_or_none_would_help(error, status, n):
    study = arm_study(DEVIATES, 30, methods={"nominal": {"kind": "nominal"}})
    rows = pd.concat([
        outcomes_of("network", {8: [5] * 30, 27: [3] * 30}),
        outcomes_of("nominal", {0: [error] * 30}),
    ])  # fmt: skip
    one = answer(study, rows)
    nominal = one.variant("nominal")
    assert (nominal.status, nominal.n_samples) == (status, n)
    assert nominal.extrapolation is None
    assert one.sizes == [8, 27]
    said = " ".join(nominal.sentences)
    assert ("With no samples, 30 of 30 arms succeed" in said) == (status == "answered")
    assert ("no samples change it" in said) == (status == "open")


def test_fresh_seeds_are_fresh_arms():
    study = arm_study(DEVIATES, 20, replication={"seeds": 5})
    task = study_task(study)
    rows = outcomes_of("network", {8: [1] * 20, 27: [1] * 20})
    fresh = fresh_study(study, answer(study, rows).variant("network"))
    again = on_arms(fresh, study_task(fresh), grid_samples(study, task, 2))
    assert again.arms == (20, 21, 22, 23, 24)


def test_nothing_is_proved_of_arms_that_give_way():
    assert certified(arm_study(SLIPS)) == []
    assert certified(arm_study(DEVIATES)) == ["network"]


def test_no_network_of_a_simulated_arm_is_taken_away(tmp_path):
    study = arm_study(DEVIATES)
    one = answer(study, outcomes_of("network", {8: [1, 1, 1]}))
    (tmp_path / "answer.json").write_text(one.to_json())
    (tmp_path / "study.json").write_text(study.model_dump_json())
    with pytest.raises(IksamplesError, match="without an arm section"):
        choose(tmp_path)


def test_the_best_of_several_arms_is_no_question():
    with pytest.raises(IksamplesError, match="best_of"):
        arm_study(DEVIATES, tolerance={"best_of": 3})


@pytest.mark.slow
def test_a_report_over_arms_begins_with_their_floor_and_says_what_each_method_knows(
    tmp_path, monkeypatch
):
    """A fitted drawing takes fewer samples than a grid has corners: its samples are its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(Path(__file__).parents[1] / "config")
    fitted = {"kind": "calibrated", "design": "sobol"}
    study = finished(
        {
            "name": "arms", "arm": SLIPS, "samples": {"sizes": [4, 8]},
            "training": {"seeds": 2, "epochs": 10}, "evaluation": {"cube_points": 64},
            "methods": {"drawn": {"kind": "nominal"}, "fitted": fitted,
                        "table": {"kind": "multilinear"}},
            "tolerance": {"success_share": 0.1, "confidence": 0.51, "error_mm": 8},
        },
        tmp_path, paper=False,
    )  # fmt: skip
    write_report(study, "results/arms", "reports/arms")
    answer = read_answer("results/arms")
    tried = {one.method: [size.n_samples for size in one.sizes] for one in answer.variants}
    assert tried == {"network": [8], "drawn": [0], "fitted": [4, 8], "table": [8]}
    text = Path("reports/arms/README.md").read_text().replace("\u00a0", " ")
    assert 0 < text.index(answer.floor.sentence) < text.index(f"> {answer.headline}")
    assert answer.floor.error_median_mm > 0.1
    assert "Arms that meet it" in text
    assert "Trainings" not in text
    page = html.parse("reports/arms/index.html").getroot()
    ladder = " ".join(page.xpath("//div[@id='figure-samples']//text()"))
    for one in answer.variants:
        assert known(study, one.method).splitlines()[1] in ladder
        if one.status == "answered" and one.n_samples:
            assert str(one.n_samples) in ladder
    assert answer.variant("fitted").status == "answered"


@pytest.mark.slow
def test_a_report_over_too_few_arms_for_any_tolerance_is_written(tmp_path, monkeypatch):
    """How far off a drawing is cannot be said at that confidence, and is not said."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(Path(__file__).parents[1] / "config")
    study = finished(
        {
            "name": "arms", "arm": DEVIATES, "samples": {"points_per_axis": [2]},
            "training": {"seeds": 2, "epochs": 10}, "evaluation": {"cube_points": 64},
            "methods": {"drawn": {"kind": "nominal"}},
            "tolerance": {"success_share": 0.9, "confidence": 0.95, "error_mm": 8},
        },
        tmp_path, paper=False,
    )  # fmt: skip
    assert np.isnan(read_answer("results/arms").variant("drawn").shown.tolerance_bound_mm)
    write_report(study, "results/arms", "reports/arms")
    ladder = html.parse("reports/arms/index.html").xpath("//div[@id='figure-samples']//text()")
    assert any(text.startswith("none:") for text in ladder)
    assert not any("nan" in text for text in ladder)


def test_methods_that_are_trained_share_the_studys_samples():
    sobol = {"design": "sobol"}
    assert arm_study({}, methods={"c": {"kind": "calibrated", **sobol}}).designs("c") == ["sobol"]
    with pytest.raises(IksamplesError, match=r"methods\.c\.design"):
        arm_study({}, methods={"c": {"kind": "network", **sobol}})
    with pytest.raises(IksamplesError, match="corners"):
        arm_study({}, samples={"sizes": [4, 8]})
    with pytest.raises(IksamplesError, match="corners"):
        arm_study({}, samples={"sizes": [4, 6]}, methods={"c": {"kind": "calibrated", **sobol}})


def test_networks_of_arms_that_differ_propose_no_poses(tmp_path):
    study = arm_study(DEVIATES)
    with pytest.raises(IksamplesError, match="no two alike"):
        next_poses(study, study_task(study), None, 3, weights=tmp_path / "weights.safetensors")


def test_what_a_fitted_drawing_says_of_itself_is_told_and_counted():
    study = arm_study(DEVIATES, seeds=4, methods={"fitted": {"kind": "calibrated"}})
    rows = outcomes_of("fitted", {8: [0.5, 0.9, 1.2, 0.7]}, confident_mm=1.0)
    [one] = answer(study, rows).variants
    assert any("1.00 mm in the median; it holds on 3 of 4 arms" in text for text in one.sentences)
    [plain] = answer(study, outcomes_of("fitted", {8: [0.5, 0.9, 1.2, 0.7]})).variants
    assert not any("in the median" in text for text in plain.sentences)
