"""Digests of source files, by which an edit re-runs the steps it affects."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from iksamples import sources


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the digest module in a package of its own, with four modules around it."""
    folder = tmp_path / "toy"
    (folder / "deep").mkdir(parents=True)
    text = Path(sources.__file__).read_text()
    (folder / "sources.py").write_text(text)
    (folder / "__init__.py").write_text("")
    (folder / "deep" / "__init__.py").write_text("")
    (folder / "deep" / "data.csv").write_text("a\n1\n")
    (folder / "deep" / "templates").mkdir()
    (folder / "deep" / "templates" / "page.md.j2").write_text("a\n1\n")
    (folder / "base.py").write_text("x = 1\n")
    (folder / "deep" / "step.py").write_text("import os\ndef f():\n    from toy.base import x\n")
    (folder / "other.py").write_text("y = 2\n")
    return folder


def digests(package):
    code = "from toy.sources import source_digest as d; print(d('toy.deep.step'), d('toy.other'))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=package.parent, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_an_edit_changes_the_digests_of_what_imports_it_and_no_others(package):
    step, other = digests(package)
    assert digests(package) == [step, other]
    (package / "base.py").write_text("x = 2\n")
    assert digests(package)[0] != step
    assert digests(package)[1] == other


@pytest.mark.parametrize(
    "block",
    [
        "class A:\n  async def f():\n    {}",
        "for _ in ():\n  pass\nelse:\n  {}",
        "try:\n  pass\nexcept ValueError:\n  {}",
        "try:\n  pass\nfinally:\n  {}",
        "if 0:\n  pass\nelif 1:\n  with open('x'):\n    {}",
        "match 1:\n  case 1:\n    {}",
        "while 1: {}",
    ],
)
def test_an_import_in_any_block_counts(package, block):
    (package / "deep" / "step.py").write_text(block.format("import toy.base") + "\n")
    step, _ = digests(package)
    (package / "base.py").write_text("x = 2\n")
    assert digests(package)[0] != step


@pytest.mark.parametrize("data", ["data.csv", "templates/page.md.j2"])
def test_data_in_a_package_counts(package, data):
    step, other = digests(package)
    (package / "deep" / data).write_text("a\n2\n")
    assert digests(package)[0] != step
    assert digests(package)[1] == other


def test_imports_are_those_that_python_sees():
    for file in Path(sources.__file__).parent.rglob("*.py"):
        text, seen = file.read_text(), set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                seen.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{file}: a relative import is not followed"
                seen.update({node.module, *(f"{node.module}.{one.name}" for one in node.names)})
        seen = {name for name in seen if name.split(".")[0] == "iksamples"}
        found = sources.imports(text)
        assert seen <= found, file
        files = [{sources._with_parents(name) for name in names} for names in (seen, found)]
        assert files[0] == files[1], file


def test_evaluation_does_not_depend_on_the_report():
    found = sources.source_files("iksamples.evaluation.errors")
    names = {path.parent.name for path in found}
    assert {"arm", "samples", "methods", "evaluation"} <= names
    assert not names & {"report", "tracking", "recording", "certify", "answer"}


def test_nothing_is_imported_to_read_sources():
    code = (
        "import sys; from iksamples.sources import source_digest as d; before = set(sys.modules);"
        "d('iksamples.training.run', 'iksamples.report.write', 'iksamples.tracking.track');"
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [name for name in done.stdout.split() if not name.startswith("encodings")]


def test_what_python_and_numba_keep_for_themselves_does_not_count(package):
    before = digests(package)
    kept = package / "deep" / "__pycache__"
    kept.mkdir(exist_ok=True)
    (kept / "step.loop-1.py311.nbi").write_bytes(b"index")
    (kept / "step.loop-1.py311.1.nbc").write_bytes(b"machine code")
    assert digests(package) == before
