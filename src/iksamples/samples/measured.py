"""Samples recorded elsewhere, such as on the real arm, read from a file."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import sample_set
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd

MEASURED = "measured"
"""What the design of such a set is called."""

_MISSED_MM = 1.0
_OTHER_BRANCH_RAD = 0.5


def read_samples(study: Study, task: Task, path: str | Path) -> SampleSet:
    """Samples from a file: CSV by its name's end, else a Parquet file of this package.

    Raises:
        IksamplesError: As ``read_samples_csv``, or the samples are another arm's.
    """
    if Path(path).suffix.lower() == ".csv":
        return read_samples_csv(study, task, path)
    samples = SampleSet.load(path)
    if samples.joint_names != task.q.names:
        raise IksamplesError(
            f"{path}: samples of the joints {', '.join(samples.joint_names)}, but the study's arm "
            f"has {', '.join(task.q.names)}. Name the study they were recorded for."
        )
    return samples


def read_samples_csv(study: Study, task: Task, path: str | Path) -> SampleSet:
    """Samples from a CSV file with columns ``x_mm``, ``y_mm``, ``z_mm`` and ``q_<joint>_rad``.

    A real arm is never quite its model, so a row whose joint values do not reach its position is
    kept; how many there are is said on stderr, and how many lie on another branch of the inverse
    kinematics than the study's. Other columns are ignored.

    Args:
        study: The study; its fresh points check the training.
        task: Its task.
        path: The file.

    Raises:
        IksamplesError: The file cannot be read, lacks a column, holds something that is not a
            number, or too little to span a volume.
    """
    positions, joints = _numbers(path, task)
    if len(positions) < 2:
        raise IksamplesError(f"{path}: {len(positions)} samples; at least 2 are needed.")
    flat = [
        column
        for column, extent in zip(task.x.columns(), np.ptp(positions, axis=0), strict=True)
        if not extent
    ]
    if flat:
        raise IksamplesError(
            f"{path}: {flat[0]} is the same in every row, so the samples span no volume. "
            "Record some at another place, such as the workspace's corners."
        )
    for line in _doubts(task, positions, joints):
        print(f"{path}: {line}", file=sys.stderr)
    n = len(positions)
    return sample_set(study, task, f"{MEASURED}{n}", MEASURED, positions, joints)


def _numbers(path: str | Path, task: Task) -> tuple[Floats, Floats]:
    """Positions [mm] and joint values [rad or mm] of every row, all finite."""
    import pandas as pd

    wanted = task.x.columns() + task.q.columns("q_")
    try:
        # As text, so that a word among the numbers can be named.
        table = pd.read_csv(path, dtype=str, skipinitialspace=True, encoding="utf-8-sig")
    except OSError as error:
        raise IksamplesError(f"{path}: cannot read the samples ({error.strerror}).") from None
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise IksamplesError(f"{path}: not a CSV file ({reason}).") from None
    table.columns = [str(name).strip() for name in table.columns]
    missing = [name for name in wanted if name not in table]
    if missing:
        raise IksamplesError(
            f"{path}: no column {', '.join(missing)}; there are {', '.join(table.columns)}. "
            "Positions are in mm and joint angles in rad, as the names say."
        )
    numbers = table[wanted].apply(pd.to_numeric, errors="coerce").to_numpy(float)
    bad = np.argwhere(~np.isfinite(numbers))
    if len(bad):
        raise IksamplesError(_not_a_number(path, table, wanted, bad))
    return numbers[:, : len(task.x)], numbers[:, len(task.x) :]


def _not_a_number(
    path: str | Path, table: "pd.DataFrame", wanted: list[str], bad: np.ndarray
) -> str:
    row, column = (int(i) for i in bad[0])
    value = table[wanted[column]].iloc[row]
    found = f"'{value}'" if isinstance(value, str) else "nothing"
    more = f" ({len(bad)} such cells in all)" if len(bad) > 1 else ""
    return (
        f"{path}: sample {row + 1} has {found} as {wanted[column]}, which is no number{more}. "
        "Correct or remove the row."
    )


def _doubts(task: Task, positions: Floats, joints: Floats) -> list[str]:
    """What is odd about the samples, a line each."""
    chain = task.arm
    missed = task.target.position_error_mm(chain, joints, positions)
    expected = task.reach(positions)
    revolute = np.array([kind == "revolute" for kind in chain.joint_kinds])
    turn = np.abs(np.angle(np.exp(1j * (joints - expected.joints)[:, revolute])))
    other = (missed <= _MISSED_MM) & expected.in_reach & np.any(turn > _OTHER_BRANCH_RAD, axis=1)
    outside = ~chain.within_limits(joints)
    lines = []
    if np.any(missed > _MISSED_MM):
        worst = int(np.argmax(missed))
        lines.append(
            f"{np.sum(missed > _MISSED_MM)} of {len(positions)} samples are more than "
            f"{_MISSED_MM:g} mm from where the model of the arm puts them "
            f"(sample {worst + 1}: {missed[worst]:.1f} mm); kept as they are."
            + (" Are they in mm and rad?" if np.mean(missed > _MISSED_MM) > 0.5 else "")
        )
    if np.any(other):
        lines.append(
            f"{np.sum(other)} of {len(positions)} samples reach their position on another branch "
            f"than the study's (sample {np.argmax(other) + 1}); a network that learns both "
            "branches answers with something between them."
        )
    if np.any(outside):
        lines.append(
            f"{np.sum(outside)} of {len(positions)} samples are outside the joint limits "
            f"(sample {np.argmax(outside) + 1})."
        )
    return lines
