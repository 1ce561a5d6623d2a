"""Writes the reports: README.md with its pictures, the same text as a page, the front page."""

import base64
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from iksamples.errors import one_line
from iksamples.files import kept_file, whole_file, write_digest, writing
from iksamples.report import answers, errors, figures, markdown, paper, run
from iksamples.report.data import read_report_data
from iksamples.report.figures import Drawing
from iksamples.report.markdown import summary, to_html
from iksamples.study import Study


class Pictures:
    """The pictures that a text asks for, by file name."""

    def __init__(self) -> None:
        """Starts without any."""
        self.drawn: dict[str, tuple[Any, str]] = {}

    def __call__(self, name: str, drawing: Any, words: str) -> Markup:
        """The Markdown of a picture.

        Args:
            name: Its file name, without an ending.
            drawing: A ``Drawing`` or a matplotlib figure.
            words: What it shows, for those who do not see it.
        """
        self.drawn[name] = drawing, words
        return Markup("![{}](figures/{}.png)").format(words, name)

    def save(self, folder: Path) -> None:
        """Writes every picture as a PNG."""
        folder.mkdir(parents=True)
        for name, (drawing, _) in self.drawn.items():
            figures.png(getattr(drawing, "figure", drawing), folder / f"{name}.png")

    def inline(self) -> dict[str, str]:
        """Every picture as HTML, by the path that the text knows it by."""
        found = {}
        for name, (drawing, words) in self.drawn.items():
            figure, tips = drawing if isinstance(drawing, Drawing) else (drawing, {})
            svg = figures.svg(figure, f"figure-{name}", words, tips)
            found[f"figures/{name}.png"] = f'<div class="drawing" id="figure-{name}">{svg}</div>\n'
        return found


def write_report(
    study: Study,
    results: str | Path,
    output: str | Path,
    command: str = "snakemake --cores 2",
) -> None:
    """Writes the report of a finished study.

    Args:
        study: The study.
        results: Its results folder, such as ``results/paper``.
        output: Folder of the report, such as ``reports/paper``: ``index.html``, one page that needs
            nothing else, and ``README.md`` with ``figures/*.png``, which hold no time, machine or
            commit, so that the same results give the same bytes.
        command: What a user types to run the study.

    Raises:
        IksamplesError: A result is missing or unreadable. What an earlier run wrote is then left as
            it was.
    """
    results, output = Path(results), Path(output)
    data = read_report_data(study, results, command)
    pictures = Pictures()
    title = study.title or f"Study {study.name}"
    values: dict[str, Any] = {
        "data": data,
        "title": title,
        "facts": run.facts(data),
        "answer": answers.answer(data),
        "curves": errors.curves(data),
        "worst": errors.worst(data),
        "comparisons": answers.comparisons(data),
        "paths": run.paths(data),
        "cost": run.cost(data),
        "made": run.made(data),
        "figure": pictures,
    }
    environment = text_environment()
    values["paper"] = _paper(environment, data, pictures)
    template = environment.get_template("report.md.j2")
    readme, text = (markdown.tidy(template.render(values, page=one)) for one in (False, True))
    body = markdown.to_html(text, pictures.inline())
    if data.cells:
        body = body.replace("<!-- viewer -->", _viewer(values["paths"]["scene"]))
    save(output, readme, page(title, body), pictures)


