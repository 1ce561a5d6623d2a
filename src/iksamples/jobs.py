"""The jobs of a large study: which seeds each of them trains or proves."""

from iksamples.plan import is_apart, plan_study, proof_seconds, seeds_per_job
from iksamples.results import networks
from iksamples.study import Study


def parts(study: Study, method: str | None = None) -> list[str]:
    """The jobs into which training, or the proofs of a method, are cut: their seeds, as ``0-49``.

    Args:
        study: The study.
        method: Whose proofs; None: the training of all methods.

    Returns:
        Nothing where one job does it all, since starting Python costs more than it would save.
    """
    if is_apart(study) or (method and method not in networks(study)):
        return []
    names = [method] if method else networks(study)
    seeds = sorted({one for name in names for one in study.all_methods[name].training.all_seeds})
    plans = {plan.method: plan for plan in plan_study(study).methods}
    if method:
        seconds = proof_seconds(study, plans[method])
    else:
        seconds = sum(plan.seconds for plan in plans.values())
    each = seeds_per_job(study, seconds, len(seeds))
    if len(seeds) <= each:
        return []
    cut = [seeds[first : first + each] for first in range(0, len(seeds), each)]
    return [f"{some[0]}-{some[-1]}" for some in cut]
