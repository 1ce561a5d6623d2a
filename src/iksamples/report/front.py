"""The front page: what every study asks and answers, those built here and those kept in docs/."""

import base64
from pathlib import Path

from markupsafe import Markup

from iksamples.files import whole_file
from iksamples.report.markdown import summary, to_html
from iksamples.report.write import html_environment, page


_KEPT = "kept-{}.html"


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
        links[built.parent.name] = f"{built.parent.name}/index.html"
    studies = []
    for name, folder in folders.items():
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
            _write(reports / links[name], page(found["title"], body))
    body = html_environment().get_template("front.html.j2").render(studies=studies)
    _write(reports / "index.html", page(Markup("iksamples: studies"), body))


def _inline(picture: Path) -> Markup:
    data = base64.b64encode(picture.read_bytes()).decode()
    return Markup(f'<img alt="{picture.stem}" src="data:image/png;base64,{data}">')


def _write(path: Path, text: str) -> None:
    with whole_file(path) as file:
        file.write_text(text, encoding="utf-8")
