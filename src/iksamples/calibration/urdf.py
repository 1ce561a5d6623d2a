"""A fitted drawing as the URDF that it was, with other origins; all else in the file stays."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from iksamples.arm.chain import MM_PER_M, Floats, SerialChain, angles_of, assemble
from iksamples.arm.drawing import drawn_urdf, numbers
from iksamples.arm.load import TABLES, load_arm
from iksamples.arm.real import rotation_of
from iksamples.arm.urdf import urdf_joints
from iksamples.calibration.known import Fitted
from iksamples.errors import IksamplesError


AGREES_MM = 1e-6
"""The file read back has the tool within this of the fit [mm]."""
ADDED = "calibrated_tool"
"""Link that is added where no fixed joint of the file can take up the tool's deviation."""
_POSTURES = 200


def fitted_urdf(
    source: Path, fitted: Fitted, base_link: str | None, tip_link: str | None
) -> tuple[str, str | None]:
    """The text of a URDF of a fitted arm, and the link whose frame is the tool's in it.

    Args:
        source: The drawing's file, a URDF or a Denavit-Hartenberg table.
        fitted: What was fitted to it.
        base_link: First link that the drawing was read with; None: its root.
        tip_link: Its tool's link; None: the only end link.

    Raises:
        IksamplesError: The file cannot be written so that it is read as what was fitted.
    """
    if source.suffix.lower() in TABLES:
        return drawn_urdf(fitted.chain), None
    content = source.read_bytes()
    joints = urdf_joints(content, base_link, tip_link)
    chain = assemble(joints)
    root = ET.fromstring(content, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    elements = {str(joint.get("name")).strip(): joint for joint in root.findall("joint")}
    frame, i = np.eye(4), 0
    moves = [_motion(chain, fitted.deviations, k) for k in range(chain.n_joints + 1)]
    for position, joint in enumerate(joints):
        before = joint.before
        if joint.kind != "fixed":
            before = np.linalg.inv(frame) @ moves[i] @ frame @ before
            i += 1
        elif position == len(joints) - 1:
            before = np.linalg.inv(frame) @ moves[-1] @ frame @ before
        if before is not joint.before:
            _set_origin(elements[joint.name], before)
        # The drawing's own frames: a deviation is told in them, not in those already moved.
        frame = frame @ joint.before
    if joints[-1].kind != "fixed":
        child = elements[joints[-1].name].find("child")
        assert child is not None
        tip_link = _add_tool(root, str(child.get("link")), np.linalg.inv(frame) @ moves[-1] @ frame)
    above = content[: content.index(b"<robot")].decode(errors="replace")
    return above + ET.tostring(root, encoding="unicode") + "\n", tip_link


def require_agreement(
    path: Path, fitted: Fitted, base_link: str | None, tip_link: str | None
) -> None:
    """Reads a URDF back and stops where it is not the fitted arm.

    Raises:
        IksamplesError: Somewhere the tools are apart by more than ``AGREES_MM``.
    """
    read, chain = load_arm(path, base_link, tip_link), fitted.chain
    low, high = (np.clip(one, -2 * np.pi, 2 * np.pi) for one in (chain.lower, chain.upper))
    q = np.random.default_rng(0).uniform(low, high, (_POSTURES, chain.n_joints))
    apart = float(np.abs(read.forward_mm(q) - chain.forward_mm(q)).max())
    if apart > AGREES_MM:
        raise IksamplesError(f"{path}: read back, it is {apart:.3g} mm from what was fitted.")


def _motion(chain: SerialChain, deviations: Floats, i: int) -> Floats:
    """A row of deviations as a motion in the base frame, shape (4, 4) [m]."""
    centre = (chain.points_mm[i] if i < chain.n_joints else chain.tip_mm) / MM_PER_M
    motion = np.eye(4)
    motion[:3, :3] = rotation_of(deviations[i, 3:])
    motion[:3, 3] = centre + deviations[i, :3] / MM_PER_M - motion[:3, :3] @ centre
    return motion


def _set_origin(joint: ET.Element, pose: Floats) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = ET.SubElement(joint, "origin")
    origin.set("xyz", numbers(pose[:3, 3]))
    origin.set("rpy", numbers(angles_of(pose[:3, :3])))


def _add_tool(root: ET.Element, parent: str, pose: Floats) -> str:
    taken = {one.get("name") for one in root}
    name = ADDED
    while name in taken or f"to_{name}" in taken:
        name += "_"
    ET.SubElement(root, "link", name=name)
    joint = ET.SubElement(root, "joint", name=f"to_{name}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=name)
    _set_origin(joint, pose)
    return name
