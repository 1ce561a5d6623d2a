"""A plan as people read it."""

from iksamples.plan.steps import plan_study
from iksamples.plan.whole import MethodPlan, Plan
from iksamples.results import sample_sets
from iksamples.study import Study
from iksamples.text import several


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
    return "\n".join([head, "", *rows, "", _expected(plan, cores)])


def readings_text(study: Study, cores: int | None = None) -> str:
    """What a study of readings trains, as people read it.

    Args:
        study: A study with ``readings``.
        cores: Cores it will have; None: no time is asked for.
    """
    from iksamples.paper.readings import draw_readings, most_chosen

    wanted = study.readings
    assert wanted is not None
    n_drawn, n_grids, n_again = len(draw_readings(wanted)), len(study.sizes), most_chosen(wanted)
    networks = n_grids * wanted.seeds * n_drawn, n_grids * wanted.fresh_seeds * n_again
    lines = [
        f"  search: {several(n_drawn, 'reading')} on {several(n_grids, 'grid')}, "
        f"{networks[0]} networks",
        f"  the best of them again: at most {several(n_again, 'reading')}, "
        f"at most {networks[1]} networks",
    ]
    if cores is None:
        return "\n".join(lines)
    return "\n".join([*lines, "", _expected(plan_study(study), cores)])


def _expected(plan: Plan, cores: int) -> str:
    long, large = plan.longest, plan.largest
    return (
        f"Expected: about {in_words(plan.seconds(cores))} with {several(cores, 'core')}, most of "
        f"it for '{long.step}', {in_words(long.seconds)} of one core.\n"
        f"Largest job: '{large.step}', {large.memory_mb / 1000:.1f} GB of memory.\n"
        "As on the machine of docs/plan.md, with no results there yet but trained networks;\n"
        "another machine may take half or twice as long."
    )


def in_words(seconds: float) -> str:
    """A time as people say it: ``8 s``, ``3 min``, ``1.5 h``."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
