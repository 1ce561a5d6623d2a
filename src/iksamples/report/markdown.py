"""Markdown, the one source of a report's README.md and its page: values in, HTML out."""

import html
import math
import re
from collections.abc import Collection, Iterable, Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

import pandas as pd
from markdown_it import MarkdownIt
from markupsafe import Markup

from iksamples.errors import one_line


_ROUNDING = 1e-6
"""What is smaller is rounding and no error [mm]."""
_BLOCKS = ("|", "#", "<", "```", "!", ">")
"""What a line of its own starts with."""
_OUTWARD = {"up": ROUND_CEILING, "down": ROUND_FLOOR}
_UNIT = re.compile(r"(?<=\d) (?=(?:mm|%)(?!\w))")
"""The space between a number and its unit, at which no line is to end."""
_SPECIAL = re.compile(r"([\\`*_\[\]|~$#])")


def escaped(value: object) -> Markup:
    """Any value as Markdown that shows it and does nothing else.

    Names and titles come from files that others wrote: what would be a mark, a link or HTML is
    escaped, in README.md as on the page. Text that a template or ``table`` made is left alone.

    Raises:
        TypeError: The value is a float, which has to be rounded first.
    """
    if isinstance(value, Markup):
        return value
    if isinstance(value, float):
        raise TypeError(f"{value}: a number needs a filter that rounds it")
    text = one_line("" if value is None else str(value))
    text = _UNIT.sub("\u00a0", text)
    return Markup(html.escape(_SPECIAL.sub(r"\\\1", text), quote=False))


def code(value: object) -> Markup:
    """A command, a path or a key between backticks, whatever backticks it holds itself."""
    text = one_line(str(value))
    fence = "`" * (max((len(run) for run in re.findall("`+", text)), default=0) + 1)
    pad = " " if "`" in text or not text else ""
    return Markup(f"{fence}{pad}{text}{pad}{fence}")


def number(value: float, digits: int = 2, rounding: str = "") -> str:
    """A number with so many decimals, or as many as show two figures; nothing where unknown.

    Args:
        value: The number.
        digits: Decimals.
        rounding: ``up`` for what is an upper bound, ``down`` for a lower one, else to the nearest.
    """
    if not math.isfinite(value):
        return ""
    value = 0.0 if abs(value) < _ROUNDING else value
    if digits and 0 < abs(value) < 10.0 ** (1 - digits):
        digits = 1 - int(f"{value:.1e}".split("e")[1])
    exact: float | Decimal = value
    if rounding:
        step = Decimal(1).scaleb(-digits)
        exact = Decimal(repr(float(value))).quantize(step, _OUTWARD[rounding])
    return f"{exact:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def mm(value: float, digits: int = 2, rounding: str = "") -> str:
    """A length [mm]."""
    return f"{number(value, digits, rounding)}\u00a0mm"


def percent(share: float, digits: int = 0, rounding: str = "") -> str:
    """A share in per cent, with just so many decimals; a dash where it is not finite."""
    if not math.isfinite(share):
        return "–"
    if rounding:
        step = Decimal(1).scaleb(-digits)
        share = (
            float(Decimal(repr(float(share))).scaleb(2).quantize(step, _OUTWARD[rounding])) / 100
        )
    return f"{100 * share:.{digits}f}\u00a0%".replace("-", "−")


def whole(value: float) -> str:
    """A whole number, thousands apart by a thin space."""
    return number(value, 0)


def plus_minus(value: float, spread: float) -> str:
    """A mean with its standard deviation, where there is one."""
    return number(value) + (f"\u00a0±\u00a0{number(spread)}" if math.isfinite(spread) else "")


def span(values: "pd.Series[float]", digits: int = 2) -> str:
    """Smallest to largest."""
    low, high = number(values.min(), digits), number(values.max(), digits)
    return low if low == high else f"{low} to {high}"


