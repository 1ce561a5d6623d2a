"""Records of a real arm: where its tool was measured to be, and what its joints read there."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain, Unit, angles_of, roll_pitch_yaw
from iksamples.errors import IksamplesError
from iksamples.samples.measured import (
    MOST,
    UNITS,
    Place,
    factors_as_said,
    find_columns,
    in_units,
    joint_places,
    name_and_unit,
)
from iksamples.samples.table import Table, read_table


FEWEST = 8
"""Records below which nothing can be learned from some and judged by others."""
_POSITION, _ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
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
        position_mm: Measured positions in the base frame [mm], shape (n, 3); NaN for a coordinate
            that was not measured.
        rotation: Measured rotations of the tool, shape (n, 3, 3); None: positions alone.
        joints: Joint values [rad or mm], shape (n, joints).
        joint_names: One name per joint.
        joint_units: ``"rad"`` or ``"mm"``, one per joint.
        remarks: What was taken for what, a sentence each.
        reference: The rotation from which a record's angles are told, shape (3, 3).
        of_drawing: Positions are not measured but the drawing's.
    """

    table: Table
    position_mm: Floats
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
        return np.flatnonzero(np.isfinite(self.position_mm).all(axis=0)).tolist()

    @property
    def revolute(self) -> NDArray[np.bool_]:
        """Which joints turn, shape (joints,); the others slide."""
        return np.array(self.joint_units) == "rad"

    @property
    def inputs(self) -> tuple[str, ...]:
        """The coordinates that were measured, as a study names its inputs."""
        found = [_POSITION[i] for i in self.positions]
        return (*found, *(_ANGLES if self.rotation is not None else ()))

    @property
    def x(self) -> Floats:
        """The measured coordinates [mm or rad], shape (n, inputs)."""
        positions = self.position_mm[:, self.positions]
        if self.rotation is None:
            return positions
        angles = [angles_of(one @ self.reference.T) for one in self.rotation]
        return np.concatenate([positions, angles], axis=1)

    def select(self, rows: NDArray[Any]) -> "Recording":
        """Some of the records, by their index or by whether each is kept."""
        lines = np.array(self.table.lines)[rows].tolist() if self.table.lines else ()
        cells = [self.table.rows[i] for i in np.arange(len(self))[rows]]
        return replace(
            self,
            table=Table(self.table.path, self.table.names, cells, lines),
            position_mm=self.position_mm[rows],
            rotation=None if self.rotation is None else self.rotation[rows],
            joints=self.joints[rows],
        )


def read_recording(
    path: str | Path,
    drawing: SerialChain | None,
    columns: Mapping[str, str] | None = None,
    fewest: int = FEWEST,
) -> Recording:
    """Reads a table of records: columns x, y, perhaps z, perhaps an orientation, and the joints.

    Units stand in the names (``x_mm``, ``q1_deg``) or in a row below them. Where one does not, it
    is the one in which the drawing fits, and a remark says so; without a drawing it has to be said.
    An orientation is ``roll, pitch, yaw`` as in a URDF or a quaternion ``qx, qy, qz, qw``.

    Args:
        path: The file (``samples.table.read_table``).
        drawing: The arm as drawn, whose joints are looked for; None: every column that is named
            like a joint (``q1``, ``joint_3``, ``q_elbow``) is one.
        columns: What columns are whose names do not say it: ``x_mm`` -> ``tcp x``.
        fewest: Records needed.

    Raises:
        IksamplesError: The file cannot be read, lacks a column or a unit, holds something that is
            no number, or no records of this arm.
    """
    table = _renamed(read_table(path), columns or {})
    names = {name_and_unit(name)[0] for name in table.names}
    position = [name for name in _POSITION if name in names or name != "z"]
    turned = next((some for some in (_ANGLES, _QUATERNION) if names >= set(some)), ())
    places = [Place(name, "mm", [name]) for name in position]
    if turned == _ANGLES:
        places += [Place(name, "rad", [name]) for name in turned]
    joints = _joint_places(table, drawing, turned)
    found, table = find_columns(table, places + joints, _REMEDY)
    n_inputs = len(places)
    raw = table.numbers([column.at for column in found], MOST)
    if len(raw) < fewest:
        raise IksamplesError(
            f"{path}: {len(raw)} records; at least {fewest} are needed to learn from some and "
            "judge by others."
        )
    said = ""
    if drawing is None:
        values = raw * factors_as_said(table, found, _NO_UNIT)
    else:
        at = [_POSITION.index(name) for name in position]

        def miss(tried: Floats) -> float:
            where = tried[:, : len(at)]
            spread = np.sqrt(np.mean(np.sum((where - where.mean(axis=0)) ** 2, axis=1)))
            off = drawing.forward_mm(tried[:, n_inputs:])[:, at] - where
            middle = float(np.median(np.linalg.norm(off, axis=1)))
            return middle / spread if spread else np.inf

        values, said = in_units(table, found, raw, miss)
    measured = np.full((len(values), 3), np.nan)
    measured[:, [_POSITION.index(name) for name in position]] = values[:, : len(position)]
    rotation = None
    if turned == _ANGLES:
        rotation = roll_pitch_yaw(values[:, len(position) : n_inputs])
    elif turned:
        rotation = _of_quaternions(table)
    joint_columns = found[n_inputs:]
    names_of = [column.wanted.removeprefix("q_").rsplit("_", 1)[0] for column in joint_columns]
    return Recording(
        table,
        measured,
        rotation,
        values[:, n_inputs:],
        drawing.joint_names if drawing else tuple(names_of),
        tuple("mm" if column.unit == "mm" else "rad" for column in joint_columns),
        (said,) if said else (),
        np.eye(3) if rotation is None else middle(rotation),
    )


def middle(rotations: Floats) -> Floats:
    """The rotation amid some, from which angles are small."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())


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


def _joint_places(
    table: Table, drawing: SerialChain | None, turned: tuple[str, ...]
) -> list[Place]:
    """The columns of the joints: the drawing's, or all that are named like one."""
    if drawing is not None:
        return joint_places(drawing.joint_names, drawing.joint_units, (*_POSITION, *turned))
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
