"""The adaptive design: samples placed step by step, where networks trained so far disagree."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from iksamples.answer.proposal import propose, spread
from iksamples.arm.chain import Floats
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.samples.designs import full_grid
from iksamples.samples.record import ADAPTIVE, region_points, sample_set, samples_at
from iksamples.study import NETWORK, HeldOut, Study
from iksamples.task import Task
from iksamples.training.run import train


GUIDES = 16
"""Seeds that are asked where they disagree: as many as the compiled loop trains at once."""

_FIRST = 8
_GROWTH = 2**0.5
_STEPS = 4000
_REGION_POINTS = 4096
# Guides are other seeds than those whose errors a study reports, or the points would be chosen
# for the very networks that are judged on them.
_FIRST_GUIDE = 2**30


def adaptive_sets(study: Study, task: Task, wanted: Iterable[int]) -> dict[int, SampleSet]:
    """Nested sets of samples of the adaptive design, one per size.

    It starts from the workspace's corners. Then 16 networks of the study's shape are trained on the
    samples so far (Adam, 4000 steps, seeds of their own), and the points where they disagree most
    are added (``propose``), until there are about 1.4 times as many; and so on. From 8 to 512
    samples these are 12 rounds. Sets of different sizes are beginnings of the same sequence of
    points, which depends on no other size.

    Of the study it depends on the arm, the workspace, ``samples`` (but for designs and sizes),
    ``network``, and ``training``'s learning rate, schedule and batch size.

    Args:
        study: The study.
        task: Its task.
        wanted: Sizes, in samples.

    Raises:
        IksamplesError: The arm cannot use all of the workspace and the study does not mask it, or
            the guiding networks all diverge.
    """
    sizes = sorted(set(wanted))
    sets: dict[int, SampleSet] = {}
    for points in _growing(study, task):
        while len(sets) < len(sizes) and len(points) >= sizes[len(sets)]:
            n = sizes[len(sets)]
            sets[n] = samples_at(study, task, ADAPTIVE, n, points[:n])
        if len(sets) == len(sizes):
            break
    return sets


def train_seeds(study: Study, samples: SampleSet, progress: bool = False) -> StackedMLP:
    """Networks of the study trained on samples; nothing stays on the disk.

    Args:
        study: The study.
        samples: The samples.
        progress: Report on stderr.
    """
    n_trained = study.training.n_trained(samples.n_samples)
    with TemporaryDirectory(prefix="iksamples-") as folder:
        train(study.for_method(NETWORK, n_trained), samples, Path(folder), progress=progress)
        return StackedMLP.load(Path(folder) / "weights.safetensors")


def _growing(study: Study, task: Task) -> Iterator[Floats]:
    """The design's points after each round [mm or rad], shape (n, d)."""
    guide = _guide(study)
    points = _start(task)
    yield points
    first, rounds = len(points), 0
    while True:
        rounds += 1
        joints = task.reach(points).joints
        samples = sample_set(guide, task, ADAPTIVE, ADAPTIVE, points, joints)
        network = train_seeds(guide, samples)
        k = round(first * _GROWTH**rounds) - len(points)
        points = np.concatenate([points, propose(task, samples, network, k)])
        yield points


def _start(task: Task) -> Floats:
    """The workspace's usable corners, and up to their number or 8 the points farthest off."""
    corners = full_grid(task.x.lower, task.x.upper, 2)
    points = corners[task.region.contains(corners)]
    region = region_points(task.region, _REGION_POINTS)
    if not len(points):
        points = region[:1]
    more = max(_FIRST, len(corners)) - len(points)
    if not more:
        return points
    mm, alike = task.x.as_lengths, np.ones(len(region))
    return np.concatenate([points, spread(region * mm, alike, points * mm, more) / mm])


def _guide(study: Study) -> Study:
    """The study as the guiding networks are trained."""
    training = study.training.model_copy(
        update={
            "optimizer": "adam",
            "steps": _STEPS,
            "early_stopping": None,
            "held_out": HeldOut(validation_share=0, test_share=0),
            "seeds": GUIDES,
            "first_seed": _FIRST_GUIDE + GUIDES * study.samples.seed % _FIRST_GUIDE,
            "snapshots": 2,
            "engine": "auto",
            "accelerator": "cpu",
        }
    )
    return study.model_copy(update={"training": training})
