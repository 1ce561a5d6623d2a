"""Stacks, trainings, networks from elsewhere, and searches of other dimensions."""

import numpy as np
import pytest
from certificate_cases import (
    make_chain,
    plain_answer,
    plain_tip,
    points_in,
    random_chain,
    random_network,
)

from iksamples.certify.external import _from_nodes, load_network
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.search import Leaves, _climb, certify_stack, certify_sup
from iksamples.errors import IksamplesError
from iksamples.region import Region


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_a_stack_is_certified_like_its_networks(chain, rng, activation):
    stack = random_network(rng, (3, 9, 7, 3), activation, n=5, lower=LOWER, upper=UPPER)
    together = certify_stack(stack, chain, Region.box(LOWER, UPPER), keep_leaves=True)
    for row, both in enumerate(together):
        alone = certify_sup(stack, row, chain, Region.box(LOWER, UPPER))
        assert both.complete
        assert alone.complete
        assert both.lower <= alone.upper
        assert alone.lower <= both.upper
        assert both.boxes >= len(both.leaves.lower)


@pytest.mark.parametrize(
    ("kinds", "d", "activation"),
    [("RR", 2, "relu"), ("RRRR", 4, "tanh"), ("RRRRR", 5, "relu"), ("RRRRRR", 6, "tanh")],
)
def test_two_to_six_inputs(rng, kinds, d, activation):
    chain = random_chain(rng, kinds)
    lower, upper = np.full(d, -10.0), np.full(d, 10.0)
    stack = random_network(
        rng, (d, 5, len(kinds)), activation, spread=0.4, lower=lower, upper=upper
    )
    certificate = certify_sup(stack, 0, chain, Region.box(lower, upper), rtol=0.05)
    assert certificate.complete
    points = points_in(rng, lower, upper, 3000)
    k = min(d, 3)
    miss = plain_tip(chain, plain_answer(stack, 0, points))[:, :k] - points[:, :k]
    assert np.linalg.norm(miss, axis=1).max() <= certificate.upper
    taken = certificate.argmax[None]
    error = plain_tip(chain, plain_answer(stack, 0, taken))[:, :k] - taken[:, :k]
    assert np.linalg.norm(error) == pytest.approx(certificate.lower, abs=1e-6)


def test_points_climb_but_never_leave_the_region(rng):
    """The arm stays where it is, so its error grows towards the corners."""
    chain = random_chain(rng, "RRRRRR")
    lower, upper = np.full(6, -300.0), np.full(6, 300.0)
    stack = random_network(rng, (6, 4, 6), "relu", n=2, lower=lower, upper=upper)
    stack.weights[1][:] = 0
    errors = ErrorOverBoxes(stack, chain, Region.box(lower, upper))
    points, which = rng.uniform(lower, upper, (8, 6)), np.arange(8) % 2
    values = errors.values(which, points)
    before = values.copy()
    _climb(errors, which, np.zeros(8, int), points, values)
    assert np.all((points >= lower) & (points <= upper))
    assert np.all(values >= before)
    np.testing.assert_array_equal(values, errors.values(which, points))
    # Of the convex distance to where the arm stays, only corners are local maxima.
    np.testing.assert_array_equal(np.abs(points[values.argmax(), :3]), 300.0)


def test_no_time_is_still_a_bound(chain, rng):
    stack = random_network(rng, (3, 16, 16, 3), "relu", n=3, lower=LOWER, upper=UPPER)
    points = points_in(rng, LOWER, UPPER, 2000)
    for row, cut in enumerate(
        certify_stack(stack, chain, Region.box(LOWER, UPPER), time_limit_s=0.0)
    ):
        errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, row, points)) - points, axis=1)
        assert errors.max() <= cut.upper < np.inf
        assert not cut.complete


def test_starts_that_do_not_tile_are_refused(chain, rng):
    stack = random_network(rng, (3, 4, 3), "relu", lower=LOWER, upper=UPPER)
    half = Leaves(np.zeros(1, int), np.zeros((1, 3)), np.array([[1.0, 1.0, 0.5]]), np.zeros(1))
    flat = Leaves(np.zeros(1, int), np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1))
    for start in (half, flat):
        with pytest.raises(IksamplesError, match="tile"):
            certify_sup(stack, 0, chain, Region.box(LOWER, UPPER), start=start)


