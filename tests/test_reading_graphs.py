"""ONNX graphs: read exactly as their operations say, or refused by name."""

import numpy as np
import pytest
from onnx import TensorProto, helper, load, numpy_helper, save
from onnx.reference import ReferenceEvaluator

from iksamples.certify.readers.layers import Scaling
from iksamples.certify.readers.network import load_network
from iksamples.errors import IksamplesError


def numbers(rng, kind=np.float64):
    """Constants of a 3-8-8-3 network, and some to scale with."""
    shapes = {
        "w1": (3, 8), "b1": (8,), "w2": (8, 8), "b2": (8,), "w3": (8, 3), "b3": (3,),
        "w1t": (8, 3), "wide": (3, 5), "narrow": (5, 8), "row": (1, 8), "column": (8, 1),
        "column3": (3, 1), "offset": (3,), "scale": (3,), "one": (), "eight": (8,),
    }  # fmt: skip
    made = {name: np.asarray(rng.normal(size=shape) * 0.5, kind) for name, shape in shapes.items()}
    made["scale"] = np.asarray(rng.uniform(0.5, 2.0, 3), kind)
    return made


def model(nodes, constants, *, kind=TensorProto.DOUBLE, shape=(None, 3), outputs=("y",), opset=17):
    info = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes, "ik",
        [info("x", kind, shape)],
        [info(name, kind, None) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )  # fmt: skip
    imports = [helper.make_opsetid("", opset), helper.make_opsetid("ai.onnx.ml", 3)]
    return helper.make_model(graph, opset_imports=imports, ir_version=9)


def chain(*steps):
    """Nodes one after another; a step is an operation and its other inputs, '_' the value."""
    nodes, value = [], "x"
    for k, (op, *rest) in enumerate(steps):
        attributes = rest.pop() if rest and isinstance(rest[-1], dict) else {}
        inputs = [value if name == "_" else name for name in rest] or [value]
        domain = "ai.onnx.ml" if op == "Scaler" else ""
        after = "y" if k == len(steps) - 1 else f"v{k}"
        nodes.append(helper.make_node(op, inputs, [after], domain=domain, **attributes))
        value = after
    return nodes


DENSE = [("MatMul", "_", "w1"), ("Add", "_", "b1")]
END = [("MatMul", "_", "w3"), ("Add", "_", "b3")]

READ = {
    "keras": [*DENSE, ("Relu",), ("MatMul", "_", "w2"), ("Add", "b2", "_"), ("Relu",), *END],
    "gemm": [("Gemm", "_", "w1", "b1"), ("Tanh",), ("Gemm", "_", "w3", "b3")],
    "gemm with everything": [
        ("Gemm", "_", "w1t", "b1", {"transB": 1, "alpha": 0.5, "beta": -2.0}), ("Tanh",),
        ("Gemm", "_", "w3", "one", {"beta": 3.0}),
    ],
    "no biases": [("MatMul", "_", "w1"), ("Relu",), ("Gemm", "_", "w3")],
    "columns": [
        ("Transpose", "_", {"perm": [1, 0]}), ("MatMul", "w1t", "_"), ("Add", "_", "column"),
        ("Tanh",), ("Gemm", "_", "w3", "b3", {"transA": 1}),
    ],
    "Gemm with the weight first": [
        ("Gemm", "w1t", "_", "column", {"transB": 1}), ("Relu",),
        ("Gemm", "_", "w3", {"transA": 1}),
    ],
    "scaled before": [("Sub", "_", "offset"), ("Div", "_", "scale"), *DENSE, ("Relu",), *END],
    "scaled by Mul and Add": [
        ("Mul", "scale", "_"), ("Add", "offset", "_"), *DENSE, ("Relu",), *END,
    ],
    "scaled many times": [
        ("Div", "_", "scale"), ("Sub", "_", "one"), ("Mul", "_", "scale"), ("Sub", "offset", "_"),
        *DENSE, ("Tanh",), *END, ("Mul", "_", "scale"), ("Add", "_", "offset"), ("Div", "_", "one"),
    ],
    "Scaler": [
        ("Scaler", "_", {"offset": [0.5, 1.0, -2.0], "scale": [2.0]}), *DENSE, ("Relu",), *END,
    ],
    "in the middle": [
        *DENSE, ("Mul", "_", "eight"), ("Relu",), ("Sub", "_", "eight"), ("Neg",), *END,
    ],
    "two linear layers": [
        ("MatMul", "_", "wide"), ("MatMul", "_", "narrow"), ("Add", "_", "b1"), ("Relu",), *END,
    ],
    "two biases": [*DENSE, ("Add", "_", "row"), ("Relu",), *END, ("Add", "_", "b3")],
    "activations at the ends": [("Tanh",), *DENSE, ("Tanh",), *END, ("Tanh",)],
    "what changes nothing": [
        ("Identity",), ("Dropout",), ("Cast", "_", {"to": TensorProto.DOUBLE}),
        ("Flatten", "_", {"axis": 1}), *DENSE, ("Unsqueeze", "_", "axis0"), ("Relu",),
        ("Squeeze", "_", "axis0"), *END, ("Reshape", "_", "shape"),
    ],
    "no activation": [*DENSE, ("MatMul", "_", "w3")],
}  # fmt: skip


