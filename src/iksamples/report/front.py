"""The front page of all studies built here."""

from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from iksamples.answer.answer import read_answer
from iksamples.errors import IksamplesError
from iksamples.study import read_study


class Built(NamedTuple):
    """A study with a report."""

    name: str
    title: str
    headline: str


def write_front_page(reports: str | Path, results: str | Path) -> None:
    """Writes ``index.html`` with a link to the report of every study, and what each answers.

    Args:
        reports: Folder of all reports, such as ``reports``.
        results: Folder of all results, such as ``results``; a report without results here is
            linked by its name alone.
    """
    reports, results = Path(reports), Path(results)
    studies = [_built(page.parent.name, results) for page in sorted(reports.glob("*/index.html"))]
    loader = PackageLoader("iksamples.report")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    style = Markup(loader.get_source(environment, "style.css")[0])
    text = environment.get_template("front.html.j2").render(studies=studies, style=style)
    unfinished = reports / ".unfinished-index.html"
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(reports / "index.html")


def _built(name: str, results: Path) -> Built:
    try:
        title = read_study(results / name / "study.json").title
        headline = read_answer(results / name).headline
    except IksamplesError:
        title, headline = "", ""
    return Built(name, title or name, headline)