def save(output: Path, readme: str, html: str, pictures: Pictures) -> None:
    """Writes a report's files, all of them or none.

    Args:
        output: Folder that gets ``README.md``, ``index.html`` and ``figures/``.
        readme: Markdown.
        html: The page.
        pictures: What the two show.
    """
    draft = output / ".unfinished"
    shutil.rmtree(draft, ignore_errors=True)  # what a kill left
    try:
        with writing(output):
            draft.mkdir(parents=True)
            pictures.save(draft / "figures")
            (draft / "index.html").write_text(html, encoding="utf-8")
            (draft / "README.md").write_text(readme, encoding="utf-8")
            shutil.rmtree(output / "figures", ignore_errors=True)
            write_digest(draft / "figures", output / "figures")
            (draft / "figures").replace(output / "figures")
            for name in ("README.md", "index.html"):
                with kept_file(output / name) as file:
                    (draft / name).replace(file)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def page(title: str, body: str) -> str:
    """A whole page that stands alone and may load nothing.

    Args:
        title: Its title; text, unless it is ``Markup``.
        body: HTML.
    """
    environment = html_environment()

    def source(name: str) -> str:
        text = environment.loader.get_source(environment, name)[0]  # type: ignore[union-attr]
        return text.rstrip("\n")

    scripts = [source("tips.js"), source("viewer.js")]
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    return environment.get_template("page.html.j2").render(
        title=title,
        body=Markup(body),
        style=Markup(source("style.css")),
        sections=markdown.headings(body),
        scripts=[Markup(text) for text in scripts],
        hashes=Markup(" ".join(f"'sha256-{one}'" for one in hashes)),
    )


def text_environment() -> Environment:
    """Templates of Markdown: every value is escaped for it, floats need a filter that rounds."""
    environment = Environment(
        loader=PackageLoader("iksamples.report"),
        autoescape=True,
        finalize=markdown.escaped,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["line"] = one_line  # of a fence, which a line break could end
    for name in ("code", "mm", "number", "percent", "span", "table", "whole"):
        environment.filters[name] = getattr(markdown, name)
    return environment


def html_environment() -> Environment:
    """Templates of HTML."""
    return Environment(
        loader=PackageLoader("iksamples.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _paper(environment: Environment, data: Any, pictures: Pictures) -> Markup:
    """The sections of a study whose networks were held against the paper; else nothing."""
    if not (data.study.paper and data.cells):
        return Markup("")
    template = environment.get_template(paper.TEMPLATE)
    return Markup(template.render(paper.values(data), figure=pictures))


def _viewer(scene: dict[str, object]) -> str:
    """The view that can be turned; ``<`` in its numbers would end the element."""
    text = json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c")
    return html_environment().get_template("viewer.html.j2").render(scene=Markup(text))


_KEPT = "kept-{}.html"
_FIRST = "real-arm"
"""The study that the front page begins with: its picture has all kinds of methods in a row."""


def write_front_page(reports: str | Path, kept: str | Path) -> None:
    """Writes ``index.html``, which has the question, answer and a picture of every study.

    Args:
        reports: Folder of all reports, such as ``reports``; one that was run here hides the one
            that was kept.
        kept: Folder of the studies that are kept as Markdown, such as ``docs/studies``; each
            becomes a page, too.
    """
    reports, kept = Path(reports), Path(kept)
    folders = {readme.parent.name: readme.parent for readme in sorted(kept.glob("*/README.md"))}
    links = {name: _KEPT.format(name) for name in folders}
    for built in sorted(reports.glob("*/README.md")):
        folders[built.parent.name] = built.parent
        links[built.parent.name] = f"{quote(built.parent.name)}/index.html"
    studies = []
    for name, folder in sorted(folders.items(), key=lambda one: one[0] != _FIRST):
        text = (folder / "README.md").read_text(encoding="utf-8")
        pictures = {
            f"figures/{file.name}": _inline(file) for file in sorted(folder.glob("figures/*.png"))
        }
        found = summary(text)
        studies.append(found | {"link": links[name], "picture": pictures.get(found["picture"], "")})
        if folder.parent == kept:
            body = to_html(
                text, {name: f'<div class="drawing">{one}</div>' for name, one in pictures.items()}
            )
            with whole_file(reports / links[name]) as file:
                file.write_text(page(found["title"], body), encoding="utf-8")
    body = html_environment().get_template("front.html.j2").render(studies=studies)
    with kept_file(reports / "index.html") as file:
        file.write_text(page(Markup("iksamples: studies"), body), encoding="utf-8")


def _inline(picture: Path) -> Markup:
    data = base64.b64encode(picture.read_bytes()).decode()
    return Markup(f'<img alt="{picture.stem}" src="data:image/png;base64,{data}">')
