"""The reference engine: stacked networks by automatic differentiation in torch.

A leading axis runs over the seeds and the losses are summed over it, so each seed gets its own
gradient. Any depth and device; the fused engine is held against this one. All engines
keep what is known of a training while it runs in a ``Progress``.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any


# By default MKL rounds a matrix product by where in memory it lies, and in a stack that depends on
# the number of seeds. MKL reads this once, at the process's first matrix product.
os.environ.setdefault("MKL_CBWR", "AVX2,STRICT")

import torch
from torch import Tensor, nn

from iksamples.training.problem import (
    Problem,
    learning_rates,
    permutations,
    snapshot_epochs,
)
from iksamples.training.record import METRICS, layers


class Progress(nn.Module):
    """The record of a training, as buffers, so that a Lightning checkpoint carries it.

    A seed whose validation loss has not dropped for ``patience`` epochs is stopped: its weights are
    put aside (``kept``) and the rest of its row in the stack no longer matters, so its neighbours
    go on as if nothing had happened. Likewise a stalled seed's learning rate is halved if the study
    says so. Without validation points nothing stops or stalls.

    Attributes:
        history: One row per metric of ``METRICS``, shape (5, epochs, seeds), NaN where not run.
        snapshots: Parameters at ``snapshot_epochs``, shape (snapshots, seeds, parameters).
        kept: Parameters put aside, shape (seeds, parameters).
        best_loss: Validation loss of the best epoch [rad^2], shape (seeds,).
        best_epoch: The best epoch so far, 0 for none, shape (seeds,).
        waited: Epochs since then, shape (seeds,).
        stalled: Epochs since then or since the learning rate was halved, shape (seeds,).
        factor: What the learning rate is multiplied with, shape (seeds,).
        stopped: Epoch after which a seed was stopped, 0 while it runs, shape (seeds,).
    """

    history: Tensor
    snapshots: Tensor
    snapshot_epochs: Tensor
    kept: Tensor
    best_loss: Tensor
    best_epoch: Tensor
    waited: Tensor
    stalled: Tensor
    factor: Tensor
    stopped: Tensor

    def __init__(self, problem: Problem, start: Tensor) -> None:
        """An empty record.

        Args:
            problem: What is trained.
            start: Initial parameters, shape (seeds, parameters).
        """
        super().__init__()
        settings, n = problem.training, problem.n_seeds
        checked = problem.validation_rows.shape[1] > 0
        stopping = settings.early_stopping if checked else None
        stalls = checked and settings.schedule == "plateau"
        self.patience = stopping.patience if stopping else 0
        self.min_delta = stopping.min_delta_rad2 if stopping else 0.0
        self.plateau = settings.plateau_patience if stalls else 0
        self.restore_best = bool(stopping and stopping.restore_best)
        epochs = torch.from_numpy(snapshot_epochs(settings.epochs, settings.snapshots))
        snapshots = start.new_zeros((len(epochs), *start.shape))
        snapshots[0] = start
        self.register_buffer("history", torch.full((len(METRICS), settings.epochs, n), torch.nan))
        self.register_buffer("snapshot_epochs", epochs)
        self.register_buffer("snapshots", snapshots)
        self.register_buffer("kept", start.clone())
        self.register_buffer("best_loss", torch.full((n,), torch.inf))
        self.register_buffer("best_epoch", torch.zeros(n, dtype=torch.int64))
        self.register_buffer("waited", torch.zeros(n, dtype=torch.int64))
        self.register_buffer("stalled", torch.zeros(n, dtype=torch.int64))
        self.register_buffer("factor", torch.ones(n))
        self.register_buffer("stopped", torch.zeros(n, dtype=torch.int64))

    def end_epoch(self, epoch: int, metrics: Tensor, flat: Tensor) -> None:
        """Records an epoch (counted from 1) and stops the seeds that no longer improve.

        Args:
            epoch: The epoch that has ended.
            metrics: Shape (5, seeds).
            flat: Parameters, shape (seeds, parameters).
        """
        running = self.stopped == 0
        metrics = metrics.to(self.history.dtype)
        self.history[:, epoch - 1] = torch.where(running, metrics, torch.nan)
        validation = metrics[1]
        better = running & (validation < self.best_loss - self.min_delta)
        self.best_loss = torch.where(better, validation, self.best_loss)
        self.best_epoch = torch.where(better, epoch, self.best_epoch)
        self.waited = torch.where(running, torch.where(better, 0, self.waited + 1), self.waited)
        self.stalled = torch.where(running, torch.where(better, 0, self.stalled + 1), self.stalled)
        if self.plateau:
            stalls = running & (self.stalled >= self.plateau)
            self.factor = torch.where(stalls, 0.5 * self.factor, self.factor)
            self.stalled = torch.where(stalls, 0, self.stalled)
        if self.patience:
            stops = running & (self.waited >= self.patience)
            self.stopped = torch.where(stops, epoch, self.stopped)
            aside = better if self.restore_best else stops
            self.kept = torch.where(aside[:, None], flat, self.kept)
        slot = torch.nonzero(self.snapshot_epochs == epoch)
        if len(slot):
            self.snapshots[slot[0, 0]] = flat

    def stop(self, finished: Tensor, epoch: int, flat: Tensor) -> None:
        """Stops seeds that have nothing left to learn.

        Args:
            finished: Whether a seed is to stop, shape (seeds,).
            epoch: The epoch that has ended.
            flat: Parameters, shape (seeds, parameters).
        """
        stops = (self.stopped == 0) & finished
        self.stopped = torch.where(stops, epoch, self.stopped)
        if not self.restore_best:
            self.kept = torch.where(stops[:, None], flat, self.kept)

    def all_stopped(self) -> bool:
        """Whether no seed is left to train."""
        return bool(torch.all(self.stopped > 0))

    def final(self, flat: Tensor) -> Tensor:
        """The parameters each seed ends with, shape (seeds, parameters)."""
        aside = self.best_epoch > 0 if self.restore_best else self.stopped > 0
        return torch.where(aside[:, None], self.kept, flat)

    def replay(self, flat: Tensor) -> Tensor:
        """The snapshots, a stopped seed standing still; the last one is what each seed ends with.

        Args:
            flat: Parameters of the stack, shape (seeds, parameters).

        Returns:
            Shape (snapshots, seeds, parameters).
        """
        over = (self.stopped > 0) & (self.snapshot_epochs[:, None] >= self.stopped)
        snapshots = torch.where(over[:, :, None], self.kept, self.snapshots)
        snapshots[-1] = self.final(flat)
        return snapshots


# Another one has to round an element alike wherever it lies in its array, else a seed's result
# depends on its neighbours; torch.sigmoid, gelu and elu do not.
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"relu": torch.relu, "tanh": torch.tanh}

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-7
"""Adam's constants, those of Keras."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Keeps torch to one thread: two would split a sum by the size of the stack.

    These networks are too small to gain from more.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class StackedAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba, 2015, Algorithm 1) on the flat parameters of all seeds.

    For Lightning one step is a block of epochs: ``step`` calls the closure that trains the block,
    and the closure calls ``update`` once for every mini-batch. Moments live in the optimiser's
    state, where a checkpoint finds them.
    """

    def __init__(self, flat: nn.Parameter) -> None:
        """Starts with zero moments.

        Args:
            flat: Parameters, shape (seeds, parameters).
        """
        super().__init__([flat], {})
        self.flat = flat
        self.state[flat] = {"mean": torch.zeros_like(flat), "square": torch.zeros_like(flat)}

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Trains a block of epochs."""
        return closure() if closure else None

    @torch.no_grad()
    def update(self, gradient: Tensor, step: int, rate: Tensor) -> None:
        """One update of every seed.

        Args:
            gradient: Shape (seeds, parameters).
            step: Number of the update, counted from 1.
            rate: Learning rate of each seed, shape (seeds,).
        """
        mean, square = self.state[self.flat]["mean"], self.state[self.flat]["square"]
        mean.mul_(BETA_1).add_(gradient, alpha=1 - BETA_1)
        square.mul_(BETA_2).addcmul_(gradient, gradient, value=1 - BETA_2)
        root = (1 - BETA_2**step) ** 0.5
        size = (rate / (1 - BETA_1**step))[:, None]
        self.flat.sub_(size * mean / (square.sqrt() / root).add_(EPSILON))


