"""ONNX graphs of affine maps with ReLU or tanh between them.

The graph is followed for one position (a batch of one). Every value that depends on it is kept as
an affine map of what came out of the last activation, element by element, so that any order of
scaling, products with constants and changes of shape becomes one layer, without rounding.
Whatever else lies between the input and the output is refused by its name.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from iksamples.certify.readers.checkpoint import MOST_BYTES
from iksamples.certify.readers.exact import (
    Numbers,
    Value,
    each,
    integers,
    over,
    plain,
    plus,
    product,
    read_tensor,
    real,
    shape_for_one,
    stretched,
    times,
)
from iksamples.certify.readers.layers import FileNetwork, Scaling, unscaled
from iksamples.errors import IksamplesError, in_a_line


_OLDEST = 7
"""Before this version of the operators, shapes were broadcast by rules of their own."""
_SCALINGS = ("Add", "Sub", "Mul", "Div", "Neg")


def read_onnx(path: Path, n_inputs: int) -> FileNetwork:
    """The network of an ONNX file.

    Args:
        path: The file; numbers kept outside lie beside it.
        n_inputs: Values that go in, where the file leaves that open.

    Raises:
        IksamplesError: The file cannot be read, or holds another kind of graph.
    """
    import onnx
    import onnx.inliner

    try:
        model = onnx.load(str(path), load_external_data=False)
        outside = {
            entry.value
            for tensor in model.graph.initializer
            for entry in tensor.external_data
            if entry.key == "location"
        }
        size = sum(file.stat().st_size for name in outside if (file := path.parent / name).exists())
        if size <= MOST_BYTES:
            onnx.load_external_data_for_model(model, str(path.parent))
            model = onnx.inliner.inline_local_functions(model)
    # The parser and the inliner raise their own kinds, not all exported by the package.
    except Exception as error:
        raise IksamplesError(f"is not a whole ONNX file ({in_a_line(error)})") from None
    if size > MOST_BYTES:
        raise IksamplesError("has more numbers than a network that can be certified")
    versions = {item.domain or "ai.onnx": item.version for item in model.opset_import}
    if versions.get("ai.onnx", _OLDEST) < _OLDEST:
        raise IksamplesError(f"is of ONNX opset {versions['ai.onnx']}; export {_OLDEST} or newer")
    try:
        return _Walk(model.graph, n_inputs).network()
    # Codes and fields of the file that mean nothing, such as a number format that is none.
    except (TypeError, ValueError, IndexError, KeyError, AttributeError) as error:
        raise IksamplesError(f"is not a whole ONNX file ({in_a_line(error)})") from None


class _Walk:
    """Follows a graph from its input to its output."""

    def __init__(self, graph: Any, n_inputs: int) -> None:
        self.graph, self.start = graph, 0
        self.layers: list[tuple[Numbers, Numbers]] = []
        self.names: list[str] = []
        self.activations: list[str] = []
        self.inputs: Scaling | None = None
        self.values: dict[str, Value] = {}
        self.scalings = 0  # operations on the input before the first layer
        self.used: list[str] = []  # names of the matrices since the last activation
        self.tensors = {item.name: item for item in graph.initializer}
        sources = [item for item in graph.input if item.name not in self.tensors]
        if len(sources) != 1 or len(graph.output) != 1:
            raise IksamplesError(
                f"has {len(sources)} inputs ({', '.join(i.name for i in sources)}) and "
                f"{len(graph.output)} outputs ({', '.join(o.name for o in graph.output)}); export "
                "a network with one of each"
            )
        if graph.sparse_initializer:
            raise IksamplesError("has sparse weights; export them dense")
        [source], [self.output] = sources, graph.output
        shape = shape_for_one(source.type.tensor_type, source.name, n_inputs)
        self.n_inputs = int(np.prod(shape, dtype=int))
        # Before anything is computed: exact arithmetic on hundreds of rows would not end.
        if self.n_inputs != n_inputs:
            batch = (
                ""
                if np.prod(shape[1:]) != n_inputs
                else (
                    "; export it for one input, or with their number left open (dynamic_axes or "
                    "dynamic_shapes in PyTorch)"
                )
            )
            raise IksamplesError(
                f"takes {' x '.join(map(str, shape))} values at once; the box has {n_inputs} "
                f"coordinates{batch}"
            )
        self.values[source.name] = self._fresh(shape)

    def _fresh(self, shape: tuple[int, ...]) -> Value:
        """The values that maps start from now."""
        k = int(np.prod(shape, dtype=int))
        return Value(np.zeros(shape), np.eye(k).reshape(k, *shape), self.start)

    def network(self) -> FileNetwork:
        """Follows the graph to its output."""
        for node in self._needed():
            inputs = [self._value(name) for name in node.input]
            self.values[node.output[0]] = self._apply(node, inputs)
        last = self._value(self.output.name)
        if last is None or last.coef is None:
            raise IksamplesError("has an output that does not depend on its input")
        self._emit(last)
        if len(set(self.activations)) > 1:
            raise IksamplesError("has ReLU and tanh in one network; only one kind can be certified")
        return FileNetwork(
            tuple(self.names),
            tuple(self.layers),
            self.activations[0] if self.activations else "relu",
            self.inputs or unscaled(self.n_inputs),
            self.scalings > 2,
        )

    def _needed(self) -> list[Any]:
        """The nodes that the output depends on, in the file's order, which is one of use."""
        given = [*self.tensors, *self.values]
        given += [name for node in self.graph.node for name in node.output if name]
        twice = next((name for name in given if given.count(name) > 1), None)
        if twice:
            raise IksamplesError(f"gives '{twice}' twice")
        wanted, needed = {self.output.name}, []
        for node in reversed(self.graph.node):
            if wanted.intersection(node.output):
                extra = [name for name in node.output[1:] if name in wanted]
                if extra:
                    raise IksamplesError(f"uses the second output of {node.op_type} ('{extra[0]}')")
                needed.append(node)
                wanted.update(node.input)
        return needed[::-1]

    def _value(self, name: str) -> Value | None:
        """A value by its name; None for an input that is left out."""
        if not name:
            return None
        if name not in self.values:
            if name not in self.tensors:
                raise IksamplesError(f"uses '{name}', which nothing gives")
            self.values[name] = Value(read_tensor(self.tensors[name], name))
        return self.values[name]

    def _apply(self, node: Any, inputs: list[Value | None]) -> Value:
        """What a node makes of its inputs."""
        from onnx.helper import get_attribute_value

        label = f"{node.op_type} '{node.name or node.output[0]}'"
        if node.domain not in ("", "ai.onnx") and node.op_type != "Scaler":
            raise IksamplesError(f"has an operation {node.domain}.{label} that is not known here")
        method, known = _OPERATIONS.get(node.op_type, (None, ""))
        attributes = {item.name: get_attribute_value(item) for item in node.attribute}
        if method is None or not set(attributes) <= set(known.split()):
            strange = ", ".join(sorted(set(attributes) - set(known.split()))) if method else ""
            raise IksamplesError(
                f"has an operation {label}{f' with {strange}' if strange else ''} that is not an "
                "affine map, ReLU or tanh; such a network cannot be certified"
            )
        if node.op_type in _SCALINGS and not self.layers and self.inputs is None:
            self.scalings += any(value is not None and value.coef is not None for value in inputs)
        if node.op_type in ("MatMul", "Gemm"):
            inputs = [v and self._normalised(v) for v in inputs]
            self.used += [name for name in node.input[:2] if name in self.tensors]
        try:
            return method(self, attributes, *inputs)
        except IksamplesError as error:
            raise IksamplesError(f"{label}: {error}") from None
        except (TypeError, ValueError, IndexError, KeyError, AttributeError) as error:
            # Shapes that do not fit, an input left out that is needed.
            raise IksamplesError(
                f"has an operation {label} that fails ({in_a_line(error)})"
            ) from None

    def _normalised(self, value: Value) -> Value:
        """Takes a scaling of each input by itself out of the first layer, as ``Scaling``."""
        if value.coef is None or self.layers or value.start != self.start or self.inputs:
            return value
        factors = value.coef.reshape(len(value.coef), -1)
        scale = np.diagonal(factors)
        plain = bool(np.all(scale == 1)) and not np.any(value.const != 0)
        diagonal = factors.shape[0] == factors.shape[1] == np.count_nonzero(factors)
        if plain or not diagonal or np.any(scale == 0):
            return value
        self.inputs = Scaling(
            over(times(value.const.reshape(-1), np.array(-1.0)), scale),
            over(np.ones(len(scale)), scale),
        )
        self.start += 1
        return self._fresh(value.const.shape)

    def _emit(self, value: Value) -> None:
        """Closes a layer."""
        if value.start != self.start or value.coef is None:
            raise IksamplesError("has branches, not one chain from the input to the output")
        self.layers.append((value.coef.reshape(len(value.coef), -1), value.const.reshape(-1)))
        self.names.append("+".join(self.used) or f"layer{len(self.layers)}")
        self.used = []

    # The operations. Arguments: attributes, then the inputs.

    def activate(self, kind: str, value: Value) -> Value:
        """ReLU or tanh."""
        self._emit(value)
        self.activations.append(kind)
        self.start += 1
        return self._fresh(value.const.shape)

    def same(self, attributes: dict, value: Value, *rest: Value | None) -> Value:
        """What changes nothing when a network is used."""
        return value

    def dropout(self, attributes: dict, value: Value, *rest: Value | None) -> Value:
        """Dropout, which does nothing outside training."""
        if len(rest) > 1 and rest[1] is not None and np.any(rest[1].const):
            raise IksamplesError("is switched to training; export the network in inference mode")
        return value

    def cast(self, attributes: dict, value: Value) -> Value:
        """A change of number format that is exact, or that float32 arithmetic makes anyway."""
        from onnx import TensorProto, helper

        wide = attributes["to"] in (TensorProto.FLOAT, TensorProto.DOUBLE)
        if value.coef is not None and wide:
            return value
        if value.coef is None and value.const.dtype != object:
            kind = helper.tensor_dtype_to_np_dtype(attributes["to"])
            if wide or (value.const.dtype.kind == "i" and kind.kind == "i"):
                return Value(plain(value.const.astype(kind)))
        name = TensorProto.DataType.Name(attributes["to"])
        raise IksamplesError(f"rounds to {name}, which is not the function that is certified")

    def add(self, attributes: dict, a: Value, b: Value) -> Value:
        """a + b."""
        if a.coef is not None and b.coef is not None and a.start != b.start:
            raise IksamplesError("adds values from before and after an activation (a skip)")
        const = plus(real(a), real(b))
        coefs = [stretched(v, const.shape) for v in (a, b) if v.coef is not None]
        if not coefs:
            return Value(const)
        start = a.start if a.coef is not None else b.start
        return Value(const, plus(*coefs) if len(coefs) == 2 else coefs[0], start)

    def subtract(self, attributes: dict, a: Value, b: Value) -> Value:
        """a - b."""
        return self.add({}, a, self.negate({}, b))

    def negate(self, attributes: dict, a: Value) -> Value:
        """-a."""
        return self.multiply({}, a, Value(np.array(-1.0)))

    def multiply(self, attributes: dict, a: Value, b: Value) -> Value:
        """a b."""
        a, b = (b, a) if a.coef is None else (a, b)
        if b.coef is not None:
            raise IksamplesError("multiplies two values that depend on the input")
        const = times(real(a), real(b))
        if a.coef is None:
            return Value(const)
        return replace(a, const=const, coef=times(stretched(a, const.shape), real(b)))

    def divide(self, attributes: dict, a: Value, b: Value) -> Value:
        """a / b."""
        if b.coef is not None:
            raise IksamplesError("divides by a value that depends on the input")
        return self.multiply({}, a, Value(over(np.ones(b.const.shape), real(b))))

    def matmul(self, attributes: dict, a: Value, b: Value) -> Value:
        """a @ b, as numpy does it."""
        if a.coef is not None and b.coef is not None:
            raise IksamplesError("multiplies two values that depend on the input")
        const = product(real(a), real(b))
        if a.coef is not None:
            return replace(a, const=const, coef=each(lambda part: product(part, real(b)), a))
        if b.coef is not None:
            return replace(b, const=const, coef=each(lambda part: product(real(a), part), b))
        return Value(const)

    def gemm(self, attributes: dict, a: Value, b: Value, c: Value | None = None) -> Value:
        """alpha a' @ b' + beta c, either of them transposed where it says so."""
        a = a.reshaped(np.transpose) if attributes.get("transA") else a
        b = b.reshaped(np.transpose) if attributes.get("transB") else b
        alpha, beta = (Value(np.array(attributes.get(k, 1.0))) for k in ("alpha", "beta"))
        found = self.multiply({}, self.matmul({}, a, b), alpha)
        return found if c is None else self.add({}, found, self.multiply({}, c, beta))

    def scaler(self, attributes: dict, value: Value) -> Value:
        """(x - offset) scale, of ai.onnx.ml (scikit-learn's scalers)."""
        offset, scale = (
            Value(np.array(attributes.get(k, default), float))
            for k, default in (("offset", [0.0]), ("scale", [1.0]))
        )
        return self.multiply({}, self.subtract({}, value, offset), scale)

    def constant(self, attributes: dict) -> Value:
        """A constant of any kind."""
        [(kind, value)] = attributes.items()
        if kind == "value":
            return Value(read_tensor(value, "a constant"))
        return Value(plain(np.asarray(value)))

    def shape_of(self, attributes: dict, value: Value) -> Value:
        """The shape, for a batch of one."""
        shape = np.array(value.const.shape, np.int64)
        return Value(shape[attributes.get("start", 0) : attributes.get("end", len(shape))])

    def gather(self, attributes: dict, value: Value, index: Value) -> Value:
        """Some elements along an axis."""
        take, axis = integers(index), attributes.get("axis", 0)
        return value.reshaped(lambda x: np.asarray(np.take(x, take, axis=axis)))

    def concat(self, attributes: dict, *parts: Value) -> Value:
        """Constants joined along an axis."""
        if any(part.coef is not None for part in parts):
            raise IksamplesError("joins values that depend on the input")
        return Value(np.concatenate([part.const for part in parts], attributes["axis"]))

    def flatten(self, attributes: dict, value: Value) -> Value:
        """A matrix of what is before and after an axis."""
        axis = attributes.get("axis", 1)
        rows = int(np.prod(value.const.shape[:axis], dtype=int))
        return value.reshaped(lambda x: x.reshape(rows, -1))

    def reshape(self, attributes: dict, value: Value, shape: Value) -> Value:
        """Another shape; 0 keeps a length, -1 is what is left."""
        lengths = [int(n) for n in integers(shape)]
        if not attributes.get("allowzero"):
            lengths = [n or value.const.shape[k] for k, n in enumerate(lengths)]
        return value.reshaped(lambda x: x.reshape(lengths))

    def squeeze(self, attributes: dict, value: Value, axes: Value | None = None) -> Value:
        """Without axes of length one."""
        which = attributes.get("axes") if axes is None else integers(axes)
        return value.reshaped(lambda x: x.squeeze(None if which is None else tuple(which)))

    def unsqueeze(self, attributes: dict, value: Value, axes: Value | None = None) -> Value:
        """With more axes of length one."""
        which = attributes["axes"] if axes is None else integers(axes)
        return value.reshaped(lambda x: np.expand_dims(x, tuple(int(k) for k in which)))

    def transpose(self, attributes: dict, value: Value) -> Value:
        """Axes in another order."""
        return value.reshaped(lambda x: x.transpose(attributes.get("perm")))


