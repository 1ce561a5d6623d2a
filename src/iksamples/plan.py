"""What a study will take before it is started: networks, time and memory.

The costs are those of one core of the machine in ``docs/benchmarks.md``, read off its runs of the
studies in ``config``; another machine may take half or twice as long.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil

from iksamples.evaluation.paths import count_waypoints
from iksamples.results import certified, networks, sample_sets
from iksamples.study import NETWORK, PROVED_TOGETHER, Study
from iksamples.text import several
from iksamples.training.run import choose_engine


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
class StepPlan:
    """One step of the workflow.

    Attributes:
        step: Its name.
        jobs: Jobs.
        seconds: Expected time of one core, all jobs together [s].
        longest_s: Expected time of the longest job [s].
        memory_mb: Expected memory of the largest job [MB].
    """

    step: str
    jobs: int
    seconds: float
    longest_s: float
    memory_mb: float


@dataclass(frozen=True)
class Plan:
    """What a study will take.

    Attributes:
        methods: The methods that are trained.
        steps: The steps of the workflow, in their order.
    """

    methods: list[MethodPlan]
    steps: list[StepPlan]

    def seconds(self, cores: int) -> float:
        """Expected time with some cores [s].

        All jobs but the recording of samples wait for training, one job where that is short, and
        replication is one that waits for the answer; the others share the cores.
        """
        parts = {step.step: step for step in self.steps}
        alone = _SNAKEMAKE + _SCHEDULING * sum(step.jobs for step in self.steps)
        alone += parts["samples"].seconds / cores
        alone += parts["train"].seconds / min(cores, parts["train"].jobs)
        alone += parts["replicate"].seconds if "replicate" in parts else 0.0
        rest = [step for step in self.steps if step.step not in ("samples", "train", "replicate")]
        shared = sum(step.seconds for step in rest) / cores
        return alone + max(shared, max(step.longest_s for step in rest))

    @property
    def memory_mb(self) -> float:
        """Expected memory of the largest job [MB]."""
        return max(step.memory_mb for step in self.steps)


def plan_study(study: Study, n_joints: int, cached: dict[str, int] | None = None) -> Plan:
    """What a study will take.

    Args:
        study: The study.
        n_joints: Joints of its arm.
        cached: Networks of each method that need not be trained again.
    """
    cached = cached or {}
    sets = sample_sets(study, method=NETWORK)
    methods = [
        _training(study, n_joints, name, [n for _, n in sets.values()], cached.get(name, 0))
        for name in networks(study)
    ]
    return Plan(methods, list(_steps(study, n_joints, methods)))


def seeds_per_job(study: Study, seconds: float, n_seeds: int) -> int:
    """How many seeds a job takes, where all of them take so long [s]."""
    blocks = _JOB * n_seeds / max(seconds, 1e-9) / PROVED_TOGETHER
    return study.seeds_per_job or PROVED_TOGETHER * max(1, int(min(blocks, n_seeds)))


def _cut(study: Study, seconds: float, n_seeds: int) -> list[float]:
    """Work with some seeds, as the jobs that it is cut into."""
    n_jobs = -(-n_seeds // seeds_per_job(study, seconds, n_seeds))
    return [seconds / n_jobs] * n_jobs


def proof_seconds(study: Study, n_joints: int, plan: MethodPlan) -> float:
    """Expected time of the proofs of a method's networks [s]."""
    method = study.all_methods[plan.method]
    weights = method.network.n_parameters(len(study.task.inputs), n_joints)
    return _PROOF[method.training.optimizer] * weights / 115 * plan.networks


def resources(study: Study, rule: str) -> dict[str, int]:
    """What a scheduler is asked for, for one job of a rule: the estimate with room to spare.

    Args:
        study: The study.
        rule: Name of the rule; one that is not in the plan does next to nothing.

    Returns:
        ``mem_mb`` [MB] and ``runtime`` [min], as Snakemake names them.
    """
    # An arm has as many joints as inputs at least; how many hardly matters here.
    steps = () if is_apart(study) else plan_study(study, n_joints=len(study.task.inputs)).steps
    found = {step.step: step for step in steps}.get(rule)
    memory_mb, seconds = (found.memory_mb, found.longest_s) if found else (_OTHER_MB, 0.0)
    return {"mem_mb": ceil(1.5 * memory_mb), "runtime": ceil(_SLOWER * seconds / 60) + 5}


def is_apart(study: Study) -> bool:
    """Whether the study has rules of its own."""
    return bool(study.readings or study.samples.recorded)


