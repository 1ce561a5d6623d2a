"""Samples recorded elsewhere, such as on the real arm, read from a file."""

import re
import sys
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.files import require_plain
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import sample_set
from iksamples.samples.table import Table, read_table
from iksamples.study import Study
from iksamples.task import Task


MEASURED = "measured"
"""What the design of such a set is called."""

UNITS = {
    "mm": {"mm": 1.0, "cm": 10.0, "m": 1000.0},
    "rad": {"rad": 1.0, "deg": np.pi / 180, "degrees": np.pi / 180, "°": np.pi / 180},
}
"""Unit here -> units that a name may say, and what a value in it is multiplied by."""

MOST = 1e12
"""A coordinate or joint value beyond it, in whatever unit, is none."""
_MISSED_MM = 1.0
_OTHER_BRANCH_RAD = 0.5
_NO_FIT = 0.25
"""Median miss of the model, as a share of how far the samples are spread."""
_TINY, _BETTER = 1e-6, 0.7
"""A miss that no unit explains, and what a column's right unit leaves of a miss at most."""


class Place(NamedTuple):
    """A wanted column: its name without a unit, the unit here, and what a file may call it."""

    wanted: str
    unit: str
    called: Sequence[str]


class Column(NamedTuple):
    """A column found: its documented name, the unit here, and where it is in what unit."""

    wanted: str
    unit: str
    at: int
    said: str | None


def read_samples(study: Study, task: Task, path: str | Path) -> SampleSet:
    """Samples from a file: a table with a column per coordinate and joint, or one of this package.

    The columns are ``x_mm``, ``y_mm``, ``z_mm`` (the task's inputs) and ``q_<joint>_rad``, in any
    order and either case; other units stand in the names (``x_m``, ``yaw [deg]``, ``q1_deg``) or in
    a row below them. Where no unit is said, the one in which the arm's model fits is taken, and
    said on stderr. Other columns are ignored.

    A real arm is never quite its model, so a row whose joint values do not reach its position is
    kept; it is named on stderr, as are rows on another branch of the inverse kinematics, outside
    the limits, a full turn off, or twice there.

    Args:
        study: The study; its fresh points check the training.
        task: Its task.
        path: The file (``samples.table.read_table``).

    Raises:
        IksamplesError: The file cannot be read, lacks a column, holds something that is not a
            number, too little to span a volume, or samples that are not this arm's.
    """
    if _is_ours(Path(path)):
        samples = SampleSet.load(path)
        if samples.joint_names != task.q.names:
            raise IksamplesError(
                f"{path}: samples of the joints {', '.join(samples.joint_names)}, but the study's "
                f"arm has {', '.join(task.q.names)}. Name the study they were recorded for."
            )
        return samples
    table = read_table(path)
    places = [
        Place(name, unit, [name]) for name, unit in zip(task.x.names, task.x.units, strict=True)
    ]
    places += joint_places(task.q.names, task.q.units, task.x.names)
    columns, table = find_columns(table, places)
    values = table.numbers([column.at for column in columns], MOST)
    if len(values) < 2:
        raise IksamplesError(f"{path}: {len(values)} samples; at least 2 are needed.")
    flat = [
        column.wanted
        for column, extent in zip(columns[: len(task.x)], np.ptp(values, axis=0), strict=False)
        if not extent
    ]
    if flat:
        raise IksamplesError(
            f"{path}: {flat[0]} is the same in every row, so the samples span no volume. "
            "Record some at another place, such as the workspace's corners."
        )
    values, said = in_units(table, columns, values, lambda tried: _miss(task, tried))
    if said:
        print(f"{path}: {said}", file=sys.stderr)
    inputs, joints = values[:, : len(task.x)], values[:, len(task.x) :]
    for line in _doubts(task, table, inputs, joints):
        print(f"{path}: {line}", file=sys.stderr)
    n = len(inputs)
    return sample_set(study, task, f"{MEASURED}{n}", MEASURED, inputs, joints)


def _is_ours(path: Path) -> bool:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        require_plain(path)
        return b"iksamples" in (parquet.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException):
        return False


