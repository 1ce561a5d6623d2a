"""What the compiled training loop is handed, by name: ``kernel.train_group``'s arguments."""

from typing import Any, NamedTuple

from numpy.typing import NDArray


Array = NDArray[Any]


class Data(NamedTuple):
    """What a group of seeds learns from, a lane for each seed.

    Attributes:
        inputs: Shape (points, in).
        targets: Shape (points, out).
        train_rows: Rows each lane learns from, shape (lanes, n), int32.
        validation_rows: Rows of its validation loss, shape (lanes, n_validation), int32.
    """

    inputs: Array
    targets: Array
    train_rows: Array
    validation_rows: Array


class Schedule(NamedTuple):
    """The steps of a block of epochs.

    Attributes:
        batch_size: Samples per step.
        first_epoch: First epoch of the block, counted from 1.
        rates: Adam's step size, bias correction included, for each step of the block.
        epsilons: Adam's epsilon, likewise.
    """

    batch_size: int
    first_epoch: int
    rates: Array
    epsilons: Array


class Group(NamedTuple):
    """A group of seeds; all but the seeds is changed in place.

    Flat arrays hold one vector of lanes per row: parameter p of the seed in lane k is
    ``w[p * lanes + k]``.

    Attributes:
        seeds: Shape (lanes,), uint64.
        w: Parameters, flat.
        m: Mean of the gradients, flat.
        v: Mean of their squares, flat.
        kept: Parameters put aside, flat.
        best_loss: Shape (lanes,).
        counters: Best epoch, epochs since it, epochs since then or since the rate was halved, and
            epoch of the stop, shape (4, lanes), int64.
        factor: What the learning rate is multiplied with, shape (lanes,).
    """

    seeds: Array
    w: Array
    m: Array
    v: Array
    kept: Array
    best_loss: Array
    counters: Array
    factor: Array


class Filled(NamedTuple):
    """What a block of epochs leaves behind.

    Attributes:
        history: Rows (epoch of the block, metric), flat.
        slots: Where to put the snapshot of each epoch of the block, -1 for nowhere.
        snapshots: Rows (slot, parameter), flat.
    """

    history: Array
    slots: Array
    snapshots: Array


class Stopping(NamedTuple):
    """What a seed's validation loss decides.

    Attributes:
        patience: Epochs without improvement that stop a seed; 0: never.
        restore_best: Put aside the parameters of the best epoch, not those of the stop.
        min_delta: Smallest improvement that counts.
        plateau: Epochs without improvement that halve the learning rate; 0: never.
    """

    patience: int
    restore_best: bool
    min_delta: float
    plateau: int
