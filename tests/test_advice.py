"""What a valid study may still get wrong."""

import re

import pytest

from iksamples.advice import advice
from iksamples.results import sample_sets
from iksamples.samples.record import record_samples
from iksamples.study import parse_study
from iksamples.task import study_task


def notes(**settings):
    study = parse_study({"name": "s", "samples": {"points_per_axis": [2]}, **settings})
    task = study_task(study)
    sets = [record_samples(study, task, *one) for one in sample_sets(study).values()]
    return advice(study, task, sets)


@pytest.mark.parametrize(("seeds", "enough"), [(13, False), (14, True)])
def test_the_fewest_seeds_that_can_show_it(seeds, enough):
    # 0.8^13 is more than 5 %, and 0.8^14 less.
    assert (0.8**seeds < 0.05) is enough
    found = notes(training={"seeds": seeds})
    assert found == [] if enough else "14 can (training.seeds)" in found[0]


def test_the_best_of_several_needs_fewer():
    assert notes(training={"seeds": 13})
    assert notes(training={"seeds": 13}, tolerance={"best_of": 3}) == []


def test_a_method_without_a_grid_is_named():
    methods = {"spline": {"kind": "cubic"}, "kernel": {"kind": "rbf"}}
    samples = {"designs": ["grid", "chebyshev", "sobol"], "points_per_axis": [2, 3]}
    [line] = notes(methods=methods, samples=samples)
    assert line.startswith("spline has no results on sobol8, sobol27: tables")
    assert notes(methods=methods) == []


def test_a_masked_grid_is_none():
    samples = {"points_per_axis": [3], "unreachable": "mask"}
    workspace = {"lower_mm": [20, 20, 0], "upper_mm": [120, 120, 60]}
    [line] = notes(methods={"spline": {"kind": "cubic"}}, samples=samples, workspace=workspace)
    assert line.startswith("spline has no results on grid3:")


def test_a_path_beyond_the_samples_is_told():
    # A circle of 20 mm about the middle of the workspace's side x = 80: half of it lies beyond.
    def ring(x):
        circle = {"shape": "circle", "waypoints": 101, "centre_mm": [x, 50, 30], "width_mm": 20}
        return {"evaluation": {"paths": {"ring": circle}}, "training": {"seeds": 20}}

    [line] = notes(**ring(80))
    assert "evaluation.paths.ring" in line
    assert int(re.search(r"(\d+) of 101 points lie outside", line).group(1)) in (50, 51)
    assert notes(**ring(60)) == []


def test_limits_that_must_be_degrees_are_told():
    limits = {"yaw": [-150, 150], "elbow": [-6.2, 6.2]}
    [line] = notes(robot={"limits_rad": limits})
    assert line.startswith("yaw can turn from -150 to 150 rad, 48 turns")
