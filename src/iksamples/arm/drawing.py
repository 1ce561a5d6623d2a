"""An arm as a URDF with simple bodies, for where a picture is wanted and its file has none."""

import os
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from iksamples.arm.chain import MM_PER_M, Floats, SerialChain, angles_of
from iksamples.arm.load import TABLES
from iksamples.arm.urdf import bodies


def shows_bodies(path: Path) -> bool:
    """Whether an arm's file shows its links: a URDF with bodies, every mesh of which may be opened.

    Args:
        path: The file. Whatever draws it opens its meshes and copies them, so that an arm of
            somebody else's may only name what it came with: files in its own folder or below, or of
            a ROS package where ROS says where packages are.
    """
    if path.suffix.lower() in TABLES:
        return False
    visuals, meshes = bodies(path.read_bytes())
    return visuals > 0 and all(_came_with(path.resolve().parent, mesh) for mesh in meshes)


def _came_with(folder: Path, mesh: str) -> bool:
    if mesh.startswith("package://"):
        in_ros = os.environ.get("ROS_PACKAGE_PATH") or os.environ.get("AMENT_PREFIX_PATH")
        return bool(in_ros) and ".." not in mesh.split("/")
    try:
        file = (folder / mesh).resolve()
        return file.is_relative_to(folder) and file.is_file() and "://" not in mesh
    except (OSError, ValueError):  # too long for a name, a NUL
        return False


def drawn_urdf(chain: SerialChain) -> str:
    """A URDF of a chain: a cylinder along every link and one around every joint.

    Its links are ``base``, ``link1`` to ``linkn`` and ``tool``; at zero, the frames of all but the
    tool are parallel to the base's.

    Args:
        chain: The arm.

    Returns:
        The file's text, which `load_arm` reads as the same chain.
    """
    knots = np.vstack([np.zeros(3), chain.points_mm, chain.tip_mm]) / MM_PER_M
    steps = np.diff(knots, axis=0)
    radius = 0.04 * np.max(np.linalg.norm(steps, axis=1))
    links = ["base", *(f"link{i}" for i in range(1, chain.n_joints + 1)), "tool"]
    parts = ['<robot name="arm">']
    for i, link in enumerate(links[:-1]):
        shown = _cylinder(steps[i], 0.8 * radius, steps[i] / 2)
        if i and chain.joint_kinds[i - 1] == "revolute":
            shown += _cylinder(2.2 * radius * chain.axes[i - 1], radius, np.zeros(3))
        parts.append(f'  <link name="{link}">{shown}</link>')
    parts.append(f'  <link name="{links[-1]}"/>')
    for i, (name, kind, unit) in enumerate(
        zip(chain.joint_names, chain.joint_kinds, chain.joint_units, strict=True)
    ):
        scale = MM_PER_M if unit == "mm" else 1.0
        low, high = float(chain.lower[i]) / scale, float(chain.upper[i]) / scale
        limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
        parts.append(
            f'  <joint name={quoteattr(name)} type="{kind}"><parent link="{links[i]}"/>'
            f'<child link="{links[i + 1]}"/><origin xyz="{numbers(steps[i])}"/>'
            f'<axis xyz="{numbers(chain.axes[i])}"/>{limit}</joint>'
        )
    parts.append(
        f'  <joint name="to_tool" type="fixed"><parent link="{links[-2]}"/>'
        f'<child link="{links[-1]}"/><origin xyz="{numbers(steps[-1])}" '
        f'rpy="{numbers(angles_of(chain.tip_rotation))}"/></joint>'
    )
    return "\n".join([*parts, "</robot>", ""])


def _cylinder(along: Floats, radius: float, centre: Floats) -> str:
    """A body [m] as long as a vector and in its direction; none where that is zero."""
    length = float(np.linalg.norm(along))
    if length < 1e-9:
        return ""
    x, y, z = along / length
    turn = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    return (
        f'<visual><origin xyz="{numbers(centre)}" rpy="{numbers(turn)}"/>'
        f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry></visual>'
    )


def numbers(values: Floats) -> str:
    """Numbers as an attribute of a URDF has them; read back they are the same."""
    return " ".join(str(float(value)) for value in values)
