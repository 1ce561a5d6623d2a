"""Which source files a module depends on, so that an edit re-runs the steps it affects.

Snakemake follows the code of its rules and scripts, but not of a package they import.
"""

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path


_PACKAGE = Path(__file__).parent


def source_digest(*modules: str) -> str:
    """Twelve hexadecimal digits of modules and of all they import from this package.

    Args:
        *modules: Full names, such as ``iksamples.training.run``.
    """
    found: set[Path] = set()
    for module in modules:
        _collect_with_parents(module, found)
    content = hashlib.sha256()
    for path in sorted(found):
        content.update(path.name.encode() + path.read_bytes())
    return content.hexdigest()[:12]


def _collect_with_parents(module: str, found: set[Path]) -> None:
    parts = module.split(".")
    for depth in range(2, len(parts) + 1):
        _collect(".".join(parts[:depth]), found)


def _collect(module: str, found: set[Path]) -> None:
    path = _path(module)
    if path is None or path in found:
        return
    found.add(path)
    if path.name == "__init__.py":
        # Importing a package runs its __init__ alone, but what it ships as data counts too.
        found.update(
            p
            for p in path.parent.rglob("*.*")
            if p.suffix != ".py" and p.is_file() and p.parent.name != "__pycache__"
        )
    for name in _imports(path):
        if name.startswith(f"{__package__}.") and name != f"{__package__}.sources":
            _collect_with_parents(name, found)


@cache
def _path(module: str) -> Path | None:
    """The file of a module of this package, or None for a name that is not a module (a class, say).

    From the name alone: asking Python where a module lies imports what is above it, and to ask
    whether a class is one imports the class's module, with Lightning and torch behind it.
    """
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    return next((p for p in (place / "__init__.py", place.with_suffix(".py")) if p.is_file()), None)


@cache
def _imports(path: Path) -> frozenset[str]:
    """Every name a file imports, at its top or inside a function."""
    names: set[str] = set()
    for node in _statements(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """All statements, however deep; the many more expressions hold none, and are passed over."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting += getattr(node, field, ())