def find_columns(
    table: Table,
    places: Sequence[Place],
    remedy: str = "Name them so; other units go into the names, such as x_m or q1_deg.",
) -> tuple[list[Column], Table]:
    """Where each wanted column is and in what unit; and the table without its row of units.

    Args:
        table: The table.
        places: The wanted columns.
        remedy: What is said to do where one is missing.

    Raises:
        IksamplesError: One is missing, stands twice, or is said to be in a unit of another kind.
    """
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
        said = names[at[0]][1] or None
        if said and said not in UNITS[unit]:
            raise IksamplesError(
                f"{table.path}: {table.names[at[0]]}: {said} is no unit of {wanted}; "
                f"it is measured in {', '.join(UNITS[unit])}."
            )
        found.append(Column(f"{wanted}_{unit}", unit, at[0], said))
    if missing:
        raise IksamplesError(
            f"{table.path}: no column {', '.join(missing)}; there are "
            f"{', '.join(table.names)[:200]}. {remedy}"
        )
    return found, table


def with_units(table: Table) -> tuple[list[tuple[str, str]], Table]:
    """Name and unit, if any, of each column; and the table without its row of units."""
    names = [name_and_unit(name) for name in table.names]
    below = [str(cell or "").strip().strip("[]()").lower() for cell in table.rows[0]]
    known = {unit for units in UNITS.values() for unit in units}
    if set(below) - {"", "-"} and set(below) <= known | {"", "-"}:
        names = [(name, said or unit) for (name, said), unit in zip(names, below, strict=True)]
        table = Table(table.path, table.names, table.rows[1:], table.lines[1:])
    return names, table


def factors_as_said(table: Table, columns: list[Column], remedy: str) -> Floats:
    """What each column is multiplied by to be in the units here, shape (columns,).

    Args:
        table: Where they are from.
        columns: What they are.
        remedy: What is said where a unit is not.

    Raises:
        IksamplesError: No unit is said for a column.
    """
    unsaid = [table.names[column.at] for column in columns if column.said is None]
    if unsaid:
        raise IksamplesError(f"{table.path}: no unit is said for {', '.join(unsaid)[:200]}{remedy}")
    return np.array([UNITS[column.unit][str(column.said)] for column in columns])


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


def in_units(
    table: Table, columns: list[Column], values: Floats, miss: Callable[[Floats], float]
) -> tuple[Floats, str]:
    """The values in mm and rad: as each column's name says, else as the arm's model says.

    Args:
        table: Where they are from.
        columns: What they are.
        values: As they stand there, shape (rows, columns).
        miss: By how much the model misses values in mm and rad, as a share of their spread.

    Returns:
        The values, and what was taken for a unit that is not said; empty: all are.

    Raises:
        IksamplesError: The samples are not this arm's in the units that are said, or in any.
    """

    def factors(mm: str, rad: str, only_unsaid: bool) -> Floats:
        tried = {"mm": mm, "rad": rad}
        said = [column.said if only_unsaid else None for column in columns]
        return np.array(
            [UNITS[c.unit][one or tried[c.unit]] for c, one in zip(columns, said, strict=True)]
        )

    tries = list(product(("mm", "cm", "m"), ("rad", "deg")))
    misses = {one: miss(values * factors(*one, True)) for one in tries}
    best = min(misses, key=misses.__getitem__)
    unsaid = sorted({column.unit for column in columns if column.said is None})
    if misses[best] <= _NO_FIT:
        _require_units_as_said(table, columns, values * factors(*best, True), miss, np.inf)
        taken = " and ".join(best[0] if unit == "mm" else best[1] for unit in unsaid)
        return values * factors(*best, True), (
            f"no unit is said for {_listed(columns, unsaid)}; taken as {taken}, in which the arm's "
            "model fits."
            if unsaid
            else ""
        )
    others = {one: miss(values * factors(*one, False)) for one in tries}
    right = min(others, key=others.__getitem__)
    angle = next((c for c in columns if c.wanted.startswith("q_") and c.unit == "rad"), columns[-1])
    if others[right] > _NO_FIT:
        _require_units_as_said(table, columns, values * factors(*best, True), miss, _NO_FIT)
    hint = (
        f"In {right[0]} and {right[1]} they would: say so in the names, such as x_{right[0]} and "
        f"{angle.wanted.removesuffix('_rad')}_{right[1]}."
        if others[right] <= _NO_FIT
        else "Is it another arm, base, tool or zero of a joint, or a column in another's place?"
    )
    raise IksamplesError(
        f"{table.path}: the joint values do not reach the positions: by the arm's model, half of "
        f"the rows miss by {misses[best] * 100:.0f} % of the samples' spread or more. {hint}"
    )


