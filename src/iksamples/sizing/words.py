"""Words of the answer: methods, lengths and shares as people write them."""

import math

from iksamples.study import NETWORK, Method, Network, Study, Training


_OPTIMIZERS = {
    "adam": "Adam",
    "lbfgs": "L-BFGS",
    "l-bfgs": "L-BFGS",
    "lm": "Levenberg-Marquardt",
    "levenberg-marquardt": "Levenberg-Marquardt",
}
_ACTIVATIONS = {"relu": "ReLU"}
_OTHERS = {
    "multilinear": "a look-up table of the same samples",
    "cubic": "a cubic spline through the same samples",
    "polynomial": "one polynomial through the same samples",
    "rbf": "a radial-basis interpolation of the same samples",
    "gaussian-process": "a Gaussian process on the same samples",
    "analytic": "the exact inverse",
}
_RECIPE = ("optimizer", "learning_rate", "batch_size", "epochs", "steps", "early_stopping")


def described(study: Study, name: str) -> str:
    """What a method is, as a noun: ``the paper's training``, ``a look-up table of ...``."""
    method = study.all_methods[name]
    if method.kind != "network":
        words = _OTHERS.get(method.kind, method.kind)
        return words if name in (method.kind, "table") else f"{words} ({name})"
    if is_paper_recipe(method):
        return "the paper's training"
    recipe = network_recipe(method)
    return f"the study's own network ({recipe})" if name == NETWORK else f"{name} ({recipe})"


def is_paper_recipe(method: Method) -> bool:
    """Whether a network has the paper's shape, activation and training."""
    ours, theirs = method.training, Training()
    return (
        method.kind == "network"
        and method.network == Network()
        and all(getattr(ours, key) == getattr(theirs, key) for key in _RECIPE)
    )


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
    return f"{neurons}, {budget} of {_OPTIMIZERS.get(training.optimizer, training.optimizer)}"


def millimetres(value: float) -> str:
    """A length with three figures: ``1.60 mm``, ``12.3 mm``."""
    if value == 0:
        return "0 mm"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    if digits > 6:
        return f"{value:.1e} mm"
    return f"{value:.{digits}f} mm"


def plain_millimetres(value: float) -> str:
    """A length as its author wrote it: ``2 mm``, ``0.25 mm``."""
    return f"{value:g} mm"


def percent(share: float) -> str:
    """A share in per cent; a tenth of a per cent is shown where it has one."""
    tenths = round(1000 * share) / 10
    return f"{tenths:.0f} %" if tenths == round(tenths) else f"{tenths:.1f} %"


def percent_down(share: float) -> str:
    """A share in per cent, rounded down: a lower end must not read as larger than it is."""
    return percent(math.floor(1000 * share + 1e-9) / 1000)


def whole(n: float) -> str:
    """A whole number, thousands apart: ``32 000``."""
    return f"{n:,.0f}".replace(",", " ")


def several(n: int, thing: str) -> str:
    """``1 training``, ``20 trainings``."""
    return f"{whole(n)} {thing}{'' if n == 1 else 's'}"
