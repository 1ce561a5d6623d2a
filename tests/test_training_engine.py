"""Training itself: the arithmetic, early stopping, and that seeds do not touch each other."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import ModelCheckpoint
from scipy import stats
from torch import nn
from training_problems import make_problem, same

from iksamples.network import ACTIVATIONS, StackedMLP
from iksamples.training import fused, kernel, reference
from iksamples.training.lanes import load, store, tanh
from iksamples.training.module import fit as fit_with
from iksamples.training.module import make_engine
from iksamples.training.problem import Problem, initial_weights, permutations
from iksamples.training.record import Record, stack, unstack


@pytest.fixture(params=["reference", "fused"])
def fit(request):
    """Trains a problem with either engine."""

    def train(problem: Problem, **options) -> Record:
        return fit_with(problem, make_engine(request.param, problem), **options)

    return train


SHAPES = [
    {"hidden": (16,), "n": 21, "batch_size": 8, "epochs": 6},
    {"hidden": (16,), "n": 17, "batch_size": 8, "epochs": 6, "activation": "tanh"},
    {"hidden": (9, 17), "n": 11, "batch_size": 3, "epochs": 5, "activation": "tanh"},
    {"hidden": (17, 5), "n": 11, "batch_size": 3, "epochs": 5},
    {"hidden": (10,), "n": 1, "batch_size": 8, "epochs": 9, "activation": "tanh"},
    {"hidden": (50, 50), "n": 27, "batch_size": 9, "epochs": 4, "activation": "tanh"},
    {"hidden": (), "n": 8, "batch_size": 8, "epochs": 9},
    {"hidden": (16,), "n": 9, "batch_size": 1, "epochs": 4},
    {"hidden": (7, 6, 5), "n": 45, "batch_size": 20, "epochs": 5, "schedule": "cosine"},
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "shape"),
    [(engine, shape) for engine in ("reference", "fused") for shape in SHAPES],
    ids=str,
)
def test_a_seed_is_the_same_to_the_last_bit_alone_and_among_many(engine, shape):
    def train(seeds):
        problem = make_problem(seeds, **shape)
        return fit_with(problem, make_engine(engine, problem))

    many = train(range(100))
    for seeds in ([0], [99], [41], [99, 3, 40, 8, 2, 77, 5], range(20)):
        same(train(seeds), many.select(seeds))


def test_training_equals_a_plain_torch_loop(fit):
    problem = make_problem([3, 8], hidden=(7, 5), activation="tanh", epochs=12, batch_size=8)
    record = fit(problem)
    for row, seed in enumerate(problem.seeds):
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(3, 7), nn.Tanh(), nn.Linear(7, 5), nn.Tanh(), nn.Linear(5, 3))
        kernels, _ = initial_weights(problem.sizes, [seed])
        with torch.no_grad():
            for linear, kernel in zip(net[::2], kernels, strict=True):
                linear.weight.copy_(torch.from_numpy(kernel[0].T))
                linear.bias.zero_()
        adam = torch.optim.Adam(net.parameters(), lr=1e-3, eps=1e-7)
        x, y = torch.from_numpy(problem.inputs), torch.from_numpy(problem.targets)
        for epoch in range(1, 13):
            losses = []
            for chosen in np.split(permutations([seed], [epoch], 21)[0, 0], [8, 16]):
                loss = nn.functional.mse_loss(net(x[chosen]), y[chosen])
                adam.zero_grad()
                loss.backward()
                adam.step()
                losses.append(loss.item() * len(chosen))
            check = nn.functional.mse_loss(net(x[21:]), y[21:]).item()
            entries = torch.cat([linear.weight.flatten() for linear in net[::2]])
            expected = [
                sum(losses) / 21,
                check,
                *(
                    value.item()
                    for value in (entries.mean(), entries.abs().mean(), entries.abs().max())
                ),
            ]
            np.testing.assert_allclose(record.history[:, epoch - 1, row], expected, rtol=2e-5)
        weights = [
            part.detach().numpy() for linear in net[::2] for part in (linear.weight.T, linear.bias)
        ]
        expected = np.concatenate([part.ravel() for part in weights])
        np.testing.assert_allclose(record.parameters[row], expected, atol=2e-6)


def test_adam_by_hand():
    flat = nn.Parameter(torch.tensor([[1.0, 2.0]]))
    adam, rate = reference.StackedAdam(flat), torch.tensor([0.1])
    adam.update(torch.tensor([[0.5, -2.0]]), 1, rate)
    # Step 1: the corrected moments are g and g^2, so each parameter moves by 0.1 against its sign.
    np.testing.assert_allclose(flat.detach(), [[0.9, 2.1]], rtol=1e-6)
    adam.update(torch.tensor([[0.5, 0.0]]), 2, rate)
    # Step 2, second parameter: m = -0.2 * 0.9 = -0.18, v = 0.004 * 0.999 = 0.003996,
    # m / (1 - 0.81) = -0.947368, v / (1 - 0.998001) = 1.998999,
    # 0.1 * 0.947368 / 1.413859 = 0.067006
    np.testing.assert_allclose(flat.detach(), [[0.8, 2.167006]], rtol=1e-6)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_network_and_gradient_agree_with_the_numpy_network(activation, rng):
    kernels, biases = initial_weights((3, 6, 4, 2), [1, 2])
    biases = [rng.normal(size=bias.shape).astype(np.float32) for bias in biases]
    x = rng.normal(size=(5, 3))
    network = StackedMLP(kernels, tuple(biases), activation, np.zeros(3), np.ones(3), (1, 2))
    flat = torch.from_numpy(stack(kernels, biases)).double().requires_grad_()

    def outputs(flat: torch.Tensor) -> torch.Tensor:
        layers = list(reference.layers(flat, (3, 6, 4, 2)))
        return reference.forward(layers, activation, torch.from_numpy(x).expand(2, 5, 3))

    np.testing.assert_allclose(outputs(flat).detach(), network.predict(x), atol=1e-12)
    assert torch.autograd.gradcheck(outputs, flat)


def keras_stop(losses, patience, min_delta):
    """Last epoch and best epoch by the rule of Keras' EarlyStopping."""
    best, best_epoch, waited = np.inf, 0, 0
    for epoch, loss in enumerate(losses, 1):
        waited += 1
        if loss < best - min_delta:
            best, best_epoch, waited = loss, epoch, 0
        elif waited >= patience:
            return epoch, best_epoch
    return len(losses), best_epoch


