"""Studies, arms and networks spoilt in the ways of their own formats."""

import io
import json
import pickle
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from conftest import WRIST
from fuzzing import PLACE, VALUES, as_json, changed, spoilt
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import save as safetensors_of
from test_arm_files import ORDINARY

from iksamples.network import StackedMLP, write_tensors
from iksamples.study import parse_study


Files = dict[str, bytes]


def named(name: str, content: st.SearchStrategy[bytes]) -> st.SearchStrategy[Files]:
    return content.map(lambda one: {name: one})


def folder_of(write: Callable[[Path], object]) -> Files:
    """What a function writes into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def one_spoilt(files: Files, ways: dict[str, st.SearchStrategy[bytes]]) -> st.SearchStrategy[Files]:
    """A folder with one of its files spoilt or missing."""
    each = [named(name, way).map(lambda one: files | one) for name, way in ways.items()]
    gone = [st.just({k: v for k, v in files.items() if k != name}) for name in files]
    return st.one_of(
        *each, st.sampled_from(gone).flatmap(lambda one: one) if gone else st.nothing()
    )


def bombs() -> list[bytes]:
    """Study files that are small and mean to be large, or never end."""
    aliases = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
    )
    merged = "a0: &a0 {x0: 1, y0: 1}\n" + "".join(
        f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}], x{i}: 1}}\n" for i in range(1, 12)
    )
    texts = [
        aliases, aliases.replace("a11:", "name:"), merged, "name: &x [*x]", "&x {name: *x}",
        "name: &x {<<: *x}", "? &x [*x]\n: 1", "name: " + "[" * 90_000, "{" * 90_000, "- " * 90_000,
        "name: " + "[" * 900 + "]" * 900, "name: " + "{a: " * 900 + "}" * 900, "a: " * 90_000,
        "name: " + "9" * 20_000, "training: {seeds: " + "9" * 20_000 + "}",
        "name: 1e" + "9" * 9_000, "name: y\ntitle: " + "x" * 20_000_000,
        "name: y\n" + "#" * 190_000, "name: y\n" + "\n" * 190_000, "name: '" + "''" * 90_000 + "'",
        "name: |\n" + " x\n" * 60_000, "%YAML 9.9\n---\nname: y", 
        "name: y\nmethods: {" + ", ".join(f"m{i}: {{kind: cubic}}" for i in range(9_000)) + "}",
        "name: y\nnetwork: {hidden: [" + "8, " * 60_000 + "]}", "\ufeff\ufeffname: y",
        "name: y\n\0", "name: y\rtraining: {seeds: 3}", "name: y\n\tseeds: 3", "name: y\nname: z",
        "name: 2020-01-01", "name: y\ntitle: 2020-01-01", "!!set {name}", "!<x> y",
        "name: !!float x", "name: !!int ''", "name: !!null x", "name: !!bool x",
        "name: !!timestamp 2020-13-45", "name: y\n...\nname: z",
    ]  # fmt: skip
    raw = [text.encode("utf-8", "surrogatepass") for text in texts]
    return [
        *raw,
        b"name: \xff\xfe",
        b"\xff\xfen",
        b"\xfe\xff\0n\0",
        b"name: \xed\xa0\x80",
        b"\x1f\x8b\x08",
    ]


def study_files() -> st.SearchStrategy[bytes]:
    paths = [Path("config/config.yaml"), *sorted(Path("config/studies").glob("*.yaml"))]
    texts = [path.read_bytes() for path in paths]
    trees = [yaml.safe_load(text) for text in texts]
    trees.append(json.loads(parse_study({"name": "paper"}).model_dump_json()))
    tree = changed(st.sampled_from(trees))
    return st.one_of(
        tree.map(as_json),
        tree.map(lambda one: yaml.safe_dump(one, allow_unicode=True).encode("utf-8", "replace")),
        spoilt(st.sampled_from(texts)),
        spoilt(st.sampled_from(texts), few=True),
        st.text().map(lambda text: text.encode("utf-8", "surrogatepass")),
        st.binary(max_size=60),
    )


XML = tuple(
    text.encode()
    for text in (
        "<link name='a'/>", "<link/>", "<joint>", "</joint>", "<joint name='j' type='revolute'/>",
        "<parent link='a'/>", "<child link='a'/>", "<child link='base'/>", "<axis/>",
        "<axis xyz='nan 0 0'/>", "<axis xyz='0 0'/>", "<origin rpy='inf 0 0'/>",
        "<origin xyz='1 2'/>", "<limit/>", "<origin/>", "<limit lower='1' upper='0'/>",
        "<limit lower='nan' upper='1'/>", "<mimic joint='j'/>", "<mimic/>",
        "<visual><geometry><mesh/></geometry></visual>",
        "<visual><geometry><box size='nan'/></geometry>", "<mesh filename='package://a/b.stl'/>",
        "<mesh filename='/dev/zero'/>", "<mesh filename='\0'/>",
        "<inertial><mass value='nan'/></inertial>", "xmlns='http://a'", "xmlns:x='y'",
        "<x:link name='a'/>", "<!DOCTYPE x [<!ENTITY a 'b'>]>", "<!DOCTYPE html>", "<![CDATA[",
        "<!--", "-->", "<?xml version='1.1'?>", "<?xml version='1.0' encoding='ascii'?>",
        "<?xml version='1.0' encoding='none'?>", "&a;", "&#0;", "type='floating'", "type='fixed'",
        "type='continuous'", "type='prismatic'", "name=''", "name='j1'", "revolute", "prismatic",
        "continuous", "fixed", "planar", "floating", "base", "tip", "<a>" * 200,
    )
)  # fmt: skip


def urdfs() -> st.SearchStrategy[bytes]:
    texts = [path.read_bytes() for path in sorted(Path("config/robots").glob("*.urdf"))]
    texts += [ORDINARY.encode(), WRIST.encode()]
    whole, small = st.sampled_from(texts), st.sampled_from(texts[-2:])
    elements = st.lists(st.sampled_from(XML), max_size=20).map(b"".join)
    return st.one_of(
        spoilt(whole, few=True),
        spoilt(small),
        spoilt(small, XML),
        spoilt(whole, XML, few=True),
        elements,
        elements.map(lambda one: b"<robot>" + one + b"</robot>"),
        small.map(lambda one: one.decode().encode("utf-16")).flatmap(
            lambda one: spoilt(st.just(one))
        ),
    )


# Networks.


def state_dict() -> dict[str, torch.Tensor]:
    torch.manual_seed(5)
    layers = torch.nn.Linear(3, 5), torch.nn.Linear(5, 4), torch.nn.Linear(4, 3)
    return torch.nn.Sequential(
        layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2]
    ).state_dict()


class Hostile:
    """What would make a file on being unpickled."""

    def __reduce__(self) -> tuple:
        return open, ("ran", "w")


def zipped(parts: Files, compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return file.getvalue()


OPCODES = tuple(
    getattr(pickle, name)
    for name in dir(pickle)
    if name.isupper() and isinstance(getattr(pickle, name), bytes)
)


def checkpoints() -> st.SearchStrategy[bytes]:
    state, wholes = state_dict(), []
    for content in (state, {"state_dict": state, "epoch": 3, "optimizer": {"lr": [0.1]}}, [state]):
        file = io.BytesIO()
        torch.save(content, file)
        wholes.append(file.getvalue())
    with zipfile.ZipFile(io.BytesIO(wholes[0])) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    main = next(name for name in parts if name.endswith("data.pkl"))
    storage = next(name for name in parts if "/data/" in name)
    hostile = [pickle.dumps(one, 2) for one in (Hostile(), {"a": Hostile()}, [Hostile()] * 3)]
    # Memory by a count, a tree without end, an object that is its own key.
    hostile += [
        b"\x80\x02" + b"\x8d" + b"\xff" * 8,
        b"\x80\x02]q\x00h\x00a.",
        b"\x80\x04" + b"(" * 99_999,
    ]
    hostile += [
        b"\x80\x02}q\x00X\x01\x00\x00\x00ah\x00s.",
        b"\x80\x02" + b"]" * 50_000 + b"a" * 49_999 + b".",
    ]
    pickles = st.one_of(
        spoilt(st.just(parts[main]), OPCODES),
        spoilt(st.just(parts[main]), few=True),
        st.sampled_from(hostile),
        spoilt(st.sampled_from(hostile), OPCODES, few=True),
    )
    inside = st.one_of(
        named(main, pickles),
        named(storage, st.binary(max_size=99)),
        named(parts and main.replace("data.pkl", "byteorder"), st.binary(max_size=8)),
    )
    other = st.sampled_from(list(parts)).map(
        lambda gone: {k: v for k, v in parts.items() if k != gone}
    )
    packing = st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
    return st.one_of(
        spoilt(st.sampled_from(wholes), few=True),
        st.builds(lambda one, how: zipped(parts | one, how), inside, packing),
        other.map(zipped),
        st.sampled_from(hostile),
    )


SHAPES = {"weight": (3, 3), "bias": (3,)}


def safetensors_files() -> st.SearchStrategy[bytes]:
    arrays = {name: value.numpy() for name, value in state_dict().items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "w"
        stack = StackedMLP(
            tuple(np.ones((2, *shape)) for shape in ((3, 4), (4, 3))),
            tuple(np.ones((2, n)) for n in (4, 3)), "tanh", np.zeros(3), np.ones(3), (0, 1),
        )  # fmt: skip
        stack.save(path)
        ours = path.read_bytes()
        over = {f"layers.0.{k}": np.ones((4, 2, *n)) for k, n in SHAPES.items()}
        more = {"epochs": np.arange(4), "offset": np.zeros(3), "scale": np.ones(3)}
        write_tensors(path, over | more, {"activation": "tanh", "seeds": [0, 1]})
        snapshots = path.read_bytes()
    wholes = [safetensors_of(arrays), safetensors_of(arrays, {"format": "pt"}), ours, snapshots]

    made = []
    for whole in wholes:
        n = int.from_bytes(whole[:8], "little")
        header, data = json.loads(whole[8 : 8 + n]), whole[8 + n :]
        values = (
            *VALUES,
            "F64",
            "F32",
            "BF16",
            "I64",
            "BOOL",
            "F8_E5M2",
            [0, 8],
            [8, 0],
            [3, 0],
            [2**40],
        )
        if "__metadata__" in header and "iksamples" in header["__metadata__"]:
            inner = json.loads(header["__metadata__"]["iksamples"])
            made.append(
                changed(st.just(inner)).map(
                    lambda one, header=header, data=data: _with_header(
                        header | {"__metadata__": {"iksamples": json.dumps(one)}}, data
                    )
                )
            )
        tree = changed(st.just(header), values)
        made.append(tree.map(lambda one, data=data: _with_header(one, data)))
    return st.one_of(*made, spoilt(st.sampled_from(wholes), few=True))


def _with_header(header: Any, data: bytes) -> bytes:
    text = as_json(header)
    return len(text).to_bytes(8, "little") + text + data


def onnx_models() -> st.SearchStrategy[Files]:
    rng = np.random.default_rng(0)
    shapes = {
        "w1": (3, 8),
        "b1": (8,),
        "w2": (8, 3),
        "b2": (3,),
        "one": (),
        "row": (1, 3),
        "col": (3, 1),
    }
    constants = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    constants |= {
        "ints": np.array([1, 3]),
        "axes": np.array([0]),
        "none": np.zeros((0, 3), np.float32),
    }
    operations = (
        "Add", "Cast", "Concat", "Constant", "Div", "Dropout", "Flatten", "Gather", "Gemm",
        "Identity", "MatMul", "Mul", "Neg", "Relu", "Reshape", "Scaler", "Shape", "Squeeze", "Sub",
        "Tanh", "Transpose", "Unsqueeze", "Sigmoid", "If", "Loop", "",
    )  # fmt: skip
    names = [*constants, "x", "x", "x", "y", "", "nowhere"]
    attributes: dict[str, list[Any]] = {
        "axis": [0, 1, -1, 9, -(2**40), 2**40, 0.5, "x"], "perm": [[1, 0], [0], [0, 0], [2**40, 1],
        [-1, 0]], "to": [1, 11, 7, 0, 99, -1, 2**40], "alpha": [0.0, 1e38, float("nan"),
        float("inf"), 3], "beta": [0.0, 1e38, 1], "transA": [1, 0, 2**40], "transB": [1, 2],
        "axes": [[0], [0, 0], [9], [-1]], "value_float": [1.0, float("nan")], "value_ints": [[1],
        [2**62] * 9], "value_floats": [[1.0] * 3], "value": [numpy_helper.from_array(np.ones(3))],
        "scale": [[1.0], [float("nan")] * 3, [0.0]], "offset": [[1.0], [1.0] * 4], "allowzero": [1,
        0], "start": [0, -9, 2**40], "end": [0, 1, -1], "value_string": ["x"], "ratio": [0.5],
        "keepdims": [1],
    }  # fmt: skip
    pair = st.sampled_from([(k, v) for k, options in attributes.items() for v in options])
    node = st.tuples(
        st.sampled_from(operations),
        st.lists(st.sampled_from(names), max_size=3),
        st.lists(pair, max_size=2).map(dict),
        PLACE,
    )
    plain = [
        ("MatMul", ["x", "w1"], {}, 1), ("Add", ["v0", "b1"], {}, 1), ("Relu", ["v1"], {}, 1),
        ("Gemm", ["v2", "w2", "b2"], {}, 1),
    ]  # fmt: skip
    shape = st.sampled_from(
        [(None, 3), (1, 3), (3,), (), (2, 3), (0, 3), (None, None), (2**40, 3), None]
    )

    def model(nodes: list, at: list[int], shape: Any, dims: int, outside: str) -> bytes:
        steps = [*plain]
        for place, one in zip(at, nodes, strict=True):
            steps.insert(place % (len(steps) + 1), one)
        made, value = [], "x"
        for k, (op, inputs, said, place) in enumerate(steps):
            # An operation takes what the one before gave, but now and then as it is written.
            inputs = [
                value if name.startswith(("v", "x")) and place % 9 else name for name in inputs
            ]
            output = "y" if k == len(steps) - 1 else f"v{k}"
            made.append(helper.make_node(op, inputs, [output], **said))
            value = output
        info = helper.make_tensor_value_info
        tensors = [numpy_helper.from_array(v, k) for k, v in constants.items()]
        if dims % 4 == 1:
            del tensors[dims % 5].dims[:]
            tensors[dims % 5].dims.extend([(2**40, -1, 0, 7)[dims % 3], 3])
        if dims % 4 == 2:
            tensors[dims % 5].raw_data = b"x" * (dims % 50)
        if dims % 8 == 3:
            tensors[0].data_type = dims % 30
        if outside:
            tensors[0].ClearField("raw_data")
            tensors[0].data_location = TensorProto.EXTERNAL
            for key, value in (("location", outside), ("offset", str(dims - 9)), ("length", "x")):
                tensors[0].external_data.add(key=key, value=value)
        graph = helper.make_graph(
            made,
            "g",
            [info("x", TensorProto.FLOAT, shape)],
            [info("y", TensorProto.FLOAT, None)],
            tensors,
        )
        opset = helper.make_opsetid("", (17, 17, 17, 7, 6, 999)[dims % 6])
        return helper.make_model(graph, opset_imports=[opset], ir_version=9).SerializeToString()

    nodes = st.lists(node, max_size=3)
    outside = st.sampled_from(
        ["", "", "", "", "", "w", "../w", "/dev/zero", "/etc/passwd", ".", "\0"]
    )
    made = nodes.flatmap(
        lambda some: st.builds(
            model, st.just(some), st.lists(PLACE, min_size=len(some), max_size=len(some)),
            shape, PLACE, outside,
        )
    )  # fmt: skip
    whole = model([], [], (None, 3), 0, "")
    return named("net.onnx", st.one_of(made, made, spoilt(st.just(whole), few=True)))
