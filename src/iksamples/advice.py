"""What a valid study may still get wrong, said before any work is spent."""

from collections.abc import Sequence

import numpy as np

from iksamples.evaluation.paths import waypoints
from iksamples.methods.grid import tensor_grid
from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.registry import KINDS
from iksamples.results import networks
from iksamples.samples.dataset import SampleSet
from iksamples.stats import met_needed, seeds_needed, single_share
from iksamples.study import Study
from iksamples.task import Task
from iksamples.text import percent, several, whole


_MOST_TURNS = 10
"""Turns between a joint's limits beyond which they are hardly meant in radians."""


def advice(study: Study, task: Task, sets: Sequence[SampleSet] | None) -> list[str]:
    """One line for each thing that will not come out as its author may expect.

    Args:
        study: The study.
        task: Its task.
        sets: Its samples, but for those chosen in training; None: neither they nor the paths are
            to be looked at.
    """
    return [
        *_limits_in_degrees(task),
        *(() if sets is None else _paths_outside(study, task)),
        *_too_few_seeds(study),
        *_methods_without_samples(study, sets or ()),
    ]


def _limits_in_degrees(task: Task) -> list[str]:
    limits = zip(task.q.names, task.q.units, task.q.lower, task.q.upper, strict=True)
    return [
        f"{name} can turn from {low:g} to {high:g} rad, {(high - low) / (2 * np.pi):.0f} turns; "
        "limits are in radians (in a URDF too)."
        for name, unit, low, high in limits
        if unit == "rad" and high - low > _MOST_TURNS * 2 * np.pi
    ]


def _paths_outside(study: Study, task: Task) -> list[str]:
    found = []
    for name, path in study.evaluation.paths.items():
        x = waypoints(path, task).x
        outside = len(x) - int(np.sum(task.region.contains(x)))
        if outside:
            found.append(
                f"evaluation.paths.{name}: {outside} of {len(x)} points lie outside of the "
                "workspace, where there are no samples; its errors are partly extrapolation."
            )
    return found


def _too_few_seeds(study: Study) -> list[str]:
    tolerance = study.tolerance
    share = single_share(tolerance.success_share, tolerance.best_of)
    counts = [study.all_methods[name].training.seeds for name in networks(study)]
    n_variants = len(counts) * len(study.samples.designs)
    # All answers together hold with the confidence asked for (answer/sizes.py).
    each = 1 - (1 - tolerance.confidence) / n_variants
    together = "" if n_variants == 1 else f" for {n_variants} variants of networks together"
    return [
        f"{several(n, 'seed')} cannot show with {percent(tolerance.confidence)} confidence"
        f"{together} that {percent(share)} of trainings succeed, even if all do; "
        f"{whole(seeds_needed(share, each))} can (training.seeds)."
        for n in sorted(set(counts))
        if met_needed(n, share, each) is None
    ]


def _methods_without_samples(study: Study, sets: Sequence[SampleSet]) -> list[str]:
    names = [name for name, method in study.methods.items() if KINDS[method.kind].needs_grid]
    used = {design for name in names for design in study.designs(name)}
    labels = [one.label for one in sets if one.design in used and not _is_full_grid(one)]
    if not labels or not names:
        return []
    what = "has" if len(names) == 1 else "have"
    return [
        f"{', '.join(names)} {what} no results on {', '.join(labels)}: tables and splines need a "
        "full grid."
    ]


def _is_full_grid(samples: SampleSet) -> bool:
    try:
        tensor_grid(samples, "")
    except NotApplicableError:
        return False
    return True
