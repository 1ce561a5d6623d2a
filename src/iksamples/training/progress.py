"""What is known of a training while it runs: history, snapshots and who has stopped, per seed."""

import torch
from torch import Tensor, nn

from iksamples.training.problem import Problem, snapshot_epochs
from iksamples.training.record import METRICS


class Progress(nn.Module):
    """The record of a training, as buffers, so that a Lightning checkpoint carries it.

    A seed whose validation loss has not dropped for ``patience`` epochs is stopped: its weights are
    put aside (``kept``) and the rest of its row in the stack no longer matters, so its neighbours
    go on as if nothing had happened. Without validation points nothing stops.

    Attributes:
        history: One row per metric of ``METRICS``, shape (5, epochs, seeds), NaN where not run.
        snapshots: Parameters at ``snapshot_epochs``, shape (snapshots, seeds, parameters).
        kept: Parameters put aside, shape (seeds, parameters).
        best_loss: Validation loss of the best epoch [rad^2], shape (seeds,).
        best_epoch: The best epoch so far, 0 for none, shape (seeds,).
        waited: Epochs since then, shape (seeds,).
        stopped: Epoch after which a seed was stopped, 0 while it runs, shape (seeds,).
    """

    history: Tensor
    snapshots: Tensor
    snapshot_epochs: Tensor
    kept: Tensor
    best_loss: Tensor
    best_epoch: Tensor
    waited: Tensor
    stopped: Tensor

    def __init__(self, problem: Problem, start: Tensor) -> None:
        """An empty record.

        Args:
            problem: What is trained.
            start: Initial parameters, shape (seeds, parameters).
        """
        super().__init__()
        settings, n = problem.training, problem.n_seeds
        stopping = settings.early_stopping if problem.validation_rows.shape[1] else None
        self.patience = stopping.patience if stopping else 0
        self.min_delta = stopping.min_delta_rad2 if stopping else 0.0
        self.restore_best = bool(stopping and stopping.restore_best)
        epochs = torch.from_numpy(snapshot_epochs(settings.epochs, settings.snapshots))
        snapshots = torch.zeros((len(epochs), *start.shape))
        snapshots[0] = start
        self.register_buffer("history", torch.full((len(METRICS), settings.epochs, n), torch.nan))
        self.register_buffer("snapshot_epochs", epochs)
        self.register_buffer("snapshots", snapshots)
        self.register_buffer("kept", start.clone())
        self.register_buffer("best_loss", torch.full((n,), torch.inf))
        self.register_buffer("best_epoch", torch.zeros(n, dtype=torch.int64))
        self.register_buffer("waited", torch.zeros(n, dtype=torch.int64))
        self.register_buffer("stopped", torch.zeros(n, dtype=torch.int64))

    def end_epoch(self, epoch: int, metrics: Tensor, flat: Tensor) -> None:
        """Records an epoch (counted from 1) and stops the seeds that no longer improve.

        Args:
            epoch: The epoch that has ended.
            metrics: Shape (5, seeds).
            flat: Parameters, shape (seeds, parameters).
        """
        running = self.stopped == 0
        self.history[:, epoch - 1] = torch.where(running, metrics, torch.nan)
        validation = metrics[1]
        better = running & (validation < self.best_loss - self.min_delta)
        self.best_loss = torch.where(better, validation, self.best_loss)
        self.best_epoch = torch.where(better, epoch, self.best_epoch)
        self.waited = torch.where(better, 0, self.waited + 1)
        if self.patience:
            stops = running & (self.waited >= self.patience)
            self.stopped = torch.where(stops, epoch, self.stopped)
            aside = better if self.restore_best else stops
            self.kept = torch.where(aside[:, None], flat, self.kept)
        slot = torch.nonzero(self.snapshot_epochs == epoch)
        if len(slot):
            stopped = (self.stopped > 0)[:, None]
            self.snapshots[slot[0, 0]] = torch.where(stopped, self.kept, flat)

    def all_stopped(self) -> bool:
        """Whether no seed is left to train."""
        return bool(torch.all(self.stopped > 0))

    def final(self, flat: Tensor) -> Tensor:
        """The parameters each seed ends with, shape (seeds, parameters)."""
        aside = self.best_epoch > 0 if self.restore_best else self.stopped > 0
        return torch.where(aside[:, None], self.kept, flat) if self.patience else flat
