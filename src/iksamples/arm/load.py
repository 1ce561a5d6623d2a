"""An arm from a file: a URDF, or a table of Denavit-Hartenberg parameters."""

from pathlib import Path

from numpy.typing import ArrayLike

from iksamples.arm.chain import SerialChain
from iksamples.arm.links import assemble
from iksamples.errors import IksamplesError


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
        path: A URDF, or a Denavit-Hartenberg table (``.csv``, ``.yaml`` or ``.yml``; see `arm.dh`).
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
    content = _read(path)
    try:
        if content.lstrip().startswith(b"version https://git-lfs"):
            raise IksamplesError("a pointer of Git LFS, not the file itself; run 'git lfs pull'.")
        if path.suffix.lower() in TABLES:
            from iksamples.arm.dh import dh_joints

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


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise IksamplesError(f"{path}: cannot read the arm ({reason}).") from None
    if len(content) > MOST_BYTES:
        raise IksamplesError(f"{path}: over {MOST_BYTES // 1_000_000} MB is no arm's description.")
    if not content.strip():
        raise IksamplesError(f"{path}: the file is empty.")
    return content
