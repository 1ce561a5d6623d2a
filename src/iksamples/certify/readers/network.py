"""Reading a network to certify, whatever wrote its file, and what is proved of it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.compared import Measure
from iksamples.certify.proof import (
    checked,
    degrees_down,
    degrees_up,
    point,
    rounded_down,
    rounded_up,
)
from iksamples.certify.readers import checkpoint
from iksamples.certify.readers.checkpoint import network_of
from iksamples.certify.readers.layers import FileNetwork, Scaling
from iksamples.certify.rounding import inference_slack, stored_slack
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


_OTHER_KINDS = {
    b"version https://git-lfs": "is a Git LFS pointer, not the file; run git lfs pull",
    b"<": "is a web page or XML, not a network; download the file itself",
    b"\x89HDF": "is a Keras HDF5 file; export it as ONNX",
    b"\x80\x02\x8a\nl\xfc\x9cF": "is of torch.save before PyTorch 1.6; load and save it again",
    b"\x80": "is a bare pickle, which is not run; save model.state_dict() or export ONNX",
}
_KINDS = "give .onnx, or a state dict as .safetensors, .pt, .pth or .ckpt"

_MOST_WEIGHTS, _WIDEST = 750_000, 5000
"""A search holds rows of weights for many boxes, and a check a square of the widest layer for each
leaf: 1.4 GB in all for two hidden layers of 850 neurons, and 1 GB for one of 4096."""


@dataclass(frozen=True, eq=False)
class Reading:
    """What was read.

    Attributes:
        network: The networks; one of seed 0 unless the file is ours.
        exact: Whether they are the file's function to the last bit. Otherwise each of their
            numbers is the exact one rounded to float64.
        folded: Whether the file or the options do more than these layers do, so that running it
            rounds elsewhere, too.
        order: The layers, in the order in which they were used.
    """

    network: StackedMLP
    exact: bool
    folded: bool
    order: str


def load_network(
    path: str | Path,
    needed: tuple[int, int],
    *,
    activation: str | None = None,
    layers: Sequence[str] | None = None,
    key: str | None = None,
    fed: Scaling | None = None,
    read: Scaling | None = None,
) -> Reading:
    """Reads networks to certify; no code of the file is run.

    Args:
        path: ``.onnx``, a state dict of Linear layers (``.safetensors``, ``.pt``, ``.pth``,
            ``.ckpt``), or our own file.
        needed: Values that the network has to take, and to answer.
        activation: ``relu`` or ``tanh``; needed for a state dict, which does not say.
        layers: The layers of a state dict in the order of use, where the file does not tell it.
        key: Where in a checkpoint the state dict is, if it holds several.
        fed: What is done to a position [mm] before the network gets it.
        read: What makes joint values [rad, mm] of its answer.

    Raises:
        IksamplesError: The file cannot be read or holds anything but such a network, or an option
            does not apply to it.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise IksamplesError("not a file" if path.exists() else "no such file")
        checkpoint.require_size(path)
        with path.open("rb") as file:
            head = file.read(32)
        ours = _ours(path, head)
        if ours is not None:
            scaling = {"the scaling and units of inputs": fed, "of outputs": read}
            _refuse(
                {"--activation": activation, "--layers": layers, "--key": key} | scaling,
                "is of a study, which says itself (mm in, rad and mm out)",
            )
            _require_counts(ours.weights[0].shape[1], ours.biases[-1].shape[1], needed)
            return Reading(ours, True, False, f"{ours.n_seeds} networks of a study")
        network = _network(path, head, activation, layers, key, *needed)
        _require_counts(network.n_inputs, network.n_outputs, needed)
        network = network if fed is None else network.fed(fed)
        network = network if read is None else network.answering(read)
        stack, exact = network.stacked()
        _require_room(stack)
    except IksamplesError as error:
        raise IksamplesError(f"{path}: {error}.") from None
    return Reading(stack, exact, network.folded, network.in_words())


def _require_room(network: StackedMLP) -> None:
    n_weights = sum(layer[0].size for layer in network.weights)
    widest = max(layer.shape[-1] for layer in network.weights)
    if n_weights > _MOST_WEIGHTS or widest > _WIDEST:
        raise IksamplesError(
            f"has {n_weights} weights and up to {widest} neurons in a layer; a proof of more than "
            f"{_MOST_WEIGHTS} or {_WIDEST} takes too much memory. Train a smaller network to "
            "answer as it does"
        )


def _require_counts(n_inputs: int, n_outputs: int, needed: tuple[int, int]) -> None:
    if (n_inputs, n_outputs) != needed:
        raise IksamplesError(
            f"takes {n_inputs} values and answers {n_outputs}; the box has {needed[0]} coordinates "
            f"and the arm {needed[1]} joints"
        )


def _network(
    path: Path,
    head: bytes,
    activation: str | None,
    layers: Sequence[str] | None,
    key: str | None,
    n_inputs: int,
    n_outputs: int,
) -> FileNetwork:
    """The network of a file that is not ours."""
    if not head:
        raise IksamplesError("is empty")
    safetensors = head[8:9] == b"{"
    what = next((text for start, text in _OTHER_KINDS.items() if head.startswith(start)), None)
    if what and not safetensors:
        raise IksamplesError(what)
    if path.suffix == ".onnx":
        from iksamples.certify.readers.graph import read_onnx

        _refuse({"--layers": layers, "--key": key}, "is an ONNX graph, which says itself")
        network = read_onnx(path, n_inputs)
        if activation not in (None, network.activation) and len(network.layers) > 1:
            raise IksamplesError(f"says {network.activation}, not {activation}; leave it out")
        return network
    if head.startswith(b"PK"):
        state = _state_of(checkpoint.read_checkpoint(path), key)
    elif safetensors:
        _refuse({"--key": key}, "is one state dict")
        state = checkpoint.read_safetensors(path)
    else:
        raise IksamplesError(f"is of no kind that is read; {_KINDS}")
    return network_of(state, activation, layers, n_inputs, n_outputs)


