"""The budget of a study, and what a scheduler is asked for."""

from math import ceil

from iksamples.errors import IksamplesError
from iksamples.plan.steps import plan_study
from iksamples.study import Study
from iksamples.text import listed


def require_affordable(study: Study, remedy: str | None = None) -> None:
    """Stops at a study that takes more than its budget, before anything is made for it.

    Args:
        study: The study.
        remedy: What to do then, where there is no study file with settings to change.

    Raises:
        IksamplesError: Names the step, the estimate, the settings it is due to, and what to do.
    """
    plan, budget = plan_study(study), study.budget
    large, long = plan.largest, plan.longest
    if large.memory_mb > 1000 * budget.memory_gb:
        other = f"Make these smaller, or raise budget.memory_gb ({budget.memory_gb:g})."
        raise IksamplesError(
            f"{study.name}: '{large.step}' would take about {_rounded(large.memory_mb / 1000)} GB "
            f"of memory, mostly by {listed(large.memory_by)}.\n{remedy or other}"
        )
    if plan.processor_s > 3600 * budget.processor_hours:
        other = f"Make these smaller, or raise budget.processor_hours ({budget.processor_hours:g})."
        raise IksamplesError(
            f"{study.name}: would take about {_rounded(plan.processor_s / 3600)} hours of one "
            f"core, {_rounded(long.seconds / 3600)} for '{long.step}', mostly by "
            f"{listed(long.time_by)}.\n{remedy or other}"
        )


def resources(study: Study, rule: str) -> dict[str, int]:
    """What a scheduler is asked for, for one job of a rule: the estimate with room to spare.

    Args:
        study: The study.
        rule: Name of the rule; one that is not in the plan does next to nothing.

    Returns:
        ``mem_mb`` [MB] and ``runtime`` [min], as Snakemake names them.
    """
    found = {step.step: step for step in plan_study(study).steps}.get(rule)
    memory_mb, seconds = (found.memory_mb, found.longest_s) if found else (0.0, 0.0)
    return {
        "mem_mb": max(500, ceil(1.5 * memory_mb)),
        "runtime": ceil(_SLOWER * seconds / 60) + 5,
    }


_SLOWER = 4
"""Times slower than here a machine may be, before a scheduler ends its job."""


def _rounded(value: float) -> str:
    """Two digits."""
    return f"{value:.1f}" if value < 10 else f"{float(f'{value:.2g}'):,.0f}".replace(",", " ")