def table(
    frame: pd.DataFrame,
    digits: Mapping[str, int] | int = 2,
    up: Collection[str] = (),
    down: Collection[str] = (),
) -> Markup:
    """A Markdown table of a frame without its index.

    Args:
        frame: Column names are the heads, ours and not to be escaped. Texts align left, numbers
            right.
        digits: Decimals of floating point columns, one number or one per column (else 2).
        up: Columns of upper bounds, which are rounded up.
        down: Columns of lower bounds, which are rounded down.
    """
    heads = [str(name) for name in frame.columns]
    cells = []
    for i, head in enumerate(heads):
        shown = digits if isinstance(digits, int) else digits.get(head, 2)
        rounding = "up" if head in up else "down" if head in down else ""
        cells.append([_cell(value, shown, rounding) for value in frame.iloc[:, i]])
    marks = ["---" if any(map(_has_letters, column)) else "--:" for column in cells]
    lines = [heads, marks, *map(list, zip(*cells, strict=True))]
    lines[0] = [head.replace("|", "\\|") for head in heads]
    return Markup("\n".join(f"| {' | '.join(line)} |" for line in lines))


def objects(values: Iterable[Any]) -> "pd.Series[Any]":
    """Values as they are: pandas would make its own strings of escaped text."""
    return pd.Series(list(values), dtype=object)


def tidy(markdown: str) -> str:
    """A text whose paragraphs are a line each, a blank line apart, as templates cannot write it."""
    lines: list[str] = []
    verbatim = False
    for line in markdown.splitlines():
        verbatim ^= line.startswith("```")
        plain = bool(line) and not verbatim and not line.startswith(_BLOCKS)
        item = line.startswith("- ")
        if plain and not item and lines and lines[-1] and not lines[-1].startswith(_BLOCKS):
            lines[-1] += f" {line.strip()}"
        elif line or (lines and lines[-1]):
            lines.append(line.rstrip())
    return "\n".join(lines).strip() + "\n"


def to_html(markdown: str, drawings: Mapping[str, str]) -> str:
    """The body of a page.

    Args:
        markdown: The report's text.
        drawings: File name of a picture -> the HTML that is shown in its place.
    """
    parser = MarkdownIt("commonmark", {"html": True}).enable("table")

    def image(self: Any, tokens: Any, index: int, options: Any, env: Any) -> str:
        token = tokens[index]
        source = str(token.attrs["src"])
        return drawings.get(source) or self.image(tokens, index, options, env)

    parser.add_render_rule("image", image)
    tokens = parser.parse(markdown)
    for before, token, after in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if before.type == "heading_open":
            before.attrSet("id", slug(token.content))
        if token.children and [child.type for child in token.children] == ["image"]:
            before.hidden = after.hidden = True
    body = str(parser.renderer.render(tokens, parser.options, {}))
    return body.replace("<table>", '<div class="scroll"><table>').replace(
        "</table>", "</table></div>"
    )


def summary(markdown: str) -> dict[str, Markup]:
    """What a front page shows of a report, as HTML.

    Args:
        markdown: The report's README.

    Returns:
        Its title, its answer (the first block quote) and the path of its first picture; empty where
        it has none.
    """
    parser = MarkdownIt("commonmark", {"html": False})
    found = dict.fromkeys(("title", "answer", "picture"), Markup())
    inside = ""
    for token in parser.parse(markdown):
        if token.type == "inline":
            part = {"h1": "title", "blockquote": "answer"}.get(inside)
            if part and not found[part]:
                found[part] = Markup(parser.renderInline(token.content))
            images = [child for child in token.children or [] if child.type == "image"]
            if images and not found["picture"]:
                found["picture"] = Markup(images[0].attrs["src"])
        elif token.type in ("heading_open", "blockquote_open"):
            inside = token.tag
        elif token.type in ("heading_close", "blockquote_close"):
            inside = ""
    return found


def headings(body: str) -> list[tuple[str, Markup]]:
    """Anchor and text of the sections (second-level headings) of a body."""
    return [(a, Markup(text)) for a, text in re.findall(r'<h2 id="([^"]*)">(.*?)</h2>', body)]


def slug(heading: str) -> str:
    """A heading's anchor."""
    return re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")


def _cell(value: object, digits: int, rounding: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value, digits, rounding)
    if value is None or value is pd.NA:
        return ""
    text = whole(value) if isinstance(value, int) else escaped(value)
    return re.sub(r"(?<!\\)\|", r"\\|", text)


def _has_letters(cell: str) -> bool:
    return bool(re.search(r"[^\W\d_]", re.sub(r"<[^>]*>|&\w+;", "", cell)))
