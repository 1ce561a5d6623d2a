"""What people measured, from their tables: which column is what, and its values in mm and rad."""

import re
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.columns import UNITS
from iksamples.errors import IksamplesError
from iksamples.samples.table import Table


POSITION = ("x", "y", "z")
MOST = 1e12
"""A coordinate or joint value beyond it, in whatever unit, is none."""
FEWEST = 8
"""Records below which nothing can be learned from some and judged by others, and those of a right
unit may fit worse than those of a wrong one."""
_NO_FIT = 0.25
"""Median miss of the model, as a share of how far the records are spread."""
_TINY, _BETTER = 0.7e-6, 0.7
"""A miss that is rounding, and what a column's right unit leaves of a miss at most."""


class Place(NamedTuple):
    """A wanted column: its name without a unit, the unit here, and what a file may call it."""

    wanted: str
    unit: str
    called: Sequence[str]


class _Column(NamedTuple):
    """A column found: its documented name, the unit here, and where it is in what unit."""

    wanted: str
    unit: str
    at: int
    said: str | None


def read_columns(
    table: Table,
    places: Sequence[Place],
    remedy: str = "Name them so; other units go into the names, such as x_m or q1_deg.",
    unsaid: str = "; write it into the names, such as x_mm.",
    *,
    drawing: SerialChain | None = None,
    fewest: int = 1,
    most: float = MOST,
) -> tuple[Floats, Table, str]:
    """The values of wanted columns in mm and rad.

    Units stand in the names (``x_m``, ``yaw [deg]``, ``q1_deg``) or in a row below them. One that
    is not said is that in which the drawing fits.

    Args:
        table: The table.
        places: The wanted columns: with a drawing x, y and z, as far as they are there, before
            all else, and its joints last.
        remedy: What is said to do where one is missing.
        unsaid: What is said where a unit is not, and no drawing tells it.
        drawing: The arm as drawn.
        fewest: Rows needed.
        most: The largest value, by its size.

    Returns:
        The values, shape (rows, places); the table without its row of units; and what was taken
        for a unit that is not said, empty where all are.

    Raises:
        IksamplesError: A column is missing, stands twice, or is in a unit of another kind or in
            none; a cell is no number; rows are too few, or not of this arm in the units that are
            said, or in any.
    """
    columns, table = _found(table, places, remedy)
    names = [table.names[column.at] for column in columns if column.said is None]
    if names and drawing is None:
        raise IksamplesError(f"{table.path}: no unit is said for {', '.join(names)[:200]}{unsaid}")
    values = table.numbers([column.at for column in columns], most)
    if len(values) < fewest:
        raise IksamplesError(f"{table.path}: {len(values)} rows; at least {fewest} are needed.")
    if drawing is None:
        return values * _factors(columns), table, ""
    factors, taken = _fitting(table, columns, values, drawing)
    return values * factors, table, taken


def _found(table: Table, places: Sequence[Place], remedy: str) -> tuple[list[_Column], Table]:
    """Where each wanted column is and in what unit; and the table without its row of units."""
    names, table = with_units(table)
    found, missing = [], []
    for wanted, unit, called in places:
        at = [i for i, (name, _) in enumerate(names) if name in called]
        if len(at) > 1:
            both = " and ".join(table.names[i] for i in at)
            raise IksamplesError(f"{table.path}: the columns {both} mean the same; keep one.")
        if not at:
            missing.append(f"{wanted}_{unit}".rstrip("_"))
            continue
        said = names[at[0]][1]
        if said and said not in UNITS[unit]:
            known = f"is measured in {', '.join(UNITS[unit])}" if unit else "has none"
            raise IksamplesError(
                f"{table.path}: {table.names[at[0]]}: {said} is no unit of {wanted}; it {known}."
            )
        found.append(_Column(f"{wanted}_{unit}", unit, at[0], said if said or not unit else None))
    if missing:
        raise IksamplesError(
            f"{table.path}: no column {', '.join(missing)}; there are "
            f"{', '.join(table.names)[:200]}. {remedy}"
        )
    return found, table


def with_units(table: Table) -> tuple[list[tuple[str, str]], Table]:
    """Name and unit, if any, of each column; and the table without its row of units."""
    names = [name_and_unit(name) for name in table.names]
    below = [str(cell or "").strip().strip("[]()-").lower() for cell in table.rows[0]]
    known = {unit for units in UNITS.values() for unit in units}
    if set(below) - {""} and set(below) <= known:
        names = [(name, said or unit) for (name, said), unit in zip(names, below, strict=True)]
        table = Table(table.path, table.names, table.rows[1:], table.lines[1:])
    return names, table


def joint_places(names: Sequence[str], units: Sequence[str], inputs: Sequence[str]) -> list[Place]:
    """The columns of some joints: ``q_<joint>``, ``q<number>``, or the joint's own name."""
    places = []
    for i, (name, unit) in enumerate(zip(names, units, strict=True), 1):
        own = plain(name)
        called = [f"q_{own}", f"q{i}", f"q_{i}", *([own] if own not in inputs else [])]
        places.append(Place(f"q_{name}", unit, called))
    return places


