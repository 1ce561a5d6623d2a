"""The Lightning module that trains all seeds of one sample set, and the call that fits it.

Lightning costs a fraction of a millisecond per training step and a few per epoch, which is more
than these networks need. So one Lightning epoch is one training step, and that step is a block of
many epochs; the engine makes the mini-batches inside the block.
"""

import logging
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.core.optimizer import LightningOptimizer
from pytorch_lightning.plugins.environments import LightningEnvironment
from torch import Tensor, nn
from torch.utils.data import DataLoader, Sampler

from iksamples.errors import IksamplesError
from iksamples.training import record
from iksamples.training.problem import Problem, initial_weights
from iksamples.training.reference import Progress, ReferenceEngine, StackedAdam, forward, layers


FEWEST_BLOCKS = 4
"""Blocks that even the shortest training is cut into, for Lightning to have something to follow."""

Block = tuple[int, int]
"""First epoch (counted from 1) and number of epochs."""


class EpochBlocks(pl.LightningDataModule):
    """The samples of all seeds, and the blocks of epochs to train them for.

    Attributes:
        problem: The data of every seed.
        blocks: All blocks in order; Lightning's epoch k trains ``blocks[k]``.
    """

    def __init__(self, problem: Problem, epochs_per_block: int) -> None:
        """Cuts the problem's epochs into blocks."""
        super().__init__()
        self.problem = problem
        epochs = problem.training.epochs
        self.blocks: list[Block] = [
            (first, min(epochs_per_block, epochs + 1 - first))
            for first in range(1, epochs + 1, epochs_per_block)
        ]

    def train_dataloader(self) -> DataLoader[Block]:
        """One block per Lightning epoch."""
        return DataLoader(self.blocks, batch_size=None, sampler=_OneBlock())  # type: ignore[arg-type]


def block_length(problem: Problem, pace: float) -> int:
    """Epochs that take about a second, or a quarter of the training if that is less.

    Args:
        problem: What is trained.
        pace: Parameters that the engine updates in a second, roughly.
    """
    updates = problem.n_seeds * problem.n_parameters * problem.steps_per_epoch
    quarter = -(-problem.training.epochs // FEWEST_BLOCKS)
    return max(1, min(quarter, int(pace / updates)))


class _OneBlock(Sampler[int]):
    """Draws the one block that belongs to the current Lightning epoch, also after a resume."""

    def __init__(self) -> None:
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each of its epochs."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        yield self.epoch

    def __len__(self) -> int:
        return 1


class Engine(Protocol):
    """A training loop.

    Attributes:
        dtype: Precision in which it keeps the parameters.
        pace: Parameters that it updates in a second, roughly: how long a block should be.
    """

    dtype: torch.dtype
    pace: float

    def run(
        self, flat: Tensor, adam: StackedAdam, progress: Progress, first: int, n_epochs: int
    ) -> None:
        """Trains a block of epochs; see ``ReferenceEngine.run``."""


class EpochBar(pl.Callback):
    """Moves a progress bar by the epochs of each block, counted for every seed."""

    def __init__(self, bar: Any, n_seeds: int) -> None:
        """Takes the bar and the number of seeds that train together."""
        self.bar = bar
        self.n_seeds = n_seeds

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: Any, outputs: Any, batch: Block, batch_idx: int
    ) -> None:
        """A block has ended."""
        self.bar.update(batch[1] * self.n_seeds)


