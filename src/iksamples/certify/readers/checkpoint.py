"""Tensors of PyTorch and safetensors files as a network, without torch and without running code.

A PyTorch file (since 1.6) is a zip archive of a pickle, ``data.pkl``, and the raw numbers of every
storage, ``data/<key>``. The pickle is read by an unpickler that knows only dictionaries, tensors
and their storages. Any other class or function in it is replaced by something that keeps its name
and does nothing: nothing is imported or called for it, so a Lightning checkpoint with its
hyperparameters and optimiser can be read, and a file that wants to run code cannot.

What a state dict holds is a network once its layers have an order: the only one in which they fit
together, or the one that is given.
"""

import io
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.readers.layers import FileNetwork, unscaled
from iksamples.errors import IksamplesError, in_a_line


MOST_BYTES = 256 * 2**20
"""Larger files are refused unread: nothing in them is a network that can be certified."""

_STORAGES = {
    "FloatStorage": "F32",
    "DoubleStorage": "F64",
    "HalfStorage": "F16",
    "BFloat16Storage": "BF16",
}
_FORMATS = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2"}


@dataclass(frozen=True)
class Tensor:
    """A tensor of a file; its numbers are read when asked for.

    Attributes:
        kind: ``F64``, ``F32``, ``F16``, ``BF16``, or what else the file calls it.
        shape: Its shape.
        source: Gives the raw numbers.
        first: Position of its first number among them.
        strides: Distance of neighbours along each axis, in numbers; None: row by row.
    """

    kind: str
    shape: tuple[int, ...]
    source: Any
    first: int = 0
    strides: tuple[int, ...] | None = None

    def array(self) -> NDArray:
        """The numbers: float64 where the file has them, else float32, which is exact.

        Raises:
            IksamplesError: They are not real numbers, or not all there.
        """
        if self.kind not in _FORMATS:
            raise IksamplesError(f"is stored as {self.kind}, not as real floating-point numbers")
        raw, kind = self.source(), np.dtype(_FORMATS[self.kind])
        numbers = np.frombuffer(raw, kind, len(raw) // kind.itemsize)
        if self.kind == "BF16":
            numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
        strides = self.strides or tuple(
            int(np.prod(self.shape[k + 1 :], dtype=int)) for k in range(len(self.shape))
        )
        count = int(np.prod(self.shape, dtype=int))
        last = self.first + sum((n - 1) * s for n, s in zip(self.shape, strides, strict=True))
        sound = min(self.shape, default=0) >= 0 and min(strides, default=0) >= 0 <= self.first
        if not sound or (count and last >= len(numbers)) or count > MOST_BYTES // 8:
            raise IksamplesError("has fewer numbers than its shape needs: a damaged file")
        if self.kind == "F16":
            numbers = numbers.astype(np.float32)
        view = np.lib.stride_tricks.as_strided(
            numbers[self.first :], self.shape, [s * numbers.itemsize for s in strides]
        )
        return np.array(view)


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file.

    Raises:
        IksamplesError: It is not one.
    """
    from safetensors import SafetensorError, deserialize

    try:
        entries = deserialize(path.read_bytes())
    except SafetensorError as error:
        raise IksamplesError(f"is not a whole safetensors file ({error})") from None
    return {
        name: Tensor(entry["dtype"], tuple(entry["shape"]), lambda data=entry["data"]: data)
        for name, entry in entries
    }


def read_checkpoint(path: Path) -> Any:
    """What was saved with ``torch.save``: dictionaries, lists, numbers and ``Tensor``.

    Raises:
        IksamplesError: It is no such file.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(path.read_bytes()))
        folder = _folder(archive)
        return _Unpickler(archive, folder).load()
    except IksamplesError:
        raise
    # Whatever a damaged or hostile archive or stream of opcodes raises.
    except Exception as error:
        raise IksamplesError(f"is damaged, or not of torch.save ({in_a_line(error)})") from None


