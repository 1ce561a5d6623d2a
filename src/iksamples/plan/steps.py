"""The steps of a study's workflow, and what each will take."""

from collections.abc import Iterator, Mapping
from math import ceil

import iksamples.plan.costs as costs
import iksamples.plan.proofs as proofs
from iksamples.methods.registry import KINDS
from iksamples.plan.costs import Settings, Shape, Terms, largest, of, total
from iksamples.plan.whole import MethodPlan, Plan, StepPlan
from iksamples.results import certified
from iksamples.study import NETWORK, PROVED_TOGETHER, Method, Study


# Of one core [s].
START = {
    "samples": 0.6,
    "train": 5.0,
    "evaluate": 0.9,
    "evaluate_untrained": 1.5,
    "floor": 0.8,
    "bounds": 1.0,
    "prove": 0.8,
    "map": 0.85,
    "collect": 0.8,
    "table": 0.9,
    "answer": 1.2,
    "replicate": 5.0,
    "track": 3.9,
    "record": 0.8,
    "report": 3.0,
    "learn": 4.5,
    "size": 1.2,
    "describe": 2.5,
    "search": 4.5,
    "confirm": 4.5,
    "rank": 0.8,
    "page": 2.0,
}
"""A job with next to nothing to do: Python with what it imports."""
_POINT, _POINT_JOINT, _POINT_WEIGHT = 3.5e-7, 1.3e-7, 6e-10
"""Of a network at a point: its statistics, the arm's motion by joint, the network by weight."""
_TURNED = 3.5
"""Times as much where the tool's angle is measured as well."""
_LOADED_JOINT = 3.3e-6
"""The same of an arm that bends under its load, which is solved at each point."""
_NEURON, _WIDER = 55e3, 1.75
"""Memory of a search for the worst case [bytes], times a power of the hidden neurons."""
_RUN = 0.1
"""Logging of a method on one set of samples to MLflow."""
_JOB = 600.0
"""Work that is worth a job of its own: beside it, starting Python costs next to nothing."""
_READING = 0.35
"""Training of a reading's sixteen networks on all grids, the mean of those drawn."""

# Memory [MB] of a job with little to do, and of what grows [bytes].
_BASE_MB = dict.fromkeys(("train", "replicate", "learn", "search", "confirm"), 600.0)
_BASE_MB |= {
    "samples": 135.0,
    "evaluate": 185.0,
    "evaluate_untrained": 200.0,
    "prove": 155.0,
    "bounds": 160.0,
    "map": 165.0,
    "collect": 145.0,
    "answer": 170.0,
    "track": 290.0,
    "rank": 130.0,
    "table": 185.0,
    "size": 165.0,
    "page": 175.0,
}
_OTHER_MB = 230.0
_ROWS, _ROW = 2**20, 170
"""Rows of tables that evaluation holds at once, and a row."""


def plan_study(study: Study, cached: Mapping[str, int] | None = None) -> Plan:
    """What a study will take, as if nothing of it were there yet but trained networks.

    It depends on the study's description alone, reads no file and takes milliseconds.

    Args:
        study: The study.
        cached: Networks of each method that need not be trained again.
    """
    if is_apart(study):
        return Plan([], list(_readings(study) if study.readings else _recorded(study)))
    shape = costs.shape_of(study)
    methods = [
        _fit(study, shape, name, method, (cached or {}).get(name, 0))
        for name, method in study.all_methods.items()
        if not KINDS[method.kind].fit
    ]
    return Plan(methods, list(_computed(study, shape, methods)))


def is_apart(study: Study) -> bool:
    """Whether the study has rules of its own."""
    return bool(study.readings or study.samples.recorded)


def seeds_per_job(study: Study, seconds: float, n_seeds: int) -> int:
    """How many seeds a job takes, where all of them take so long [s]."""
    blocks = _JOB * n_seeds / max(seconds, 1e-9) / PROVED_TOGETHER
    return study.seeds_per_job or PROVED_TOGETHER * max(1, int(min(blocks, n_seeds)))


