"""Reading a study file, and what is wrong with one in words for people."""

import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from iksamples.errors import IksamplesError
from iksamples.study.paths import SHAPES
from iksamples.study.section import NAMES, without_password
from iksamples.study.study import Study, overlay
from iksamples.study.text import read_settings


_MOST_SETTINGS = 20_000
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
        lines = [f"{origin}: {_describe(item)}" for item in _own(error.errors())]
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
