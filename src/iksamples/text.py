"""Words of the answer: methods, lengths and shares as people write them."""

import math
import re
from collections.abc import Sequence
from decimal import ROUND_CEILING, Decimal

from iksamples.study import NETWORK, Method, Network, Robot, Study, Tolerance, Training


OPTIMIZERS = {"adam": "Adam", "levenberg-marquardt": "Levenberg-Marquardt"}
"""Optimisers as people write them."""
_ACTIVATIONS = {"relu": "ReLU"}
_OTHERS = {
    "multilinear": "a look-up table of the same samples",
    "cubic": "a cubic spline through the same samples",
    "polynomial": "one polynomial through the same samples",
    "rbf": "a radial-basis interpolation of the same samples",
    "gaussian-process": "a Gaussian process on the same samples",
    "nominal": "the drawing's inverse",
    "calibrated": "the drawing fitted to the same samples",
    "trigonometric": "sines and cosines fitted to the same samples",
    "residual": "the drawing's inverse corrected by the same samples",
}
_SAME = "the same samples"
_KNOWN = {
    "trigonometric": "that its joints turn",
    "nominal": "the drawing",
    "calibrated": "the drawing and how much arms differ from it",
    "residual": "the drawing",
}
_PLACED = {
    "grid": "on an even grid",
    "chebyshev": "at Chebyshev nodes",
    "sobol": "at Sobol points",
    "latin": "in a Latin hypercube",
    "uniform": "at random in the workspace",
    "joints": "at random in joint space",
    "adaptive": "where trained networks disagreed",
    "optimal": "where they tell most about the drawing",
    "recorded": "as they were recorded",
}
_NO_RECIPE = {"seeds", "first_seed", "snapshots", "engine", "accelerator"}


def described(study: Study, name: str) -> str:
    """What a method is, as a noun: ``the paper's training``, ``a look-up table of ...``."""
    method = study.all_methods[name]
    if method.kind != "network":
        words = _OTHERS.get(method.kind, method.kind)
        return words if name in (method.kind, "table") else f"{words} ({name})"
    if is_paper_recipe(method) and study.robot == Robot():
        return "the paper's training"
    recipe = network_recipe(method)
    return f"the study's own network ({recipe})" if name == NETWORK else f"{name} ({recipe})"


def known(study: Study, name: str) -> str:
    """What a method is and what it knows of the arm before it has a sample, a line each."""
    what = re.sub(rf" \w+ {_SAME}", "", described(study, name))
    if study.all_methods[name].kind == "network":
        what = what.split(" (")[0] if name == NETWORK else f"a network ({name})"
    return f"{what}\nknows {_KNOWN.get(study.all_methods[name].kind, 'nothing of the arm')}"


def placed(study: Study, design: str) -> str:
    """Where samples lie, with a space in front; nothing to say where the study has one design."""
    return "" if study.samples.designs == [design] else f" {_PLACED.get(design, design)}"


def described_on(study: Study, name: str, design: str) -> str:
    """What a method is and where its samples lie, as a noun."""
    words, where = described(study, name), placed(study, design)
    if where and _SAME in words:
        return words.replace(_SAME, f"samples{where}")
    return words + where


def domain(region_share: float) -> str:
    """What errors and proofs are over: the workspace, or what the arm can use of it."""
    return "the workspace" if region_share == 1 else "the usable part of the workspace"


def trial(study: Study) -> str:
    """What a seed is: a training on the one arm, another arm, or another order of its records."""
    if study.samples.recorded:
        return "order"
    return "arm" if study.arm else "training"


def is_paper_recipe(method: Method) -> bool:
    """Whether a network has the paper's shape, activation and training."""
    return (
        method.kind == "network"
        and method.network == Network()
        and same_training(method.training, Training())
    )


def same_training(ours: Training, theirs: Training) -> bool:
    """Whether two trainings are alike in all but which seeds are trained, and by what engine."""
    first, second = (training.model_dump(exclude=_NO_RECIPE) for training in (ours, theirs))
    return first == second


def network_recipe(method: Method) -> str:
    """A network's shape and training: ``16 tanh neurons, 500 epochs of Adam``."""
    network, training = method.network, method.training
    activation = _ACTIVATIONS.get(network.activation, network.activation)
    shape = "-".join(str(width) for width in network.hidden)
    neurons = f"{shape} {activation} neurons" if shape else "no hidden layer"
    budget = (
        f"{whole(training.steps)} steps" if training.steps else f"{whole(training.epochs)} epochs"
    )
    if training.early_stopping:
        budget = f"up to {budget}"
    recipe = f"{neurons}, {budget} of {OPTIMIZERS[training.optimizer]}"
    return recipe if training.schedule == "constant" else f"{recipe}, {training.schedule} schedule"


def millimetres(value: float) -> str:
    """An error with three figures, rounded up as bounds are: ``1.60 mm``, ``12.3 mm``."""
    if value == 0:
        return "0 mm"
    if abs(value) < 1e-6:
        return "less than 1 nm"  # rounding, not an error
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{Decimal(repr(float(value))).quantize(Decimal(1).scaleb(-digits), ROUND_CEILING)} mm"


def plain_millimetres(value: float) -> str:
    """A length as its author wrote it: ``2 mm``, ``0.25 mm``."""
    return f"{value:g} mm"


def allowed(tolerance: Tolerance) -> str:
    """What a tolerance allows: ``2 mm``, or ``2 mm and 1° (1° counts as 2 mm)``."""
    limit = plain_millimetres(tolerance.error_mm)
    if not tolerance.angle_deg:
        return limit
    counts = plain_millimetres(tolerance.error_mm / tolerance.angle_deg)
    return f"{limit} and {tolerance.angle_deg:g}° (1° counts as {counts})"


def percent(share: float) -> str:
    """A share in per cent; a tenth of a per cent is shown where it has one."""
    tenths = round(1000 * share) / 10
    return f"{tenths:.0f} %" if tenths == round(tenths) else f"{tenths:.1f} %"


def percent_down(share: float) -> str:
    """A share in per cent, rounded down: a lower end must not read as larger than it is."""
    return percent(math.floor(1000 * share + 1e-9) / 1000)


def percent_up(share: float) -> str:
    """A share in per cent, rounded up: an upper end must not read as smaller than it is."""
    return percent(math.ceil(1000 * share - 1e-9) / 1000)


def whole(n: float) -> str:
    """A whole number, thousands apart by a thin space."""
    return f"{n:,.0f}".replace(",", "\u202f")


def several(n: int, thing: str) -> str:
    """``1 training``, ``20 trainings``."""
    return f"{whole(n)} {thing}{'' if n == 1 else 's'}"


def listed(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
