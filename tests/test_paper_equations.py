"""Every equation of the paper against a value worked by hand, and its column in Table 1."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from iksamples.evaluation.errors import cube_errors
from iksamples.network import StackedMLP
from iksamples.paper import equations as paper
from iksamples.paper.equations import audit, input_jacobian
from iksamples.paper.gather import paper_table
from iksamples.samples.record import grid_samples, region_points
from iksamples.study import parse_study
from iksamples.task import study_task


def test_lemma_1():
    assert paper.lemma_1(2.0, 0.5) == pytest.approx((4 + 1) * 0.25)


def test_lemma_2():
    assert paper.lemma_2(2.0) == pytest.approx(3.4641016)


def test_equation_16_is_the_largest_absolute_row_sum():
    assert paper.equation_16([[1, -2, 3], [0, 5, 0]]) == 6


def test_equation_18_is_no_bound():
    """One neuron with w1 = 10 and w2 = 1 has the slope 10, above the claimed 1."""
    network = StackedMLP(
        (np.full((1, 3, 1), 10, np.float32), np.ones((1, 1, 3), np.float32)),
        (np.zeros((1, 1), np.float32), np.zeros((1, 3), np.float32)),
        "relu",
        np.zeros(3),
        np.ones(3),
        (0,),
    )
    slope = input_jacobian(network, np.ones((1, 3)))[0, 0]
    np.testing.assert_allclose(slope, 10, rtol=1e-6)
    assert paper.equation_18(network.weights[-1])[0] == 1


def test_equation_21_joins_the_lemmas():
    assert paper.equation_21(2.0, 0.5) == pytest.approx((3 * 4 + 1) * 0.25)


def test_equations_22_and_23():
    assert paper.equation_23(0.5) == 1.5


@pytest.mark.parametrize(("m", "half"), [(2, 0.5), (3, 0.25), (5, 0.125)])
def test_equation_24_is_half_a_cells_edge(m, half):
    assert paper.equation_24(m**3) == pytest.approx(half)


def test_equation_25():
    assert paper.equation_25(0.5, 27) == pytest.approx((27 * 0.25 + 1) / (4 * 4))


def test_the_papers_column_is_one_average_weight_times_60_mm():
    table = paper_table()
    m = table.index.to_numpy()
    wbar = paper.average_weight_of(table["paper_estimate_mm"], m**3, 60.0)
    np.testing.assert_allclose(wbar, 0.146, atol=0.005)
    again = paper.estimate_mm(wbar, m**3, 60.0)
    np.testing.assert_allclose(again, table["paper_estimate_mm"], rtol=1e-12)
    # The printed rows m = 3 to 8 share one constant to their last digit.
    shared = paper.estimate_mm(0.14594, m[1:] ** 3, 60.0)
    np.testing.assert_allclose(shared, table["paper_estimate_mm"].iloc[1:], atol=0.0051)


def test_no_average_weight_gives_less_than_the_distance_alone():
    assert np.isnan(paper.average_weight_of(1.0, 8, 60.0))


def test_averages_pool_the_kernels_of_a_seed():
    kernels = [np.array([[[1.0, -3.0]], [[2.0, 2.0]]]), np.array([[[2.0], [0.0]], [[2.0], [2.0]]])]
    expected = {
        "mean": [0.0, 2.0],
        "mean_abs": [1.5, 2.0],
        "rms": [np.sqrt(14 / 4), 2.0],
        "max_abs": [3.0, 2.0],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(paper.AVERAGES[name](kernels), values)


def random_networks(rng, activation, hidden=(7, 5)):
    sizes = (3, *hidden, 3)
    return StackedMLP(
        tuple(rng.normal(size=(2, a, b)).astype(np.float32) for a, b in pairwise(sizes)),
        tuple(rng.normal(size=(2, b)).astype(np.float32) for b in sizes[1:]),
        activation,
        np.array([20.0, 20.0, 0.0]),
        np.array([60.0, 60.0, 60.0]),
        (4, 9),
    )


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_input_jacobian_is_the_derivative_by_normalised_inputs(rng, activation):
    network = random_networks(rng, activation)
    points = rng.uniform(20, 60, (40, 3))
    step = 1e-5 * network.scale
    for i, unit in enumerate(np.eye(3)):
        ahead, behind = (network.predict(points + sign * step * unit) for sign in (1, -1))
        difference = (ahead - behind) / 2e-5
        np.testing.assert_allclose(input_jacobian(network, points)[..., i], difference, atol=1e-3)


def test_audit_counts_the_points_above_each_estimate(chain, rng):
    study = parse_study({"name": "x", "evaluation": {"cube_points": 256}})
    samples = grid_samples(study, study_task(study), 3)
    network = random_networks(rng, "relu", (6,))
    cube = cube_errors(study.evaluation, study_task(study), network)
    table = audit(study, samples, network, cube).set_index("seed")
    assert list(table.index) == [4, 9]
    points = region_points(study_task(study).region, 256)
    for row, seed in enumerate((4, 9)):
        weights = np.concatenate([np.ravel(w[row]) for w in network.weights])
        wbar = np.abs(weights).mean()
        estimate = 60 * (27 * wbar**2 + 1) / (4 * 2**2)
        joints = network.predict(points)[row]
        error = np.linalg.norm(chain.forward_mm(joints) - points, axis=1)
        assert table.loc[seed, "estimate_mean_abs_mm"] == pytest.approx(estimate)
        assert table.loc[seed, "above_mean_abs"] == pytest.approx(np.mean(error > estimate))
        gamma = table.loc[seed, "gamma"]
        nearest = np.linalg.norm((points[:, None] - samples.x[None]) / 60, axis=-1).min(axis=1)
        bound = (gamma**2 + 1) * nearest**2
        assert table.loc[seed, "lemma_1_above_mm"] == pytest.approx(np.mean(error > 60 * bound))


def test_papers_table_is_kept_as_printed():
    table = paper_table()
    assert isinstance(table, pd.DataFrame)
    assert table.loc[5].to_dict() == {
        "n_samples": 125,
        "paper_error_mm": 2.17,
        "paper_error_sd_mm": 0.20,
        "paper_estimate_mm": 1.48,
        "paper_error_over_spacing": 0.14,
    }
