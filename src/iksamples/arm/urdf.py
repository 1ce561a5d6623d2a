"""The chain in a URDF (https://wiki.ros.org/urdf/XML), read strictly where it matters.

Only links, joints and what places them are read; bodies, meshes, transmissions, simulator tags and
namespaces are passed over. XML is parsed by expat without entities, so that no file can make itself
larger than it is.
"""

from dataclasses import dataclass, field
from typing import cast
from xml.parsers import expat

import numpy as np

from iksamples.arm.chain import KINDS, MOST_READ, Floats, Joint, Kind, number, roll_pitch_yaw
from iksamples.errors import IksamplesError, some_of


_DEEPEST = 100


@dataclass
class _Element:
    """An XML element."""

    tag: str
    attributes: dict[str, str]
    children: list["_Element"] = field(default_factory=list)

    def all(self, tag: str) -> list["_Element"]:
        return [child for child in self.children if child.tag == tag]

    def one(self, tag: str, where: str) -> "_Element | None":
        found = self.all(tag)
        if len(found) > 1:
            raise IksamplesError(f"{where} has {len(found)} <{tag}>; keep one.")
        return found[0] if found else None


def urdf_joints(content: bytes, base_link: str | None, tip_link: str | None) -> list[Joint]:
    """The joints between two links of a URDF, from the base on.

    Args:
        content: The file (lengths in metres, angles in radians).
        base_link: First link; None: the root that the tip hangs from.
        tip_link: Link whose frame is the tool's; None: the only end link.

    Raises:
        IksamplesError: What is wrong with the file or the links, and what to do.
    """
    robot = _parse(content)
    if robot.tag != "robot":
        raise IksamplesError(f"a file of <{robot.tag}>, not of <robot>: not a URDF.")
    links = _names(robot, "link")
    if (n := len(robot.all("joint"))) > MOST_READ:
        raise IksamplesError(f"{n} joints; no more than {MOST_READ} are read.")
    joints = dict(zip(_names(robot, "joint"), robot.all("joint"), strict=True))
    if not links:
        macros = [child.tag for child in robot.children if ":" in child.tag]
        raise IksamplesError(
            f"no links, but <{macros[0]}>: expand the xacro first (xacro in > out.urdf)."
            if macros
            else "no links."
        )
    above: dict[str, tuple[str, str]] = {}  # link -> its parent, and the joint between
    for name, joint in joints.items():
        parent, child = (_end(joint, end, name, links) for end in ("parent", "child"))
        if child in above:
            raise IksamplesError(
                f"link '{child}' hangs from joint '{above[child][1]}' and from joint '{name}'; "
                "a URDF is a tree, so cut the loop."
            )
        above[child] = (parent, name)
        mimic = joint.one("mimic", f"joint '{name}'")
        if mimic and mimic.attributes.get("joint") not in joints:
            raise IksamplesError(
                f"joint '{name}' mimics joint '{mimic.attributes.get('joint', '')}', "
                "which does not exist."
            )
    names = _between(links, above, base_link, tip_link)
    return [_joint(name, joints[name]) for name in names]


def bodies(content: bytes) -> tuple[int, list[str]]:
    """How many bodies a URDF's links show, and the mesh files that are named anywhere in it."""
    visuals, meshes, waiting = 0, list[str](), [_parse(content)]
    while waiting:
        element = waiting.pop()
        visuals += element.tag == "visual"
        if element.tag == "mesh":
            meshes.append(element.attributes.get("filename", ""))
        waiting += element.children
    return visuals, meshes


