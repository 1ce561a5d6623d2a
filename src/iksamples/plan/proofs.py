"""What proofs take: worst cases and means of networks and tables, and those along a training.

Searches cut the workspace into boxes until each is decided. What that takes was measured of
networks of 16 to 256 neurons in one and two layers, of arms of two to seven joints.
"""

from collections.abc import Iterable

import iksamples.plan.costs as costs
from iksamples.plan.costs import Shape
from iksamples.study import MAX_EPOCHS, MOST_INPUTS_OF_A_MEAN, Method, Study


_PROVED = 0.01
"""What the proofs of a network take at least [s]."""
_SEARCH = {"adam": 0.012, "levenberg-marquardt": 0.08}
"""Worst distance of a network of 16 neurons on an arm of three joints and inputs [s]."""
_MEAN = {"adam": 0.025, "levenberg-marquardt": 0.08}
"""And its mean, within a share of 0.025 [s]; of half that share about twice as much."""
_STEPS, _LONGER = 4000, 0.3
"""Of Adam; a network that is trained for longer is less smooth, with this power of the steps."""
_WIDER_SEARCH, _WIDER_MEAN, _SMOOTH = 1.6, 1.3, 0.5
"""Powers of the hidden neurons: where each bends the network, and of tanh that Adam trains, which
stays smooth."""
_TURNED = 2.0
"""Times as much where the worst angle is proved as well."""
_PLANE_SEARCH, _PLANE_MEAN = 0.15, 0.03
"""Times as much with two inputs."""
_KINKED_MEAN = 20.0
"""Times as much a mean with four inputs, where the kinks of ReLUs have to be found."""
_TABLE, _CELL = 0.05, 7e-4
"""A look-up table, and each of its cells [s]."""
_OF_AN_EPOCH, _WIDER_EPOCH, _BY_INPUT = 1.5e-3, 0.8, 2.5
"""Worst case at an epoch of a training [s], that of 16 neurons and three inputs: the power of the
neurons, and times as much with each input more."""
_CONVERGED = 0.12
"""What it takes besides, once a training has converged, as a share of that at its end."""
_SAFE = 0.5
"""The share of the workspace that keeps the tolerance, beside a mean."""


def network_seconds(study: Study, shape: Shape, method: Method) -> float:
    """Expected time of the proofs of one network [s]."""
    times = _TURNED if study.task.orientation != "free" else 1
    seconds = _PROVED + times * _search(study, shape, method)
    if shape.inputs > MOST_INPUTS_OF_A_MEAN:
        return seconds
    return seconds + _mean(study, shape, method) * 0.025 / study.bounds.mean_rtol


def tables_seconds(study: Study, sizes: Iterable[int]) -> float:
    """Expected time of the proofs of look-up tables of so many samples each [s]."""
    times = _TURNED if study.task.orientation != "free" else 1
    return times * sum(_TABLE + _CELL * n for n in sizes)


def pictures_seconds(study: Study, shape: Shape, method: Method, n_sets: int) -> float:
    """Expected time of what is proved of the networks that pictures show [s]."""
    each = _OF_AN_EPOCH
    if method.training.optimizer == "adam":
        each *= _roughness(study, shape, method, _WIDER_EPOCH) * _BY_INPUT ** (shape.inputs - 3)
    else:
        each += _CONVERGED * _search(study, shape, method)
    seconds = min(MAX_EPOCHS, method.training.snapshots) * each
    if shape.inputs <= 3:
        seconds += _SAFE * _mean(study, shape, method)
    return n_sets * len(study.evaluation.paths) * seconds


def _search(study: Study, shape: Shape, method: Method) -> float:
    """Of one network's worst distance [s]."""
    seconds = _SEARCH[method.training.optimizer] * _roughness(study, shape, method, _WIDER_SEARCH)
    return seconds * shape.joints / 3 * (_PLANE_SEARCH if shape.inputs == 2 else 1)


def _mean(study: Study, shape: Shape, method: Method) -> float:
    """Of one network's mean, within a share of 0.025 [s]."""
    seconds = _MEAN[method.training.optimizer] * _roughness(study, shape, method, _WIDER_MEAN)
    if shape.inputs == 2:
        seconds *= _PLANE_MEAN
    if shape.inputs == 4 and method.network.activation == "relu":
        seconds *= _KINKED_MEAN
    return seconds * shape.joints / 3


def _roughness(study: Study, shape: Shape, method: Method, wider: float) -> float:
    """Times as much as of a network of 16 neurons that was trained for some steps of Adam."""
    training = method.training
    smooth = training.optimizer == "adam" and method.network.activation == "tanh"
    times = float((sum(method.network.hidden) / 16) ** (_SMOOTH if smooth else wider))
    sizes = [training.n_trained(n) for n in costs.sets_of(study, shape, method)]
    if training.optimizer != "adam" or not sizes:
        return times
    steps = sum(costs.epochs_of(method, n) * training.steps_per_epoch(n) for n in sizes)
    return times * float((steps / len(sizes) / _STEPS) ** _LONGER)
