"""What the parts of a study take: trainings, methods that are not trained, samples.

Time is one core's of the machine in ``docs/plan.md``, where ``benchmarks/plan.py`` holds plans
against runs; memory is what a process takes beside Python and its libraries.
"""

from collections.abc import Iterable, Mapping
from math import ceil, log2
from typing import NamedTuple

from iksamples.methods.registry import KINDS
from iksamples.methods.scattered import MOST_SAMPLES
from iksamples.study import NETWORK, CsvPath, Design, Method, Study
from iksamples.training.run import SEEDS_AT_ONCE, choose_engine


Settings = tuple[str, ...]
"""Names of settings."""
Terms = Mapping[Settings, float]
"""What something takes by the settings that it grows with: the sum counts, the largest explains."""


class Shape(NamedTuple):
    """Numbers of a study that every step depends on."""

    inputs: int
    joints: int
    arms: int
    waypoints: int
    points: int
    sizes: dict[Design, list[int]]
    """Samples of each set by design."""
    said: str
    """The setting of the sizes."""


# Of one core [s].
FIT = 0.03
"""Start of one training of all seeds."""
_EPOCH = 18e-6
"""Of the fused engine, beside its steps."""
_FLOPS = {"relu": 2.4e10, "tanh": 2.0e10}
"""Of the fused engine, per second."""
_STACKED_STEP, _STACKED_FLOPS = 5e-4, 1e10
"""Of the reference engine: a step of the whole stack, and floating-point operations per second."""
_ITERATION, _DERIVATIVE, _GRAM, _SOLVE = 2e-4, 1e-8, 1e11, 2.5e10
"""Of Levenberg-Marquardt, per seed: an iteration, a derivative of one answer by one weight, and
operations per second of its two products."""
_TUNED, _TRIED = {"gaussian-process": 36, "residual": 25}, 2e-4
"""Kernels that are tried, about, and each of them beside its matrix."""
_CLOSED, _FOLLOWED = (0.01, 3e-6), (0.1, 4e-5)
"""Of a set of samples, and of the joints at a point: in closed form, and where they are followed
from a home posture."""
_ARM, _ON_ARM = 5e-3, 8e-6
"""Of a simulated arm's samples of one set, and each of them."""
_NEAREST, _NEAREST_BYTES = 0.8, 62e6
"""Where samples are on no grid: SciPy, which finds the nearest of them."""
_SOLVED = 3e9
"""Operations per second of dense matrices: kernels, designs."""
_MASKED = 4.0
"""To find the part of the workspace that an arm can use, if not all."""
_LIGHTNING, _ROUND = 4.5, 0.15
"""Of the adaptive sets: to import what trains, and each round beside its training."""
_GUIDING: dict[str, object] = {
    "optimizer": "adam",
    "steps": 4000,
    "seeds": 16,
    "early_stopping": None,
    "engine": "auto",
}


def shape_of(study: Study) -> Shape:
    """What all steps depend on."""
    methods, samples = study.all_methods, study.samples
    d, robot = len(study.task.inputs), study.robot
    sizes = {design: study.sizes_of(design) for design in study.designs()}
    seeds = [one.training for one in methods.values()]
    first, last = (
        min(one.first_seed for one in seeds),
        max(one.first_seed + one.seeds for one in seeds),
    )
    way = sum(
        1000 if isinstance(path, CsvPath) else path.waypoints
        for path in study.evaluation.paths.values()
    )
    return Shape(
        d,
        # No arm has fewer joints than inputs; one that has more needs a home posture.
        max(d, len(robot.home_rad) + len(robot.home_mm)),
        last - first if study.arm else 0,
        way,
        study.evaluation.cube_points + way,
        sizes,
        "samples.sizes" if samples.sizes else "samples.points_per_axis",
    )


def of(name: str, setting: str) -> str:
    """A method's setting as people write it."""
    return setting if name == NETWORK else f"methods.{name}.{setting}"