@pytest.mark.parametrize("restore", [False, True])
def test_early_stopping_acts_on_each_seed_by_itself(fit, restore):
    stopping = {"patience": 3, "min_delta_rad2": 2e-3, "restore_best": restore}
    shape = {"hidden": (16,), "epochs": 60, "learning_rate": 0.03}
    free = fit(make_problem(range(8), **shape))
    record = fit(make_problem(range(8), **shape, early_stopping=stopping))
    ends = [keras_stop(free.history[1, :, i], 3, np.float32(2e-3)) for i in range(8)]
    assert len({end for end, _ in ends}) > 3
    assert min(end for end, _ in ends) < 60
    for i, (end, best) in enumerate(ends):
        assert record.stopped[i] == (end if end < 60 else 0)
        assert record.best_epoch[i] == best
        np.testing.assert_array_equal(record.history[:, :end, i], free.history[:, :end, i])
        assert np.isnan(record.history[:, end:, i]).all()
        # A run that ends where the seed was stopped ends with the same weights.
        shorter = fit(make_problem([i], **(shape | {"epochs": best if restore else end})))
        np.testing.assert_array_equal(record.parameters[i], shorter.parameters[0])
        np.testing.assert_array_equal(record.snapshots[-1, i], record.parameters[i])


def test_without_validation_points_nothing_stops(fit):
    stopping = {"patience": 1, "min_delta_rad2": 1.0}
    record = fit(make_problem(check=0, epochs=5, early_stopping=stopping))
    assert not record.stopped.any()
    assert np.isnan(record.history[1]).all()
    assert np.isfinite(record.history[[0, 2, 3, 4]]).all()


