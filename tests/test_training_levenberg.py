"""Levenberg-Marquardt for the stacked networks."""

import numpy as np
import pytest
import torch
from training_problems import make_problem, same

from iksamples.arm.chain import SerialChain
from iksamples.network import ACTIVATIONS
from iksamples.samples.record import grid_samples, region_points
from iksamples.study import parse_study
from iksamples.task import study_task
from iksamples.training import levenberg, reference
from iksamples.training.module import fit as fit_with
from iksamples.training.module import make_engine
from iksamples.training.problem import pose_problem
from iksamples.training.record import final_network


def problem_of(*args, **settings):
    return make_problem(*args, optimizer="levenberg-marquardt", **settings)


def fit(problem, **options):
    return fit_with(problem, make_engine("levenberg-marquardt", problem), **options)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_jacobian_is_the_derivative_of_the_residuals(activation, rng):
    sizes = (3, 5, 4, 2)
    flat = torch.from_numpy(rng.normal(size=(2, 20 + 24 + 10)))
    x, y = (
        torch.from_numpy(rng.normal(size=(2, 7, 3))),
        torch.from_numpy(rng.normal(size=(2, 7, 2))),
    )

    def residuals(flat):
        stack = list(reference.layers(flat, sizes))
        return (reference.forward(stack, activation, x) - y).flatten(1)

    residual, jacobian = levenberg.linearise(list(reference.layers(flat, sizes)), activation, x, y)
    np.testing.assert_allclose(residual, residuals(flat), atol=1e-12)
    full = torch.autograd.functional.jacobian(residuals, flat)
    for seed in range(2):
        np.testing.assert_allclose(jacobian[seed], full[seed, :, seed], atol=1e-12)


def test_a_linear_network_ends_at_the_least_squares_solution():
    problem = problem_of(range(3), hidden=(), epochs=40)
    record = fit(problem)
    x = np.column_stack([problem.inputs[:21], np.ones(21)]).astype(float)
    solution, *_ = np.linalg.lstsq(x, problem.targets[:21].astype(float), rcond=None)
    for row in record.parameters:
        np.testing.assert_allclose(row.reshape(4, 3), solution, atol=1e-6)
    assert (record.stopped > 0).all()
    assert (record.stopped < 40).all()


def test_loss_never_rises_and_ends_far_below_adams():
    problem = problem_of(range(6), hidden=(8,), activation="tanh", epochs=60)
    record = fit(problem)
    assert (np.diff(record.history[0], axis=0) <= 0).all()
    adam = fit_with(make_problem(range(6), hidden=(8,), activation="tanh", epochs=60))
    assert (record.history[0, -1] < 0.01 * adam.history[0, -1]).all()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    "shape",
    [
        {"hidden": (16,), "activation": "tanh", "n": 61},
        {"hidden": (7, 6), "activation": "relu", "n": 8},
        {"hidden": (5,), "activation": "tanh", "n": 1},
    ],
    ids=str,
)
def test_a_seed_is_the_same_to_the_last_bit_alone_and_among_many(shape, threads):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        many = fit(problem_of(range(23), epochs=30, **shape))
        for seeds in ([0], [22], [22, 5, 1, 7, 9]):
            same(fit(problem_of(seeds, epochs=30, **shape)), many.select(seeds))
    finally:
        torch.set_num_threads(before)


def test_blocks_and_memory_do_not_show_in_the_result(monkeypatch):
    problem = problem_of(range(5), hidden=(6,), activation="tanh", epochs=20)
    whole = fit(problem)
    monkeypatch.setattr(levenberg, "_JACOBIAN_BYTES", 1)
    same(fit(problem, epochs_per_block=3), whole)


def test_early_stopping_keeps_the_best_weights():
    stopping = {"patience": 5, "min_delta_rad2": 0, "restore_best": True}
    shape = {"hidden": (8,), "activation": "tanh", "n": 12, "epochs": 60}
    record = fit(problem_of(range(4), **shape, early_stopping=stopping))
    assert (record.stopped > 0).any()
    for i, best in enumerate(record.best_epoch):
        shorter = fit(problem_of([i], **(shape | {"epochs": int(best)})))
        np.testing.assert_array_equal(record.parameters[i], shorter.parameters[0])


@pytest.mark.slow
@pytest.mark.parametrize(("points_per_axis", "expected_mm"), [(5, 0.16), (8, 0.10)])
def test_sixteen_tanh_neurons_on_the_papers_cube(
    chain: SerialChain, points_per_axis: int, expected_mm: float
):
    # An independent prototype reached these mean errors on the same samples.
    settings = {"optimizer": "levenberg-marquardt", "epochs": 300, "seeds": 5}
    study = parse_study({"name": "x", "network": {"activation": "tanh"}, "training": settings})
    samples = grid_samples(study, study_task(study), points_per_axis)
    problem = pose_problem(study, samples, study.seeds)
    network = final_network(problem, samples, fit(problem))
    points = region_points(study_task(study).region, 2048)
    errors = np.linalg.norm(chain.forward_mm(network.predict(points)) - points, axis=-1)
    assert np.median(errors.mean(axis=1)) == pytest.approx(expected_mm, rel=0.25)