@pytest.mark.parametrize("steps", READ.values(), ids=READ)
def test_read_as_the_operations_say(rng, tmp_path, steps):
    """Against the reference evaluator of the onnx package, in float64."""
    constants = numbers(rng)
    constants |= {"axis0": np.array([0]), "shape": np.array([-1, 3])}
    whole = model(chain(*steps), constants)
    save(whole, tmp_path / "net.onnx")
    reading = load_network(tmp_path / "net.onnx", (3, 3))
    points = rng.normal(size=(20, 3)) * 3
    run = ReferenceEvaluator(whole)
    expected = [run.run(None, {"x": point[None]})[0].reshape(3) for point in points]
    np.testing.assert_allclose(reading.network.predict(points)[0], expected, rtol=0, atol=1e-12)


def random_steps(rng, constants):
    """A chain of random operations from three values to three, with one kind of activation."""
    kind = str(rng.choice(["Relu", "Tanh"]))
    steps, width = [], 3

    def fresh(shape):
        name = f"c{len(constants)}"
        constants[name] = rng.uniform(0.3, 1.2, shape) * rng.choice([-1, 1], shape)
        return name

    def mapped(after):
        gemm = {"transB": int(rng.integers(2)), "alpha": float(rng.choice([1.0, -0.5]))}
        shape = (after, width) if gemm["transB"] else (width, after)
        match rng.integers(3):
            case 0:
                return [("MatMul", "_", fresh((width, after)))]
            case 1:
                bias = fresh([(), (after,), (1, after)][rng.integers(3)])
                return [("Gemm", "_", fresh(shape), bias, gemm | {"beta": 0.25})]
            case _:
                turn = ("Transpose", "_", {"perm": [1, 0]})
                return [turn, ("MatMul", fresh((after, width)), "_"), turn]

    for _ in range(rng.integers(3, 12)):
        operand = [(), (1,), (width,), (1, width)][rng.integers(4)]
        match rng.integers(8):
            case 0 | 1:
                after = int(rng.integers(2, 6))
                steps += mapped(after)
                width = after
            case 2:
                steps.append((kind,))
            case 3:
                steps.append((str(rng.choice(["Neg", "Identity", "Dropout"])),))
            case 4:
                steps += [("Unsqueeze", "_", "axis0"), ("Squeeze", "_", "axis0")]
            case 5:
                steps.append(("Div", "_", fresh(operand)))
            case _:
                ends = ["_", fresh(operand)]
                op = str(rng.choice(["Add", "Sub", "Mul"]))
                steps.append((op, *(ends if rng.integers(2) else ends[::-1])))
    return [*steps, *mapped(3)]


@pytest.mark.parametrize("case", range(40))
def test_any_chain_of_operations(rng, tmp_path, case):
    constants = {"axis0": np.array([0])}
    whole = model(chain(*random_steps(rng, constants)), constants)
    save(whole, tmp_path / "net.onnx")
    found = load_network(tmp_path / "net.onnx", (3, 3)).network
    points, run = rng.normal(size=(5, 3)), ReferenceEvaluator(whole)
    expected = np.concatenate([run.run(None, {"x": point[None]})[0] for point in points])
    size = np.abs(expected).max() + 1
    np.testing.assert_allclose(found.predict(points)[0], expected, rtol=0, atol=1e-11 * size)