def plan_text(study: Study, plan: Plan, cores: int) -> str:
    """A plan as people read it.

    Args:
        study: The study.
        plan: Its plan.
        cores: Cores it will have.
    """
    sets = sample_sets(study)
    sizes = sorted({n for _, n in sets.values()})
    wide = max(len("method"), *(len(one.method) for one in plan.methods))
    rows = [f"{'method':{wide}}  networks  to train  steps at most  training"]
    total = MethodPlan(
        "in all",
        sum(one.networks for one in plan.methods),
        sum(one.to_train for one in plan.methods),
        sum(one.steps for one in plan.methods),
        sum(one.seconds for one in plan.methods),
    )
    for one in (*plan.methods, total):
        rows.append(
            f"{one.method:{wide}}  {one.networks:8d}  {one.to_train:8d}  {one.steps:13,d}  "
            f"{in_words(one.seconds):>8}".replace(",", " ")
        )
    jobs = sum(step.jobs for step in plan.steps)
    of_sizes = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else f"{sizes[0]}"
    head = (
        f"{study.name}: {several(len(study.all_methods), 'method')} on "
        f"{several(len(sets), 'set')} of {of_sizes} samples, {jobs} jobs"
    )
    tail = (
        f"{_expected(plan.seconds(cores), cores)}, {plan.memory_mb / 1000:.1f} GB of memory for "
        "the largest job.\n"
        "As on the machine of docs/benchmarks.md, with no results there yet but trained networks;\n"
        f"{_ELSEWHERE}"
    )
    return "\n".join([head, "", *rows, "", tail])


def readings_text(study: Study, n_joints: int, cores: int | None = None) -> str:
    """What a study of readings trains, as people read it.

    Args:
        study: A study with ``readings``.
        n_joints: Joints of its arm.
        cores: Cores it will have; None: no time is asked for.
    """
    from iksamples.paper.readings import draw_readings, most_chosen

    wanted = study.readings
    assert wanted is not None
    drawn = draw_readings(wanted)
    n_grids, n_again = len(study.sizes), most_chosen(wanted)
    networks = n_grids * wanted.seeds * len(drawn), n_grids * wanted.fresh_seeds * n_again
    lines = [
        f"  search: {several(len(drawn), 'reading')} on {several(n_grids, 'grid')}, "
        f"{networks[0]} networks",
        f"  the best of them again: at most {several(n_again, 'reading')}, "
        f"at most {networks[1]} networks",
    ]
    if cores is None:
        return "\n".join(lines)

    def each(seeds: int) -> float:
        """Expected time of training a reading, the mean of those drawn [s]."""
        studies = [reading.study(seeds) for reading in drawn]
        times = [
            _fit_seconds(one, n_joints, one.training.n_trained(n)) + _FIT
            for one in studies
            for n in one.sizes
        ]
        return sum(times) / len(drawn)

    seconds = len(drawn) * each(wanted.seeds) + n_again * each(wanted.fresh_seeds)
    seconds += 2 * wanted.jobs * _START["train"] + _START["report"]
    seconds = _SNAKEMAKE + seconds / cores
    tail = (
        f"{_expected(seconds, cores)}, if no training stops early.\n"
        f"As on the machine of docs/benchmarks.md; {_ELSEWHERE}"
    )
    return "\n".join([*lines, "", tail])


def _expected(seconds: float, cores: int) -> str:
    return f"Expected: about {in_words(seconds)} with {several(cores, 'core')}"