def test_a_seed_that_diverges_leaves_the_others_alone(fit):
    seeds, n = range(5), 21
    rows = np.tile(np.arange(n, dtype=np.int32), (5, 1))
    rows[2, 4] = n  # a row of the table that only this seed learns from
    problem = make_problem(seeds, rows=rows, epochs=6, check=3)
    problem.inputs[n] = 3e38
    record = fit(problem)
    assert not np.isfinite(record.parameters[2]).any()
    others = [0, 1, 3, 4]
    clean = fit(make_problem(seeds, rows=np.tile(rows[:1], (5, 1)), epochs=6, check=3))
    same(record.select(others), clean.select(others), "parameters", "snapshots")
    np.testing.assert_array_equal(record.history[0][:, others], clean.history[0][:, others])


@pytest.mark.parametrize("per_block", [1, 7])
def test_result_does_not_depend_on_the_size_of_blocks(fit, per_block):
    stopping = {"patience": 4, "min_delta_rad2": 1e-3}
    problem = make_problem(epochs=20, learning_rate=0.02, early_stopping=stopping)
    same(fit(problem, epochs_per_block=per_block), fit(problem))


@pytest.mark.filterwarnings("ignore:.*callbacks used to create the checkpoint")
def test_resume_from_a_lightning_checkpoint_equals_one_run(fit, tmp_path):
    stopping = {"patience": 5, "min_delta_rad2": 1e-3, "restore_best": True}
    problem = make_problem(epochs=30, learning_rate=0.02, early_stopping=stopping)
    whole = fit(
        problem,
        callbacks=[ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1)],
        epochs_per_block=6,
        enable_checkpointing=True,
    )
    assert len(list(tmp_path.iterdir())) >= 3
    resumed = fit(problem, epochs_per_block=6, resume_from=str(tmp_path / "epoch=1.ckpt"))
    same(resumed, whole)
    assert not np.array_equal(whole.parameters, fit(make_problem(epochs=12)).parameters)