def test_float32_constants_are_folded_without_rounding(rng, tmp_path):
    """Products of two float32 numbers fit a float64; nothing else is multiplied here."""
    constants = numbers(rng, np.float32)
    steps = [*DENSE, ("Relu",), ("MatMul", "_", "w3"), ("Mul", "_", "scale")]
    save(model(chain(*steps), constants, kind=TensorProto.FLOAT), tmp_path / "net.onnx")
    reading = load_network(tmp_path / "net.onnx", (3, 3))
    assert reading.exact
    assert reading.folded
    product = constants["w3"].astype(float) * constants["scale"].astype(float)
    np.testing.assert_array_equal(reading.network.weights[1][0], product)
    rounded = [*steps, ("Div", "_", "scale")]
    save(model(chain(*rounded), constants, kind=TensorProto.FLOAT), tmp_path / "net.onnx")
    again = load_network(tmp_path / "net.onnx", (3, 3))
    assert again.exact  # multiplied and divided by the same: back where it was
    np.testing.assert_array_equal(again.network.weights[1][0], constants["w3"])
    thirds = [*steps, ("Div", "_", "offset")]
    save(model(chain(*thirds), constants, kind=TensorProto.FLOAT), tmp_path / "net.onnx")
    assert not load_network(tmp_path / "net.onnx", (3, 3)).exact


def test_a_scaling_of_the_inputs_stays_what_it_is(rng, tmp_path):
    constants = numbers(rng, np.float32)
    steps = [("Sub", "_", "offset"), ("Div", "_", "scale"), *DENSE, ("Relu",), *END]
    save(model(chain(*steps), constants, kind=TensorProto.FLOAT), tmp_path / "net.onnx")
    reading = load_network(tmp_path / "net.onnx", (3, 3))
    assert reading.exact
    assert not reading.folded
    np.testing.assert_array_equal(reading.network.offset, constants["offset"])
    np.testing.assert_array_equal(reading.network.scale, constants["scale"])
    more = [("Mul", "_", "scale"), *steps]
    save(model(chain(*more), constants, kind=TensorProto.FLOAT), tmp_path / "more.onnx")
    assert load_network(tmp_path / "more.onnx", (3, 3)).folded
    fed = Scaling(np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0, 30.0]))
    twice = load_network(tmp_path / "net.onnx", (3, 3), fed=fed)
    assert twice.folded
    both = twice.network
    points = rng.normal(size=(5, 3)) * 10
    np.testing.assert_allclose(
        both.predict(points),
        reading.network.predict((points - fed.offset) / fed.scale),
        atol=1e-12,
    )


