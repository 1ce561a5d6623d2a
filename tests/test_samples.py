"""Samples: where they lie, what they say, and that they survive the disk."""

import numpy as np
import pytest
from scipy.stats import qmc

from iksamples.errors import IksamplesError
from iksamples.samples.dataset import SampleSet
from iksamples.samples.designs import fill_distance, full_grid, grid_spacing, sobol
from iksamples.samples.record import grid_samples, record_samples, region_points
from iksamples.study import parse_study
from iksamples.task import study_task


@pytest.mark.parametrize(("m", "spacing_mm"), [(4, 20.0), (5, 15.0)])
def test_spacings_are_those_the_paper_states(study, task, chain, m, spacing_mm):
    samples = grid_samples(study, task, m)
    assert samples.n_samples == m**3
    assert samples.spacing_mm == spacing_mm
    np.testing.assert_allclose(chain.forward_mm(samples.joints), samples.x, atol=1e-9)
    inputs = samples.normalise(samples.x)
    assert inputs.min() == 0
    assert inputs.max() == 1
    assert samples.n_masked == 0


def test_fill_distance_of_a_grid_is_half_a_cells_diagonal():
    box = (0, 0, 0), (60, 30, 15)
    grid = full_grid(*box, 4)
    dense = full_grid(*box, 31)
    # Cell centres are among the dense points, so the estimate attains the exact value.
    exact = np.sqrt(20**2 + 10**2 + 5**2) / 2
    assert fill_distance(grid, dense) == pytest.approx(exact)
    np.testing.assert_array_equal(grid_spacing(*box, 4), (20, 10, 5))


@pytest.mark.parametrize("d", range(1, 7))
def test_sobol_points_are_those_of_scipy_to_the_last_bit(d):
    lower, upper = np.arange(d) - 3.0, np.arange(d) * 7.0 + 1.0
    for n in (1, 2, 5, 4096):
        drawn = qmc.Sobol(d, rng=np.random.default_rng([d, n])).random(4096)[:n]
        points = sobol(lower, upper, n, np.random.default_rng([d, n]))
        np.testing.assert_array_equal(points, lower + (upper - lower) * drawn)


def test_fill_distance_of_the_samples_of_a_grid(study, task):
    samples = grid_samples(study, task, 4)
    assert samples.fill_distance_mm == pytest.approx(np.sqrt(3) * 10)


def test_saved_samples_come_back_the_same(study, task, tmp_path):
    samples = grid_samples(study, task, 3)
    samples.save(tmp_path / "grid3.parquet")
    again = SampleSet.load(tmp_path / "grid3.parquet")
    assert again.digest() == samples.digest()
    for name, value in vars(samples).items():
        if name in ("space", "joint_space", "region"):
            for part, entry in vars(value).items():
                np.testing.assert_array_equal(getattr(getattr(again, name), part), entry)
        else:
            np.testing.assert_array_equal(getattr(again, name), value)


def test_the_digest_tells_what_joint_values_are_divided_by(study, task, monkeypatch):
    samples = grid_samples(study, task, 2)
    before, scale = samples.digest(), 2 * samples.output_scale
    monkeypatch.setattr(SampleSet, "output_scale", scale)
    assert samples.digest() != before


def test_fresh_points_are_counted_and_off_the_grid(study, task, chain):
    counts = {m: len(grid_samples(study, task, m).validation_x) for m in (2, 5, 8)}
    assert counts == {2: 16, 5: 16, 8: 26}  # at least 16, else 5 % of n rounded up
    samples = grid_samples(study, task, 5)
    apart = np.linalg.norm(samples.validation_x[:, None] - samples.x, axis=-1)
    assert apart.min() > 0
    assert not np.array_equal(samples.validation_x, samples.test_x)
    np.testing.assert_allclose(
        chain.forward_mm(samples.validation_joints), samples.validation_x, atol=1e-9
    )


def test_points_held_out_of_the_grid_leave_no_fresh_ones():
    study = parse_study({"name": "x", "training": {"held_out": {"source": "grid"}}})
    assert len(grid_samples(study, study_task(study), 3).validation_x) == 0


