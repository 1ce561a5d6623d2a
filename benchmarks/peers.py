"""Other ways to train the same networks on the same work, one function each.

Each takes a problem and a number of epochs and returns the seconds of the training alone (imports,
compilation and set-up left out, shuffles in) and the parameters it ended with, layer by layer
kernel and bias, shape (seeds, parameters). Weights start Glorot-uniform with zero biases, batches
are reshuffled every epoch, the last one may be smaller, Adam's epsilon is 1e-7.
"""

import ctypes
import functools
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from iksamples.training.problem import Problem, initial_weights
from iksamples.training.record import stack, unstack


Result = tuple[float, np.ndarray]


def fused(problem: Problem, epochs: int) -> Result:
    """This project: the fused engine under Lightning, validation and history kept."""
    return _ours(problem, epochs, "fused")


def kernel(problem: Problem, epochs: int) -> Result:
    """This project: the fused engine called without Lightning."""
    from dataclasses import replace

    from iksamples.training.module import StackedTraining, make_engine

    shorter = replace(problem, training=problem.training.model_copy(update={"epochs": epochs}))
    start = time.perf_counter()
    engine = make_engine("fused", shorter)
    module = StackedTraining(shorter, engine)
    adam = module.configure_optimizers()
    engine.run(module.flat.detach(), adam, module.progress, 1, epochs)
    record = module.result()
    return time.perf_counter() - start, record.parameters


def reference(problem: Problem, epochs: int) -> Result:
    """This project: stacked autograd under Lightning, validation and history kept."""
    return _ours(problem, epochs, "reference")


def _ours(problem: Problem, epochs: int, engine: str) -> Result:
    from dataclasses import replace

    from iksamples.training.module import fit, make_engine

    shorter = replace(problem, training=problem.training.model_copy(update={"epochs": epochs}))
    start = time.perf_counter()
    record = fit(shorter, make_engine(engine, shorter))
    return time.perf_counter() - start, record.parameters


def keras(problem: Problem, epochs: int) -> Result:
    """Keras' ``Model.fit`` for one seed after another (backend as installed)."""
    import keras as k

    k.backend.clear_session()
    n, seconds, ends = problem.n_train, 0.0, []
    for seed in problem.seeds:
        k.utils.set_random_seed(seed)
        layers = [k.layers.Input((problem.sizes[0],))]
        layers += [k.layers.Dense(size, problem.activation) for size in problem.sizes[1:-1]]
        model = k.Sequential([*layers, k.layers.Dense(problem.sizes[-1])])
        model.compile(k.optimizers.Adam(problem.training.learning_rate), "mse")
        x, y = problem.inputs[:n], problem.targets[:n]
        weights = model.get_weights()
        options = {"batch_size": problem.training.batch_size, "verbose": 0}
        model.fit(x, y, epochs=1, **options)  # traces the training step
        model.set_weights(weights)
        for variable in model.optimizer.variables[2:]:
            variable.assign(np.zeros(variable.shape))
        model.optimizer.iterations.assign(0)
        start = time.perf_counter()
        model.fit(x, y, epochs=epochs, **options)
        seconds += time.perf_counter() - start
        ends.append(np.concatenate([part.ravel() for part in model.get_weights()]))
    return seconds, np.array(ends)