REFUSED = {
    "another activation": ([*DENSE, ("Sigmoid",), *END], "Sigmoid"),
    "leaky": ([*DENSE, ("LeakyRelu", "_", {"alpha": 0.1}), *END], "LeakyRelu"),
    "both activations": ([*DENSE, ("Relu",), ("MatMul", "_", "w2"), ("Tanh",), *END], "one kind"),
    "rounded to integers": (
        [*DENSE, ("Relu",), *END, ("Cast", "_", {"to": TensorProto.INT32}),
         ("Cast", "_", {"to": TensorProto.DOUBLE})],
        "INT32",
    ),
    "rounded to half": ([*DENSE, ("Cast", "_", {"to": TensorProto.FLOAT16})], "FLOAT16"),
    "rounded outright": ([*DENSE, ("Relu",), *END, ("Round",)], "Round"),
    "clipped": ([*DENSE, ("Clip",), *END], "Clip"),
    "in training": ([*DENSE, ("Dropout", "_", "one", "yes"), *END], "training"),
    "a product with itself": ([*DENSE, ("Mul", "_", "_"), *END], "depend on the input"),
    "divides by the input": ([("Div", "one", "_"), *DENSE, ("Relu",), *END], "divides by a value"),
    "divides by zero": ([("Div", "_", "zero"), *DENSE, ("Relu",), *END], "zero"),
    "shapes that do not fit": ([("MatMul", "_", "w3")], "MatMul"),
    "an offset of the wrong length": ([("Sub", "_", "eight"), *DENSE], "Sub"),
    "a constant that is not finite": ([("MatMul", "_", "nan"), ("Relu",), *END], "not finite"),
    "eight outputs": ([*DENSE, ("Relu",)], "answers 8"),
    "something unknown": ([("MatMul", "_", "nowhere")], "nowhere"),
    "an attribute that is not known": (
        [("Gemm", "_", "w1", "b1", {"broadcast": 1}), ("Relu",), *END], "broadcast",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("steps", "match"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_understood_is_refused_by_name(rng, tmp_path, steps, match):
    constants = numbers(rng) | {
        "zero": np.zeros(3), "yes": np.array(True), "nan": np.full((3, 8), np.nan),
    }  # fmt: skip
    save(model(chain(*steps), constants), tmp_path / "net.onnx")
    with pytest.raises(IksamplesError, match=match) as caught:
        load_network(tmp_path / "net.onnx", (3, 3))
    assert "\n" not in str(caught.value)


def test_branches_and_several_ends_are_refused(rng, tmp_path):
    path, constants = tmp_path / "net.onnx", numbers(rng)
    make = helper.make_node

    def refused(nodes, match, **options):
        save(model(nodes, constants, **options), path)
        with pytest.raises(IksamplesError, match=match):
            load_network(path, (3, 3))

    dense = [make("MatMul", ["x", "w1"], ["a"]), make("Relu", ["a"], ["r"])]
    refused([*dense, make("Add", ["a", "r"], ["s"]), make("MatMul", ["s", "w3"], ["y"])], "skip")
    two = [*dense, make("Tanh", ["a"], ["t"]), make("Add", ["r", "t"], ["s"])]
    refused([*two, make("MatMul", ["s", "w3"], ["y"])], "branches")
    refused([*dense, make("MatMul", ["r", "w3"], ["y"])], "2 outputs", outputs=("y", "r"))
    refused([make("Add", ["w3", "b3"], ["y"])], "does not depend")
    mask = [*dense, make("Dropout", ["r"], ["d", "m"]), make("MatMul", ["m", "w3"], ["y"])]
    refused(mask, "second output")
    refused([*dense, make("MatMul", ["r", "w3"], ["y"], domain="mine")], "mine")
    refused([*dense, make("MatMul", ["r", "w3"], ["y"])], "opset", opset=6)
    refused([*dense, make("MatMul", ["r", "w3"], ["y"])], "INT64", kind=TensorProto.INT64)
    refused([*dense, make("MatMul", ["r", "w3"], ["r"])], "twice")


def test_dead_ends_do_not_matter_and_equal_starts_add_up(rng, tmp_path):
    """A skip that passes no activation is an affine map like any other."""
    constants, make = numbers(rng), helper.make_node
    nodes = [
        make("MatMul", ["x", "w1"], ["a"]), make("Mul", ["a", "eight"], ["b"]),
        make("Add", ["a", "b"], ["s"]), make("Sigmoid", ["s"], ["unused"]),
        make("Relu", ["s"], ["r"]), make("MatMul", ["r", "w3"], ["y"]),
    ]  # fmt: skip
    whole = model(nodes, constants)
    save(whole, tmp_path / "net.onnx")
    found = load_network(tmp_path / "net.onnx", (3, 3)).network
    points = rng.normal(size=(5, 3))
    hidden = points @ constants["w1"] * (1 + constants["eight"])
    expected = np.maximum(hidden, 0) @ constants["w3"]
    np.testing.assert_allclose(found.predict(points)[0], expected, atol=1e-12)


@pytest.mark.parametrize("shape", [None, (3,), (1, 3), (None, None), ("n", 3), (1, 1, 3)])
def test_inputs_declared_in_any_way(rng, tmp_path, shape):
    constants = numbers(rng)
    save(model(chain(*DENSE, ("Relu",), *END), constants, shape=shape), tmp_path / "net.onnx")
    found = load_network(tmp_path / "net.onnx", (3, 3)).network
    point = rng.normal(size=(1, 3))
    hidden = np.maximum(point @ constants["w1"] + constants["b1"], 0)
    np.testing.assert_allclose(
        found.predict(point)[0], hidden @ constants["w3"] + constants["b3"], atol=1e-12
    )


@pytest.mark.parametrize("shape", [(500, 3), (2, 3), (1, 4), (3, 1000), (100_000,)])
def test_a_graph_for_another_number_of_values_is_refused_at_once(rng, tmp_path, shape):
    steps = [("Sub", "_", "one"), ("Div", "_", "half"), *DENSE, ("Relu",), *END]
    constants = numbers(rng) | {"half": np.array(0.7)}
    save(model(chain(*steps), constants, shape=shape), tmp_path / "net.onnx")
    with pytest.raises(IksamplesError, match="3 coordinates"):
        load_network(tmp_path / "net.onnx", (3, 3))


def test_weights_from_constants_transposes_casts_and_outside(rng, tmp_path):
    constants, make = numbers(rng, np.float32), helper.make_node
    half = constants["w1t"].astype(np.float16)
    nodes = [
        make("Constant", [], ["half"], value=numpy_helper.from_array(half)),
        make("Cast", ["half"], ["single"], to=TensorProto.FLOAT),
        make("Transpose", ["single"], ["w"]),
        make("MatMul", ["x", "w"], ["a"]),
        make("Constant", [], ["shift"], value_floats=[0.5] * 8),
        make("Add", ["a", "shift"], ["b"]),
        make("Relu", ["b"], ["r"]),
        make("MatMul", ["r", "w3"], ["c"]),
        # What PyTorch writes for x.view(x.size(0), -1).
        make("Shape", ["c"], ["sizes"]),
        make("Constant", [], ["zero"], value_int=0),
        make("Gather", ["sizes", "zero"], ["batch"], axis=0),
        make("Constant", [], ["axes"], value_ints=[0]),
        make("Unsqueeze", ["batch", "axes"], ["first"]),
        make("Constant", [], ["rest"], value_ints=[-1]),
        make("Concat", ["first", "rest"], ["shape"], axis=0),
        make("Reshape", ["c", "shape"], ["y"]),
    ]
    whole = model(nodes, constants, kind=TensorProto.FLOAT)
    save(
        whole, tmp_path / "net.onnx", save_as_external_data=True, location="net.data",
        size_threshold=0,
    )  # fmt: skip
    points = rng.normal(size=(5, 3))
    hidden = np.maximum(points @ half.astype(float).T + 0.5, 0)
    expected = hidden @ constants["w3"].astype(float)
    found = load_network(tmp_path / "net.onnx", (3, 3)).network
    np.testing.assert_allclose(found.predict(points)[0], expected, atol=1e-12)
    (tmp_path / "net.data").unlink()
    with pytest.raises(IksamplesError, match=r"net\.data"):
        load_network(tmp_path / "net.onnx", (3, 3))


@pytest.mark.parametrize("location", ["../private", "{}/private", "link", "sub/../../private"])
def test_numbers_outside_a_file_come_from_beside_it_alone(tmp_path, location):
    """Else a network of somebody's could take any file of this machine for its weights."""
    folder = tmp_path / "net"
    (folder / "sub").mkdir(parents=True)
    constants = {"w": np.eye(3, dtype=np.float32)}
    whole = model(
        [helper.make_node("MatMul", ["x", "w"], ["y"])], constants, kind=TensorProto.FLOAT
    )
    save(
        whole, folder / "net.onnx", save_as_external_data=True, location="beside", size_threshold=0
    )
    load_network(folder / "net.onnx", (3, 3))
    (folder / "beside").rename(tmp_path / "private")
    (folder / "link").symlink_to(tmp_path / "private")
    moved = load(folder / "net.onnx", load_external_data=False)
    for entry in moved.graph.initializer[0].external_data:
        if entry.key == "location":
            entry.value = location.format(tmp_path)
    (folder / "net.onnx").write_bytes(moved.SerializeToString())
    with pytest.raises(IksamplesError, match="is not a whole ONNX file"):
        load_network(folder / "net.onnx", (3, 3))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_torch_export_is_read(rng, tmp_path):
    import torch

    torch.manual_seed(3)
    net = torch.nn.Sequential(
        torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Dropout(0.2), torch.nn.Linear(8, 3)
    ).eval()
    torch.onnx.export(net, (torch.zeros(1, 3),), str(tmp_path / "net.onnx"), dynamo=False)
    found = load_network(tmp_path / "net.onnx", (3, 3)).network
    points = rng.normal(size=(5, 3))
    expected = net.double()(torch.tensor(points)).detach().numpy()
    np.testing.assert_allclose(found.predict(points)[0], expected, atol=1e-12)


CODES_THAT_MEAN_NOTHING = {
    "format of the input": lambda graph: setattr(graph.input[0].type.tensor_type, "elem_type", 29),
    "format of the weights": lambda graph: setattr(graph.initializer[0], "data_type", 29),
    "kind of an attribute": lambda graph: graph.node[1].attribute.add(name="alpha", type=0),
    "a node without outputs": lambda graph: graph.node[0].ClearField("output"),
    "a node without inputs": lambda graph: graph.node[0].ClearField("input"),
}


@pytest.mark.parametrize("code", CODES_THAT_MEAN_NOTHING)
def test_a_code_that_means_nothing_is_refused(rng, tmp_path, code):
    steps = [("Gemm", "_", "w1", "b1"), ("Tanh",), ("Gemm", "_", "w3", "b3")]
    spoilt = model(chain(*steps), numbers(rng))
    CODES_THAT_MEAN_NOTHING[code](spoilt.graph)
    (tmp_path / "net.onnx").write_bytes(spoilt.SerializeToString())
    with pytest.raises(IksamplesError):
        load_network(tmp_path / "net.onnx", (3, 3))