def forward(stack: Sequence[tuple[Tensor, Tensor]], activation: str, x: Tensor) -> Tensor:
    """Outputs of the stacked networks, shape (seeds, points, out), for (seeds, points, in)."""
    for depth, (kernel, bias) in enumerate(stack):
        x = torch.baddbmm(bias[:, None, :], x, kernel)
        if depth < len(stack) - 1:
            x = ACTIVATIONS[activation](x)
    return x


def seed_losses(
    stack: Sequence[tuple[Tensor, Tensor]], activation: str, x: Tensor, y: Tensor
) -> Tensor:
    """Mean squared error of each seed over points and joints [rad^2], shape (seeds,)."""
    return (forward(stack, activation, x) - y).square().mean(dim=(1, 2))


class ReferenceEngine:
    """Trains blocks of epochs by automatic differentiation."""

    dtype = torch.float32
    pace = 1e7

    def __init__(self, problem: Problem) -> None:
        """Takes the problem whose seeds it trains."""
        self.problem = problem

    @one_thread()
    def run(
        self, flat: Tensor, adam: StackedAdam, progress: Progress, first: int, n_epochs: int
    ) -> None:
        """Trains from epoch ``first`` (counted from 1) for ``n_epochs`` epochs.

        Args:
            flat: Parameters, changed in place, shape (seeds, parameters).
            adam: Their optimiser.
            progress: The record that each epoch is entered into.
            first: First epoch.
            n_epochs: Number of epochs.
        """
        problem, device = self.problem, flat.device
        inputs, targets = (
            torch.from_numpy(table).to(device) for table in (problem.inputs, problem.targets)
        )
        train_rows, validation_rows = (
            torch.tensor(rows, dtype=torch.int64, device=device)
            for rows in (problem.train_rows, problem.validation_rows)
        )
        x_check, y_check = inputs[validation_rows], targets[validation_rows]
        flat = flat.detach()
        # The leaves are views of the flat parameters, which are updated in place.
        stack = list(layers(flat, problem.sizes))
        leaves = [leaf.requires_grad_() for layer in stack for leaf in layer]
        size = problem.training.batch_size
        rates = learning_rates(problem.training)
        for epoch in range(first, first + n_epochs):
            order = torch.from_numpy(permutations(problem.seeds, [epoch], problem.n_train)[:, 0])
            rate = progress.factor * float(rates[epoch - 1])
            rows = train_rows.gather(1, order.to(device, torch.int64))
            x, y = inputs[rows], targets[rows]
            total = torch.zeros(problem.n_seeds, dtype=torch.float64, device=device)
            for batch in range(problem.steps_per_epoch):
                chosen = slice(batch * size, (batch + 1) * size)
                losses = seed_losses(stack, problem.activation, x[:, chosen], y[:, chosen])
                slopes = torch.autograd.grad(losses.sum(), leaves)
                gradient = torch.cat([slope.flatten(1) for slope in slopes], dim=1)
                adam.update(gradient, (epoch - 1) * problem.steps_per_epoch + batch + 1, rate)
                total += losses.detach().double() * x[:, chosen].shape[1]
            with torch.no_grad():
                metrics = [
                    (total / problem.n_train).float(),
                    seed_losses(stack, problem.activation, x_check, y_check),
                    *kernel_statistics(stack),
                ]
                progress.end_epoch(epoch, torch.stack(metrics), flat)
            if progress.patience and progress.all_stopped():
                return


def kernel_statistics(stack: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, mean absolute and largest absolute kernel entry of each seed (biases left out)."""
    entries = torch.cat([kernel.detach().flatten(1) for kernel, _ in stack], dim=1).double()
    return (
        entries.mean(1).float(),
        entries.abs().mean(1).float(),
        entries.abs().amax(1).float(),
    )
