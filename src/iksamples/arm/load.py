"""An arm from a file: a URDF (`arm.urdf`), or a table of Denavit-Hartenberg parameters.

The table is YAML or CSV: one row per joint from the base on; a row of kind ``fixed`` places what
moves with the joint before it, such as a flange. Every length and angle carries its unit in its key
or column, and the file says which of the two conventions it means:

* ``standard`` (Spong, Hutchinson and Vidyasagar, *Robot Modeling and Control*, sec. 3.2): a row
  goes from its joint's axis to the next one, ``Rz(theta) Tz(d) Tx(a) Rx(alpha)``.
* ``modified`` (Craig, *Introduction to Robotics*, sec. 3.4): a row goes from the axis before to its
  joint's, ``Rx(alpha) Tx(a) Rz(theta) Tz(d)``.

A joint's value is added to theta, or to d where it is prismatic.
"""

import csv
import io
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import KINDS, MOST_READ, Floats, Joint, Kind, SerialChain, assemble, number
from iksamples.columns import UNITS
from iksamples.errors import IksamplesError
from iksamples.files import read_bytes


_LENGTHS, _ANGLES = ("mm", "m"), ("deg", "rad")
_ALLOWED = {
    "a": _LENGTHS,
    "d": _LENGTHS,
    "alpha": _ANGLES,
    "theta": _ANGLES,
    "lower": (*_LENGTHS, *_ANGLES),
    "upper": (*_LENGTHS, *_ANGLES),
}

EXAMPLE = "name, kind, a_mm, alpha_deg, d_mm, theta_deg, lower_deg, upper_deg"


def dh_joints(path: Path, content: bytes) -> list[Joint]:
    """The joints of a table.

    Args:
        path: Where it was read; ``.csv`` is read as CSV with a first line such as
            ``# convention: modified``, anything else as YAML with ``convention`` and ``joints``.
        content: The file.

    Raises:
        IksamplesError: What is wrong with the table, and what to do.
    """
    convention, rows = _csv(content) if path.suffix.lower() == ".csv" else _yaml(path)
    if convention not in ("standard", "modified"):
        raise IksamplesError(
            "say which convention the table is in: 'convention: standard' or 'convention: "
            f"modified'{f', not {convention!r}' if convention else ''}"
            + (" (as the CSV's first line, after a #)." if path.suffix.lower() == ".csv" else ".")
        )
    if not rows:
        raise IksamplesError("no joints in the table.")
    if len(rows) > MOST_READ:
        raise IksamplesError(f"{len(rows)} joints; no more than {MOST_READ} are read.")
    joints = [_joint(i, row, convention == "modified") for i, row in enumerate(rows, 1)]
    names = [joint.name for joint in joints]
    for name in names:
        if names.count(name) > 1:
            raise IksamplesError(f"joint '{name}' is in the table twice; names must differ.")
    return joints


def _yaml(path: Path) -> tuple[str, list[dict[str, Any]]]:
    from iksamples.study.reading import read_settings

    settings = read_settings(path)
    unknown = settings.keys() - {"convention", "joints"}
    if unknown:
        raise IksamplesError(
            f"unknown key '{min(unknown)}'; a table of Denavit-Hartenberg parameters has "
            "'convention' and 'joints'."
        )
    rows = settings.get("joints")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise IksamplesError(f"'joints' should be a list of rows with the keys {EXAMPLE}.")
    return str(settings.get("convention", "")), rows


def _csv(content: bytes) -> tuple[str, list[dict[str, Any]]]:
    try:
        lines = [line.strip() for line in content.decode("utf-8-sig").splitlines()]
    except UnicodeDecodeError:
        raise IksamplesError("not a text file in UTF-8.") from None
    notes = [line[1:].partition(":") for line in lines if line.startswith("#")]
    said = [value.strip() for key, _, value in notes if key.strip().lower() == "convention"]
    table = [line for line in lines if line and not line.startswith("#")]
    reader = csv.reader(io.StringIO("\n".join(table)), skipinitialspace=True)
    header, *body = [[cell.strip() for cell in row] for row in reader] or [[]]
    if len(set(header)) != len(header):
        raise IksamplesError("a column's name stands twice in the header.")
    for i, row in enumerate(body, 1):
        if len(row) != len(header):
            raise IksamplesError(
                f"row {i} has {len(row)} values, the header {len(header)} names ({EXAMPLE})."
            )
    rows = [{k: v for k, v in zip(header, row, strict=True) if v} for row in body]
    return (said[0] if len(said) == 1 else ""), rows


