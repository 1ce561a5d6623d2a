"""Audits what is installed: its licences, and whether known vulnerabilities are in constraints.txt.

    python .ci/audit.py

Ends with 1 where a licence is not allowed or unknown, or a vulnerability is known; with 3 where all
else is well but the service that knows vulnerabilities gave no answer for some packages: they are
then not audited, which is no sign that they are sound.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import venv
from collections import defaultdict
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path


CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "ISC",
    "LLVM-exception", "MIT", "MIT-0", "MIT-CMU", "PSF-2.0", "Zlib",
    # Asks that changes to its own files are passed on; nothing of it is changed here.
    "MPL-2.0",
}  # fmt: skip
REVIEWED = {
    "docutils": "public domain and BSD-2-Clause; the one part under the GPL, an Emacs mode, is not "
    "in the wheel. Snakemake's reports need it.",
    "psycopg2-binary": "LGPL with exceptions; only the tests of a tracking server on PostgreSQL "
    "load it, unchanged, and nothing of it is passed on.",
}
"""What metadata alone would refuse -> what was found by reading, and why it may stay."""
# As licences are called where no SPDX expression is given.
CALLED = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache License 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD 3-Clause License": "BSD-3-Clause",
    "BSD License": "BSD",
    "GNU Library or Lesser General Public License (LGPL)": "LGPL",
    "GNU General Public License (GPL)": "GPL",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
# How licences begin that give themselves no name.
BEGINNINGS = {
    "Permission is hereby granted, free of charge": "MIT",
    "Redistribution and use in source and binary forms": "BSD",
}
TEXTS = re.compile(r"licen[cs]e[^/]*$|copying[^/]*$", re.I)


def licence(package: metadata.Distribution) -> str:
    """A distribution's licence as an SPDX expression, as far as it says; else empty."""
    about = package.metadata
    if expression := about.get("License-Expression"):
        return str(expression)
    named = [one.split(" :: ") for one in about.get_all("Classifier", [])]
    known = [CALLED.get(one[-1], one[-1]) for one in named if one[0] == "License" and one[2:]]
    if known:
        return " AND ".join(known)
    said = str(about.get("License") or "").strip()
    if said and "\n" not in said:
        return CALLED.get(said, said)
    for file in package.files or ():
        if TEXTS.search(str(file)) and file.locate().is_file():
            text = " ".join(file.locate().read_text(encoding="utf-8", errors="replace").split())
            if found := {name for words, name in BEGINNINGS.items() if words in text}:
                return " AND ".join(sorted(found))
    return ""


def is_allowed(expression: str) -> bool:
    """Whether a licence may be used: one of its alternatives has nothing that is not allowed."""
    if "(" in expression:  # then all that is named has to be
        parts = [re.split(r"[\s()]+(?:AND|OR|WITH)[\s()]+|[()]", expression)]
    else:
        parts = [re.split(" AND | WITH ", one) for one in expression.split(" OR ")]
    named = [[name.strip() for name in one if name.strip()] for one in parts]
    return any(one and ALLOWED.issuperset(one) for one in named)


def licences() -> tuple[dict[str, list[str]], list[str]]:
    """Packages by licence, and a line for each that may not be used."""
    found: dict[str, list[str]] = defaultdict(list)
    wrong = []
    for package in sorted(metadata.distributions(), key=lambda one: one.name.lower()):
        name, expression = package.name, licence(package)
        if package.name not in found[expression]:
            found[expression].append(name)
        if not is_allowed(expression) and name.lower() not in REVIEWED:
            wrong.append(f"{name} {package.version}: {expression or 'no licence is named'}")
    return found, wrong


def vulnerabilities(constraints: Path) -> tuple[int, list[str], list[str]]:
    """Asks pip-audit, which gets an environment of its own so as not to be what is audited.

    Returns:
        How many packages were audited, a line per vulnerability, and a line per package about
        which nothing is known, or why pip-audit did not run.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder) / "bin/python")
        call = [python, "-m", "pip", "install", "--quiet", "pip-audit"]
        done = subprocess.run(call, capture_output=True, text=True)
        if done.returncode:
            return 0, [], [f"pip-audit cannot be installed: {_last(done.stderr)}"]
        call = [python, "-m", "pip_audit", "--no-deps", "--disable-pip", "--progress-spinner=off"]
        call += ["--format=json", f"--requirement={constraints}"]
        done = subprocess.run(call, capture_output=True, text=True)
    try:
        audited = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        return 0, [], [f"pip-audit had no answer: {_last(done.stderr)}"]
    bad = [
        f"{one['name']} {one['version']}: {', '.join([flaw['id'], *flaw['aliases']])}, mended in "
        f"{', '.join(flaw['fix_versions']) or 'no version yet'}"
        for one in audited
        for flaw in one.get("vulns", ())
    ]
    unknown = [one["skip_reason"] for one in audited if "skip_reason" in one]
    return len(audited) - len(unknown), bad, unknown


def _last(text: str) -> str:
    return (text.strip().splitlines() or ["no reason given"])[-1][:200]


def report(
    by_licence: dict[str, list[str]],
    wrong: list[str],
    audited: int,
    bad: list[str],
    unknown: list[str],
) -> Iterator[str]:
    """The outcome, in lines of Markdown."""
    n = sum(map(len, by_licence.values()))
    yield f"{n} packages, {len(wrong)} with a licence that is not allowed or unknown:"
    yield ""
    yield "| licence | packages | |"
    yield "|---|--:|---|"
    for name, packages in sorted(by_licence.items(), key=lambda one: (-len(one[1]), one[0])):
        few = ", ".join(packages) if len(packages) < 6 else ""
        yield f"| {name or 'none named'} | {len(packages)} | {few} |"
    yield ""
    installed = {one.lower() for packages in by_licence.values() for one in packages}
    yield from (f"- {name}: {why}" for name, why in REVIEWED.items() if name in installed)
    yield from (f"- NOT ALLOWED: {line}" for line in wrong)
    yield ""
    if unknown:
        yield (
            f"NOT AUDITED for vulnerabilities: {len(unknown)} of {audited + len(unknown)}; the "
            f"first: {unknown[0]}."
        )
    yield f"{audited} packages audited by pip-audit, {len(bad)} known vulnerabilities."
    yield from (f"- VULNERABLE: {line}" for line in bad)


def main() -> int:
    """The audit."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--constraints", type=Path, default=CONSTRAINTS)
    given = options.parse_args()
    found, wrong = licences()
    audited, bad, unknown = vulnerabilities(given.constraints)
    print("\n".join(report(found, wrong, audited, bad, unknown)))
    return 1 if wrong or bad else 3 if unknown else 0


if __name__ == "__main__":
    sys.exit(main())
