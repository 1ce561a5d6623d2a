"""Tables as people record them: text in any of its usual forms, or Parquet; names and cells."""

import csv
import gzip
import io
import re
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError, in_a_line, some_of
from iksamples.files import read_bytes


_MOST_BYTES, _MOST_CELLS = 500_000_000, 20_000_000
_INFINITE = "[-+]?(?i:inf|infinity)"
_NUMBER = re.compile(r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|" + _INFINITE)
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+(,[0-9]+)?([eE][-+]?[0-9]+)?|" + _INFINITE)
_MARKS = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class Table:
    """Named columns of cells that are not read yet.

    Attributes:
        path: Where it was read.
        names: A name per column, as written; empty where a column has none.
        rows: The cells of each row: text, a number, or None.
        lines: Line of the file each row stands on; empty for a file without lines.
    """

    path: Path
    names: tuple[str, ...]
    rows: Sequence[Sequence[object]]
    lines: Sequence[int] = ()

    def place(self, row: int) -> str:
        """What a message calls a row, counted from 0 here and from 1 there."""
        return f"row {row + 1} (line {self.lines[row]})" if self.lines else f"row {row + 1}"

    def listed(self, rows: NDArray[np.intp]) -> str:
        """What a message calls some rows: the first of them, and how many more."""
        return some_of([self.place(int(row)) for row in rows], 5)

    def numbers(self, columns: Sequence[int], most: float = sys.float_info.max) -> Floats:
        """The cells of some columns as numbers, shape (rows, columns).

        Args:
            columns: Which.
            most: The largest that is one, by its size; infinite: `inf` is one too.

        Raises:
            IksamplesError: A cell is no number; the first one is named.
        """
        cells = [[row[column] for column in columns] for row in self.rows]
        as_number = _with_comma if _uses_decimal_comma(cells) else _plain
        found = np.array([[as_number(cell) for cell in row] for row in cells], float)
        bad = np.argwhere(~(np.abs(found) <= most))
        if len(bad):
            row, column = (int(i) for i in bad[0])
            cell = cells[row][column]
            shown = "nothing" if cell is None or str(cell).strip() == "" else f"'{cell}'"
            more = f" ({len(bad)} such cells in all)" if len(bad) > 1 else ""
            raise IksamplesError(
                f"{self.path}: {self.place(row)} has {shown} as {self.names[columns[column]]}, "
                f"which is no plain number such as 1025.5{more}. Correct or remove the row."
            )
        return found.reshape(len(cells), len(columns))


def read_table(path: str | Path, most_rows: int = _MOST_CELLS, names: Sequence[str] = ()) -> Table:
    """Reads a table.

    Text may be gzipped, in UTF-8 or UTF-16, with or without a byte order mark; its columns are
    separated by semicolons, tabs, commas, bars or spaces, whichever the line of names has; lines
    that begin with ``#`` or ``%`` are comments, and names may stand in the last one above the rows.

    Args:
        path: The file.
        most_rows: Rows of the largest that is read.
        names: What its columns are, where it is a text without names; empty: it has them.

    Raises:
        IksamplesError: One line: not such a file, no names, no rows, or a row with more or fewer
            values than there are names.
    """
    path = Path(path)
    content = _content(path)
    if content.startswith(b"PAR1") and not names:
        return _parquet(path, content, most_rows)
    if content.startswith(b"PK"):
        raise IksamplesError(f"{path}: a spreadsheet or an archive; save it as CSV.")
    try:
        text = content.decode("utf-16" if content.startswith(_MARKS) else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise IksamplesError(f"{path}: no text in UTF-8, and no Parquet file; save it as CSV.")
    if not text.strip():
        raise IksamplesError(f"{path}: the file is empty.")
    if text.lstrip()[0] in "{[<":
        raise IksamplesError(f"{path}: no table (it looks like JSON or HTML); save it as CSV.")
    return _text(path, text, most_rows, names)


def _content(path: Path) -> bytes:
    content = read_bytes(path, _MOST_BYTES, "the samples")
    if not content.startswith(b"\x1f\x8b"):
        return content
    try:
        with gzip.open(io.BytesIO(content)) as packed:
            content = packed.read(_MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise IksamplesError(f"{path}: cannot read the samples ({in_a_line(error)}).") from None
    if len(content) > _MOST_BYTES:
        raise IksamplesError(f"{path}: over {_MOST_BYTES // 10**6} MB; record fewer rows.")
    return content


def _require_room(path: Path, n_rows: int, n_columns: int, most_rows: int) -> None:
    """Stops at a table that would take gigabytes, which a small file can hold if packed well."""
    most = min(most_rows, _MOST_CELLS // max(1, n_columns))
    if n_rows > most:
        raise IksamplesError(
            f"{path}: {n_rows} rows of {n_columns} columns; no more than {most} rows are read. "
            "Take every so many."
        )


def _parquet(path: Path, content: bytes, most_rows: int) -> Table:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        about = parquet.read_metadata(io.BytesIO(content))
        _require_room(path, about.num_rows, about.num_columns, most_rows)
        table = parquet.read_table(io.BytesIO(content))
    except (OSError, ValueError, pa.ArrowException) as error:  # a name that is no UTF-8
        raise IksamplesError(f"{path}: not a whole Parquet file ({in_a_line(error)}).") from None
    columns = [column.to_pylist() for column in table.columns]
    rows = list(zip(*columns, strict=True))
    return _with_rows(Table(path, tuple(table.column_names), rows))


def _text(path: Path, text: str, most_rows: int, names: Sequence[str]) -> Table:
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    kept = [(n, line) for n, line in lines if line.lstrip()[0] not in "#%"]
    if not kept:
        raise IksamplesError(f"{path}: there are only comments.")
    separator = _separator(kept[0][1])
    if not names:
        first, above = lines.index(kept[0]), ""
        if first and _is_numbers(_split(kept[0][1], separator)):
            above = lines[first - 1][1].lstrip("#% \t")  # where numpy.savetxt writes the names
        names_line = above or kept.pop(0)[1]
        separator = _separator(names_line)
        names = [name.strip() for name in _split(names_line, separator)]
        if _is_numbers(names):
            raise IksamplesError(
                f"{path}: no names above the columns; write a first line such as x_mm,y_mm,z_mm,..."
            )
    _require_room(path, len(kept), len(names), most_rows)
    split = [(n, _split(line, separator)) for n, line in kept]
    split = [(n, row) for n, row in split if "".join(row).strip()]  # empty rows of a spreadsheet
    rows = [row for _, row in split]
    if all(len(row) == len(names) + 1 and not row[-1].strip() for row in rows):
        rows = [row[:-1] for row in rows]  # a separator at the end of each row
    table = Table(path, tuple(names), rows, [n for n, _ in split])
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise IksamplesError(
                f"{path}: {table.place(i)} has {len(row)} values, but there are {len(names)} "
                f"names ({', '.join(names)[:80]}). Which value is which cannot be known."
            )
    return _with_rows(table)


def _with_rows(table: Table) -> Table:
    if not table.rows:
        raise IksamplesError(f"{table.path}: there are names but no rows.")
    return table


def _separator(line: str) -> str:
    return next((one for one in ";\t,|" if one in line), " ")


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except csv.Error:  # a field without end
        return [line]


def _is_numbers(cells: Sequence[str]) -> bool:
    return all(
        np.isfinite(_with_comma(cell)) or np.isfinite(_plain(cell)) for cell in cells if cell
    )


def _plain(cell: object) -> float:
    if isinstance(cell, str):
        cell = cell.strip()  # more than float() takes off
        return float(cell) if _NUMBER.fullmatch(cell) else np.nan
    return float(cell) if isinstance(cell, int | float) and not isinstance(cell, bool) else np.nan


def _with_comma(cell: object) -> float:
    return _plain(cell.replace(",", ".", 1) if isinstance(cell, str) else cell)


def _uses_decimal_comma(cells: Sequence[Sequence[object]]) -> bool:
    """Whether commas are decimal: in every number at most one, and not just before thousands."""
    texts = [cell.strip() for row in cells for cell in row if isinstance(cell, str)]
    commas = [text for text in texts if "," in text]
    return (
        bool(commas)
        and all(_DECIMAL_COMMA.fullmatch(text) for text in texts if text)
        and any(len(re.split("[eE]", text.split(",")[1])[0]) != 3 for text in commas)
    )