def test_callbacks_and_logged_values_are_lightnings(fit):
    class Listener(pl.Callback):
        def __init__(self):
            self.seen = []

        def on_train_epoch_end(self, trainer, module):
            metrics = trainer.callback_metrics
            self.seen.append(
                (trainer.global_step, metrics["train_loss"], metrics["validation_loss"])
            )

    listener = Listener()
    record = fit(make_problem(epochs=20), callbacks=[listener], epochs_per_block=8)
    steps, train, check = zip(*listener.seen, strict=True)
    assert steps == (1, 2, 3)
    ends = [7, 15, 19]
    np.testing.assert_allclose(train, record.history[0, ends].mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(check, record.history[1, ends].mean(axis=1), rtol=1e-6)


def test_snapshots_begin_with_the_initial_and_end_with_the_final_weights(fit):
    problem = make_problem(epochs=40)
    record = fit(problem)
    np.testing.assert_array_equal(record.snapshots[0], stack(*initial_weights((3, 7, 3), range(4))))
    np.testing.assert_array_equal(record.snapshots[-1], record.parameters)
    middle = int(record.snapshot_epochs[3])
    np.testing.assert_array_equal(record.snapshots[3], fit(make_problem(epochs=middle)).parameters)


SCHEDULES = [
    {"hidden": (16,), "n": 125, "batch_size": 8, "epochs": 20},
    {"hidden": (16,), "n": 125, "batch_size": 8, "epochs": 20, "activation": "tanh"},
    {"hidden": (10, 7), "n": 27, "batch_size": 5, "epochs": 50, "schedule": "cosine"},
    {"hidden": (5, 6, 7), "n": 45, "batch_size": 20, "epochs": 80, "activation": "tanh"},
    {"hidden": (), "n": 8, "batch_size": 8, "epochs": 200},
    {"hidden": (16,), "n": 1, "batch_size": 8, "epochs": 200, "seeds": [5]},
    {"hidden": (16,), "n": 9, "batch_size": 1, "epochs": 30, "activation": "tanh"},
    {"hidden": (40,), "n": 64, "batch_size": 64, "epochs": 200, "learning_rate": 0.005},
    {"hidden": (16,), "n": 30, "batch_size": 2, "epochs": 20, "seeds": range(33)},
]


@pytest.mark.parametrize("shape", SCHEDULES, ids=str)
def test_fused_engine_follows_the_reference(shape):
    # Both round differently in the last place, and a ReLU's kink or Adam's division by a tiny root
    # can blow that up: after some 300 steps losses agree to 2e-4 relative, parameters to 2e-4.
    problem = make_problem(**({"seeds": range(5)} | shape))
    fused = fit_with(problem, make_engine("fused", problem))
    reference = fit_with(problem)
    np.testing.assert_allclose(fused.history[:2], reference.history[:2], rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(fused.history[2:], reference.history[2:], rtol=2e-4, atol=2e-6)
    np.testing.assert_allclose(fused.snapshots, reference.snapshots, atol=2e-4)
    assert (np.abs(fused.parameters - fused.snapshots[0]).max(axis=1) > 0.005).all()


def test_engines_agree_when_each_seed_has_its_own_samples():
    rows = np.argsort(np.random.default_rng(1).random((20, 30)), axis=1)[:, :21].astype(np.int32)
    problem = make_problem(range(20), n=21, check=9, rows=rows, epochs=40)
    records = [fit_with(problem, make_engine(name, problem)) for name in ("fused", "reference")]
    losses = [record.history[:2] for record in records]
    np.testing.assert_allclose(*losses, rtol=2e-4, atol=1e-7)
    # The samples matter: seeds that start alike but learn from others end elsewhere.
    shared = fit_with(make_problem(range(20), n=21, epochs=40))
    assert not np.isclose(shared.parameters, records[0].parameters, atol=1e-3).all(axis=1).any()


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["constant", "plateau"])
def test_engines_end_with_the_same_errors(schedule):
    # 2400 steps: single trajectories have parted, their distribution has not.
    problem = make_problem(
        range(40), n=61, hidden=(16,), epochs=300, schedule=schedule, plateau_patience=10
    )
    losses = [
        fit_with(problem, make_engine(name, problem)).history[1, -1]
        for name in ("fused", "reference")
    ]
    spread = np.std(losses[0])
    assert abs(losses[0].mean() - losses[1].mean()) < 0.05 * spread
    assert stats.ks_2samp(*losses).pvalue > 0.9


def test_plateau_halves_the_rate_of_a_stalled_seed_alone(fit):
    shape = {"hidden": (16,), "epochs": 60, "learning_rate": 0.05}
    free = fit(make_problem(range(8), **shape))
    record = fit(make_problem(range(8), **shape, schedule="plateau", plateau_patience=4))
    for i in range(8):
        check, best, waited, halved = free.history[1, :, i], np.inf, 0, 60
        for epoch, loss in enumerate(check, 1):
            waited = 0 if loss < best else waited + 1
            best = min(best, loss)
            if waited == 4:
                halved = epoch
                break
        np.testing.assert_array_equal(record.history[:, :halved, i], free.history[:, :halved, i])
        if halved < 60:
            before, after = (r.history[0, halved, i] for r in (free, record))
            assert before != after
            # From there on as with half the rate: one epoch further from the same weights.
            assert not np.array_equal(record.parameters[i], free.parameters[i])


@pytest.mark.slow
@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_fused_gradient_against_finite_differences(activation, rng):
    n, sizes, lanes = 5, (3, 6, 4, 2), fused.LANES
    kernels, _ = initial_weights(sizes, range(lanes))
    biases = [rng.normal(size=(lanes, size)) for size in sizes[1:]]
    start = stack([kernel.astype(float) for kernel in kernels], biases)
    points, targets = rng.normal(size=(n, 3)), rng.normal(size=(n, 2))

    def losses(flat):
        network = StackedMLP(
            *unstack(flat, sizes, np.ones(sizes[-1])),
            activation,
            np.zeros(3),
            np.ones(3),
            tuple(range(lanes)),
        )
        return np.mean((network.predict(points) - targets) ** 2, axis=(1, 2))

    w, m, v = start.T.flatten(), np.zeros(start.size), np.zeros(start.size)
    order = np.tile(np.arange(n, dtype=np.int32), (lanes, 1))
    handed = (
        fused.Data(points, targets, order, order[:, :0]),
        np.array(sizes),
        kernel.ACTIVATIONS[activation],
        fused.Schedule(n, 1, np.ones(1), np.ones(1)),
        fused.Group(
            *(np.arange(lanes, dtype=np.uint64), w, m, v, w.copy()),
            *(np.zeros(lanes), np.zeros((4, lanes), np.int64), np.ones(lanes)),
        ),
        fused.Filled(np.zeros(5 * lanes), np.array([-1]), np.zeros(0)),
        fused.Stopping(0, False, np.float64(0), 0),
        (0,) * lanes,
        (0,) * 4,
    )
    fused.compiled(*handed)(*handed)
    # After one step the mean of the gradients is a tenth of the gradient.
    gradient = m.reshape(-1, lanes).T / (1 - kernel.BETA_1)
    step = 1e-6
    for p in range(start.shape[1]):
        up, down = start.copy(), start.copy()
        up[:, p] += step
        down[:, p] -= step
        slope = (losses(up) - losses(down)) / (2 * step)
        np.testing.assert_allclose(gradient[:, p], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_tanh_of_the_kernel(rng):
    import numba

    @numba.njit
    def evaluate(x, y, lanes):
        for k in range(len(x) // len(lanes)):
            store(y, k, tanh(load(x, k, lanes, (0,))))

    x = np.concatenate([rng.normal(size=2**20) * s for s in (1e-3, 0.3, 1, 4, 100)])
    x = np.concatenate([x, np.linspace(0, 12, 2**20), [0, np.inf, -np.inf, 1e-40] * 4])
    x = x.astype(np.float32)
    y = np.empty_like(x)
    evaluate(x, y, (0,) * 16)
    exact = np.tanh(x.astype(float))
    assert (np.abs(y - exact) <= 6 * np.spacing(np.abs(exact).astype(np.float32))).all()
    nothing = np.full(16, np.nan, np.float32)
    evaluate(nothing, y, (0,) * 16)
    assert np.isnan(y[:16]).all()


def test_kernel_shuffles_like_everyone_else():
    order = np.tile(np.arange(50, dtype=np.int32), (3, 1))
    expected = permutations([7, 8, 2**31 - 1], [12], 50)[:, 0]
    for lane, seed in enumerate([7, 8, 2**31 - 1]):
        kernel.shuffle(order, lane, np.uint64(seed), 12, np.empty(50, np.int32))
    np.testing.assert_array_equal(order, expected)


def test_result_does_not_depend_on_threads():
    problem = make_problem(range(50), epochs=5)
    before, records = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            records.append(fit_with(problem, make_engine("fused", problem)))
    finally:
        torch.set_num_threads(before)
    same(*records)


@pytest.mark.slow
def test_kernel_works_without_a_place_for_its_cache(tmp_path):
    package = tmp_path / "iksamples"
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(kernel.__file__).parents[1], package, ignore=ignore)
    (package / "training" / "__pycache__").write_text("a file where the folder should be")
    code = (
        "import sys; sys.path[:0] = sys.argv[1:];"
        "import iksamples, training_problems as t;"
        "from iksamples.training.module import fit, make_engine;"
        "assert iksamples.__file__.startswith(sys.argv[1]), iksamples.__file__;"
        "p = t.make_problem(epochs=3);"
        "print(fit(p, make_engine('fused', p)).parameters.sum())"
    )
    environment = {**os.environ, "HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null"}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), str(Path(__file__).parent)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    problem = make_problem(epochs=3)
    expected = fit_with(problem, make_engine("fused", problem)).parameters.sum()
    assert done.stdout.strip() == str(expected)
    assert not list(tmp_path.rglob("*.nbi"))


def test_a_damaged_cache_is_done_without(monkeypatch):
    class Dispatcher:
        def __init__(self, cached):
            self.cached = cached

        def compile(self, signature):
            if self.cached:
                raise EOFError("Ran out of input")

    monkeypatch.setattr(fused, "_dispatcher", Dispatcher)
    assert not fused.compiled(1.0).cached
