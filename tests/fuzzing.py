"""Files spoilt in every way, and what may come of them: a result, or a refusal in words."""

import copy
import gzip
import io
import json
import re
import resource
import signal
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from hypothesis import strategies as st
from pyarrow import parquet

from iksamples.errors import IksamplesError


SECONDS = 10.0
"""Processor time that an example may take."""
MEMORY = 2 * 2**30
"""Bytes of address space that an example may take beyond what the process has."""
MOST_LINES, MOST_LETTERS = 11, 1200
"""Of a refusal. A study has a line for each thing that is wrong with it."""

PLACE = st.integers(0, 2**16)


class Endless(BaseException):
    """An example took too long; nothing that catches errors catches it."""


@contextmanager
def limits() -> Iterator[None]:
    """Ends what runs too long or takes too much memory."""

    def end(*_: object) -> None:
        raise Endless(f"over {SECONDS:g} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    own = Path("/proc/self/statm")  # not on macOS, where the limit would do nothing
    has = int(own.read_text().split()[0]) * resource.getpagesize() if own.exists() else 0
    before = signal.signal(signal.SIGPROF, end)
    try:
        if has:
            resource.setrlimit(resource.RLIMIT_AS, (has + MEMORY, hard))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def outcome(read: Callable[[], object]) -> str:
    """``read``, or ``refused`` in lines for people; anything else is an error."""
    try:
        with limits():
            read()
    except IksamplesError as error:
        lines = str(error).split("\n")
        assert len(lines) <= MOST_LINES, lines
        assert all(0 < len(one) <= MOST_LETTERS and steers_nothing(one) for one in lines), lines
        return "refused"
    return "read"


def steers_nothing(text: str) -> bool:
    """Whether no sign ends a line, controls a terminal, turns text round or is half a letter."""
    kinds = {unicodedata.category(one) for one in text}
    turns = {unicodedata.bidirectional(one) for one in text}
    return not kinds & {"Cc", "Cs", "Zl", "Zp"} and not turns & TURNS


TURNS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


# Bytes.

_WORD = re.compile(rb"[A-Za-z_][\w.:-]*")
_NUMBER = re.compile(rb"[-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?")
_QUOTED = re.compile(rb'"[^"\n]*"')
_WAYS = ("put", "number", "word", "quoted", "delete", "again", "exchange", "cut", "flip", "slice")

ODD = tuple(
    text.encode("utf-8", "surrogatepass")
    for text in (
        "nan", "NaN", ".nan", "inf", "-inf", ".inf", "Infinity", "1e400", "-1e308", "1e308",
        "1e-320", "5e-324", "0", "-0.0", "-1", "1", "2", "999999999999999999999", "9" * 400,
        "9" * 20_000, "1e9", "1,5", "0x1F", "1_000", "010", "1:30", "true", "false", "yes", "null",
        "~", "", " ", "\t", "\n", "\r", "\r\n", "\0", "\x1b[31m", "\ufeff", "\u202e", "\u2028",
        "é", "\ud800", "٣", "²", "'", '"', "{", "}", "[", "]", "<", ">", "&", "&amp;", "&x;",
        "&#0;", "*x", "&x ", "<<: ", "- ", ": ", "#", "---\n",
        "!!python/object/apply:os.system ['true']", "!!binary ", "!!set ", "2020-01-01",
        "2020-01-01T00:00:00Z", "/", "../../etc/passwd", "/dev/null", "/dev/zero", ".", "a" * 5000,
        "{x}", "%s", "$(true)", "${x}", ",", ",,", ";", "|", "=", "\\", "?", "x_mm", "q1_deg",
    )
)  # fmt: skip


def _spoilt(content: bytes, steps: Sequence[tuple[str, int, int, bytes]]) -> bytes:
    for way, first, second, odd in steps:
        if way in ("number", "word", "quoted"):
            pattern = {"number": _NUMBER, "word": _WORD, "quoted": _QUOTED}[way]
            if found := list(pattern.finditer(content)):
                here = found[first % len(found)]
                other = found[second % len(found)].group()
                odd = other if second % 3 == 0 else odd
                odd = b'"%b"' % odd if way == "quoted" and second % 3 else odd
                content = content[: here.start()] + odd + content[here.end() :]
            continue
        if way in ("delete", "again", "exchange"):
            lines = content.split(b"\n")
            i, j = first % len(lines), second % len(lines)
            if way == "delete":
                del lines[i]
            elif way == "again":
                lines.insert(j, lines[i])
            else:
                lines[i], lines[j] = lines[j], lines[i]
            content = b"\n".join(lines)
            continue
        i = first % (len(content) + 1)
        j = i + second % 40
        if way == "put":
            content = content[:i] + odd + content[i:]
        elif way == "cut":
            content = content[:i]
        elif way == "flip" and i < len(content):
            content = content[:i] + bytes([second % 256]) + content[i + 1 :]
        elif way == "slice":
            content = content[:i] + content[j:]
    return content


def spoilt(
    content: st.SearchStrategy[bytes], odd: Sequence[bytes] = (), few: bool = False
) -> st.SearchStrategy[bytes]:
    """Contents with some bytes, words, numbers or lines exchanged, put in, taken out or cut off."""
    step = st.tuples(
        st.sampled_from(_WAYS), PLACE, PLACE, st.sampled_from(odd) if odd else st.sampled_from(ODD)
    )
    steps = st.lists(step, min_size=1, max_size=2 if few else 5)
    return st.builds(_spoilt, content, steps)


# Trees of dictionaries and lists.

VALUES: tuple[Any, ...] = (
    None, True, False, "", " ", "text", "a\nb", "\0", "\x1b[31m", "\ud800", "é" * 300, "a" * 3000,
    "no", "nan", "1", "../x", "/dev/zero", "{x}", 0, -1, 1, 2, 7, 10**9, 2**31, 2**63, 2**64,
    10**30, 10**400, 0.5, -0.0, 1e-320, 1e-30, 1e30, 1e308, -1e308, float("nan"), float("inf"),
    float("-inf"), [], {}, [None], [[]], {"": None}, {"x": 1}, [1, 2], [1, 2, 3], [1e308] * 3,
    ["a", "b"],
)  # fmt: skip


def _deep(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every place of a tree: what holds it, and its key or index there."""
    found = []
    waiting = [tree]
    while waiting:
        one = waiting.pop()
        keys = list(one) if isinstance(one, dict) else range(len(one))
        found += [(one, key) for key in keys]
        waiting += [one[key] for key in keys if isinstance(one[key], dict | list)]
    return found


def _changed(tree: Any, steps: Sequence[tuple[str, int, int, Any]]) -> Any:
    tree = copy.deepcopy(tree)
    for way, first, second, value in steps:
        places = _places(tree)
        if not places:
            break
        (holder, key), (other, at) = places[first % len(places)], places[second % len(places)]
        if way == "put":
            holder[key] = copy.deepcopy(value)
        elif way == "delete":
            del holder[key]
        elif way == "copy":
            holder[key] = copy.deepcopy(other[at])
        elif way == "wrap":
            holder[key] = [holder[key]]
        elif way == "scale" and isinstance(holder[key], int | float):
            holder[key] = -holder[key] if second % 2 else holder[key] * 1e3
        elif way == "again" and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif way == "rename" and isinstance(holder, dict):
            name = value if isinstance(value, str) else str(at)
            holder[name] = holder.pop(key)
        elif way == "deep":
            holder[key] = _deep((second % 40) * 8)
    return tree


_TREE_WAYS = ("put", "put", "put", "delete", "copy", "wrap", "scale", "again", "rename", "deep")


def changed(tree: st.SearchStrategy[Any], values: Sequence[Any] = VALUES) -> st.SearchStrategy[Any]:
    """Trees with some of their values exchanged, put in, taken out, copied or nested."""
    steps = st.lists(
        st.tuples(st.sampled_from(_TREE_WAYS), PLACE, PLACE, st.sampled_from(values)),
        min_size=1,
        max_size=4,
    )
    return st.builds(_changed, tree, steps)


def as_json(tree: Any) -> bytes:
    """JSON as Python writes it, with NaN and lone surrogates."""
    return json.dumps(tree).encode()


def json_files(tree: Any) -> st.SearchStrategy[bytes]:
    """Spoilt JSON files of what was one."""
    whole = st.just(tree)
    return changed(whole).map(as_json) | spoilt(whole.map(as_json))


# Parquet files: other kinds of columns, odd cells, other names, a broken file.

KINDS_OF_COLUMN: tuple[Callable[[list], pa.Array], ...] = (
    lambda cells: pa.array([None if one is None else str(one) for one in cells]),
    lambda cells: pa.array([None] * len(cells)),
    lambda cells: pa.array([None] * len(cells), pa.float64()),
    lambda cells: pa.array([[1.0]] * len(cells)),
    lambda cells: pa.array([[i] * (i % 3) for i in range(len(cells))]),
    lambda cells: pa.array([{"x": 1}] * len(cells)),
    lambda cells: pa.array([b"\xff\0"] * len(cells)),
    lambda cells: pa.array([True] * len(cells)),
    lambda cells: pa.array([0] * len(cells), pa.timestamp("ns")),
    lambda cells: (
        pa.array([i % 9 for i in range(len(cells))], pa.float16()) if cells else pa.nulls(0)
    ),
    lambda cells: pa.array([-(2**63)] * len(cells), pa.int64()),
    lambda cells: pa.array([2**64 - 1] * len(cells), pa.uint64()),
    lambda cells: pa.array([1e308] * len(cells)),
    lambda cells: pa.array([float("nan")] * len(cells)),
    lambda cells: pa.array([float("inf")] * len(cells)),
    lambda cells: pa.array([0.0] * len(cells)),
    lambda cells: pa.array(list(range(len(cells)))),
    lambda cells: pa.array([1e-320] * len(cells)),
    lambda cells: pa.array(["x"] * len(cells)).dictionary_encode(),
    lambda cells: pa.array([pd.Timedelta(1)] * len(cells)),
    lambda cells: pa.array([9] * len(cells), pa.decimal128(30, 3)),
)
ODD_NUMBERS = (None, float("nan"), float("inf"), 1e308, -1e308, -1.0, 0.0, 1e9, 5e-324, 2.5)
_TABLE_WAYS = ("kind", "cell", "name", "drop", "twice", "rows", "again", "shuffle")


def _table_changed(table: pa.Table, steps: list[tuple[str, int, int]]) -> bytes:
    for way, first, second in steps:
        if not table.num_columns:
            break
        i = first % table.num_columns
        names, column = table.column_names, table.column(i)
        if way == "kind":
            made = KINDS_OF_COLUMN[second % len(KINDS_OF_COLUMN)](column.to_pylist())
            table = table.set_column(i, names[i], made)
        elif way == "cell" and pa.types.is_floating(column.type) and len(column):
            cells = column.to_pylist()
            cells[second % len(cells)] = ODD_NUMBERS[first % len(ODD_NUMBERS)]
            table = table.set_column(i, names[i], pa.array(cells, column.type))
        elif way == "name":
            names[i] = (*names, "", "x", "seed", "\0", "é" * 99)[second % (len(names) + 5)]
            table = table.rename_columns(names)
        elif way == "drop":
            table = table.remove_column(i)
        elif way == "twice":
            table = table.append_column(names[i], column)
        elif way == "rows":
            table = table.slice(0, second % 9)
        elif way == "again":
            table = pa.concat_tables([table, table.slice(second % (len(table) + 1))])
        elif way == "shuffle":
            order = np.random.default_rng(second).permutation(len(table))
            table = table.take(pa.array(order))
    file = io.BytesIO()
    parquet.write_table(table, file)
    return file.getvalue()


def parquets(table: pd.DataFrame | pa.Table) -> st.SearchStrategy[bytes]:
    whole = pa.Table.from_pandas(table) if isinstance(table, pd.DataFrame) else table
    steps = st.lists(st.tuples(st.sampled_from(_TABLE_WAYS), PLACE, PLACE), min_size=1, max_size=3)
    tables = [whole, whole.replace_schema_metadata(None)]
    made = st.builds(_table_changed, st.sampled_from(tables), steps)
    return st.one_of(made, made, made, spoilt(st.just(_table_changed(whole, [])), few=True))


def with_header(table: pa.Table) -> st.SearchStrategy[bytes]:
    """Spoilt Parquet files of this package, or such a file with another header."""
    header = json.loads(table.schema.metadata[b"iksamples"])

    def headed(one: bytes) -> bytes:
        return _table_changed(table.replace_schema_metadata({"iksamples": one}), [])

    return st.one_of(json_files(header).map(headed), parquets(table))


def csvs(table: pd.DataFrame) -> st.SearchStrategy[bytes]:
    texts = [
        table.round(6).head(n).to_csv(index=False, **how).encode()
        for n in (4, 12, len(table))
        for how in ({}, {"sep": ";"}, {"sep": "\t"}, {"sep": " "}, {"sep": ";", "decimal": ","})
    ]
    whole = st.sampled_from(texts)
    other = st.sampled_from(["utf-16", "utf-8-sig", "latin1"])
    return st.one_of(
        spoilt(whole, few=True),
        spoilt(whole),
        spoilt(whole.map(lambda one: gzip.compress(one, mtime=0)), few=True),
        st.builds(lambda one, name: one.decode("utf-8", "replace").encode(name, "replace"),
                  spoilt(whole, few=True), other),
        st.text().map(lambda text: text.encode("utf-8", "surrogatepass")),
        st.binary(max_size=60),
    )  # fmt: skip
