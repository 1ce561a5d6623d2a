"""The house itself: imports go one way through its folders, and nothing stands in it unused."""

import ast
import graphlib
from pathlib import Path

import pytest


ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "iksamples"
ORDER = [
    "errors",
    "files",
    "columns",
    "stats",
    "region",
    "network",
    "study",
    "handbook",
    "text",
    "arm",
    "task",
    "calibration",
    "samples",
    "methods",
    "results",
    "evaluation",
    "advice",
    "training",
    "certify",
    "answer",
    "recorded",
    "paper",
    "plan",
    "jobs",
    "report",
    "recording",
    "export",
    "tracking",
    "cli",
    "__main__",
]
"""The folders and modules of the package; each imports only what stands before it."""
ALONE = {"__main__", "jobs", "sources"}
"""Started by Python, and by the workflow: no module of the package imports these."""


def name_of(file):
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {name_of(file): file for file in sorted(PACKAGE.rglob("*.py"))}


def imports_of(module, for_types=True):
    """The modules of the package that a module imports, at its top or inside a function.

    Those that only the type checker follows are left out if asked.
    """
    found, tree = set(), ast.parse(FILES[module].read_text(encoding="utf-8"))
    if not for_types:
        tree.body = [one for one in tree.body if not getattr(one, "test", None)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            named = [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}: a relative import hides where it leads"
            named = [(node.module, f".{alias.name}") for alias in node.names]
        else:
            continue
        for base, name in named:
            if base.split(".")[0] == "iksamples":
                whole = (base + name).removeprefix("iksamples").removeprefix(".")
                found.add(whole if whole in FILES else whole.rpartition(".")[0])
    return found - {""}


IMPORTS = {module: imports_of(module) for module in FILES if module}


def test_the_order_names_every_folder():
    assert sorted({*ORDER, "sources"}) == sorted({module.split(".")[0] for module in IMPORTS})


@pytest.mark.parametrize("folder", [*ORDER, "sources"])
def test_imports_go_one_way_through_the_folders(folder):
    before = ORDER[: ORDER.index(folder) + 1] if folder in ORDER else []
    for module, imported in IMPORTS.items():
        if module.split(".")[0] == folder:
            back = sorted(one for one in imported if one.split(".")[0] not in before)
            assert not back, f"{module} imports {back}, which stand behind it"


def test_no_modules_import_each_other_in_a_circle():
    run = {module: imports_of(module, for_types=False) for module in IMPORTS}
    tuple(graphlib.TopologicalSorter(run).static_order())  # raises with the circle


def test_every_module_has_a_caller():
    called = set().union(*IMPORTS.values())
    packages = {module for module, file in FILES.items() if file.name == "__init__.py"}
    assert sorted(IMPORTS.keys() - called - packages - ALONE) == []
    assert "from iksamples.sources import" in (ROOT / "workflow/rules/common.smk").read_text()


@pytest.mark.parametrize("module", FILES)
def test_no_file_has_over_400_lines(module):
    assert len(FILES[module].read_text(encoding="utf-8").splitlines()) <= 400