def _folder(archive: zipfile.ZipFile) -> str:
    """The folder of an archive that ``torch.save`` wrote."""
    names = archive.namelist()
    pickles = [name for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
    if any("/code/" in f"/{name}" for name in names):
        raise IksamplesError("is a TorchScript program; save model.state_dict(), or export ONNX")
    if len(pickles) != 1:
        raise IksamplesError("is a zip archive, but not one of torch.save")
    if sum(item.file_size for item in archive.infolist()) > MOST_BYTES:
        raise IksamplesError(_too_large())
    folder = pickles[0].removesuffix("data.pkl")
    if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
        raise IksamplesError("was saved on a big-endian machine; save it again on another")
    return folder


def state_dicts(content: Any, key: str = "", depth: int = 4) -> Iterator[tuple[str, Mapping]]:
    """Every dictionary of named tensors in a checkpoint, with the keys that lead to it."""
    if not isinstance(content, Mapping) or not content or not depth:
        return
    names = all(isinstance(name, str) for name in content)
    if names and any(isinstance(value, Tensor) for value in content.values()):
        yield key, content
        return
    for name, value in content.items():
        yield from state_dicts(value, f"{key}.{name}" if key else str(name), depth - 1)


def require_size(path: Path) -> None:
    """Stops at a file that is too large, before it is read."""
    if path.stat().st_size > MOST_BYTES:
        raise IksamplesError(_too_large())


def _too_large() -> str:
    return f"is larger than {MOST_BYTES // 2**20} MiB; save the network alone"


class Unknown:
    """Stands for an object of a class that is not known, without making one."""

    def __new__(cls, *args: Any, **kwargs: Any) -> "Unknown":
        """Takes anything."""
        return object.__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Takes anything."""

    def __setstate__(self, state: Any) -> None:
        """Keeps nothing."""

    def __setitem__(self, key: Any, value: Any) -> None:
        """Keeps nothing."""

    def append(self, value: Any) -> None:
        """Keeps nothing."""

    def extend(self, values: Any) -> None:
        """Keeps nothing."""


@dataclass(frozen=True)
class _Kind:
    """The class of a storage."""

    name: str


class _Unpickler(pickle.Unpickler):
    """Reads ``data.pkl``; makes dictionaries and tensors, and nothing else."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self.archive, self.folder = archive, folder

    def find_class(self, module: str, name: str) -> Any:
        """What a name in the pickle stands for; nothing is imported."""
        known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch", "Size"): tuple,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): lambda data, *rest: data,
        }
        if (module, name) in known:
            return known[module, name]
        if module in ("torch", "torch.storage") and name.endswith("Storage"):
            return _Kind(_STORAGES.get(name, name))
        return type(f"{module}.{name}", (Unknown,), {})

    def persistent_load(self, saved: Any) -> Tensor:
        """A storage: its numbers, one after another."""
        _, kind, key, _, count = saved

        def read() -> bytes:
            try:
                return self.archive.read(f"{self.folder}data/{key}")
            # A record that is missing, cut, encrypted, of another compression, ...
            except Exception as error:
                raise IksamplesError(f"is damaged ({in_a_line(error)})") from None

        return Tensor(kind.name if isinstance(kind, _Kind) else str(kind), (int(count),), read)


def _tensor(
    storage: Tensor,
    first: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    requires_grad: bool = False,
    hooks: Any = None,
    metadata: Any = None,
) -> Tensor:
    """A tensor as a view of its storage; one that is lazily negated or conjugated is not read."""
    kind = f"{storage.kind} with {', '.join(metadata)}" if metadata else storage.kind
    return Tensor(
        kind, tuple(map(int, shape)), storage.source, int(first), tuple(map(int, strides))
    )


_MOST_TRIED = 10_000
"""Partial orders that are looked at before the order counts as not known."""

Layer = tuple[NDArray, NDArray]


def network_of(
    state: Mapping[str, Any],
    activation: str | None,
    order: Sequence[str] | None,
    n_inputs: int,
    n_outputs: int,
) -> FileNetwork:
    """The network of a state dict of Linear layers (weights of shape (out, in)).

    The order is the only one in which layers fit together whose names differ by numbers alone are
    in the order of these numbers; else it has to be given.

    Args:
        state: Name -> tensor, as PyTorch names them.
        activation: ``relu`` or ``tanh``, which a state dict does not say.
        order: The layers in the order of use, if given.
        n_inputs: Values that go in.
        n_outputs: Values that come out.

    Raises:
        IksamplesError: It is not such a state dict, or its order is not known.
    """
    if activation not in ("relu", "tanh"):
        raise IksamplesError(
            "is a state dict, which does not say the activation between its layers; give "
            "--activation relu or --activation tanh (other activations cannot be certified)"
        )
    layers = _linear(state, named=order is not None)
    if order is None:
        names = _order(layers, n_inputs, n_outputs)
    else:
        names = list(order)
        if sorted(names) != sorted(layers):
            raise IksamplesError(
                f"has the layers {', '.join(layers)}; --layers has to name each of them once"
            )
        if not _fit(layers, names):
            raise IksamplesError(f"has layers that do not fit in this order: {_widths(layers)}")
    return FileNetwork(
        tuple(names),
        tuple(layers[name] for name in names),
        activation,
        unscaled(len(layers[names[0]][0])),
    )