def in_words(seconds: float) -> str:
    """A time as people say it: ``8 s``, ``3 min``, ``1.5 h``."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


# Seconds of one core. A job's start is Python with what it imports.
_START = {
    "samples": 0.5,
    "train": 7.0,
    "evaluate": 1.3,
    "bounds": 1.2,
    "prove": 0.8,
    "map": 1.0,
    "table": 0.5,
    "answer": 1.5,
    "replicate": 7.0,
    "track": 3.0,
    "record": 1.0,
    "report": 5.0,
}
_ELSEWHERE = "another machine may take half or twice as long."
_JOB = 600.0
"""Work that is worth a job of its own: beside it, starting Python costs next to nothing."""
_SLOWER = 4
"""Times slower than here a machine may be, before a scheduler ends its job."""
_SNAKEMAKE, _SCHEDULING = 4.0, 0.4
"""Of Snakemake itself: to begin with, and per job."""
_FIT = 0.03
"""Start of one training of all seeds."""
_EPOCH = 18e-6
"""Of the fused engine, beside its steps."""
_FLOPS = {"relu": 2.4e10, "tanh": 2.0e10}
"""Of the fused engine, per second."""
_STACKED_STEP, _STACKED_FLOPS = 5e-4, 1e10
"""Of the reference engine: a step of the whole stack, and floating-point operations per second."""
_ITERATION, _GRAM, _SOLVE = 5e-5, 1e10, 1.5e10
"""Of Levenberg-Marquardt, per seed: an iteration, and operations per second of its two products."""
_POINT = 1e-6
"""Evaluation of one network at one point, written to disk."""
_PROOF = {"adam": 0.07, "levenberg-marquardt": 0.5}
"""Worst case and mean of one network of 115 weights, proved and checked."""
_RUN = 0.06
"""Logging of one network to MLflow."""
_ADAPTIVE = 9.0
"""Training of the networks that choose the adaptive sets."""
_TRAINING_MB, _OTHER_MB = 650.0, 320.0
"""Memory of a job with little to do: with Lightning, and without."""


def _training(study: Study, n_joints: int, name: str, sizes: list[int], cached: int) -> MethodPlan:
    method = study.all_methods[name]
    seeds = method.training.seeds
    n_networks = seeds * len(sizes)
    share = 1 - cached / n_networks
    steps, seconds = 0, 0.0
    for n in sizes:
        n = method.training.n_trained(n)
        own = study.for_method(name, n)
        steps += seeds * own.training.epochs * own.training.steps_per_epoch(n)
        seconds += _FIT + _fit_seconds(own, n_joints, n)
    return MethodPlan(name, n_networks, n_networks - cached, round(steps * share), seconds * share)


def _fit_seconds(study: Study, n_joints: int, n: int) -> float:
    """Expected time of training all seeds of the study's own network on n samples."""
    training, engine = study.training, choose_engine(study, n_joints)
    weights = study.network.n_parameters(len(study.task.inputs), n_joints)
    if engine == "levenberg-marquardt":
        products = 3 * n * weights**2 / _GRAM + weights**3 / _SOLVE
        return training.seeds * training.epochs * (_ITERATION + products)
    steps = training.epochs * training.steps_per_epoch(n)
    operations = 6.0 * min(training.batch_size, n) * weights * training.seeds * steps
    if engine == "reference":
        return steps * _STACKED_STEP + operations / _STACKED_FLOPS
    return training.epochs * _EPOCH + operations / _FLOPS[study.network.activation]


def _steps(study: Study, n_joints: int, methods: list[MethodPlan]) -> Iterator[StepPlan]:
    """The workflow's steps, as if none of their files were there yet."""
    n_sets, n_first = (
        len(sample_sets(study, method=NETWORK)),
        len(sample_sets(study, study.samples.design)),
    )
    plans = {plan.method: plan for plan in methods}
    points = study.evaluation.cube_points + sum(
        count_waypoints(path) for path in study.evaluation.paths.values()
    )
    n_networks = plans["network"].networks
    evaluations = [_POINT * points * plan.networks for plan in methods]
    untrained = len(study.all_methods) - len(methods)
    if untrained:
        evaluations.append(_POINT * points * untrained * n_sets)
    proofs = []
    for name in certified(study):
        if name not in plans:
            proofs.append(0.1 * n_sets)
            continue
        needed = proof_seconds(study, n_joints, plans[name])
        proofs += _cut(study, needed, study.all_methods[name].training.seeds)
    work = {
        "samples": [_ADAPTIVE if "adaptive" in study.designs() else 0.02 * n_sets],
        "train": _cut(
            study,
            sum(plan.seconds for plan in methods),
            max(study.all_methods[plan.method].training.seeds for plan in methods),
        ),
        "evaluate": evaluations,
        "bounds": [0.01 * n_networks],
        "prove": proofs,
        "map": [0.4 * n_first],
        "table": [0.0],
        "answer": [0.1 * len(study.all_methods) * len(study.samples.designs)],
        "track": [_RUN * n_networks * n_first / n_sets],
        "record": [0.5 * len(study.evaluation.paths)],
        "report": [1.0],
    }
    if study.replication.seeds:
        fresh = 2 * study.replication.seeds * len(methods)
        share = fresh / sum(plan.networks for plan in methods)
        again = sum(work["train"]) + sum(evaluations)
        if study.tolerance.certifiable:
            again += sum(proofs)
        work["replicate"] = [share * again]
    for step, jobs in work.items():
        if not jobs:
            continue
        seconds = [_START[step] + own for own in jobs]
        memory = _training_mb(study, n_joints) if step in ("train", "replicate") else _OTHER_MB
        yield StepPlan(step, len(jobs), sum(seconds), max(seconds), memory)


def _training_mb(study: Study, n_joints: int) -> float:
    """Memory of the training job: the stack of one method, its history and its snapshots."""
    largest = 0.0
    for name in networks(study):
        method = study.all_methods[name]
        training = method.training
        weights = method.network.n_parameters(len(study.task.inputs), n_joints)
        n = max(study.sizes)
        epochs = study.for_method(name, n).training.epochs
        if training.steps:
            epochs = study.for_method(name, min(study.sizes)).training.epochs
        stack = 4.0 * training.seeds * weights * (4 + training.snapshots)
        if training.optimizer == "levenberg-marquardt":
            stack += 3 * 8.0 * training.seeds * weights**2
        history = 60.0 * training.seeds * epochs
        largest = max(largest, stack + history)
    return _TRAINING_MB + largest / 1e6
