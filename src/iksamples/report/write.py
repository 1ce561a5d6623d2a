"""Writes the report: one page that stands alone, and its Markdown twin with pictures."""

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from iksamples.answer.words import OPTIMIZERS
from iksamples.report import (
    sections_answer,
    sections_certified,
    sections_changes,
    sections_claims,
    sections_cost,
    sections_map,
    sections_methods,
    sections_paper,
    sections_results,
    style,
)
from iksamples.report.blocks import Figure, Number, Section, Viewer
from iksamples.report.data import ReportData, read_report_data
from iksamples.report.verdict import verdict
from iksamples.report.wording import ACTIVATION_NAMES, box_ranges, box_size, budget, count
from iksamples.study import Study, Training


SECTIONS: tuple[Callable[[ReportData], Section | None], ...] = (
    sections_answer.how_many_samples,
    sections_answer.fresh_trainings,
    sections_methods.methods_and_designs,
    sections_methods.placing,
    sections_methods.readings,
    sections_changes.what_each_change_does,
    sections_results.table_one,
    sections_results.error_against_samples,
    sections_certified.certified_worst_case,
    sections_map.where_and_when,
    sections_claims.claims,
    sections_results.training_progress,
    sections_results.arm_with_heart,
    sections_results.path_views,
    sections_paper.estimate_against_measured,
    sections_paper.differences,
    sections_cost.cost,
    sections_cost.look_closer,
    sections_cost.origin,
)
"""The report, top to bottom. A section is one function, and is left out where it returns None."""


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
        IksamplesError: A result is missing or unreadable, or every network diverged. What an
            earlier run wrote is then left as it was.
    """
    results, output = Path(results), Path(output)
    data = read_report_data(study, results, output, command)
    sections = list(_lettered(section for make in SECTIONS if (section := make(data))))
    context = {
        "study": study,
        "title": study.title or f"Study “{study.name}”",
        "facts": facts(data),
        "verdict": verdict(data),
        "sections": sections,
    }
    environment = _environment()
    page = environment.get_template("page.html.j2").render(context)
    readme = environment.get_template("readme.md.j2").render(context)

    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=output) as folder:
        draft = Path(folder)
        (draft / "figures").mkdir()
        for figure in _figures(sections):
            style.png(figure.drawing, draft / "figures" / f"{figure.name}.png")
        (draft / "index.html").write_text(page, encoding="utf-8")
        (draft / "README.md").write_text(readme, encoding="utf-8")
        shutil.rmtree(output / "figures", ignore_errors=True)
        for name in ("figures", "README.md", "index.html"):
            (draft / name).replace(output / name)


def facts(data: ReportData) -> list[str]:
    """The study in a line: arm, workspace, networks, training."""
    study = data.study
    widths = [3, *study.network.hidden, data.chain.n_joints]
    sizes, designs = study.samples.points_per_axis, study.samples.designs
    kind = "sizes" if len(designs) > 1 else "grids"
    ladder = f"{len(sizes)} {kind}, {sizes[0]}³ to {sizes[-1]}³ samples"
    if len(designs) > 1:
        ladder += f", placed in {len(designs)} ways"
    per = " per set of samples" if len(designs) > 1 else " per grid"
    return [
        f"arm {Path(study.robot.urdf).stem}",
        f"{box_size(study)} ({box_ranges(study)} mm)",
        f"network {'-'.join(map(str, widths))}, {ACTIVATION_NAMES[study.network.activation]}",
        _training_facts(study.training),
        ladder if len(sizes) > 1 else f"{sizes[0]}³ samples",
        count(study.training.seeds, "seed") + (per if len(sizes) * len(designs) > 1 else ""),
    ]


def _training_facts(training: Training) -> str:
    if training.optimizer == "levenberg-marquardt":
        return f"{OPTIMIZERS[training.optimizer]}, {budget(training)}"
    return (
        f"{OPTIMIZERS[training.optimizer]}, rate {training.learning_rate:g}, "
        f"batch {training.batch_size}, {budget(training)}"
    )


def _lettered(sections: Iterator[Section]) -> Iterator[Section]:
    """Gives the figures that the paper does not have their letters, in order."""
    letters = iter("ABCDEFGHIJKLMNOPQRSTUVWXYZ")
    for section in sections:
        blocks = [
            replace(block, label=f"Figure {next(letters)}")
            if isinstance(block, Figure | Viewer) and not block.label
            else block
            for block in section.blocks
        ]
        yield replace(section, blocks=blocks)


def _figures(sections: list[Section]) -> Iterator[Figure]:
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Figure) and block.in_readme:
                yield block


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("iksamples.report"),
        # Markdown is not HTML; only the page is escaped.
        autoescape=lambda name: name is not None and ".html" in name,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "marks": _marks,
        "svg": _svg,
        "raised": _raised,
        "cell": _cell,
        "scene": _scene,
    }
    environment.tests["number"] = lambda value: isinstance(value, Number)
    return environment


def _marks(text: str) -> Markup:
    """The four marks of a text as HTML: `code`, **strong**, ^raised^, [link](target)."""
    html = str(escape(text))
    # A number and its unit stay on one line.
    html = re.sub(r"(?<=\d) (?=%|mm\b)", "\u00a0", html)
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", html)
    html = re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", html)
    html = re.sub(r"\^([^^]+)\^", r"<sup>\1</sup>", html)
    html = re.sub(r"\[([^\]]+)\]\(([^)]+)\)", r'<a href="\2">\1</a>', html)
    return Markup(html)


def _svg(figure: Figure) -> Markup:
    return Markup(style.svg(figure.drawing, figure.name, figure.caption, figure.tips))


def _raised(text: str) -> str:
    """Markdown has no mark for raised text, but knows the HTML one."""
    return re.sub(r"\^([^^]+)\^", r"<sup>\1</sup>", text)


def _cell(value: str | Number) -> str:
    """A cell of a Markdown table."""
    return str(value).replace("|", "\\|")


def _scene(value: dict[str, object]) -> Markup:
    """Numbers for the page's script; ``<`` would end the element."""
    return Markup(json.dumps(value, separators=(",", ":")).replace("<", "\\u003c"))