def _require_units_as_said(
    table: Table,
    columns: list[Column],
    values: Floats,
    miss: Callable[[Floats], float],
    fits: float,
) -> None:
    """Stops where the model fits much better with a single column in another unit than it says.

    Args:
        table: As ``in_units``.
        columns: Likewise.
        values: In the units that are said.
        miss: Likewise.
        fits: Miss at which the model fits with that unit.

    Raises:
        IksamplesError: Names the column and that unit.
    """
    plain = miss(values)
    for i, column in enumerate(columns):
        if column.said is None or plain <= _TINY:
            continue
        for other, factor in UNITS[column.unit].items():
            ratio = factor / UNITS[column.unit][column.said]
            tried = values.copy()
            tried[:, i] *= ratio
            if ratio != 1 and miss(tried) < min(_BETTER * plain, fits):
                raise IksamplesError(
                    f"{table.path}: {table.names[column.at]} is said to be in {column.said}, but "
                    f"by the arm's model it is in {other}. Correct its name or its values."
                )


def _miss(task: Task, values: Floats) -> float:
    """Median distance from where the model puts the tool, as a share of the samples' spread."""
    inputs, joints = values[:, : len(task.x)], values[:, len(task.x) :]
    lengths = inputs[:, [unit == "mm" for unit in task.x.units]]
    spread = np.sqrt(np.mean(np.sum((lengths - lengths.mean(axis=0)) ** 2, axis=1)))
    missed = task.target.position_error_mm(task.drawing, joints, inputs)
    return float(np.median(missed) / spread)


def _listed(columns: list[Column], units: list[str]) -> str:
    return ", ".join(
        c.wanted.rsplit("_", 1)[0] for c in columns if c.said is None and c.unit in units
    )


def _doubts(task: Task, table: Table, inputs: Floats, joints: Floats) -> list[str]:
    """What is odd about the samples, a line each."""
    chain, n = task.drawing, len(inputs)
    missed = task.target.position_error_mm(chain, joints, inputs)
    expected = task.reach(inputs)
    turn = np.abs(np.angle(np.exp(1j * (joints - expected.joints)[:, chain.revolute])))
    other = (missed <= _MISSED_MM) & expected.in_reach & np.any(turn > _OTHER_BRANCH_RAD, axis=1)
    middle = np.where(np.isfinite(chain.lower + chain.upper), (chain.lower + chain.upper) / 2, 0)
    turned = joints - np.where(
        chain.revolute, 2 * np.pi * np.round((joints - middle) / (2 * np.pi)), 0
    )
    outside = ~chain.within_limits(joints)
    a_turn_off = outside & chain.within_limits(turned)
    _, first, which = np.unique(inputs, axis=0, return_index=True, return_inverse=True)
    earlier = first[which.reshape(-1)]
    again = np.flatnonzero(earlier != np.arange(n))
    lines = []
    far = np.flatnonzero(missed > _MISSED_MM)
    if len(far):
        far = far[np.argsort(-missed[far], kind="stable")]
        lines.append(
            f"{len(far)} of {n} samples are more than {_MISSED_MM:g} mm from where the model of "
            f"the arm puts them, {missed[far[0]]:.1f} mm at most; kept as they are, the farthest "
            f"first: {table.listed(far)}."
        )
    if np.any(other):
        lines.append(
            f"{np.sum(other)} of {n} samples reach their position on another branch than the "
            "study's; a network that learns both branches answers with something between them "
            f"({table.listed(np.flatnonzero(other))})."
        )
    if np.any(a_turn_off):
        lines.append(
            f"{np.sum(a_turn_off)} of {n} samples have a joint full turns beside its limits; a "
            f"network takes that for another place ({table.listed(np.flatnonzero(a_turn_off))})."
        )
    if np.any(outside & ~a_turn_off):
        lines.append(
            f"{np.sum(outside & ~a_turn_off)} of {n} samples are outside the joint limits "
            f"({table.listed(np.flatnonzero(outside & ~a_turn_off))})."
        )
    if len(again):
        lines.append(
            f"{len(again)} of {n} samples repeat the position of an earlier one "
            f"({table.place(int(again[0]))} that of {table.place(int(earlier[again[0]]))})."
        )
    return lines
