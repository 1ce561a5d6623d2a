"""Samples as arms that differ from their drawing have recorded them."""

from dataclasses import replace

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.arm.deviation import rotation_of
from iksamples.arm.inverse import Solution, followed
from iksamples.arm.real import RealArm
from iksamples.errors import IksamplesError
from iksamples.samples.dataset import SampleSet
from iksamples.study import Arm, Study
from iksamples.task import Task


_NOISE, _PLAY = 20, 30
"""Streams of an arm's generator, beside the seed, for each role of a point."""


def on_arms(study: Study, task: Task, samples: SampleSet) -> SampleSet:
    """The samples as each of the study's arms records them; in most studies, as they are.

    The tool is brought to each input by what is measured, so it really is there but for the
    measurement's noise, and the encoders are read.

    Args:
        study: The study; its seeds say which arms, its ``arm`` section how well is measured.
        task: Its task.
        samples: The samples as the drawing has them.

    Raises:
        IksamplesError: An arm cannot get to a sample.
    """
    if study.arm is None:
        return samples
    parts = (samples.x, samples.validation_x, samples.test_x)
    drawn = [task.reach(x) for x in parts if len(x)]
    recorded = [
        np.concatenate(
            [_recorded(task, study.arm, seed, role, one) for role, one in enumerate(drawn)]
        )
        for seed in study.arms
    ]
    for seed, joints in zip(study.arms, recorded, strict=True):
        lost = np.flatnonzero(~np.isfinite(joints).all(axis=1))
        if lost.size:
            at = ", ".join(f"{value:g}" for value in samples.inputs[lost[0]])
            raise IksamplesError(
                f"{samples.label}: the arm of seed {seed} cannot get to ({at}), so it differs too "
                "much from its drawing; make arm.deviation_mm, arm.deviation_rad or the workspace "
                "smaller."
            )
    return replace(samples, arms=study.arms, arm_joints=np.stack(recorded))


def _recorded(task: Task, settings: Arm, seed: int, role: int, drawn: Solution) -> Floats:
    """What the encoders of a seed's arm read, shape (points, joints)."""
    position, rotation = task.target.wanted(drawn.x)
    # Drawn point by point, so that a longer list of points begins like a shorter one.
    noise = np.random.default_rng([seed, _NOISE + role]).standard_normal((len(drawn.x), 6))
    position = position + settings.noise_mm * noise[:, :3]
    rotation = rotation_of(settings.noise_rad * noise[:, 3:]) @ rotation
    arm = task.arm_of(seed)
    actual = followed(drawn, task.chain_of(seed), (position, rotation))
    if isinstance(arm, RealArm):
        return replace(arm, seed=(seed, _PLAY + role)).read(actual)
    return actual
