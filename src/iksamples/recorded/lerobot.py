"""A LeRobot data set as records: joint values of its frames, and the drawing's tool if told so.

Versions 2.1 (a file per episode) and 3.0 (many episodes a file). No file says in what unit joint
values are: -100 to 100 over each motor's calibrated range, or degrees from its middle; which of the
two a recorder writes by default has changed. Where the tool was is not recorded either.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.errors import IksamplesError, in_a_line
from iksamples.recorded.doubts import MOST_RAD, first_of_each
from iksamples.recorded.read import ANGLES, Recording, angles_amid
from iksamples.samples.measured import FEWEST, POSITION, plain
from iksamples.samples.table import Table
from iksamples.study import Recorded


MOST = 400
"""Frames that are taken, evenly spread; those between lie too near to tell anything new."""
STATE = "observation.state"
VERSIONS = ("v2.1", "v3.0")
_STOP = 100.0


def is_lerobot(folder: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (folder / "meta" / "info.json").is_file()


def read_lerobot(settings: Recorded, drawing: SerialChain | None) -> Recording:
    """Reads the frames of a data set as records.

    Args:
        settings: Where it is, in which unit its joints are, and whether the tool's poses are
            computed.
        drawing: The arm as drawn.

    Raises:
        IksamplesError: It is no such data set, or it is not said what cannot be known: the arm,
            the joints' unit, and that the tool's poses are to be the drawing's.
    """
    folder = Path(settings.path)
    names, values = _frames(folder)
    if drawing is None:
        raise IksamplesError(f"{folder}: a LeRobot data set; name its arm with --robot.")
    columns = _columns(folder, names, drawing, settings)
    values = values[:, columns]
    stops, unit = bool(np.abs(values).max() == _STOP), settings.joint_unit
    if unit is None:
        hint = ", as values that stop at exactly 100 are" if stops else ""
        raise IksamplesError(
            f"{folder}: no file of a LeRobot data set says the unit of joint values, here from "
            f"{values.min():.4g} to {values.max():.4g}; say --joint-unit deg, rad or range (-100 "
            f"to 100 over the motor's range{hint}), or samples.recorded.joint_unit."
        )
    joints = _in_rad(folder, values, unit, stops, drawing)
    if not settings.tool_from_drawing:
        raise IksamplesError(
            f"{folder}: a LeRobot data set does not say where the tool was. Record that as well; "
            "or --tool-from-drawing (samples.recorded.tool_from_drawing) computes it, and what is "
            "learned is then the drawing, at the postures that were used."
        )
    kept = first_of_each(joints)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, MOST).round().astype(int))]
    if len(kept) < FEWEST:
        raise IksamplesError(
            f"{folder}: {len(kept)} different postures; at least {FEWEST} are needed."
        )
    position, rotation = drawing.pose(joints[kept])
    angles, amid = angles_amid(rotation)
    what = {
        "deg": "degrees from the drawing's zero (the recorder counts from the middle of the range "
        "that each motor was calibrated over)",
        "rad": "radians",
        "range": "-100 to 100 over the drawing's limits (the recorder's are the range that each "
        "motor was calibrated over)",
    }
    return Recording(
        Table(folder, drawing.joint_names, joints[kept].tolist()),
        (*POSITION, *ANGLES),
        np.concatenate([position, angles], axis=1),
        rotation,
        joints[kept],
        drawing.joint_names,
        drawing.joint_units,
        (
            f"{len(kept)} of {len(values)} frames are taken, evenly spread and each posture once; "
            "records near to those held out are still learned from, so that errors are those "
            "between postures of one recording.",
            f"joint values are taken as {what[unit]}.",
            "where the tool was is computed: everything here is the drawing's, not the arm's.",
        ),
        amid,
        of_drawing=True,
    )


def _frames(folder: Path) -> tuple[list[str], Floats]:
    """Names and values of the joints of all frames, in their order."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        info = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
        version, feature = str(info["codebase_version"]), info["features"][STATE]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise IksamplesError(
            f"{folder}: no LeRobot data set whose meta/info.json names {STATE} ({error!r})."
        ) from None
    if version not in VERSIONS:
        raise IksamplesError(
            f"{folder}: a LeRobot data set of version {version}; {' and '.join(VERSIONS)} are read."
        )
    names = feature.get("names") if isinstance(feature, dict) else None
    while isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    files = sorted((folder / "data").rglob("*.parquet"))
    if not isinstance(names, list) or not files:
        raise IksamplesError(
            f"{folder}: {'no frames in data/' if isinstance(names, list) else 'no joint names'}."
        )
    try:
        states = [parquet.read_table(file, columns=[STATE])[STATE].to_numpy() for file in files]
        values = np.stack([row for rows in states for row in rows]).astype(float)
    except (OSError, pa.ArrowException, ValueError, TypeError) as error:
        raise IksamplesError(f"{folder}: its frames cannot be read ({in_a_line(error)}).") from None
    if values.ndim != 2 or values.shape[1] != len(names):
        raise IksamplesError(
            f"{folder}: {len(names)} joint names, but values of shape {values.shape}."
        )
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise IksamplesError(f"{folder}: frame {bad[0]} has a joint value that is no number.")
    return [str(name) for name in names], values


def _columns(folder: Path, names: list[str], drawing: SerialChain, settings: Recorded) -> list[int]:
    """Which value of a frame is each of the drawing's joints."""
    own = [plain(name).removesuffix(".pos").removeprefix("main_") for name in names]
    said: dict[str, Any] = {
        plain(wanted).removeprefix("q_"): name for wanted, name in settings.columns.items()
    }
    found = []
    for joint in drawing.joint_names:
        name = said.get(plain(joint), plain(joint))
        at = [i for i, one in enumerate(names) if name in (one, own[i])]
        if len(at) != 1:
            raise IksamplesError(
                f"{folder}: no joint '{joint}' among {', '.join(names)}; say which it is by "
                f"--column q_{joint}=NAME or samples.recorded.columns."
            )
        found += at
    return found


def _in_rad(folder: Path, values: Floats, unit: str, stops: bool, drawing: SerialChain) -> Floats:
    if unit == "range":
        if np.abs(values).max() > _STOP:
            raise IksamplesError(
                f"{folder}: joint values up to {np.abs(values).max():.4g} are not within -100 to "
                "100; say --joint-unit deg."
            )
        return drawing.lower + (values + _STOP) / (2 * _STOP) * (drawing.upper - drawing.lower)
    if stops:
        raise IksamplesError(
            f"{folder}: joint values stop at exactly 100, as those do that are -100 to 100 over "
            f"the motor's range, and not {unit}; say --joint-unit range."
        )
    joints = np.radians(values) if unit == "deg" else values
    if np.abs(joints).max() > MOST_RAD:
        raise IksamplesError(
            f"{folder}: joint values up to {np.abs(values).max():.4g} are no angles in {unit}."
        )
    return joints
