"""State dicts and checkpoints: read without torch and without running code, or refused."""

import os
import pickle
import subprocess
import sys
import zipfile
from collections import OrderedDict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from certificate_cases import points_in, random_network
from safetensors.torch import save_file

from iksamples.certify.readers.layers import Scaling
from iksamples.certify.readers.network import load_network
from iksamples.errors import IksamplesError


LOWER, UPPER = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])
LINEAR = torch.nn.Linear(3, 3)


def mlp(widths=(3, 8, 5, 3), activation=torch.nn.Tanh):
    torch.manual_seed(1)
    modules = []
    for a, b in pairwise(widths):
        modules += [torch.nn.Linear(a, b), activation()]
    return torch.nn.Sequential(*modules[:-1])


def answers(model, points):
    return model.double()(torch.tensor(points)).detach().numpy()


def read(path, needed=(3, 3), activation="tanh", **options):
    return load_network(path, needed, activation=activation, **options)


def refused(path, match, **options):
    with pytest.raises(IksamplesError, match=match) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


class Holder(torch.nn.Module):
    """Layers by name, declared in the order given."""

    def __init__(self, **layers):
        super().__init__()
        for name, layer in layers.items():
            setattr(self, name, layer)


@pytest.mark.parametrize("kind", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("suffix", ["pt", "safetensors"])
def test_every_float_format_is_read_exactly(rng, tmp_path, kind, suffix):
    model = mlp().to(kind)
    path = tmp_path / f"net.{suffix}"
    if suffix == "pt":
        torch.save(model.state_dict(), path)
    else:
        save_file(model.state_dict(), str(path))
    reading = read(path)
    assert reading.exact
    assert not reading.folded
    points = rng.normal(size=(20, 3))
    np.testing.assert_allclose(
        reading.network.predict(points)[0], answers(model, points), atol=1e-13
    )
    np.testing.assert_array_equal(
        reading.network.weights[0][0], model[0].weight.detach().double().numpy().T
    )


@pytest.mark.parametrize(
    "wrap",
    [
        lambda state: {"state_dict": state, "epoch": 3},
        lambda state: {"model": state, "optimizer": {"state": {}, "param_groups": []}},
        lambda state: {"epoch": 1, "model_state_dict": state, "loss": 0.5},
        lambda state: {"net": state},
        lambda state: {"training": {"best": {"weights": state}}},
        lambda state: {f"module.{key}": value for key, value in state.items()},
        lambda state: {"state_dict": state, "hyper_parameters": {"path": Path("x"), "f": len}},
    ],
)
def test_usual_checkpoints(rng, tmp_path, wrap):
    model = mlp()
    torch.save(wrap(model.state_dict()), tmp_path / "net.ckpt")
    points = rng.normal(size=(5, 3))
    found = read(tmp_path / "net.ckpt").network
    np.testing.assert_allclose(found.predict(points)[0], answers(model, points), atol=1e-13)


def test_a_checkpoint_of_lightning(rng, tmp_path):
    import pytorch_lightning as lightning
    from pytorch_lightning.plugins.environments import LightningEnvironment

    class Module(lightning.LightningModule):
        def __init__(self, width=8):
            super().__init__()
            self.save_hyperparameters()
            self.model = mlp((3, width, 3))

        def training_step(self, batch):
            return self.model(batch[0]).square().mean()

        def configure_optimizers(self):
            return torch.optim.Adam(self.parameters())

    module = Module()
    trainer = lightning.Trainer(
        max_epochs=0, logger=False, enable_checkpointing=False, accelerator="cpu",
        enable_progress_bar=False, enable_model_summary=False, plugins=LightningEnvironment(),
    )  # fmt: skip
    trainer.strategy.connect(module)
    trainer.save_checkpoint(tmp_path / "net.ckpt", weights_only=True)
    points = rng.normal(size=(5, 3))
    found = read(tmp_path / "net.ckpt").network
    np.testing.assert_allclose(found.predict(points)[0], answers(module.model, points), atol=1e-13)


def test_several_networks_in_a_checkpoint_are_told_apart(tmp_path):
    one, other = mlp().state_dict(), mlp((3, 4, 3)).state_dict()
    torch.save({"model": one, "ema": other}, tmp_path / "net.pt")
    refused(tmp_path / "net.pt", "model, ema; name one with --key")
    refused(tmp_path / "net.pt", "--key", key="best")
    assert read(tmp_path / "net.pt", key="ema").network.weights[0].shape == (1, 3, 4)


@pytest.mark.parametrize("suffix", ["pt", "safetensors"])
@pytest.mark.parametrize("name", ["fc", f"a{'7' * 5000}.fc"])
def test_numbers_in_names_are_numbers(tmp_path, suffix, name):
    """safetensors has no order of its own, and 10 sorts before 2 as text."""
    state = {}
    for k in range(1, 13):
        layer = torch.nn.Linear(4 if k > 1 else 3, 4 if k < 12 else 3)
        state |= {f"{name}{k}.{part}": value for part, value in layer.state_dict().items()}
    path = tmp_path / f"net.{suffix}"
    torch.save(state, path) if suffix == "pt" else save_file(state, str(path))
    reading = read(path)
    for k, weight in enumerate(reading.network.weights, start=1):
        np.testing.assert_array_equal(weight[0], state[f"{name}{k}.weight"].numpy().T)
    assert ", tanh, ".join(f"{name}{k} (4)" for k in range(1, 12)) in reading.order


def test_an_order_is_known_or_asked_for(rng, tmp_path):
    linear, path = torch.nn.Linear, tmp_path / "net.pt"

    def order(model, **options):
        torch.save(model.state_dict(), path)
        words = read(path, **options).order.split(", ")[1:-1]
        return [word.split(" ")[0] for word in words if word != "tanh"]

    backwards = Holder(out=linear(8, 3), hidden=linear(3, 8))
    assert order(backwards) == ["hidden", "out"]  # nothing else fits
    mixed = Holder(head=linear(4, 3), fc2=linear(4, 4), fc10=linear(4, 4), fc1=linear(3, 4))
    assert order(mixed) == ["fc1", "fc2", "fc10", "head"]
    blocks = torch.nn.ModuleList([torch.nn.ModuleList([linear(3, 3), linear(3, 3)])] * 1)
    assert order(blocks) == ["0.0", "0.1"]
    guess = Holder(a=linear(3, 3), b=linear(3, 3))
    torch.save(guess.state_dict(), path)
    refused(path, "--layers a,b,c")
    assert order(guess, layers=["b", "a"]) == ["b", "a"]
    for wrong in (["a"], ["a", "b", "c"], ["a", "a"], ["a", ""]):
        refused(path, "each of them once", layers=wrong)
    alike = {"l1.weight": torch.eye(3), "l1.bias": torch.ones(3)}
    alike |= {"l01.weight": torch.eye(3), "l01.bias": torch.zeros(3)}
    torch.save(alike, path)
    refused(path, "--layers")
    torch.save(Holder(a=linear(3, 4), b=linear(5, 3)).state_dict(), path)
    refused(path, "in no order")
    torch.save(torch.nn.ModuleList([linear(3, 4), linear(5, 3)]).state_dict(), path)
    refused(path, "do not fit")


def test_a_layer_without_bias_is_confirmed(rng, tmp_path):
    model = torch.nn.Sequential(
        torch.nn.Linear(3, 4, bias=False), torch.nn.Tanh(), torch.nn.Linear(4, 3)
    )
    torch.save(model.state_dict(), tmp_path / "net.pt")
    refused(tmp_path / "net.pt", "embedding")
    found = read(tmp_path / "net.pt", layers=["0", "2"]).network
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(found.predict(points)[0], answers(model, points), atol=1e-13)


def test_inputs_and_outputs_are_counted(tmp_path):
    torch.save(mlp((2, 8, 5)).state_dict(), tmp_path / "net.pt")
    refused(
        tmp_path / "net.pt",
        "takes 2 values and answers 5; the box has 3 coordinates and the arm 3 joints",
    )


@pytest.mark.parametrize(
    ("state", "match"),
    [
        (torch.nn.BatchNorm1d(3).state_dict(), "running_mean"),
        (
            torch.nn.Sequential(LINEAR, torch.nn.LayerNorm(3)).state_dict(),
            "1.weight",
        ),
        (torch.nn.Sequential(LINEAR, torch.nn.PReLU()).state_dict(), "1.weight"),
        (torch.nn.Embedding(3, 3).state_dict(), "embedding"),
        (torch.nn.Conv1d(3, 3, 1).state_dict(), "weight"),
        (torch.nn.GRU(3, 3).state_dict(), "weight_ih"),
        (
            torch.nn.utils.parametrizations.weight_norm(torch.nn.Linear(3, 3)).state_dict(),
            "original0",
        ),
        (mlp().state_dict() | {"x_mean": torch.zeros(3)}, "x_mean"),
        ({"0.weight": torch.eye(3).to_sparse(), "0.bias": torch.zeros(3)}, "sparse"),
        ({"0.weight": torch.eye(3) + 1j, "0.bias": torch.zeros(3)}, "Complex"),
        ({"0.weight": torch.eye(3).int(), "0.bias": torch.zeros(3)}, "Int"),
        ({"0.weight": torch.eye(3), "0.bias": torch.zeros(4)}, "0.bias"),
        ({"0.weight": torch.full((3, 3), np.nan), "0.bias": torch.zeros(3)}, "not finite"),
        ({}, "no state dict"),
        ([1, 2], "no state dict"),
    ],
)
def test_what_a_state_dict_cannot_say_is_refused(tmp_path, state, match):
    torch.save(state, tmp_path / "net.pt")
    refused(tmp_path / "net.pt", match)


def test_an_activation_is_named_where_the_file_does_not(tmp_path):
    torch.save(mlp().state_dict(), tmp_path / "net.pt")
    refused(tmp_path / "net.pt", "--activation", activation=None)
    refused(tmp_path / "net.pt", "--activation", activation="leaky_relu")


def test_views_of_a_storage_are_taken_apart(rng, tmp_path):
    """Transposed and strided weights, and several in one storage."""
    whole = torch.tensor(rng.normal(size=(6, 6)))
    state = {"0.weight": whole[:3, 1:4].T, "0.bias": whole[5, ::2]}
    torch.save(state, tmp_path / "net.pt")
    found = read(tmp_path / "net.pt").network
    np.testing.assert_array_equal(found.weights[0][0], whole[:3, 1:4].numpy())
    np.testing.assert_array_equal(found.biases[0][0], whole[5, ::2].numpy())


class Bomb:
    """What runs a command when an ordinary unpickler loads it."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_no_code_is_run(tmp_path):
    marker = tmp_path / "ran"
    content = {"state_dict": mlp().state_dict(), "callback": Bomb(marker)}
    torch.save(content, tmp_path / "net.ckpt")
    read(tmp_path / "net.ckpt")
    torch.save(Bomb(marker), tmp_path / "net.pt")
    refused(tmp_path / "net.pt", "no state dict")
    assert not marker.exists()
    torch.load(tmp_path / "net.pt", weights_only=False)  # it would have
    assert marker.exists()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_files_that_are_something_else(tmp_path):
    path = tmp_path / "net.pt"
    refused(path, "no such file")
    torch.save(mlp(), path)
    refused(path, "no state dict")
    torch.jit.trace(mlp(), torch.zeros(1, 3)).save(str(path))
    refused(path, "TorchScript")
    torch.save(mlp().state_dict(), path, _use_new_zipfile_serialization=False)
    refused(path, "before PyTorch 1.6")
    path.write_bytes(pickle.dumps({"a": 1}))
    refused(path, "pickle")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"1")
    refused(path, "not one of torch.save")
    for text, match in (
        (b"", "empty"),
        (b"<!DOCTYPE html><html>", "web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "git lfs pull"),
        (b"just text", "no kind|ONNX"),
        (b"\x89HDF\r\n", "Keras"),
    ):
        for name in ("net.pt", "net.onnx", "net.safetensors"):
            (tmp_path / name).write_bytes(text)
            refused(tmp_path / name, match)


def test_a_truncated_or_flipped_file_is_refused(rng, tmp_path):
    """Never read as something else, and never with a traceback."""
    torch.save(mlp().state_dict(), tmp_path / "whole.pt")
    save_file(mlp().state_dict(), str(tmp_path / "whole.safetensors"))
    for suffix in ("pt", "safetensors"):
        whole = (tmp_path / f"whole.{suffix}").read_bytes()
        path = tmp_path / f"broken.{suffix}"
        for length in rng.integers(1, len(whole) - 1, 40):
            path.write_bytes(whole[:length])
            refused(path, "broken")
        for place in rng.integers(0, len(whole), 200):
            broken = bytearray(whole)
            broken[place] ^= 1 << int(rng.integers(8))
            path.write_bytes(bytes(broken))
            with np.errstate(all="ignore"):
                try:
                    read(path)
                except IksamplesError as error:
                    assert "\n" not in str(error)  # noqa: PT017


def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "net.pt"
    with path.open("wb") as file:
        file.truncate(10 * 2**30)  # sparse
    refused(path, "larger than")


def test_our_own_file_needs_nothing_named(rng, tmp_path):
    stack = random_network(rng, (3, 4, 3), "tanh", n=2, lower=LOWER, upper=UPPER)
    path = tmp_path / "weights.safetensors"
    stack.save(path)
    points = points_in(rng, LOWER, UPPER, 5)
    found = load_network(path, (3, 3)).network
    np.testing.assert_array_equal(found.predict(points), stack.predict(points))
    refused(path, "leave out --activation")
    scaling = Scaling(np.zeros(3), np.ones(3))
    refused(path, "leave out the scaling", activation=None, fed=scaling)


def test_options_that_would_do_nothing_are_refused(tmp_path):
    onnx = pytest.importorskip("onnx")
    node = onnx.helper.make_node("MatMul", ["x", "w"], ["y"])
    info = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["x", "w"], ["a"]),
         onnx.helper.make_node("Relu", ["a"], ["r"]),
         onnx.helper.make_node("MatMul", ["r", "w"], ["y"])],
        "ik", [info("x", 1, [1, 3])], [info("y", 1, [1, 3])],
        [onnx.numpy_helper.from_array(np.eye(3, dtype=np.float32), "w")],
    )  # fmt: skip
    del node
    path = tmp_path / "net.onnx"
    onnx.save(onnx.helper.make_model(graph), str(path))
    read(path, activation="relu")
    read(path, activation=None)
    refused(path, "says relu, not tanh")
    refused(path, "leave out --layers", activation=None, layers=["w"])
    refused(path, "leave out --key", activation=None, key="model")
    save_file(mlp().state_dict(), str(tmp_path / "net.safetensors"))
    refused(tmp_path / "net.safetensors", "leave out --key", key="model")


@pytest.mark.parametrize("name", ["net.pt", "net.safetensors"])
def test_nothing_heavy_is_imported(tmp_path, name):
    state = OrderedDict(mlp().state_dict())
    path = tmp_path / name
    torch.save(state, path) if name == "net.pt" else save_file(state, path)
    words = (
        f"certify --weights {path} --activation tanh --robot config/robots/rrr70.urdf --rtol 0.1"
    )
    words += " --box 20 20 0 80 80 60 --scale-mm 60 60 60"
    heavy = "torch pandas scipy numba pytorch_lightning mlflow matplotlib rerun sklearn pyarrow"
    code = f"""import sys
from iksamples.cli import app
app({words.split()}, standalone_mode=False)
print("heavy:", set({heavy.split()}) & set(sys.modules))"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "(checked" in done.stdout
    assert "heavy: set()" in done.stdout


@pytest.mark.parametrize(
    ("hidden", "said"), [([900, 900], "815400 weights"), ([6000], "6000 neurons")]
)
def test_a_network_whose_proof_would_take_all_memory_is_refused(tmp_path, hidden, said):
    layers = torch.nn.ModuleList(torch.nn.Linear(*size) for size in pairwise([3, *hidden, 3]))
    torch.save(layers.state_dict(), tmp_path / "large.pt")
    with pytest.raises(IksamplesError, match=rf"{said}.*memory"):
        load_network(tmp_path / "large.pt", (3, 3), activation="tanh")
