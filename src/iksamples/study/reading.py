"""Reading a study file, and what is wrong with one in words for people."""

import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from iksamples.errors import IksamplesError
from iksamples.study.evaluation import DoubleRectangle, Heart
from iksamples.study.section import Section
from iksamples.study.study import Study


def parse_study(settings: dict[str, Any], origin: str = "study") -> Study:
    """Validates settings as read from a study file.

    Args:
        settings: The file's content.
        origin: What the messages call the file.

    Raises:
        IksamplesError: One line for each thing that is wrong: the key, the value and what is
            allowed there.
    """
    try:
        return Study.model_validate(settings)
    except ValidationError as error:
        lines = [f"{origin}: {_describe(item)}" for item in error.errors()]
        raise IksamplesError("\n".join(lines)) from None


def read_study(path: str | Path) -> Study:
    """Reads a study file (YAML or JSON).

    Raises:
        IksamplesError: The file cannot be read or does not describe a study.
    """
    try:
        settings = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise IksamplesError(f"{path}: cannot read the study file ({error.strerror}).") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise IksamplesError(f"{path}: not a YAML file ({reason}).") from None
    if not isinstance(settings, dict):
        raise IksamplesError(f"{path}: expected a mapping of settings, found nothing of the kind.")
    return parse_study(settings, str(path))


_SHAPES: dict[str, type[Section]] = {"double_rectangle": DoubleRectangle, "heart": Heart}


def _describe(item: Any) -> str:
    """One validation error as a line for people."""
    # A path's shape stands in the location of an error, though the user never wrote it as a key.
    key = ".".join(str(part) for part in item["loc"] if part not in _SHAPES) or "study"
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}'; known keys here: {', '.join(_keys_at(item['loc'][:-1]))}."
    if item["type"] == "missing":
        return f"'{key}' is missing."
    message = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not item["loc"]:  # a rule between sections, which names its keys itself
        return f"{message}."
    shown = json.dumps(item["input"], default=str)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return f"'{key}' {message} (found {shown})."


def _keys_at(location: tuple[Any, ...]) -> list[str]:
    """The keys that the section at a location of the study file may have."""
    section: Any = Study
    for part in location:
        if part in _SHAPES:
            section = _SHAPES[part]
        elif part in section.model_fields:
            annotation = section.model_fields[part].annotation
            candidates = (annotation, *getattr(annotation, "__args__", ()))
            section = next((c for c in candidates if hasattr(c, "model_fields")), section)
    return list(section.model_fields)
