"""What is learned: its spaces, and the one region that everything is over."""

import numpy as np
import pytest

from iksamples.certify.step import certify_networks
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors
from iksamples.network import StackedMLP
from iksamples.samples.record import grid_samples, record_samples, region_points
from iksamples.study import Study, parse_study
from iksamples.task import merged, study_task
from iksamples.training.run import train


HALF = {"lower_mm": [20, 20, 0], "upper_mm": [110, 110, 60]}
"""A workspace whose far corner the arm cannot reach."""


@pytest.fixture
def partly() -> Study:
    """A study of a workspace that the arm reaches in part."""
    return parse_study(
        {
            "name": "partly",
            "workspace": HALF,
            "samples": {"points_per_axis": [4], "unreachable": "mask"},
            "network": {"activation": "tanh"},
            "training": {"seeds": 2, "optimizer": "levenberg-marquardt", "epochs": 60},
            "evaluation": {"cube_points": 1024},
        }
    )


def test_everything_is_over_the_usable_part_of_the_workspace(partly, tmp_path):
    """Errors were measured over this part, and certificates over the box: 1.1 mm beside 300 mm."""
    task = study_task(partly)
    assert 0.5 < task.region_share < 0.95
    assert not task.region.contains(np.array(HALF["upper_mm"], float))
    for design in ("grid", "sobol", "latin", "uniform", "joints"):
        samples = record_samples(partly, task, design, 64)
        for x in (samples.x, samples.validation_x, samples.test_x):
            assert task.region.contains(x).all()
            assert task.reach(x).usable.all()
    samples = grid_samples(partly, task, 4)
    train(partly, [samples], [tmp_path])
    network = StackedMLP.load(tmp_path / "weights.safetensors")
    measured = cube_errors(partly.evaluation, task, network).groupby("seed")["error_mm"].max()
    proved = certify_networks(partly, task, "network", samples, network).set_index("seed")
    assert proved["verified"].all()
    assert (measured <= proved["sup_upper_mm"] + 1e-3).all()
    # The worst point of some thousand is near the worst of all.
    assert (proved["sup_lower_mm"] <= 4 * measured).all()
    worst = proved[["argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]].to_numpy(float)
    assert task.region.contains(worst).all()


def test_the_region_is_usable_and_misses_little(partly, rng):
    task = study_task(partly)
    inside = region_points(task.region, 4096)
    assert task.reach(inside).usable.all()
    spread = task.x.lower + (task.x.upper - task.x.lower) * rng.random((20_000, 3))
    usable = task.reach(spread).usable
    assert 0.85 * usable.mean() < task.region_share < usable.mean()
    assert task.region.contains(spread).mean() == pytest.approx(task.region_share, abs=0.02)


def test_a_whole_workspace_is_one_box(task):
    assert task.region.n_boxes == 1
    assert task.region_share == 1
    assert (task.region.lower_corner == task.x.lower).all()
    assert (task.region.upper_corner == task.x.upper).all()


def test_a_workspace_out_of_reach_is_refused(partly):
    settings = partly.model_dump(mode="json")
    settings["workspace"] = {"lower_mm": [300, 300, 0], "upper_mm": [400, 400, 60]}
    with pytest.raises(IksamplesError, match=r"can use no part of it; \(300, 300, 0\) mm is out"):
        study_task(parse_study(settings))


@pytest.mark.parametrize("shape", [(7, 9), (5, 4, 6), (3, 2, 3, 2)])
def test_merged_cells_are_covered_once(shape, rng):
    cells = rng.random(shape) < 0.7
    covered = np.zeros(shape, int)
    firsts, lasts = merged(cells)
    for first, last in zip(firsts, lasts, strict=True):
        covered[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] += 1
    np.testing.assert_array_equal(covered, cells)
    assert len(merged(np.ones(shape, bool))[0]) == 1


def test_columns_carry_their_unit(task):
    assert task.x.columns() == ["x_mm", "y_mm", "z_mm"]
    assert task.q.columns("q_") == ["q_yaw_rad", "q_shoulder_rad", "q_elbow_rad"]
