"""What a valid study may still get wrong, said before any work is spent."""

from iksamples.sizing.statistics import met_needed, seeds_needed, single_share
from iksamples.sizing.words import percent, several, whole
from iksamples.study import Study


_NEED_A_GRID = ("multilinear", "cubic", "polynomial")
_GRIDS = ("grid", "chebyshev")


def advice(study: Study) -> list[str]:
    """One line for each thing that will not come out as its author may expect."""
    return [*_too_few_seeds(study), *_methods_without_samples(study)]


def _too_few_seeds(study: Study) -> list[str]:
    tolerance = study.tolerance
    share = single_share(tolerance.success_share, tolerance.best_of)
    lines = []
    counts = {m.training.seeds for m in study.all_methods.values() if m.kind == "network"}
    for n in sorted(counts):
        if met_needed(n, share, tolerance.confidence) is None:
            enough = seeds_needed(share, tolerance.confidence)
            lines.append(
                f"{several(n, 'seed')} cannot show with {percent(tolerance.confidence)} confidence "
                f"that {percent(share)} of trainings succeed, even if all do; {whole(enough)} can "
                "(training.seeds)."
            )
    return lines


def _methods_without_samples(study: Study) -> list[str]:
    scattered = [design for design in study.samples.designs if design not in _GRIDS]
    names = [name for name, method in study.methods.items() if method.kind in _NEED_A_GRID]
    if not scattered or not names:
        return []
    what = "has" if len(names) == 1 else "have"
    return [
        f"{', '.join(names)} {what} no results on {', '.join(scattered)} samples: tables and "
        "splines need a full grid."
    ]