def test_networks_and_arms_that_do_not_fit(chain, rng):
    with pytest.raises(IksamplesError, match="joints"):
        certify_sup(random_network(rng, (3, 4, 2), "relu"), 0, chain, Region.box(LOWER, UPPER))
    torn = random_network(rng, (3, 4, 3), "relu")
    torn = type(torn)(
        (torn.weights[0], torn.weights[1][:, :3]), torn.biases, "relu",
        torn.offset_mm, torn.scale_mm, torn.seeds,
    )  # fmt: skip
    with pytest.raises(IksamplesError, match="fit"):
        certify_sup(torn, 0, chain, Region.box(LOWER, UPPER))
    whole = random_network(rng, (3, 4, 3), "relu")
    whole.scale_mm[1] = 0.0
    with pytest.raises(IksamplesError, match="normalisation"):
        certify_sup(whole, 0, chain, Region.box(LOWER, UPPER))


def torch_model(activation):
    import torch

    torch.manual_seed(1)
    kind = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[activation]
    return torch.nn.Sequential(
        torch.nn.Linear(3, 8), kind(), torch.nn.Linear(8, 5, bias=False), kind(),
        torch.nn.Linear(5, 3),
    )  # fmt: skip


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("suffix", ["pt", "safetensors"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_networks_from_torch_answer_as_torch_does(rng, tmp_path, activation, suffix, wrapped):
    import torch
    from safetensors.torch import save_file

    model = torch_model(activation).double() if wrapped else torch_model(activation)
    state = model.state_dict()
    path = tmp_path / f"net.{suffix}"
    if suffix == "safetensors":
        save_file(state, str(path))
    else:
        torch.save({"state_dict": state} if wrapped else state, path)
    network = load_network(path, activation=activation, offset_mm=LOWER, scale_mm=UPPER - LOWER)
    points = points_in(rng, LOWER, UPPER, 50)
    expected = model.double()(torch.tensor((points - LOWER) / (UPPER - LOWER)))
    np.testing.assert_allclose(network.predict(points)[0], expected.detach(), atol=1e-12)
    raw = load_network(path, activation=activation)
    np.testing.assert_allclose(
        raw.predict(points)[0], model.double()(torch.tensor(points)).detach(), atol=1e-9
    )


def test_ten_layers_stay_in_order(tmp_path):
    """safetensors sorts names, so 10 would come before 2."""
    import torch
    from safetensors.torch import save_file

    layers = [torch.nn.Linear(k + 1, k + 2) for k in range(11)]
    modules = [m for layer in layers for m in (layer, torch.nn.ReLU())][:-1]
    model = torch.nn.Sequential(*modules)
    save_file(model.state_dict(), str(tmp_path / "deep.safetensors"))
    network = load_network(tmp_path / "deep.safetensors", activation="relu")
    assert [w.shape[1:] for w in network.weights] == [(k + 1, k + 2) for k in range(11)]


def test_our_own_file_needs_nothing_named(rng, tmp_path):
    stack = random_network(rng, (3, 4, 3), "tanh", n=2, lower=LOWER, upper=UPPER)
    stack.save(tmp_path / "weights.safetensors")
    network = load_network(tmp_path / "weights.safetensors")
    points = points_in(rng, LOWER, UPPER, 5)
    np.testing.assert_array_equal(network.predict(points), stack.predict(points))


def test_files_that_are_no_network(tmp_path):
    import torch

    def refused(name, match, **options):
        with pytest.raises(IksamplesError, match=match):
            load_network(tmp_path / name, **options)

    refused("none.pt", "no such file", activation="relu")
    (tmp_path / "net.txt").write_text("x")
    refused("net.txt", "unknown kind", activation="relu")
    for name in ("rubbish.pt", "rubbish.safetensors", "rubbish.onnx"):
        (tmp_path / name).write_bytes(b"not a file of tensors")
        refused(name, r"rubbish\.", activation="relu")
    torch.save(torch_model("relu"), tmp_path / "model.pt")  # a pickled module would run code
    refused("model.pt", "state dict", activation="relu")
    torch.save([1, 2], tmp_path / "list.pt")
    refused("list.pt", "state dict", activation="relu")
    torch.save(torch_model("relu").state_dict(), tmp_path / "net.pt")
    refused("net.pt", "which activation")
    refused("net.pt", "which activation", activation="gelu")
    refused("net.pt", "3 inputs", activation="relu", scale_mm=[1.0])
    torch.save(torch.nn.Conv1d(3, 3, 1).state_dict(), tmp_path / "conv.pt")
    refused("conv.pt", "linear layers", activation="relu")
    torch.save(torch.nn.BatchNorm1d(3).state_dict(), tmp_path / "norm.pt")
    refused("norm.pt", "linear layers", activation="relu")
    twisted = {"0.weight": torch.zeros(4, 3), "1.weight": torch.zeros(3, 5)}
    torch.save(twisted, tmp_path / "twisted.pt")
    refused("twisted.pt", "does not fit", activation="relu")


def test_an_onnx_file_answers_as_its_graph_says(rng, tmp_path):
    onnx = pytest.importorskip("onnx")
    weights = [rng.normal(size=s).astype(np.float32) for s in ((3, 4), (5, 4), (5, 3))]
    biases = [rng.normal(size=n).astype(np.float32) for n in (4, 5, 3)]
    numbers = {
        "offset": np.float32(LOWER), "scale": np.float32(UPPER - LOWER),
        "w0": weights[0], "b0": biases[0], "w1": weights[1], "b1": biases[1],
        "w2": weights[2], "b2": biases[2],
    }  # fmt: skip
    make = onnx.helper.make_node
    nodes = [
        make("Sub", ["x", "offset"], ["a"]), make("Div", ["a", "scale"], ["b"]),
        make("MatMul", ["b", "w0"], ["c"]), make("Add", ["c", "b0"], ["d"]),
        make("Tanh", ["d"], ["e"]), make("Gemm", ["e", "w1", "b1"], ["f"], transB=1),
        make("Tanh", ["f"], ["g"]), make("Gemm", ["g", "w2", "b2"], ["y"]),
    ]  # fmt: skip
    shape = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        nodes, "ik",
        [shape("x", onnx.TensorProto.FLOAT, [None, 3])],
        [shape("y", onnx.TensorProto.FLOAT, [None, 3])],
        [onnx.numpy_helper.from_array(value, name) for name, value in numbers.items()],
    )  # fmt: skip
    onnx.save(onnx.helper.make_model(graph), str(tmp_path / "net.onnx"))
    network = load_network(tmp_path / "net.onnx")
    points = points_in(rng, LOWER, UPPER, 5)
    hidden = np.tanh((points - LOWER) / (UPPER - LOWER) @ weights[0] + biases[0])
    expected = np.tanh(hidden @ weights[1].T + biases[1]) @ weights[2] + biases[2]
    np.testing.assert_allclose(network.predict(points)[0], expected, atol=1e-6)


def node(kind, *constants, before="x", after="y", attributes=None):
    numbers = [(k + 1, np.asarray(c, np.float32)) for k, c in enumerate(constants)]
    return kind, [before], numbers, after, attributes or {}


@pytest.mark.parametrize(
    ("chain_of", "match"),
    [
        ([node("Softmax")], "Softmax"),
        ([node("MatMul", np.eye(3)), node("MatMul", np.eye(3), before="y", after="z")], "between"),
        ([node("MatMul", np.eye(3)), node("Relu", before="q", after="z")], "chain"),
        ([node("MatMul", np.eye(3)), node("Relu", before="y", after="z")], "end"),
        ([node("Relu")], "Relu"),
        ([node("Sub", [1.0]), node("Sub", [1.0], before="y", after="z")], "more than one"),
        ([], "no linear layer"),
    ],
)
def test_onnx_graphs_of_another_shape_are_refused(tmp_path, chain_of, match):
    with pytest.raises(IksamplesError, match=match):
        _from_nodes(chain_of, tmp_path / "net.onnx")


def test_an_onnx_chain_is_read(tmp_path):
    network = _from_nodes(
        [
            node("Sub", [1.0, 2.0], after="a"),
            node("Div", [2.0], before="a", after="b"),
            node("MatMul", np.eye(2), before="b", after="c"),
            node("Add", [0.5, -0.5], before="c", after="d"),
            node("Relu", before="d", after="e"),
            node("Gemm", 2 * np.eye(2), [1.0, 1.0], before="e", after="f"),
        ],
        tmp_path / "net.onnx",
    )
    arm = make_chain("PP", np.eye(3)[:2], np.zeros((2, 3)), (0, 0, 0))
    point = np.array([[5.0, 4.0]])
    np.testing.assert_allclose(network.predict(point)[0], [[6.0, 2.0]])
    certificate = certify_sup(network, 0, arm, Region.box((3, 3), (6, 6)))
    # Here the answer is (x + 1, y - 2), wrong by the same everywhere.
    assert certificate.lower == pytest.approx(np.sqrt(5))
    assert certificate.upper == pytest.approx(np.sqrt(5))
