"""What a valid study may still get wrong, said before any work is spent."""

from collections.abc import Sequence

from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.registry import KINDS
from iksamples.methods.tensor import tensor_grid
from iksamples.results import networks
from iksamples.samples.dataset import SampleSet
from iksamples.stats import met_needed, seeds_needed, single_share
from iksamples.study import Study
from iksamples.text import percent, several, whole


def advice(study: Study, sets: Sequence[SampleSet]) -> list[str]:
    """One line for each thing that will not come out as its author may expect.

    Args:
        study: The study.
        sets: Its samples, but for those chosen in training.
    """
    return [*_too_few_seeds(study), *_methods_without_samples(study, sets)]


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
    labels = [samples.label for samples in sets if not _is_full_grid(samples)]
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
