"""What is known of a training while it runs: history, snapshots and who has stopped, per seed."""

import torch
from torch import Tensor, nn

from iksamples.training.problem import Problem, snapshot_epochs
from iksamples.training.record import METRICS


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