def sets_of(study: Study, shape: Shape, method: Method) -> list[int]:
    """Samples of each set of a method."""
    designs = [method.design] if method.design else study.samples.designs
    return [n for design in designs for n in shape.sizes[design]]


def epochs_of(method: Method, n: int) -> int:
    """Epochs of a training on n samples, if it does not stop early."""
    training = method.training
    if training.steps is None:
        return training.epochs
    return -(-training.steps // training.steps_per_epoch(n))


def engine_of(study: Study, shape: Shape, method: Method) -> tuple[str, int]:
    """A method's engine, if there is no GPU, and the weights of one network."""
    training = method.training
    if training.accelerator == "auto":  # torch would have to be asked
        training = training.model_copy(update={"accelerator": "cpu"})
    own = study.model_copy(update={"network": method.network, "training": training})
    weights = method.network.n_parameters(shape.inputs, shape.joints)
    return choose_engine(own, shape.joints), weights


def fit_seconds(
    method: Method, engine: str, weights: int, joints: int, n: int, seeds: int
) -> float:
    """Expected time of training some seeds of a method on n samples."""
    training, epochs = method.training, epochs_of(method, n)
    if engine == "levenberg-marquardt":
        derivatives = n * joints * weights * (_DERIVATIVE + weights / _GRAM)
        return seeds * epochs * (_ITERATION + derivatives + weights**3 / _SOLVE)
    steps = epochs * training.steps_per_epoch(n)
    operations = 6.0 * min(training.batch_size, n) * weights * seeds * steps
    if engine == "reference":
        return steps * _STACKED_STEP + operations / _STACKED_FLOPS
    return epochs * _EPOCH + operations / _FLOPS[method.network.activation]


def fit_bytes(study: Study, shape: Shape, name: str, method: Method) -> Terms:
    """Memory of a method's training on its largest set: the stack, its snapshots and history."""
    training, sizes = method.training, sets_of(study, shape, method)
    engine, weights = engine_of(study, shape, method)
    n, seeds = max(sizes, default=0), training.seeds
    at_once = min(seeds, SEEDS_AT_ONCE)
    epochs = max((epochs_of(method, k) for k in sizes), default=0)
    keys = ("network.hidden", "training.seeds", "training.snapshots", "training.epochs")
    hidden, of_seeds, snapshots, of_epochs = (of(name, key) for key in keys)
    stack = 4.0 * weights * (12 * at_once + training.snapshots * (2 * at_once + 2 * seeds))
    found: dict[Settings, float] = {(hidden, of_seeds, snapshots): stack}
    found[(of_epochs, of_seeds)] = epochs * (40.0 * at_once + 150.0 * seeds)
    found[(shape.said, of_seeds)] = 8.0 * n * (seeds + at_once)
    if engine == "levenberg-marquardt":
        jacobian = 8.0 * n * shape.joints * weights
        part = max(1, 2**23 // max(1, int(jacobian)))
        found[(hidden, shape.said)] = 4 * jacobian * part
        found[(hidden,)] = 24.0 * min(part, at_once) * weights**2
    return found


def kernel_seconds(kind: str, n: int) -> float:
    """Of one fit of a method that is not trained to n samples."""
    if KINDS[kind].dense:
        if n > MOST_SAMPLES:
            return 0.0
        if kind == "rbf":
            return 0.1 * n**3 / _SOLVED
        return _TUNED[kind] * (_TRIED + min(n, 256) ** 3 / _SOLVED) + 0.2 * n**3 / _SOLVED
    return 0.05 + 1e-4 * n if kind == "calibrated" else 0.01 + 1e-5 * n


def answer_seconds(kind: str, n: int, joints: int) -> float:
    """Of one answer of such a method."""
    if KINDS[kind].dense:
        return (5e-9 if kind == "rbf" else 1e-7) * n * (n <= MOST_SAMPLES) + 1e-6
    return 2e-6 if KINDS[kind].needs_grid else 4e-6 * joints


def kernel_bytes(kind: str, n: int, arms: int, points: float = 8192) -> float:
    """Memory of such a method: the fit of every arm, and its work on points at once."""
    if KINDS[kind].dense and n <= MOST_SAMPLES:
        at_once = 0.0 if kind == "rbf" else 8.0 * points * n * 5  # SciPy cuts its own up
        return 8.0 * n**2 * (max(1, arms) + 2) + at_once
    return 500.0 * n


def placing(study: Study, shape: Shape) -> Terms:
    """Time to record all samples but those chosen in training, and to look at the paths."""
    sets = [n for design, sizes in shape.sizes.items() if design != "adaptive" for n in sizes]
    of_set, each = _FOLLOWED if study.robot.home_rad or study.robot.home_mm else _CLOSED
    found: dict[Settings, float] = {
        (shape.said,): of_set * len(sets) + each * sum(sets),
        (shape.said, "training.seeds"): shape.arms * (_ARM * len(sets) + _ON_ARM * sum(sets)),
        ("evaluation.paths",): each * shape.waypoints,
    }
    for n in shape.sizes.get("optimal", []):
        width = 6.0 * (shape.joints + 1)
        key = ("samples.designs", shape.said)
        candidates = max(400, 2 * n)
        taken = n * (candidates * 6 * width**2 + n * width**2) / _SOLVED
        found[key] = found.get(key, 0.0) + taken
    return found


def recording(study: Study, shape: Shape) -> Terms:
    """Time to record all samples."""
    found = {**placing(study, shape)}
    if study.samples.unreachable == "mask":
        found[("samples.unreachable",)] = _MASKED
    if _on_no_grid(study, shape):
        found[("samples.designs",)] = _NEAREST
    if "adaptive" in shape.sizes:
        own, n = study.all_methods[NETWORK], max(shape.sizes["adaptive"])
        guide = own.model_copy(update={"training": own.training.model_copy(update=_GUIDING)})
        engine, weights = engine_of(study, shape, guide)
        each = _ROUND + fit_seconds(guide, engine, weights, shape.joints, n, guide.training.seeds)
        # From 8 samples on, or the corners, there are 1.4 times as many after each.
        rounds = max(0.0, 2 * log2(n / max(8, 2**shape.inputs)))
        found[("samples.designs", "network.hidden")] = _LIGHTNING + ceil(rounds) * each
    return found


def _on_no_grid(study: Study, shape: Shape) -> bool:
    """Whether distances to the nearest sample are asked for that no formula has."""
    return not study.workspace.lower_rad and bool(shape.sizes.keys() - {"grid", "adaptive"})


def recording_bytes(study: Study, shape: Shape, n: int) -> Terms:
    """Memory to record n samples."""
    width = 6.0 * (shape.joints + 1)
    optimal = 3 * 8.0 * 6 * width * 2 * max(shape.sizes.get("optimal", [0]))
    solved = 1500.0 * n * (4 if {"uniform", "joints"} & shape.sizes.keys() else 1)
    arms = 16.0 * n * shape.joints * shape.arms
    trained = 465e6 if "adaptive" in shape.sizes else 0.0
    nearest = _NEAREST_BYTES if _on_no_grid(study, shape) else 0.0
    masked = 140e6 if study.samples.unreachable == "mask" else 0.0
    return {
        ("samples.designs",): max(trained, nearest),
        ("samples.unreachable",): masked,
        (shape.said,): solved,
        (shape.said, "samples.designs"): optimal,
        (shape.said, "training.seeds"): arms,
    }


def largest(jobs: Iterable[Terms]) -> dict[Settings, float]:
    """Of jobs that follow one another, or run apart, the one that takes most."""
    all_jobs: list[Terms] = list(jobs)
    return dict(all_jobs[max(range(len(all_jobs)), key=lambda i: total(all_jobs[i]))])


def total(*jobs: Terms) -> float:
    """All terms of all jobs together."""
    return sum(sum(job.values()) for job in jobs)
