"""A plan: the steps of a study, and what each takes."""

from dataclasses import dataclass

from iksamples.plan.costs import Settings


_SNAKEMAKE, _SCHEDULING = 4.0, 0.4
"""Of Snakemake itself: to begin with, and per job."""


@dataclass(frozen=True)
class StepPlan:
    """One step of the workflow.

    Attributes:
        step: Its rule.
        jobs: Jobs.
        seconds: Expected time of one core, all jobs together [s].
        longest_s: Expected time of the longest job [s].
        memory_mb: Expected memory of the largest job [MB].
        time_by: The settings that most of the time is due to.
        memory_by: The settings that most of the memory is due to.
    """

    step: str
    jobs: int
    seconds: float
    longest_s: float
    memory_mb: float
    time_by: Settings
    memory_by: Settings


@dataclass(frozen=True)
class MethodPlan:
    """Training of one method on all sets of samples.

    Attributes:
        method: Its name.
        networks: Networks in all.
        to_train: Those that are not in the cache of trained seeds.
        steps: Optimiser steps (iterations of Levenberg-Marquardt) of those to train, if none
            stops early.
        seconds: Expected time of training [s].
    """

    method: str
    networks: int
    to_train: int
    steps: int
    seconds: float


@dataclass(frozen=True)
class Plan:
    """What a study will take.

    Attributes:
        methods: The methods that are trained; none where a study has rules of its own.
        steps: The steps of the workflow, in their order.
    """

    methods: list[MethodPlan]
    steps: list[StepPlan]

    def seconds(self, cores: int) -> float:
        """Expected time with some cores [s].

        All jobs but the recording of samples wait for training, one job where that is short, and
        replication is one that waits for the answer; the others share the cores.
        """
        alone = _SNAKEMAKE + _SCHEDULING * sum(step.jobs for step in self.steps)
        waited = ("samples", "train", "replicate")
        alone += sum(
            step.seconds / min(cores, step.jobs) for step in self.steps if step.step in waited
        )
        rest = [step for step in self.steps if step.step not in waited]
        shared = sum(step.seconds for step in rest) / cores
        return alone + max(shared, max(step.longest_s for step in rest))

    @property
    def processor_s(self) -> float:
        """Expected time of one core, all jobs together [s]."""
        return sum(step.seconds for step in self.steps)

    @property
    def longest(self) -> StepPlan:
        """The step that takes most of it."""
        return max(self.steps, key=lambda step: step.seconds)

    @property
    def largest(self) -> StepPlan:
        """The step with the largest job, by memory."""
        return max(self.steps, key=lambda step: step.memory_mb)
