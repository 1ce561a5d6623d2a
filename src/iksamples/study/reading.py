"""Reading a study file, and what is wrong with one in words for people.

YAML 1.1, which PyYAML reads, takes ``yes`` for true, ``010`` for eight, ``1:30`` for ninety, and
the last of two equal keys. Here only ``true`` and ``false`` are booleans, only decimal numbers are
numbers (YAML 1.2, core schema, https://yaml.org/spec/1.2.2/#103-core-schema), every key is a name,
and a key that stands twice is an error. Anything else that looks odd is text, which the study
refuses where it expects a number.
"""

import json
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any, ClassVar

import yaml
from pydantic import ValidationError

from iksamples.errors import IksamplesError, in_a_line
from iksamples.files import read_bytes
from iksamples.study.evaluation import SHAPES
from iksamples.study.sections import NAMES, without_password
from iksamples.study.study import Study, overlay


MOST_BYTES = 200_000
_MOST_DIGITS = 18
_MAP, _MERGE = "tag:yaml.org,2002:map", "tag:yaml.org,2002:merge"


class _Loader(yaml.SafeLoader):
    """PyYAML's parser with these rules."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012
    yaml_constructors: ClassVar[dict[str | None, Any]] = {}

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        entries = self._entries(node, {}, ())
        return {name: self.construct_object(value, deep=deep) for name, value in entries.items()}

    def _entries(self, node: Any, done: dict[int, Any], above: tuple[int, ...]) -> dict[str, Any]:
        """Names and values of a mapping; what it says itself wins over what ``<<`` brings."""
        if not isinstance(node, yaml.MappingNode) or id(node) in above:
            raise _mistake(node, "'<<' needs another mapping")
        if id(node) not in done:
            own: dict[str, Any] = {}
            brought: dict[str, Any] = {}
            lines: dict[str, int] = {}
            for key, value in node.value:
                if key.tag == _MERGE:
                    sources = value.value if isinstance(value, yaml.SequenceNode) else [value]
                    for source in reversed(sources):
                        brought |= self._entries(source, done, (*above, id(node)))
                    continue
                if not isinstance(key, yaml.ScalarNode):
                    raise _mistake(key, "a key is a plain name")
                line = key.start_mark.line + 1
                if key.value in own:
                    first = lines[key.value]
                    where = f"on line {line}" if first == line else f"on lines {first} and {line}"
                    raise IksamplesError(f"'{_shown(key.value)}' stands twice, {where}; keep one.")
                own[key.value], lines[key.value] = value, line
            done[id(node)] = {**brought, **own}
        return done[id(node)]

    def construct_whole_number(self, node: Any) -> int:
        digits = node.value.replace("_", "")
        n = len(digits.lstrip("+-"))
        if n > _MOST_DIGITS:
            raise _mistake(node, f"a whole number of {n} digits")
        return int(digits)

    def construct_truth(self, node: Any) -> bool:
        # What the pattern below has not matched is here by its tag.
        if node.value.lower() not in ("true", "false"):
            raise _mistake(node, "a value that is said to be a boolean is true or false")
        return node.value.lower() == "true"

    def construct_undefined(self, node: Any) -> Any:
        raise _mistake(node, f"the tag {node.tag} is not read; write the plain value")


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9_]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?((0|[1-9][0-9_]*)(\.[0-9_]*)?|\.[0-9][0-9_]*)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("merge", "<<", ["<"]),
):
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first
    )
for _tag, _construct in {
    "null": yaml.SafeLoader.construct_yaml_null,
    "bool": _Loader.construct_truth,
    "int": _Loader.construct_whole_number,
    "float": yaml.SafeLoader.construct_yaml_float,
    "str": yaml.SafeLoader.construct_yaml_str,
    "seq": yaml.SafeLoader.construct_yaml_seq,
    "map": yaml.SafeLoader.construct_yaml_map,
}.items():
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _construct)
_Loader.add_constructor(None, _Loader.construct_undefined)


def read_settings(path: str | Path) -> dict[str, Any]:
    """The settings that a study file holds (YAML or JSON; UTF-8, or UTF-16 with its mark).

    Raises:
        IksamplesError: The file cannot be read, or is not one mapping of names to settings.
    """
    content = read_bytes(path, MOST_BYTES, "the study file")
    try:
        settings = yaml.load(content, _Loader)
    except IksamplesError as error:
        raise IksamplesError(f"{path}: {error}") from None
    except RecursionError:
        raise IksamplesError(f"{path}: sections inside sections without end.") from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        raise IksamplesError(f"{path}: {_in_words(error)}") from None
    if not isinstance(settings, dict):
        found = {type(None): "nothing", list: "a list"}.get(type(settings), "a value")
        raise IksamplesError(
            f"{path}: expected a mapping of settings such as 'name: my-study', found {found}."
        )
    return settings


def typed(value: Any) -> Any:
    """Settings whose scalars are still text, as Snakemake's ``--config`` gives, read as above."""
    if isinstance(value, dict):
        return {key: typed(one) for key, one in value.items()}
    if isinstance(value, list):
        return [typed(one) for one in value]
    if not isinstance(value, str):
        return value
    loader = _Loader("")
    return loader.construct_object(
        yaml.ScalarNode(loader.resolve(yaml.ScalarNode, value, (True, False)), value)
    )


def _mistake(node: Any, what: str) -> IksamplesError:
    mark = node.start_mark
    return IksamplesError(f"line {mark.line + 1}: {what}." if mark else f"{what}.")