def name_and_unit(name: str) -> tuple[str, str]:
    """A name in lower case, and the unit in it, if any: ``x_mm``, ``x [mm]``, ``x (mm)``."""
    match = re.fullmatch(
        r"(.*?)[\s_/]*[\[(]\s*(\S+)\s*[\])]|(.*)[\s_/](\S+?)", name.strip().lower()[:500]
    )
    if match:
        base, unit = match[1] or match[3] or "", match[2] or match[4]
        if base and any(unit in units for units in UNITS.values()):
            return plain(base), unit
    return plain(name), ""


def plain(name: str) -> str:
    """A name in lower case, its words joined by underscores."""
    return re.sub(r"[\s_-]+", "_", name.strip().lower())


def _factors(
    columns: Sequence[_Column], mm: str = "mm", rad: str = "rad", believed: bool = True
) -> Floats:
    """What columns are multiplied by: as they say if that is believed, and else from such units."""
    tried = {"mm": mm, "rad": rad, "": ""}
    said = [column.said if believed else None for column in columns]
    units = [tried[c.unit] if one is None else one for c, one in zip(columns, said, strict=True)]
    return np.array([UNITS[c.unit][one] for c, one in zip(columns, units, strict=True)])


def _fitting(
    table: Table, columns: list[_Column], values: Floats, drawing: SerialChain
) -> tuple[Floats, str]:
    """What columns are multiplied by: as they say, else so that the drawing fits; and what is said.

    Raises:
        IksamplesError: The records are not this arm's in the units that are said, or in any.
    """
    axes = [POSITION.index(one.wanted[0]) for one in columns if one.wanted[:-3] in POSITION]

    def miss(factors: Floats) -> float:
        """The median distance from where the drawing puts the tool, as a share of the spread."""
        tried = values * factors
        where = tried[:, : len(axes)]
        middle = where.mean(axis=0)
        spread = float(np.sqrt(np.mean(np.sum((where - middle) ** 2, axis=1))))
        if len(values) < FEWEST:  # they may lie close together, or be a single one
            spread = max(spread, float(np.linalg.norm(middle)) / 2)
        off = drawing.forward_mm(tried[:, -drawing.n_joints :])[:, axes] - where
        return float(np.median(np.linalg.norm(off, axis=1))) / spread if spread else np.inf

    tries = list(product(("mm", "cm", "m"), ("rad", "deg")))
    misses = {one: miss(_factors(columns, *one)) for one in tries}
    best = min(misses, key=misses.__getitem__)
    factors, least = _factors(columns, *best), misses[best]
    if least <= _NO_FIT:
        if len(values) >= FEWEST:
            _require_units_as_said(table, columns, factors, miss, _BETTER * least)
        unsaid = [column for column in columns if column.said is None]
        kinds = [column.unit for column in unsaid]
        units = [one for kind, one in zip(("mm", "rad"), best, strict=True) if kind in kinds]
        names = ", ".join(column.wanted.rsplit("_", 1)[0] for column in unsaid)
        said = f"no unit is said for {names}; taken as {' and '.join(units)}, in which the arm's "
        return factors, f"{said}model fits." if unsaid else ""
    others = {one: miss(_factors(columns, *one, believed=False)) for one in tries}
    right = min(others, key=others.__getitem__)
    hint = "Is it another arm, base, tool or zero of a joint, or a column in another's place?"
    if others[right] <= _NO_FIT:
        turning = (c for c in columns if c.wanted.startswith("q_") and c.unit == "rad")
        angle = next(turning, columns[-1]).wanted.removesuffix("_rad")
        hint = f"In {right[0]} and {right[1]} they would: say so in the names, such as "
        hint += f"x_{right[0]} and {angle}_{right[1]}."
    else:
        _require_units_as_said(table, columns, factors, miss, min(_BETTER * least, _NO_FIT))
    raise IksamplesError(
        f"{table.path}: the joint values do not reach the positions: by the arm's model, half of "
        f"the rows miss by {least * 100:.0f} % of the samples' spread or more. {hint}"
    )


def _require_units_as_said(
    table: Table,
    columns: list[_Column],
    factors: Floats,
    miss: Callable[[Floats], float],
    most: float,
) -> None:
    """Stops where the drawing misses by less with a single column in another unit than it says."""
    for i, column in enumerate(columns):
        for other, factor in UNITS[column.unit].items() if column.said and most > _TINY else ():
            changed = np.where(np.arange(len(columns)) == i, factor, factors)
            if factor != factors[i] and miss(changed) < most:
                raise IksamplesError(
                    f"{table.path}: {table.names[column.at]} is said to be in {column.said}, but "
                    f"by the arm's model it is in {other}. Correct its name or its values."
                )
