"""What a section of the report is made of; the templates turn each block into HTML and Markdown.

A section is written once. Its text is plain, with four marks that both outputs know: `code`,
**strong**, ^raised^ and [link](target).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np


if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    text: str
    in_readme: bool = True
    in_page: bool = True


@dataclass(frozen=True)
class Number:
    """A number in a table, with its column's name in the data so that it can be checked.

    Attributes:
        value: The number; NaN prints as an empty cell.
        digits: Decimals shown.
        spread: Printed behind a ± if finite.
        source: Column of the data file it comes from, empty if it is computed here.
    """

    kind: ClassVar[str] = "number"
    value: float
    digits: int = 2
    spread: float = float("nan")
    source: str = ""

    def __str__(self) -> str:
        """The number as it is printed."""
        if not np.isfinite(self.value):
            return ""
        shown = f"{self.value:,.{self.digits}f}".replace(",", "\u202f")
        if np.isfinite(self.spread):
            shown += f" ± {self.spread:.{self.digits}f}"
        return shown.replace("-", "−")


@dataclass(frozen=True)
class Column:
    """A column's head: a group that spans columns, a title, a unit, and how cells align."""

    title: str
    unit: str = ""
    group: str = ""
    text: bool = False
    ours: bool = False

    @property
    def flat(self) -> str:
        """The head in one line."""
        head = f"{self.group}: {self.title}" if self.group else self.title
        return f"{head} [{self.unit}]" if self.unit else head


@dataclass(frozen=True)
class Table:
    """A table; cells are strings or ``Number``."""

    kind: ClassVar[str] = "table"
    in_page: ClassVar[bool] = True
    columns: Sequence[Column]
    rows: Sequence[Sequence[str | Number]]
    caption: str = ""
    name: str = ""
    in_readme: bool = True

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Heads that span columns, as (title, columns)."""
        runs: list[tuple[str, int]] = []
        for column in self.columns:
            if runs and runs[-1][0] == column.group:
                runs[-1] = (column.group, runs[-1][1] + 1)
            else:
                runs.append((column.group, 1))
        return runs


@dataclass(frozen=True)
class Figure:
    """A drawing with its caption.

    Attributes:
        name: File name of the picture and prefix of the identifiers in the page.
        label: ``Figure 3``, or empty for a figure the paper does not have, which gets a letter.
        caption: What is shown; the first sentence is the title.
        drawing: The matplotlib figure.
        data: Which files it was drawn from.
        drawn_by: Which function drew it.
        hint: What can be done with it on the page; not in the Markdown twin.
        tips: Name of a group of marks -> one line for each mark, shown when pointed at.
    """

    kind: ClassVar[str] = "figure"
    in_page: ClassVar[bool] = True
    name: str
    label: str
    caption: str
    drawing: "Drawing"
    data: str
    drawn_by: str
    hint: str = ""
    tips: dict[str, list[str]] = field(default_factory=dict)
    in_readme: bool = True


@dataclass(frozen=True)
class Viewer:
    """The view in three dimensions that can be turned; the page only."""

    kind: ClassVar[str] = "viewer"
    in_page: ClassVar[bool] = True
    label: str
    caption: str
    scene: dict[str, object]
    data: str
    drawn_by: str
    hint: str = ""
    in_readme: bool = False


@dataclass(frozen=True)
class Commands:
    """Lines to type in a terminal."""

    kind: ClassVar[str] = "commands"
    in_page: ClassVar[bool] = True
    lines: Sequence[str]
    in_readme: bool = True


Block = Text | Table | Figure | Viewer | Commands


@dataclass(frozen=True)
class Section:
    """A part of the report with a heading."""

    name: str
    title: str
    blocks: Sequence[Block]

    @property
    def in_readme(self) -> bool:
        """Whether anything of it goes into the Markdown twin."""
        return any(block.in_readme for block in self.blocks)