def _linear(state: Mapping[str, Any], named: bool) -> dict[str, Layer]:
    """Weights (in, out) and biases of the layers."""
    layers: dict[str, Layer] = {}
    strange = []
    for key, value in state.items():
        name, _, part = key.rpartition(".")
        weight = state.get(f"{name}.weight" if name else "weight")
        shape = weight.shape if isinstance(weight, Tensor) else ()
        wanted = {"weight": shape, "bias": shape[:1]}.get(part)
        found = value.shape if isinstance(value, Tensor) else type(value).__name__
        if len(shape) != 2 or 0 in shape or found != wanted:
            strange.append(f"{key} {found}")
    if strange or not state:
        more = ", ..." if len(strange) > 3 else ""
        raise IksamplesError(
            f"has more than Linear layers: {', '.join(strange[:3])}{more}; a state dict does not "
            "say what they do, so export the network as ONNX"
        )
    for key, value in state.items():
        name, _, part = key.rpartition(".")
        if part == "bias":
            continue
        bias = state.get(f"{name}.bias" if name else "bias")
        if bias is None and not named:
            raise IksamplesError(
                f"has a layer '{name}' without bias, which may be an embedding; if it is Linear, "
                "give the layers in their order: --layers a,b,c"
            )
        weight = _array(key, value).T
        layers[name or "weight"] = (
            weight,
            np.zeros(weight.shape[1]) if bias is None else _array(f"{name}.bias", bias),
        )
    return layers


def _array(key: str, tensor: Tensor) -> NDArray:
    try:
        return tensor.array()
    except IksamplesError as error:
        raise IksamplesError(f"cannot be read: {key} {error}") from None


def _fit(layers: Mapping[str, Layer], names: Sequence[str]) -> bool:
    return all(len(layers[a][1]) == len(layers[b][0]) for a, b in pairwise(names))


def _widths(layers: Mapping[str, Layer]) -> str:
    return ", ".join(f"{name} ({len(w)} to {len(b)})" for name, (w, b) in layers.items())


def _order(layers: Mapping[str, Layer], n_inputs: int, n_outputs: int) -> list[str]:
    """The only order that the numbers in the names and the widths of the layers allow.

    Names that differ in nothing but numbers are in the order of these numbers.

    Raises:
        IksamplesError: There is none, or more than one.
    """
    # By length first, as numbers are; int() takes no more than some digits.
    numbers = {
        name: tuple((len(one), one) for one in re.findall(r"0*(\d+)", name)) for name in layers
    }
    texts = {name: re.sub(r"\d+", "#", name) for name in layers}
    alike = sorted(layers, key=numbers.__getitem__)
    if len(set(texts.values())) == 1 and len(set(numbers.values())) == len(layers):
        if _fit(layers, alike):
            return alike
        raise IksamplesError(
            f"has layers that do not fit in the order of their names: {_widths(layers)}"
        )

    def may_follow(names: list[str], width: int) -> list[str]:
        left = [name for name in alike if name not in names]
        first = {texts[name]: numbers[name] for name in reversed(left)}
        return [n for n in left if len(layers[n][0]) == width and numbers[n] == first[texts[n]]]

    found: list[list[str]] = []
    tried = 0
    waiting: list[list[str]] = [[]]
    while waiting and len(found) < 2 and tried < _MOST_TRIED:
        tried += 1
        names = waiting.pop()
        width = len(layers[names[-1]][1]) if names else n_inputs
        if len(names) == len(layers) and width == n_outputs:
            found.append(names)
        waiting += [[*names, name] for name in may_follow(names, width)]
    if len(found) == 1 and not waiting:
        return found[0]
    if not found and not waiting:
        raise IksamplesError(
            f"has layers that lead in no order from {n_inputs} inputs to {n_outputs} outputs: "
            f"{_widths(layers)}"
        )
    raise IksamplesError(
        f"does not say the order of its layers {', '.join(layers)}; give it: --layers a,b,c"
    )