def _joint(number_of: int, row: dict[str, Any], modified: bool) -> Joint:
    name = str(row.get("name") or f"joint{number_of}")
    where = f"joint '{name}'"
    kind = row.get("kind") or "revolute"
    if kind not in KINDS:
        raise IksamplesError(f"{where}: kind is '{kind}'; say one of {', '.join(KINDS)}.")
    kind = cast(Kind, kind)
    values: dict[str, float] = {}
    for key, value in row.items():
        if key in ("name", "kind"):
            continue
        quantity, _, unit = key.rpartition("_")
        if unit not in _ALLOWED.get(quantity, ()):
            raise IksamplesError(f"{where}: '{key}' is no value with its unit, such as {EXAMPLE}.")
        if quantity in values:
            raise IksamplesError(f"{where}: {quantity} is given in two units; keep one.")
        if quantity in ("lower", "upper"):
            _check_limit(kind, key, unit, where)
        if isinstance(value, bool):
            raise IksamplesError(f"{where}: {key} is {value}, not a number.")
        known = UNITS["mm" if unit in _LENGTHS else "rad"]
        factor = known[unit] / known.get("m", 1)  # metres, or rad
        values[quantity] = number(str(value), f"{where}: {key}") * factor
    if len(values.keys() & {"lower", "upper"}) == 1:
        raise IksamplesError(f"{where} has only one limit; give both or none.")
    limits = (values["lower"], values["upper"]) if "lower" in values else None
    across = _turn(values.get("alpha", 0.0), 0) @ _shift(values.get("a", 0.0), 0)
    along = _turn(values.get("theta", 0.0), 2) @ _shift(values.get("d", 0.0), 2)
    axis = np.array([0.0, 0.0, 1.0])
    if modified:
        return Joint(name, kind, across, axis, along, limits)
    return Joint(name, kind, np.eye(4), axis, along @ across, limits)


def _check_limit(kind: str, key: str, unit: str, where: str) -> None:
    if kind not in ("revolute", "prismatic"):
        raise IksamplesError(f"{where} is {kind} and has no limits; leave {key} out.")
    if (unit in _LENGTHS) != (kind == "prismatic"):
        raise IksamplesError(f"{where} is {kind}: its limit cannot be {key}.")


def _turn(angle: float, axis: int) -> Floats:
    matrix = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _shift(length_m: float, axis: int) -> Floats:
    matrix = np.eye(4)
    matrix[axis, 3] = length_m
    return matrix


MOST_BYTES = 10_000_000
TABLES = (".csv", ".yaml", ".yml")
"""How the name of a Denavit-Hartenberg table ends."""


def load_arm(
    path: str | Path,
    base_link: str | None = None,
    tip_link: str | None = None,
    tool_offset_mm: ArrayLike = (0.0, 0.0, 0.0),
) -> SerialChain:
    """Reads an arm.

    Args:
        path: A URDF, or a Denavit-Hartenberg table (``.csv``, ``.yaml`` or ``.yml``).
        base_link: First link of a URDF; None: its root link.
        tip_link: Link of a URDF whose frame is the tool's; None: its only end link.
        tool_offset_mm: Tool centre point in that frame [mm], shape (3,).

    Returns:
        The chain, with lengths in millimetres. A continuous joint has the limits -pi and pi, a
        joint without limits infinite ones.

    Raises:
        IksamplesError: One line that says what is wrong with the file, and what to do.
    """
    path = Path(path)
    content = read_bytes(path, MOST_BYTES, "the arm")
    if not content.strip():
        raise IksamplesError(f"{path}: the file is empty.")
    try:
        if content.lstrip().startswith(b"version https://git-lfs"):
            raise IksamplesError("a pointer of Git LFS, not the file itself; run 'git lfs pull'.")
        if path.suffix.lower() in TABLES:
            if base_link or tip_link:
                raise IksamplesError(
                    "a Denavit-Hartenberg table has no links; leave the base and tip link out."
                )
            joints = dh_joints(path, content)
        else:
            from iksamples.arm.urdf import urdf_joints

            joints = urdf_joints(content, base_link, tip_link)
        return assemble(joints).with_tool(tool_offset_mm)
    except IksamplesError as error:
        message = str(error)
        raise IksamplesError(
            message if message.startswith(f"{path}:") else f"{path}: {message}"
        ) from None