def _in_words(error: Exception) -> str:
    """What PyYAML says, on one line and with the line of the file."""
    if isinstance(error, yaml.composer.ComposerError) and "single document" in str(error):
        assert error.problem_mark
        return f"line {error.problem_mark.line + 1} begins a second study; a file holds one."
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        problem = (error.problem or error.context or "").replace("\\t", "a tab")
        return f"not a YAML file (line {error.problem_mark.line + 1}: {problem})."
    if isinstance(error, yaml.reader.ReaderError | UnicodeDecodeError):
        return f"not a text file in UTF-8 ({in_a_line(error)})."
    return f"not a YAML file ({in_a_line(error)})."


_MOST_SETTINGS = 20_000
_MOST_LINES = 10
_DEEPEST = 20


def parse_study(settings: dict[str, Any], origin: str = "study") -> Study:
    """Validates settings as read from a study file.

    Args:
        settings: The file's content.
        origin: What the messages call the file.

    Raises:
        IksamplesError: One line for each thing that is wrong: the key, the value and what is
            allowed there.
    """
    if wrong := _not_settings(settings):
        raise IksamplesError(f"{origin}: {wrong}")
    try:
        return Study.model_validate(settings)
    except ValidationError as error:
        items = _own(error.errors())
        lines = [f"{origin}: {_describe(item)}" for item in items[:_MOST_LINES]]
        if len(items) > _MOST_LINES:
            lines.append(f"{origin}: and {len(items) - _MOST_LINES} more such faults.")
        raise IksamplesError("\n".join(lines)) from None


def read_study(*paths: str | Path, changes: dict[str, Any] | None = None) -> Study:
    """Reads a study file (YAML or JSON).

    Args:
        *paths: The file; of several, each is laid over those before it.
        changes: Settings that are laid over the files'.

    Raises:
        IksamplesError: A file cannot be read or does not describe a study.
    """
    settings: dict[str, Any] = {}
    for layer in (*map(read_settings, paths), changes or {}):
        settings = overlay(settings, layer)
    return parse_study(settings, ", ".join(map(str, paths)))


def _not_settings(settings: Any) -> str:
    """What in settings is no setting at all: a key that is no text, a date, no end."""
    n = 0
    waiting: list[tuple[tuple[Any, ...], Any]] = [((), settings)]
    while waiting:
        place, value = waiting.pop()
        n += 1
        if len(place) > _DEEPEST or n > _MOST_SETTINGS:
            return f"'{_shown(str(place[0]))}' holds more than any study; does it repeat itself?"
        if isinstance(value, dict):
            for key, one in value.items():
                if not isinstance(key, str):
                    return f"the key {key!r} under '{_dotted(place)}' is no text; quote it."
                waiting.append(((*place, key), one))
        elif isinstance(value, list | tuple):
            waiting += [((*place, i), one) for i, one in enumerate(value)]
        elif not (value is None or isinstance(value, str | int | float)):
            return f"'{_dotted(place)}' is neither text nor number ({value}); quote it."
    return ""


def _own(items: list[Any]) -> list[Any]:
    """The errors without those that a method only inherits from the study's own sections."""
    said = {(item["loc"], repr(item["input"])) for item in items}
    return [
        item
        for item in items
        if item["loc"][:1] != ("methods",) or (item["loc"][2:], repr(item["input"])) not in said
    ]


def _describe(item: Any) -> str:
    """One validation error as a line for people."""
    # A path's shape stands in the location of an error, though the user never wrote it as a key.
    location = tuple(part for part in item["loc"] if part not in SHAPES)
    kind, key = item["type"], _dotted(location)
    if location[-1:] == ("[key]",):
        where = _dotted(location[:-2])
        return f"the name '{_shown(location[-2])}' under '{where}' {_expected(item)}."
    if kind == "extra_forbidden":
        return f"unknown key '{key}'; known keys here: {', '.join(_keys_at(item['loc'][:-1]))}."
    if kind == "missing" and isinstance(location[-1], int):
        return f"'{_dotted(location[:-1])}' has too few values ({location[-1]})."
    if kind == "missing":
        return f"'{key}' is missing."
    if not location:  # a rule between sections, which names its keys itself
        return f"{_expected(item)}."
    found = "nothing" if item["input"] is None else json.dumps(item["input"], default=str)
    found = _shown(without_password(found))
    return f"'{key}' {_expected(item)} (found {found})."


def _expected(item: Any) -> str:
    """What should stand there instead."""
    match item["type"]:
        case "model_type" | "model_attributes_type":
            return f"should be a section with the keys {', '.join(_keys_at(item['loc']))}"
        case "dict_type":
            return "should be a section of names and what each is"
        case "list_type" | "tuple_type":
            return "should be a list such as [1, 2]"
        case "string_type":
            return "should be text; put it in quotes"
        case "string_pattern_mismatch" if item["ctx"]["pattern"] in NAMES:
            return f"should be {NAMES[item['ctx']['pattern']]}"
        case "string_too_long":
            return f"should have at most {item['ctx']['max_length']} characters"
    message = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return message.replace("Tuple should", "should").replace("List should", "should")


def _dotted(location: tuple[Any, ...]) -> str:
    return ".".join(_shown(str(part)) for part in location) or "study"


def _shown(text: str) -> str:
    """A text that fits a line of a message."""
    text = text if text.isprintable() else json.dumps(text)[1:-1]
    return text if len(text) <= 60 else f"{text[:57]}..."


def _keys_at(location: tuple[Any, ...]) -> list[str]:
    """The keys that the section at a location of the study file may have."""
    section: Any = Study
    for part in location:
        if part in SHAPES:
            section = SHAPES[part]
        elif part in section.model_fields:
            annotation = section.model_fields[part].annotation
            candidates = (annotation, *getattr(annotation, "__args__", ()))
            section = next((c for c in candidates if hasattr(c, "model_fields")), section)
    return list(section.model_fields)
