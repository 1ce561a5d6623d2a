"""Which source files a module depends on, so that an edit re-runs the steps it affects.

Snakemake follows the code of its rules and scripts, but not of a package they import.
"""

import hashlib
import re
from functools import cache
from pathlib import Path


_PACKAGE = Path(__file__).parent
_OWN = rf"{__package__}(?:\.\w+)*"
# To parse the sources as Python does takes ten times as long, in every run.
_IMPORT = re.compile(
    rf"\bfrom\s+({_OWN})\s+import\s+(\([^)]*\)|[^\n;]+)|\bimport\s+([^\n;]*{_OWN}[^\n;]*)"
)


def source_digest(*modules: str) -> str:
    """Twelve hexadecimal digits of modules and of all they import from this package.

    Args:
        *modules: Full names, such as ``iksamples.training.run``.
    """
    content = hashlib.sha256()
    for path in sorted(source_files(*modules)):
        content.update(path.name.encode() + _content(path))
    return content.hexdigest()[:12]


def source_files(*modules: str) -> set[Path]:
    """The files of modules, of all they import from this package, and of what these ship as data.

    Args:
        *modules: Full names.
    """
    found: set[Path] = set()
    waiting = [path for module in modules for path in _with_parents(module)]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _needed(path)
    return found


@cache
def _content(path: Path) -> bytes:
    return path.read_bytes()


@cache
def _needed(path: Path) -> frozenset[Path]:
    """What a file needs of this package besides."""
    if path.suffix != ".py":
        return frozenset()
    needed = {file for name in imports(_content(path).decode()) for file in _with_parents(name)} - {
        _PACKAGE / "sources.py"
    }
    if path.name == "__init__.py":
        # Importing a package runs its __init__ alone, but what it ships as data counts too.
        needed.update(
            file
            for file in path.parent.rglob("*.*")
            if file.suffix != ".py" and file.is_file() and file.parent.name != "__pycache__"
        )
    return frozenset(needed)


def imports(text: str) -> set[str]:
    """What a source imports from this package, at its top or inside a function; perhaps more.

    Args:
        text: The source.

    Returns:
        Full names of modules, and of what is in them.
    """
    names: set[str] = set()
    for module, some, plain in _IMPORT.findall(text):
        names.update(re.findall(rf"\b{_OWN}", plain))
        if module:
            names.add(module)
            names.update(f"{module}.{name}" for name in re.findall(r"\w+", some))
    return names


@cache
def _with_parents(module: str) -> tuple[Path, ...]:
    """The files of a module and of the packages it is in, but this one."""
    parts = module.split(".")
    names = (parts[1:depth] for depth in range(2, len(parts) + 1))
    return tuple(path for name in names if (path := _path(*name)))


def _path(*parts: str) -> Path | None:
    """The file of a module of this package, or None for a name that is not a module (a class, say).

    From the name alone: asking Python where a module lies imports what is above it, and to ask
    whether a class is one imports the class's module, with Lightning and torch behind it.
    """
    place = _PACKAGE.joinpath(*parts)
    return next((p for p in (place / "__init__.py", place.with_suffix(".py")) if p.is_file()), None)