def _state_of(content: Any, key: str | None) -> Mapping[str, Any]:
    """The state dict in a checkpoint."""
    found = dict(checkpoint.state_dicts(content))
    if not found:
        raise IksamplesError(
            f"holds no state dict ({type(content).__name__}); save model.state_dict(), or export "
            "the network as ONNX"
        )
    if key is None and len(found) == 1:
        return next(iter(found.values()))
    if key not in found:
        names = ", ".join(name or "(the file itself)" for name in found)
        raise IksamplesError(f"holds the state dicts {names}; name one with --key")
    return found[key]


def _ours(path: Path, head: bytes) -> StackedMLP | None:
    """The networks of a file that a study wrote; None if it is another's."""
    if head[8:9] != b"{":
        return None
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            if "iksamples" not in (file.metadata() or {}):
                return None
    except (OSError, SafetensorError):
        return None
    try:
        return StackedMLP.load(path)
    except IksamplesError:
        raise IksamplesError(
            "holds no trained networks of a study; give its weights.safetensors"
        ) from None


def _refuse(options: dict[str, Any], why: str) -> None:
    """Stops at an option that would do nothing."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise IksamplesError(f"{why}; leave out {', '.join(given)}")


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proved:
    """What the checker proved of one network: of its position [mm], or of its angle [deg].

    Attributes:
        what: What it is about, in words.
        unit: ``"mm"`` or ``"deg"``.
        upper: No input of the region has a larger error; infinite: nothing is proved.
        lower: The error at ``argmax`` is at least this.
        argmax: An input of the region, shape (d,).
        float32: What evaluating the layers in float32 adds at most.
        boxes: Boxes that the search bounded.
        complete: Whether the bounds met as closely as asked.
    """

    what: str
    unit: str
    upper: float
    lower: float
    argmax: Floats
    float32: float
    boxes: int
    complete: bool

    def in_words(self) -> str:
        """The bounds, rounded outward."""
        if self.upper == math.inf:
            return f"NOT PROVED, so there is no bound of the {self.what}"
        return (
            f"no {self.what} is missed by more than {rounded_up(self.upper)} {self.unit}; at "
            f"{point(self.argmax)} it is missed by {rounded_down(self.lower)} {self.unit}"
        )


def float32_in_words(proved: Iterable[Proved]) -> str:
    """What evaluating the layers in float32 adds at most, over several bounds."""
    most: dict[str, float] = {}
    for one in proved:
        most[one.unit] = max(most.get(one.unit, 0.0), one.float32)
    if math.inf in most.values():
        return "evaluating these layers in float32 may overflow"
    added = " and ".join(f"{rounded_up(value)} {unit}" for unit, value in most.items())
    return f"evaluating these layers in float32 adds at most {added}"


def prove(
    reading: Reading,
    chain: SerialChain,
    region: Region,
    target: Target,
    *,
    rtol: float = 1e-3,
    atol_deg: float = 0.0,
    time_limit_s: float = np.inf,
    max_boxes: int | None = None,
) -> dict[Measure, list[Proved]]:
    """Bounds the largest errors of every network that was read, and checks the proofs.

    Args:
        reading: The networks.
        chain: The arm.
        region: The inputs.
        target: What is asked of the tool.
        rtol: How closely the bounds are to meet, as a share;
        atol_deg: those of the angle, besides [deg].
        time_limit_s: Time for each search, per network [s].
        max_boxes: Boxes that each search bounds at most, per network.

    Returns:
        Of the position and, unless the orientation is free, of the angle: one per network.

    Raises:
        IksamplesError: Network, arm, region and target do not fit together.
    """
    limits = {"rtol": rtol, "time_limit_s": time_limit_s, "max_boxes": max_boxes}
    atol: dict[Measure, float] = {"position": 0.0}
    if target.orientation != "free":
        atol["angle"] = np.radians(atol_deg)
    return {
        measure: _proved(reading, chain, region, target, measure, limits | {"atol": near})
        for measure, near in atol.items()
    }


def _proved(
    reading: Reading,
    chain: SerialChain,
    region: Region,
    target: Target,
    measure: Measure,
    limits: dict[str, Any],
) -> list[Proved]:
    """What is proved of one measure, by network."""
    network = reading.network
    # Half a unit in the last place of each number is within what plain evaluation rounds. Distances
    # and angles between rotations are metrics, so what it does to the tool can be added.
    rounding = stored_slack(network, chain, region, target, measure)
    allowance = inference_slack(network, chain, region, target, measure)
    found = checked(network, chain, region, target, measure, **limits)
    proved = []
    for row, (one, check) in enumerate(found):
        # What the checker itself has proved holds, also where the search stated less or more.
        upper, lower, single = check.upper, check.lower, float(allowance[row])
        if not reading.exact:
            upper = math.nextafter(upper + rounding[row], math.inf)
            lower = max(math.nextafter(lower - rounding[row], -math.inf), 0.0)
        what, unit = "position", "mm"
        if measure == "angle":
            what = "rotation" if target.orientation == "fixed" else "direction of the tool's z axis"
            unit = "deg"
            upper, lower, single = degrees_up(upper), degrees_down(lower), degrees_up(single)
        proved.append(Proved(what, unit, upper, lower, one.argmax, single, one.boxes, one.complete))
    return proved