def _parse(content: bytes) -> _Element:
    parser = expat.ParserCreate()
    top = _Element("", {})
    stack = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > _DEEPEST:
            raise IksamplesError(f"elements inside elements over {_DEEPEST} deep: not a URDF.")
        element = _Element(tag, attributes)
        stack[-1].children.append(element)
        stack.append(element)

    def end(tag: str) -> None:
        stack.pop()

    def doctype(name: str, *_: object) -> None:
        raise IksamplesError(
            "a web page, not a URDF; download the file itself."
            if name.lower() == "html"
            else "has a <!DOCTYPE>; a URDF needs none, so delete it."
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content.lstrip(), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last: its encoding
        line = content[: len(content) - len(content.lstrip())].count(b"\n") + parser.ErrorLineNumber
        reason = expat.ErrorString(parser.ErrorCode) if parser.ErrorCode else error
        raise IksamplesError(f"not a valid URDF (line {line}: {reason}).") from None
    return top.children[0]


def _names(robot: _Element, tag: str) -> list[str]:
    names = [element.attributes.get("name", "").strip() for element in robot.all(tag)]
    if "" in names:
        raise IksamplesError(f"<{tag}> number {names.index('') + 1} has no name.")
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise IksamplesError(f"{tag} '{name}' is defined twice; keep one.")
        seen.add(name)
    return names


def _end(joint: _Element, end: str, name: str, links: list[str]) -> str:
    """The link at one end of a joint."""
    element = joint.one(end, f"joint '{name}'")
    link = element.attributes.get("link", "").strip() if element else ""
    if not link:
        raise IksamplesError(f"joint '{name}' names no {end} link.")
    if link not in links:
        raise IksamplesError(f"joint '{name}': its {end} link '{link}' is not defined.")
    return link


def _between(
    links: list[str], above: dict[str, tuple[str, str]], base: str | None, tip: str | None
) -> list[str]:
    """Names of the joints from the base to the tip."""
    for link in (base, tip):
        if link is not None and link not in links:
            raise IksamplesError(f"no link '{link}'; the links are {some_of(links)}.")
    roots = [link for link in links if link not in above]
    if not roots:
        raise IksamplesError("the links go round in a loop; a URDF is a tree, so cut it.")
    if base is None and tip is None and len(roots) > 1:
        raise IksamplesError(
            f"{len(roots)} links hang from no other ({some_of(roots)}); say which is the base "
            "(--base-link, or robot.base_link in a study), or delete the rest."
        )
    if tip is None:
        tip = _only_tip(links, above, base or roots[0])
    names, link, seen = [], tip, {tip}
    while link != base and link in above:
        link, name = above[link]
        names.append(name)
        if link in seen:
            raise IksamplesError(f"link '{link}' hangs from itself: cut the loop.")
        seen.add(link)
    if base is not None and link != base:
        raise IksamplesError(f"link '{tip}' does not hang from link '{base}'.")
    return names[::-1]


def _only_tip(links: list[str], above: dict[str, tuple[str, str]], base: str) -> str:
    """The only end link below the base."""
    below = {base}
    waiting = [base]
    children: dict[str, list[str]] = {}
    for child, (parent, _) in above.items():
        children.setdefault(parent, []).append(child)
    while waiting:
        new = [child for child in children.get(waiting.pop(), []) if child not in below]
        below.update(new)
        waiting += new
    tips = [link for link in links if link in below and link not in children]
    if len(tips) != 1:
        raise IksamplesError(
            f"the arm has {len(tips)} end links ({some_of(tips)}); say which is the tool "
            "(--tip-link, or robot.tip_link in a study)."
        )
    return tips[0]


def _joint(name: str, joint: _Element) -> Joint:
    """A joint of the chain."""
    where = f"joint '{name}'"
    kind = joint.attributes.get("type", "")
    if kind not in KINDS:
        raise IksamplesError(
            f"{where} is {kind or 'of no type'}; between the base and the tool there can be "
            f"{', '.join(KINDS)} joints, so choose another base or tip link, or make it one."
        )
    before = np.eye(4)
    if origin := joint.one("origin", where):
        before[:3, 3] = _vector(origin, "xyz", where, (0.0, 0.0, 0.0))
        before[:3, :3] = roll_pitch_yaw(_vector(origin, "rpy", where, (0.0, 0.0, 0.0)))
    if kind == "fixed":
        return Joint(name, "fixed", before)
    if mimic := joint.one("mimic", where):
        raise IksamplesError(
            f"{where} mimics joint '{mimic.attributes['joint']}'; between the base and the tool "
            "each joint must move by itself."
        )
    axis = np.array([1.0, 0.0, 0.0])
    if (element := joint.one("axis", where)) is not None:
        axis = _vector(element, "xyz", where, None)
        if np.linalg.norm(axis) < 1e-9:
            raise IksamplesError(f"{where}: its axis is zero; give it a direction.")
    return Joint(name, cast(Kind, kind), before, axis, limits=_limits(joint, where))


def _limits(joint: _Element, where: str) -> tuple[float, float] | None:
    """Lower and upper [rad or m]; None where the file gives none."""
    limit = joint.one("limit", where)
    given = {
        name: number(limit.attributes[name], f"{where}: the {name} limit")
        for name in ("lower", "upper")
        if limit and name in limit.attributes
    }
    if len(given) == 1:
        raise IksamplesError(f"{where} has only a {next(iter(given))} limit; give both or none.")
    return (given["lower"], given["upper"]) if given else None


def _vector(
    element: _Element, name: str, where: str, default: tuple[float, float, float] | None
) -> Floats:
    what = f"{where}: the {element.tag}'s {name}"
    text = element.attributes.get(name)
    if text is None:
        if default is None:
            raise IksamplesError(f"{what} is missing; give three numbers.")
        return np.array(default)
    if "," in text and "$" not in text:
        raise IksamplesError(f"{what} is '{text}'; separate its numbers by spaces, not commas.")
    values = np.array([number(part, what) for part in text.split()])
    if len(values) != 3:
        raise IksamplesError(f"{what} is '{text}': {len(values)} numbers instead of 3.")
    return values
