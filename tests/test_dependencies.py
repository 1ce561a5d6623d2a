"""What is installed: pinned to the last package, and under licences that were looked at."""

import re
from importlib import metadata, util
from pathlib import Path
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def audit():
    spec = util.spec_from_file_location("audit", ROOT / ".ci/audit.py")
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def needed(name: str, extras: frozenset[str], seen: set[tuple[str, str]]) -> set[str]:
    """Names of all that a package needs here, directly or not."""
    found: set[str] = set()
    for line in metadata.requires(name) or ():
        one = Requirement(line)
        chosen = ["", *sorted(extras)]
        if one.marker and not any(one.marker.evaluate({"extra": extra}) for extra in chosen):
            continue
        child = canonicalize_name(one.name)
        found.add(child)
        wanted = {(child, extra) for extra in ["", *one.extras]} - seen
        if wanted:
            seen |= wanted
            found |= needed(child, frozenset(extra for _, extra in wanted), seen)
    return found


def test_all_that_is_needed_is_pinned_and_nothing_else() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==") for line in lines if not line.startswith("#"))
    pinned = {str(canonicalize_name(name)): version for name, version in pairs}
    versions = {
        str(canonicalize_name(one.name)): one.version.partition("+")[0]
        for one in metadata.distributions()
    }
    asked = needed("iksamples", frozenset({"test"}), set())
    assert {name: versions[name] for name in asked} == {
        # Elsewhere less may be needed: eaik has no wheel for every Python.
        name: pin for name, pin in pinned.items() if name in asked or name in versions
    }  # fmt: skip


def test_every_licence_that_is_installed_was_looked_at(audit) -> None:
    found, wrong = audit.licences()
    assert sum(map(len, found.values())) > 100
    assert wrong == []
    # What was read once stays an exception only as long as it is needed.
    installed = {one.name.lower(): one for one in metadata.distributions()}
    for name in audit.REVIEWED:
        assert not audit.is_allowed(audit.licence(installed[name]))


@pytest.mark.parametrize(
    ("about", "allowed"),
    [
        ({"License-Expression": "MIT"}, True),
        ({"License-Expression": "GPL-3.0-only OR MIT"}, True),
        ({"License-Expression": "GPL-3.0-only AND MIT"}, False),
        ({"License-Expression": "(MIT OR Apache-2.0) AND BSD-3-Clause"}, True),
        ({"License-Expression": "(MIT OR GPL-2.0-only) AND BSD-3-Clause"}, False),
        ({"License-Expression": "Apache-2.0 WITH LLVM-exception"}, True),
        ({"Classifier": "License :: OSI Approved :: MIT License"}, True),
        ({"Classifier": "License :: OSI Approved :: GNU Affero General Public License v3"}, False),
        ({"Classifier": "License :: OSI Approved", "License": "AGPL"}, False),
        ({"License": "Proprietary"}, False),
        ({"Classifier": "Programming Language :: Python"}, False),
    ],
)
def test_a_licence_is_allowed_if_all_that_binds_is(
    audit, tmp_path: Path, about: dict[str, str], allowed: bool
) -> None:
    lines = "".join(f"{key}: {value}\n" for key, value in about.items())
    folder = tmp_path / "thing-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: thing\nVersion: 1\n{lines}")
    [thing] = metadata.distributions(path=[str(tmp_path)])
    assert audit.is_allowed(audit.licence(thing)) == allowed


def test_a_package_that_could_not_be_audited_is_not_called_sound(
    audit, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """pip-audit itself ends with 0 and "No known vulnerabilities found" then."""
    answers = {
        "sound": '{"dependencies": [{"name": "a", "version": "1", "vulns": []}]}',
        "skipped": '{"dependencies": [{"name": "a", "skip_reason": "no a there"}]}',
        "silent": "",
        "bad": '{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "CVE-1",'
        ' "fix_versions": ["2"], "aliases": []}]}]}',
    }
    monkeypatch.setattr("sys.argv", ["audit"])
    monkeypatch.setattr(audit.venv, "create", lambda *_, **__: None)
    ends = {}
    for name, answer in answers.items():
        done = SimpleNamespace(returncode=0, stdout=answer, stderr="no network")
        monkeypatch.setattr(audit.subprocess, "run", lambda *_, done=done, **__: done)
        ends[name] = audit.main(), capsys.readouterr().out
    assert {name: code for name, (code, _) in ends.items()} == {
        "sound": 0, "skipped": 3, "silent": 3, "bad": 1,
    }  # fmt: skip
    assert re.search(r"NOT AUDITED.* 1 of 1.*no a there", ends["skipped"][1])
    assert re.search(r"NOT AUDITED.*no network", ends["silent"][1])
    assert "VULNERABLE: a 1: CVE-1, mended in 2" in ends["bad"][1]
