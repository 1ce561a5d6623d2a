"""What a message tells people to set or to type is there."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import typer

from iksamples.cli import app
from iksamples.study import Section, Study


SOURCES = Path(__file__).parents[1] / "src/iksamples"
OF_OTHERS = {"--cores", "--configfile", "--config", "--backend-store-uri"}
"""Options of Snakemake and MLflow."""
OF_GIT = {"--short", "--porcelain", "--untracked-files"}
FILES = {"parquet", "json", "csv", "md", "log", "urdf"}


def texts() -> Iterator[str]:
    """Every text of the package but docstrings; what is filled in is a gap."""
    for path in SOURCES.rglob("*.py"):
        tree = ast.parse(path.read_bytes())
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                parts = (p.value if isinstance(p, ast.Constant) else "{}" for p in node.values)
                yield "".join(map(str, parts))
            elif isinstance(node, ast.Constant) and id(node) not in docs:
                yield str(node.value)


def settings(section: type[Section], place: str = "") -> Iterator[str]:
    """Every setting with its section, but for those of methods and paths, which have names."""
    for name, field in section.model_fields.items():
        yield place + name
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, Section):
                yield from settings(kind, f"{place}{name}.")


def test_every_setting_that_a_message_names_exists() -> None:
    known = set(settings(Study))
    assert {"training.held_out.source", "readings.count", "evaluation.paths"} <= known
    sections = "|".join(name for name in Study.model_fields)
    pattern = rf"(?<![\w./])(?:{sections})(?:\.[a-z_]*[a-z])+(?![\w(/{{])"
    named = {word for text in texts() for word in re.findall(pattern, text)}
    named = {word for word in named if word.rpartition(".")[2] not in FILES}
    assert len(named) > 20
    assert named <= known


def test_every_option_that_a_message_names_exists() -> None:
    waiting, known = [typer.main.get_command(app)], {"--help"}
    while waiting:
        command = waiting.pop()
        waiting += getattr(command, "commands", {}).values()
        known |= {word for option in command.params for word in option.opts}
    named = {word for text in texts() for word in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)}
    assert len(named) > 15
    assert named <= known | OF_OTHERS | OF_GIT