class StackedTraining(pl.LightningModule):
    """Many seeds of one network as one stack; a training step is a block of epochs.

    Attributes:
        problem: What is trained.
        flat: Parameters of all seeds, shape (seeds, parameters).
        progress: History, snapshots and early stopping, per seed.
        engine: The loop that does the work.
    """

    def __init__(self, problem: Problem, engine: Engine) -> None:
        """Sets the networks to their initial weights."""
        super().__init__()
        self.automatic_optimization = False
        self.save_hyperparameters(
            {
                "sizes": list(problem.sizes),
                "activation": problem.activation,
                "seeds": list(problem.seeds),
                **problem.training.model_dump(mode="json"),
            }
        )
        self.problem = problem
        self.engine = engine
        start = record.stack(*initial_weights(problem.sizes, problem.seeds))
        self.flat = nn.Parameter(torch.from_numpy(start).to(engine.dtype))
        self.progress = Progress(problem, self.flat.detach())

    def configure_optimizers(self) -> StackedAdam:
        """Adam on the flat parameters."""
        return StackedAdam(self.flat)

    def forward(self, x: Tensor) -> Tensor:
        """Joint values, shape (seeds, points, joints), for inputs of shape (points, in)."""
        stack = list(layers(self.flat, self.problem.sizes))
        return forward(stack, self.problem.activation, x.expand(len(self.flat), *x.shape))

    def training_step(self, batch: Block, batch_idx: int) -> None:
        """Trains a block of epochs and logs the means over the seeds at its end."""
        first, n_epochs = batch
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        # Lightning's wrapper counts the blocks; the engine needs Adam itself.
        adam = optimizer.optimizer
        assert isinstance(adam, StackedAdam)
        optimizer.step(
            lambda: self.engine.run(self.flat.detach(), adam, self.progress, first, n_epochs)
        )
        last = self.progress.history[:, first + n_epochs - 2]
        for name, row in zip(record.METRICS[:2], last, strict=False):
            self.log(name, torch.nanmean(row))
        if self.progress.all_stopped():
            self.trainer.should_stop = True

    def result(self) -> record.Record:
        """What the training has left behind."""

        def array(tensor: Tensor) -> Any:
            return tensor.detach().cpu().numpy().copy()

        progress = self.progress
        return record.Record(
            np.array(self.problem.seeds, np.int64),
            array(progress.final(self.flat.detach()).float()),
            array(progress.history),
            array(progress.snapshot_epochs),
            array(progress.replay(self.flat.detach()).float()),
            array(progress.best_epoch),
            array(progress.stopped),
        )


def make_engine(name: str, problem: Problem) -> Engine:
    """The engine of that name, "fused", "reference" or "levenberg-marquardt"."""
    if name == "levenberg-marquardt":
        from iksamples.training.levenberg import LevenbergEngine

        return LevenbergEngine(problem)
    if name == "fused":
        from iksamples.training.fused import FusedEngine

        return FusedEngine(problem)
    return ReferenceEngine(problem)


def accelerator(asked: str) -> str:
    """The device that is meant by the study's ``accelerator``: "cpu" or "gpu" (CUDA).

    Raises:
        IksamplesError: A GPU is asked for and torch finds none.
    """
    if asked == "gpu" and not torch.cuda.is_available():
        raise IksamplesError(
            "training.accelerator: gpu, but torch finds no CUDA device here; use cpu or auto."
        )
    return "gpu" if asked != "cpu" and torch.cuda.is_available() else "cpu"


def fit(
    problem: Problem,
    engine: Engine | None = None,
    callbacks: Sequence[pl.Callback] = (),
    epochs_per_block: int | None = None,
    resume_from: str | None = None,
    **trainer_options: Any,
) -> record.Record:
    """Trains the seeds of a problem under a Lightning trainer.

    Args:
        problem: What is trained.
        engine: The training loop; the reference engine if None.
        callbacks: Further Lightning callbacks (checkpoints, progress, ...).
        epochs_per_block: Epochs per training step of Lightning, on which the result does not
            depend; None: about a second's worth.
        resume_from: A Lightning checkpoint of the same problem, from the end of a block.
        **trainer_options: Passed to ``Trainer`` (logger, enable_checkpointing, ...).

    Returns:
        The trained seeds.
    """
    engine = engine or ReferenceEngine(problem)
    module = StackedTraining(problem, engine)
    data = EpochBlocks(problem, epochs_per_block or block_length(problem, engine.pace))
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    options: dict[str, Any] = {
        "accelerator": accelerator(problem.training.accelerator),
        "devices": 1,
        # Else a job of Slurm is taken for a part of a distributed training.
        "plugins": LightningEnvironment(),
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        "log_every_n_steps": 1,
        "use_distributed_sampler": False,
    }
    with warnings.catch_warnings():
        # Lightning's own use of a name that torch has deprecated.
        warnings.filterwarnings("ignore", ".*LeafSpec.*is deprecated.*")
        # The loader hands over two integers: workers would only cost.
        warnings.filterwarnings("ignore", ".*does not have many workers.*")
        # A job of Slurm trains alone.
        warnings.filterwarnings("ignore", ".*`srun` command is available.*")
        trainer = pl.Trainer(
            max_epochs=len(data.blocks), callbacks=list(callbacks), **(options | trainer_options)
        )
        trainer.fit(module, data, ckpt_path=resume_from)
    return module.result()