def scikit_learn(problem: Problem, epochs: int) -> Result:
    """scikit-learn's ``MLPRegressor`` for one seed after another (its biases do not start at 0)."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    n, seconds, ends = problem.n_train, 0.0, []
    for seed in problem.seeds:
        model = MLPRegressor(
            hidden_layer_sizes=problem.sizes[1:-1],
            activation=problem.activation,
            alpha=0,
            batch_size=min(problem.training.batch_size, n),
            learning_rate_init=problem.training.learning_rate,
            max_iter=epochs,
            tol=0,
            n_iter_no_change=epochs + 1,
            epsilon=1e-7,
            random_state=seed,
        )
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            model.fit(problem.inputs[:n], problem.targets[:n])
        seconds += time.perf_counter() - start
        parts = [
            part for layer in zip(model.coefs_, model.intercepts_, strict=True) for part in layer
        ]
        ends.append(np.concatenate([part.ravel() for part in parts]))
    return seconds, np.array(ends)


def _torch_network(problem: Problem, seed: int):
    import torch
    from torch import nn

    activation = {"relu": nn.ReLU, "tanh": nn.Tanh}[problem.activation]
    kernels, _ = initial_weights(problem.sizes, [seed])
    modules: list[nn.Module] = []
    for kernel in kernels:
        linear = nn.Linear(*kernel.shape[1:])
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(kernel[0].T))
            linear.bias.zero_()
        modules += [linear, activation()]
    return nn.Sequential(*modules[:-1])


def _torch_parameters(network) -> np.ndarray:
    parts = [
        part.detach().numpy().ravel()
        for linear in network[::2]
        for part in (linear.weight.T, linear.bias)
    ]
    return np.concatenate(parts)


def torch_loop(problem: Problem, epochs: int) -> Result:
    """A plain PyTorch loop (index shuffles, fused Adam) for one seed after another."""
    import torch
    from torch.nn.functional import mse_loss

    n, size = problem.n_train, problem.training.batch_size
    x, y = torch.from_numpy(problem.inputs[:n]), torch.from_numpy(problem.targets[:n])
    seconds, ends = 0.0, []
    for seed in problem.seeds:
        generator = torch.Generator().manual_seed(seed)
        network = _torch_network(problem, seed)
        rate = problem.training.learning_rate
        adam = torch.optim.Adam(network.parameters(), rate, eps=1e-7, fused=True)
        start = time.perf_counter()
        for _ in range(epochs):
            for rows in torch.randperm(n, generator=generator).split(size):
                adam.zero_grad()
                mse_loss(network(x[rows]), y[rows]).backward()
                adam.step()
        seconds += time.perf_counter() - start
        ends.append(_torch_parameters(network))
    return seconds, np.array(ends)


def lightning_per_seed(problem: Problem, epochs: int) -> Result:
    """A ``LightningModule`` and a ``DataLoader`` for one seed after another, quiet trainer."""
    import pytorch_lightning as pl
    import torch
    from torch.nn.functional import mse_loss
    from torch.utils.data import DataLoader, TensorDataset

    class Plain(pl.LightningModule):
        def __init__(self, network):
            super().__init__()
            self.network = network

        def training_step(self, batch, _):
            loss = mse_loss(self.network(batch[0]), batch[1])
            self.log("train_loss", loss, on_step=False, on_epoch=True)
            return loss

        def configure_optimizers(self):
            return torch.optim.Adam(self.parameters(), problem.training.learning_rate, eps=1e-7)

    n, seconds, ends = problem.n_train, 0.0, []
    data = TensorDataset(
        torch.from_numpy(problem.inputs[:n]), torch.from_numpy(problem.targets[:n])
    )
    for seed in problem.seeds:
        module = Plain(_torch_network(problem, seed))
        generator = torch.Generator().manual_seed(seed)
        loader = DataLoader(data, problem.training.batch_size, shuffle=True, generator=generator)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trainer = pl.Trainer(
                max_epochs=epochs,
                accelerator="cpu",
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
            start = time.perf_counter()
            trainer.fit(module, loader)
            seconds += time.perf_counter() - start
        ends.append(_torch_parameters(module.network))
    return seconds, np.array(ends)


@functools.cache
def _jax_program(sizes, activation, n, size, rate, epochs):
    import jax
    import jax.numpy as jnp

    act = {"relu": jax.nn.relu, "tanh": jnp.tanh}[activation]
    steps = -(-n // size)

    def loss(parameters, x, y, weight):
        for depth, (kernel, bias) in enumerate(parameters):
            x = x @ kernel + bias
            x = act(x) if depth < len(sizes) - 2 else x
        return jnp.sum(weight[:, None] * (x - y) ** 2) / (jnp.sum(weight) * sizes[-1])

    def train(parameters, seed, x, y):
        # The last mini-batch is filled up with samples of weight zero.
        weight = (jnp.arange(steps * size) < n).astype(jnp.float32).reshape(steps, size)

        def step(state, batch):
            parameters, mean, square, t = state
            rows, weight = batch
            gradient = jax.grad(loss)(parameters, x[rows], y[rows], weight)
            t = t + 1
            mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, mean, gradient)
            square = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, square, gradient)
            c, s = 1 - 0.9**t, jnp.sqrt(1 - 0.999**t)
            parameters = jax.tree.map(
                lambda p, m, v: p - rate * (m / c) / (jnp.sqrt(v) / s + 1e-7),
                parameters,
                mean,
                square,
            )
            return (parameters, mean, square, t), None

        def epoch(state, key):
            order = jnp.pad(jax.random.permutation(key, n), (0, steps * size - n))
            state, _ = jax.lax.scan(step, state, (order.reshape(steps, size), weight))
            return state, None

        zeros = jax.tree.map(jnp.zeros_like, parameters)
        keys = jax.random.split(jax.random.key(seed), epochs)
        state, _ = jax.lax.scan(epoch, (parameters, zeros, zeros, jnp.float32(0)), keys)
        return state[0]

    return jax.jit(jax.vmap(train, in_axes=(0, 0, None, None)))


def jax_vmap(problem: Problem, epochs: int) -> Result:
    """JAX: the whole training of a seed as nested scans, vmapped over the seeds."""
    import jax

    n, settings = problem.n_train, problem.training
    train = _jax_program(
        problem.sizes, problem.activation, n, settings.batch_size, settings.learning_rate, epochs
    )
    arguments = (
        tuple(zip(*initial_weights(problem.sizes, problem.seeds), strict=True)),
        np.array(problem.seeds),
        problem.inputs[:n],
        problem.targets[:n],
    )
    compiled = _jax_compiled(train, arguments)
    start = time.perf_counter()
    end = jax.block_until_ready(compiled(*arguments))
    seconds = time.perf_counter() - start
    kernels, biases = zip(*[tuple(map(np.asarray, layer)) for layer in end], strict=True)
    return seconds, stack(kernels, biases)


_COMPILED: dict[tuple, Callable] = {}


def _jax_compiled(train, arguments):
    key = (train, len(arguments[1]))
    if key not in _COMPILED:
        _COMPILED[key] = train.lower(*arguments).compile()
    return _COMPILED[key]


@functools.cache
def _floor_library():
    folder = Path(tempfile.mkdtemp())
    flags = ["-O3", "-march=native", "-mprefer-vector-width=512", "-fno-math-errno"]
    source = Path(__file__).with_name("floor.c")
    command = ["gcc", *flags, "-shared", "-fPIC", str(source), "-o", str(folder / "floor.so")]
    subprocess.run(command, check=True, capture_output=True)
    return ctypes.CDLL(str(folder / "floor.so"))


def floor_c(problem: Problem, epochs: int) -> Result:
    """The hand-written C kernel: this one network, no validation, no history, no Lightning."""
    from iksamples.training.fused import step_sizes

    if (problem.sizes, problem.activation, problem.training.batch_size) != ((3, 16, 3), "relu", 8):
        raise ValueError("the C kernel is 3-16-3, ReLU, batches of 8 and nothing else")
    library = _floor_library()

    def aligned(shape: tuple[int, ...]) -> np.ndarray:
        raw = np.zeros(int(np.prod(shape)) * 4 + 64, np.uint8)
        start = -raw.ctypes.data % 64
        return raw[start : start + int(np.prod(shape)) * 4].view(np.float32).reshape(shape)

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return array.ctypes.data_as(ctypes.c_void_p)

    lanes, n = 16, problem.n_train
    groups = -(-problem.n_seeds // lanes)
    rows = np.minimum(np.arange(groups * lanes), problem.n_seeds - 1)
    start = time.perf_counter()
    initial = stack(*initial_weights(problem.sizes, problem.seeds))[rows]
    w = aligned((groups, initial.shape[1], lanes))
    w[:] = initial.reshape(groups, lanes, -1).transpose(0, 2, 1)
    seeds = np.array(problem.seeds, np.uint64)[rows].reshape(groups, lanes)
    x, y = (np.ascontiguousarray(table[:n]) for table in (problem.inputs, problem.targets))
    # Only the first `epochs` of the problem's schedule are used.
    rates, epsilons = step_sizes(problem, np.arange(1, epochs + 1), np.float32)
    for group in range(groups):
        m, v, losses = aligned(w.shape[1:]), aligned(w.shape[1:]), aligned((lanes,))
        library.train(
            *(pointer(x), pointer(y), n, epochs, pointer(seeds[group])),
            *(pointer(rates), pointer(epsilons), pointer(w[group])),
            *(pointer(m), pointer(v), pointer(losses)),
        )
    seconds = time.perf_counter() - start
    return seconds, w.transpose(0, 2, 1).reshape(groups * lanes, -1)[: problem.n_seeds]


def flops_per_seed_step(problem: Problem) -> int:
    """Floating-point operations of one full mini-batch step of one seed.

    Forward, backward and loss count two per multiply-add; Adam is 13 per parameter.
    """
    batch, total = min(problem.training.batch_size, problem.n_train), 0
    for layer, (a, b) in enumerate(zip(problem.sizes[:-1], problem.sizes[1:], strict=True)):
        hidden = layer < len(problem.sizes) - 2
        total += batch * (2 * a * b + b + (b if hidden else 0))  # forward, bias, activation
        total += batch * (2 * a * b + b)  # gradients of kernel and bias
        total += batch * (2 * a * b + a) if layer > 0 else 0  # slope sent back, activation
    return total + batch * 4 * problem.sizes[-1] + 13 * problem.n_parameters


def peak_flops() -> float:
    """Best single-precision rate of a matrix product on this core [FLOP/s]."""
    import torch

    torch.set_num_threads(1)
    a, b = torch.rand(1024, 1024), torch.rand(1024, 1024)
    best = np.inf
    for _ in range(20):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return 2 * 1024**3 / best


def errors_mm(problem: Problem, samples, chain, points, parameters: np.ndarray) -> np.ndarray:
    """Mean position error of each network over some points [mm]."""
    from iksamples.network import StackedMLP

    network = StackedMLP(
        *unstack(parameters, problem.sizes, problem.output_scale),
        problem.activation,
        samples.offset,
        samples.scale,
        tuple(range(len(parameters))),
    )
    reached = chain.forward_mm(network.predict(points))
    return np.linalg.norm(reached - points, axis=-1).mean(axis=1)
