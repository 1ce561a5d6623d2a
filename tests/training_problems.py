"""Small training problems, and what it means that two trainings are the same."""

import numpy as np

from iksamples.study import Study, parse_study
from iksamples.training.problem import Problem
from iksamples.training.record import Record


def make_problem(
    seeds=range(4), n=21, hidden=(7,), activation="relu", check=9, rows=None, **training
) -> Problem:
    """A problem on made-up smooth data, with the same validation points for every seed."""
    generator = np.random.default_rng(5)
    points = generator.random((n + check, 3))
    targets = np.stack([np.sin(points.sum(1)), points[:, 0] * points[:, 1], -points[:, 2]], 1)
    settings: Study = parse_study({"name": "x", "training": {"snapshots": 6, **training}})
    table = np.broadcast_to(np.arange(n + check, dtype=np.int32), (len(seeds), n + check))
    return Problem(
        tuple(seeds),
        (3, *hidden, 3),
        activation,
        points.astype(np.float32),
        targets.astype(np.float32),
        np.ones(3),
        table[:, :n] if rows is None else rows,
        table[:, n:],
        table[:, :0],
        settings.training,
    )


def same(one: Record, other: Record, *names: str) -> None:
    """Asserts equality to the last bit."""
    for name in names or ("parameters", "history", "snapshots", "best_epoch", "stopped"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