@pytest.mark.parametrize(
    ("kind", "low", "high"), [("unit", 0, 1), ("symmetric", -1, 1), ("none", 0, 80)]
)
def test_normalisation(kind, low, high):
    study = parse_study({"name": "x", "samples": {"normalisation": kind}})
    samples = grid_samples(study, study_task(study), 3)
    inputs = samples.normalise(samples.x)
    assert (inputs.min(), inputs.max()) == (low, high)


STATED_BOX = {"lower_mm": [20, 20, -10], "upper_mm": [100, 100, 60]}


def test_unreachable_grid_point_is_named():
    study = parse_study({"name": "x", "workspace": STATED_BOX})
    with pytest.raises(IksamplesError, match=r"5 of 27 points.*\(60, 100, -10\) mm is out of"):
        grid_samples(study, study_task(study), 3)


def test_masked_points_are_counted_never_moved():
    study = parse_study({"name": "x", "workspace": STATED_BOX, "samples": {"unreachable": "mask"}})
    task = study_task(study)
    samples = grid_samples(study, task, 4)
    assert samples.n_samples + samples.n_masked == 64
    assert samples.n_masked > 0
    assert task.reach(samples.x).usable.all()
    grid = {tuple(point) for point in full_grid(STATED_BOX["lower_mm"], STATED_BOX["upper_mm"], 4)}
    assert {tuple(point) for point in samples.x} < grid
    points = region_points(task.region, 512)
    assert len(points) == 520
    assert task.region.contains(points).all()
    assert np.linalg.norm(points - [0, 0, 70], axis=1).max() < 140


def test_region_points_are_the_same_every_time_and_hold_the_corners(study, task):
    points = region_points(task.region, 100)
    np.testing.assert_array_equal(points, region_points(task.region, 100))
    corners = {tuple(corner) for corner in full_grid((20, 20, 0), (80, 80, 60), 2)}
    assert corners <= {tuple(point) for point in points}
    assert len(points) == 108


@pytest.mark.parametrize("design", ["chebyshev", "sobol", "latin", "uniform", "joints"])
def test_every_design_gives_as_many_samples_inside_the_workspace(study, task, chain, design):
    samples = record_samples(study, task, design, 64)
    assert samples.label == {"chebyshev": "chebyshev4"}.get(design, f"{design}64")
    assert samples.n_samples == 64
    assert (samples.x >= (20, 20, 0)).all()
    assert (samples.x <= (80, 80, 60)).all()
    np.testing.assert_allclose(chain.forward_mm(samples.joints), samples.x, atol=1e-9)
    again = record_samples(study, task, design, 64)
    assert again.digest() == samples.digest()
    other = parse_study({"name": "x", "samples": {"seed": 1}})
    moved = record_samples(other, study_task(other), design, 64).x != samples.x
    assert moved.any() == (design != "chebyshev")


def test_chebyshev_nodes_are_those_of_numpy(study, task):
    samples = record_samples(study, task, "chebyshev", 125)
    nodes = np.polynomial.chebyshev.chebpts1(5)
    for axis, low in enumerate((20, 20, 0)):
        np.testing.assert_allclose(
            np.unique(samples.x[:, axis].round(9)), (low + 30 + 30 * nodes).round(9)
        )


def test_latin_hypercube_has_one_point_in_each_slice(study, task):
    samples = record_samples(study, task, "latin", 27)
    slices = np.floor((samples.x - (20, 20, 0)) / 60 * 27).astype(int)
    for column in slices.T:
        assert sorted(column) == list(range(27))


def test_joint_space_samples_follow_the_arm_not_the_box(study, task, chain):
    """Uniform in the joints is denser in space where the Jacobian's determinant is smaller."""
    samples = record_samples(study, task, "joints", 512)
    low, high = np.percentile(np.abs(np.linalg.det(chain.jacobian_mm(samples.joints))), [5, 95])
    even = record_samples(study, task, "uniform", 512)
    low_even = np.percentile(np.abs(np.linalg.det(chain.jacobian_mm(even.joints))), 5)
    assert low < low_even < high


def test_a_file_of_something_else_is_refused(tmp_path):
    (tmp_path / "x.parquet").write_text("no parquet")
    with pytest.raises(IksamplesError, match="not a file of samples"):
        SampleSet.load(tmp_path / "x.parquet")
