"""The Lightning data module: it deals out blocks of epochs, not mini-batches.

Lightning costs a fraction of a millisecond per training step and a few per epoch, which is more
than these networks need. So one Lightning epoch is one training step, and that step is a block of
many epochs; the engine makes the mini-batches inside the block.
"""

from collections.abc import Iterator

import pytorch_lightning as pl
from torch.utils.data import DataLoader, Sampler

from iksamples.training.problem import Problem


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
