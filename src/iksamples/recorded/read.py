"""Records of a real arm: where its tool was measured to be, and what its joints read there."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain, Unit, angles_of, roll_pitch_yaw
from iksamples.columns import UNITS
from iksamples.errors import IksamplesError
from iksamples.samples.measured import (
    FEWEST,
    MOST,
    POSITION,
    Place,
    joint_places,
    name_and_unit,
    read_columns,
)
from iksamples.samples.table import Table, read_table


ANGLES = ("roll", "pitch", "yaw")
_MOST_RECORDS = 100_000  # as of samples; a fit holds some 12 kB of each, of seven joints
_QUATERNION = ("qx", "qy", "qz", "qw")
_JOINT = re.compile(r"(?:q|joint|j)_?\d+|q_\w+|joint_\w+")
_UNIT_LENGTH = 0.01
_REMEDY = (
    "Name them so (x_m, q1_deg in other units), or say which they are by --column x_mm=NAME or "
    "samples.recorded.columns."
)
_NO_UNIT = (
    ", and without a drawing of the arm (--robot) it cannot be known. Write it into the names, "
    "such as x_mm and q1_deg."
)


@dataclass(frozen=True, eq=False)
class Recording:
    """Records, each a posture and where the tool was then.

    Attributes:
        table: Where they were read; it knows each record's row.
        inputs: The coordinates that were measured, as a study names its inputs: positions first.
        x: These in the base frame [mm or rad], shape (n, inputs).
        rotation: Measured rotations of the tool, shape (n, 3, 3); None: positions, or the angles
            that a task asks for.
        joints: Joint values [rad or mm], shape (n, joints).
        joint_names: One name per joint.
        joint_units: ``"rad"`` or ``"mm"``, one per joint.
        remarks: What was taken for what, a sentence each.
        reference: The rotation from which a record's angles are told, shape (3, 3).
        of_drawing: Positions are not measured but the drawing's.
    """

    table: Table
    inputs: tuple[str, ...]
    x: Floats
    rotation: Floats | None
    joints: Floats
    joint_names: tuple[str, ...]
    joint_units: tuple[Unit, ...]
    remarks: tuple[str, ...] = ()
    reference: Floats = field(default_factory=lambda: np.eye(3))
    of_drawing: bool = False

    def __len__(self) -> int:
        """Number of records."""
        return len(self.joints)

    @property
    def positions(self) -> list[int]:
        """Which of x, y and z (as 0, 1, 2) were measured."""
        return [POSITION.index(name) for name in self.inputs if name in POSITION]

    @property
    def where_mm(self) -> Floats:
        """These positions [mm], shape (n, positions)."""
        return self.x[:, : len(self.positions)]

    @property
    def position_mm(self) -> Floats:
        """All three [mm], shape (n, 3); NaN for one that was not measured."""
        found = np.full((len(self), 3), np.nan)
        found[:, self.positions] = self.where_mm
        return found

    @property
    def revolute(self) -> NDArray[np.bool_]:
        """Which joints turn, shape (joints,); the others slide."""
        return np.array(self.joint_units) == "rad"

    def select(self, rows: NDArray[Any]) -> "Recording":
        """Some of the records, by their index or by whether each is kept."""
        lines = np.array(self.table.lines)[rows].tolist() if self.table.lines else ()
        cells = [self.table.rows[i] for i in np.arange(len(self))[rows]]
        return replace(
            self,
            table=Table(self.table.path, self.table.names, cells, lines),
            x=self.x[rows],
            rotation=None if self.rotation is None else self.rotation[rows],
            joints=self.joints[rows],
        )


def read_recording(
    path: str | Path,
    drawing: SerialChain | None,
    columns: Mapping[str, str] | None = None,
    fewest: int = FEWEST,
    inputs: Sequence[str] = (),
) -> Recording:
    """Reads a table of records: columns x, y, perhaps z, perhaps an orientation, and the joints.

    Units are as ``samples.measured.read_columns`` finds them; a remark says what was taken for one.
    An orientation is ``roll, pitch, yaw`` as in a URDF or a quaternion ``qx, qy, qz, qw``.

    Args:
        path: The file (``samples.table.read_table``).
        drawing: The arm as drawn, whose joints are looked for; None: every column that is named
            like a joint (``q1``, ``joint_3``, ``q_elbow``) is one.
        columns: What columns are whose names do not say it: ``x_mm`` -> ``tcp x``.
        fewest: Records needed.
        inputs: What a task asks of the tool, to be read as it is; empty: whatever is there.

    Raises:
        IksamplesError: The file cannot be read, lacks a column or a unit, holds something that is
            no number, or no records of this arm.
    """
    table = _renamed(read_table(path, _MOST_RECORDS), columns or {})
    names = {name_and_unit(name)[0] for name in table.names}
    turned = next((some for some in (ANGLES, _QUATERNION) if names >= set(some)), ())
    found = inputs or [*("xyz" if "z" in names else "xy"), *(ANGLES if turned == ANGLES else ())]
    places = [Place(name, "mm" if name in POSITION else "rad", [name]) for name in found]
    joints = _joint_places(table, drawing, (*POSITION, *(inputs or turned)))
    values, table, said = read_columns(
        table, [*places, *joints], _REMEDY, _NO_UNIT, drawing=drawing, fewest=fewest
    )
    x, rotation, reference = values[:, : len(places)], None, np.eye(3)
    if turned and not inputs:
        n = len([name for name in found if name in POSITION])
        rotation = roll_pitch_yaw(x[:, n:]) if turned == ANGLES else _of_quaternions(table)
        angles, reference = angles_amid(rotation)
        found, x = [*found[:n], *ANGLES], np.concatenate([x[:, :n], angles], axis=1)
    return Recording(
        table,
        tuple(found),
        x,
        rotation,
        values[:, len(places) :],
        drawing.joint_names if drawing else tuple(one.wanted.removeprefix("q_") for one in joints),
        tuple("mm" if one.unit == "mm" else "rad" for one in joints),
        (said,) if said else (),
        reference,
    )


def angles_amid(rotations: Floats) -> tuple[Floats, Floats]:
    """Roll, pitch and yaw from the rotation amid some, where they are small; and that rotation.

    Returns:
        Angles [rad], shape (n, 3), and a rotation, shape (3, 3).
    """
    from scipy.spatial.transform import Rotation

    amid = np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())
    return np.array([angles_of(one @ amid.T) for one in rotations]), amid


def _renamed(table: Table, columns: Mapping[str, str]) -> Table:
    """The table with some columns called what they are said to be."""
    names = list(table.names)
    for wanted, own in columns.items():
        at = [i for i, name in enumerate(table.names) if name.strip() == own.strip()]
        if len(at) != 1:
            raise IksamplesError(
                f"{table.path}: columns.{wanted}: {'no' if not at else 'more than one'} column "
                f"'{own}'; there are {', '.join(table.names)[:200]}."
            )
        base = name_and_unit(wanted)[0]
        names = ["" if name_and_unit(name)[0] == base else name for name in names]
        names[at[0]] = wanted
    return Table(table.path, tuple(names), table.rows, table.lines)


def _joint_places(table: Table, drawing: SerialChain | None, inputs: Sequence[str]) -> list[Place]:
    """The columns of the joints: the drawing's, or all that are named like one."""
    if drawing is not None:
        return joint_places(drawing.joint_names, drawing.joint_units, inputs)
    found = []
    for name in table.names:
        plain, said = name_and_unit(name)
        if _JOINT.fullmatch(plain) and plain not in _QUATERNION:
            unit = "mm" if said in UNITS["mm"] else "rad"
            found.append(Place(f"q_{plain.removeprefix('q_')}", unit, [plain]))
    if not found:
        raise IksamplesError(
            f"{table.path}: no column is named like a joint (q1_deg, q_elbow_rad, joint_3_deg); "
            f"there are {', '.join(table.names)[:200]}. Say which they are, by "
            "--column q1_deg=NAME or samples.recorded.columns."
        )
    return found


def _of_quaternions(table: Table) -> Floats:
    """Rotations from the columns qx, qy, qz and qw, shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    names = [name_and_unit(name)[0] for name in table.names]
    values = table.numbers([names.index(name) for name in _QUATERNION], MOST)
    wrong = np.flatnonzero(np.abs(np.linalg.norm(values, axis=1) - 1) > _UNIT_LENGTH)
    if len(wrong):
        raise IksamplesError(
            f"{table.path}: {table.place(int(wrong[0]))} has a quaternion that is none (its length "
            "is not 1)."
        )
    return Rotation.from_quat(values).as_matrix()