_OPERATIONS: dict[str, tuple[Callable[..., Value], str]] = {
    "Add": (_Walk.add, ""),
    "Cast": (_Walk.cast, "to saturate round_mode"),
    "Concat": (_Walk.concat, "axis"),
    "Constant": (_Walk.constant, "value value_float value_floats value_int value_ints"),
    "Div": (_Walk.divide, ""),
    "Dropout": (_Walk.dropout, "ratio seed"),
    "Flatten": (_Walk.flatten, "axis"),
    "Gather": (_Walk.gather, "axis"),
    "Gemm": (_Walk.gemm, "alpha beta transA transB"),
    "Identity": (_Walk.same, ""),
    "MatMul": (_Walk.matmul, ""),
    "Mul": (_Walk.multiply, ""),
    "Neg": (_Walk.negate, ""),
    "Relu": (lambda walk, attributes, x: walk.activate("relu", x), ""),
    "Reshape": (_Walk.reshape, "allowzero"),
    "Scaler": (_Walk.scaler, "offset scale"),
    "Shape": (_Walk.shape_of, "start end"),
    "Squeeze": (_Walk.squeeze, "axes"),
    "Sub": (_Walk.subtract, ""),
    "Tanh": (lambda walk, attributes, x: walk.activate("tanh", x), ""),
    "Transpose": (_Walk.transpose, "perm"),
    "Unsqueeze": (_Walk.unsqueeze, "axes"),
}
"""Operation -> what it does, and its attributes that are known."""