def _cut(study: Study, work: Terms, n_seeds: int) -> list[Terms]:
    """Work with some seeds, as the jobs that it is cut into."""
    n_jobs = -(-n_seeds // seeds_per_job(study, total(work), n_seeds))
    return [{key: seconds / n_jobs for key, seconds in work.items()}] * n_jobs


def proof_seconds(study: Study, plan: MethodPlan) -> float:
    """Expected time of the proofs of a method's networks [s]."""
    method = study.all_methods[plan.method]
    return proofs.network_seconds(study, costs.shape_of(study), method) * plan.networks


def _fit(study: Study, shape: Shape, name: str, method: Method, cached: int) -> MethodPlan:
    training, sizes = method.training, costs.sets_of(study, shape, method)
    engine, weights = costs.engine_of(study, shape, method)
    seconds, steps = 0.0, 0
    for n in map(training.n_trained, sizes):
        steps += training.seeds * costs.epochs_of(method, n) * training.steps_per_epoch(n)
        seconds += costs.FIT + costs.fit_seconds(
            method, engine, weights, shape.joints, n, training.seeds
        )
    n_networks = training.seeds * len(sizes)
    share = 1 - cached / n_networks if n_networks else 0.0
    return MethodPlan(name, n_networks, n_networks - cached, round(steps * share), seconds * share)


def _computed(study: Study, shape: Shape, fits: list[MethodPlan]) -> Iterator[StepPlan]:
    methods = study.all_methods
    trained = {name: one for name, one in methods.items() if not KINDS[one.kind].fit}
    plans = {fit.method: fit for fit in fits}
    n_max = max((n for sizes in shape.sizes.values() for n in sizes), default=0)
    n_all = sum(n for sizes in shape.sizes.values() for n in sizes)
    wide = shape.inputs + shape.joints
    said: Settings = (shape.said,)

    yield _step(
        "samples", [costs.recording(study, shape)], costs.recording_bytes(study, shape, n_max)
    )

    memory = largest(costs.fit_bytes(study, shape, name, one) for name, one in trained.items())
    memory[said] = memory.get(said, 0.0) + 16.0 * n_all * wide * (1 + shape.arms)
    training: Terms = {
        (of(n, "training.seeds"), of(n, "training.epochs"), shape.said): plans[n].seconds
        for n in trained
    }
    n_seeds = max(one.training.seeds for one in trained.values())
    yield _step("train", _cut(study, training, n_seeds), memory)

    asked: Settings = ("evaluation.cube_points", "training.seeds")
    turned = study.task.orientation != "free"
    point = _POINT + _POINT_JOINT * shape.joints * (_TURNED if turned else 1)
    if study.arm and study.arm.payload_kg:
        point += _LOADED_JOINT * shape.joints
    jobs, sizes = list[Terms](), list[Terms]()
    for name, one in trained.items():
        weights = one.network.n_parameters(shape.inputs, shape.joints)
        each = shape.points * (point + _POINT_WEIGHT * weights)
        key: Settings = (asked[0], of(name, asked[1]))
        jobs.append({key: each * plans[name].networks})
        rows = min(one.training.seeds * shape.points, max(_ROWS, shape.points))
        held: Terms = {
            (of(name, "network.hidden"),): 8.0 * 2**22 + 12.0 * weights * one.training.seeds
        }
        sizes.append({key: float(_ROW * rows), **held})
    yield _step("evaluate", jobs, largest(sizes))
    arms = max(1, shape.arms)
    untrained = {name: one for name, one in methods.items() if name not in trained}
    if untrained:
        work, sizes = dict[Settings, float](), list[Terms]()
        for name, one in untrained.items():
            for n in costs.sets_of(study, shape, one):
                fitted = costs.kernel_seconds(one.kind, n)
                answers = (costs.answer_seconds(one.kind, n, shape.joints) + point) * shape.points
                own = (shape.said, f"methods.{name}", "evaluation.cube_points")
                work[own] = work.get(own, 0.0) + arms * (fitted + answers)
                sizes.append({own[:2]: costs.kernel_bytes(one.kind, n, shape.arms)})
        rows = min(arms * shape.points, max(_ROWS, shape.points))
        yield _step("evaluate_untrained", [work], {asked: float(_ROW * rows), **largest(sizes)})
    if study.arm and not study.arm.repeats:
        rows = min(arms * shape.points, max(_ROWS, shape.points))
        yield _step("floor", [{asked: 2e-5 * arms * shape.points}], {asked: float(_ROW * rows)})

    proved = list[Terms]()
    for name in certified(study):
        one = methods[name]
        key = (of(name, "training.seeds"), of(name, "network.hidden"), shape.said)
        if name in plans:
            needed = proof_seconds(study, plans[name])
            proved += _cut(study, {key: needed}, one.training.seeds)
            continue
        seconds = arms * proofs.tables_seconds(study, costs.sets_of(study, shape, one))
        proved.append({(f"methods.{name}", shape.said): seconds})
    neurons = max(sum(one.network.hidden) for one in trained.values())
    searched: Terms = {said: 4e3 * n_max, ("network.hidden",): _NEURON * neurons**_WIDER}
    if proved:
        yield _step("prove", proved, searched)

    first = study.samples.design
    n_first = len(shape.sizes[first])
    n_networks = sum(fit.networks for fit in plans.values())
    by: Settings = ("training.seeds", "methods", shape.said)
    hidden = max(study.network.hidden, default=shape.inputs)
    if study.paper:
        rows = min(study.training.seeds * shape.points, max(2**18, shape.points))
        width = ("evaluation.cube_points", "network.hidden")
        taken: Terms = {width: 12.5 * rows * (shape.inputs + 1) * hidden}
        each = shape.points * (4.5e-7 + 7.5e-9 * (shape.inputs + 1) * hidden)
        yield _step("bounds", [{(*width, by[0]): each * plans[NETWORK].networks}], taken)
        yield _step("table", [{}], {})
    weights = study.network.n_parameters(shape.inputs, shape.joints)
    snapshots = 4.0 * weights * study.training.seeds * study.training.snapshots
    kept: Terms = {("network.hidden", "training.seeds", "training.snapshots"): 2 * snapshots}
    drawn = proofs.pictures_seconds(study, shape, methods[NETWORK], n_first)
    pictures: Terms = {(shape.said, "training.snapshots", "network.hidden"): drawn}
    yield _step("map", [pictures], {**kept, said: 7e3 * n_max})
    everything = n_networks + len(untrained) * arms * sum(map(len, shape.sizes.values()))
    runs = everything * (1 + len(study.evaluation.paths))
    yield _step("collect", [{by: 2e-5 * runs + 0.01 * len(methods) * n_first}], {by: 900.0 * runs})
    at_samples = sum(fit.networks for fit in plans.values()) * n_all / max(1, n_first)
    yield _step(
        "answer",
        [{by: 0.1 * len(methods) + 2e-6 * at_samples}],
        {by: 600.0 * runs, said: 200.0 * max(n_max, 2**16)},
    )
    if study.replication.seeds:
        yield _replication(study, shape, plans, proved, jobs)
    history = (
        50.0 * study.training.seeds * max(costs.epochs_of(methods[NETWORK], n) for n in study.sizes)
    )
    epochs: Settings = ("training.epochs", "training.seeds")
    yield _step(
        "track",
        # A network is exported, and that is proved.
        [
            {
                by: _RUN * len(methods) * n_first,
                ("network.hidden",): proofs.network_seconds(study, shape, methods[NETWORK]),
            }
        ],
        {by: 600.0 * runs, epochs: 3 * history, ("network.hidden",): _NEURON * neurons**_WIDER},
    )
    way = 300.0 * study.training.seeds * shape.waypoints
    paths: Settings = ("evaluation.paths", "training.seeds")
    yield _step("record", [{paths: 0.25 * len(study.evaluation.paths)}], {paths: way, **kept})
    yield _step("report", [{by: 1.0 + 1e-5 * runs}], {by: 600.0 * runs, paths: way, **kept})


def _replication(
    study: Study,
    shape: Shape,
    plans: Mapping[str, MethodPlan],
    proved: list[Terms],
    evaluations: list[Terms],
) -> StepPlan:
    """The answers' networks again, on two sizes each."""
    fresh = 2 * study.replication.seeds * len(plans) * len(study.samples.designs)
    share = fresh / sum(plan.networks for plan in plans.values())
    again = sum(plan.seconds for plan in plans.values()) + total(*evaluations, *proved)
    sizes = []
    for name in plans:
        method = study.all_methods[name]
        training = method.training.model_copy(update={"seeds": study.replication.seeds})
        one = method.model_copy(update={"training": training})
        taken = costs.fit_bytes(study, shape, name, one)
        sizes.append(
            {
                tuple("replication.seeds" if "training.seeds" in said else said for said in key): v
                for key, v in taken.items()
            }
        )
    return _step("replicate", [{("replication.seeds",): share * again}], largest(sizes))


def _recorded(study: Study) -> Iterator[StepPlan]:
    """Of a recording there are as many records as the largest size needs, at least."""
    settings, shape, methods = study.samples.recorded, costs.shape_of(study), study.all_methods
    assert settings is not None
    share, orders = settings.held_out_share, settings.subsets
    held = study.sizes[-1] * share / (1 - share)
    said, by = (shape.said,), ("samples.recorded.subsets", shape.said, "methods")
    work, sizes = dict[Settings, float](), list[Terms]()
    for name, one in methods.items():
        engine, weights = costs.engine_of(study, shape, one)
        key = (of(name, "training.epochs"), of(name, "network.hidden"), by[0])
        if KINDS[one.kind].fit:
            key = (f"methods.{name}", *by[:2])
        taken = 0.0
        for n in study.sizes:
            if KINDS[one.kind].fit:
                taken += orders * costs.kernel_seconds(one.kind, n)
            else:
                taken += costs.FIT + costs.fit_seconds(
                    one, engine, weights, shape.joints, n, orders
                )
        work[key] = work.get(key, 0.0) + taken
        if KINDS[one.kind].fit:
            sizes.append({key[:2]: costs.kernel_bytes(one.kind, study.sizes[-1], 1, held)})
        else:
            training = one.training.model_copy(update={"seeds": orders, "snapshots": 2})
            alike = one.model_copy(update={"training": training})
            sizes.append(costs.fit_bytes(study, shape, name, alike))
    rows = len(methods) * len(study.sizes) * orders * held
    work[by] = 3e-6 * rows + 0.003 * len(methods) * len(study.sizes) * orders
    yield _step("learn", [work], {by: 250.0 * rows, **largest(sizes)})
    runs = len(methods) * len(study.sizes) * orders
    yield _step("size", [{by: 0.2 * len(methods)}], {by: 600.0 * runs})
    yield _step("track", [{by: 2e-3 * runs}], {by: 900.0 * runs})
    yield _step("describe", [{by: 1e-5 * runs}], {by: 600.0 * runs, said: 200.0 * rows})


def _readings(study: Study) -> Iterator[StepPlan]:
    wanted = study.readings
    assert wanted is not None
    parts, again = wanted.jobs, min(wanted.count, wanted.best + 60)
    for step, number, n, seeds, count in (
        ("search", wanted.count, wanted.seeds, "readings.seeds", "readings.count"),
        ("confirm", again, wanted.fresh_seeds, "readings.fresh_seeds", "readings.best"),
    ):
        each = _READING * ceil(n / 16) * number / parts
        yield _step(step, [{(count, seeds): each}] * parts, {(seeds,): 4e5 * n})
    yield _step("rank", [{}], {})
    yield _step("page", [{}], {("readings.count",): 2000.0 * wanted.count})


def _step(step: str, jobs: list[Terms], taken: Terms) -> StepPlan:
    """A step whose jobs take some time beside their start, and some bytes beside the libraries."""
    start, base = START[step], _BASE_MB.get(step, _OTHER_MB)
    seconds = [start + sum(job.values()) for job in jobs]
    work: dict[Settings, float] = {}
    for job in jobs:
        for key, value in job.items():
            work[key] = work.get(key, 0.0) + value
    return StepPlan(
        step,
        len(jobs),
        sum(seconds),
        max(seconds),
        base + sum(taken.values()) / 1e6,
        _mostly(work),
        _mostly(taken),
    )


def _mostly(terms: Terms) -> Settings:
    """The settings that most of it is due to."""
    largest = max(terms, key=lambda key: terms[key], default=())
    many = largest and terms[largest] < sum(terms.values()) / 4
    return ("methods", *largest) if many else largest
