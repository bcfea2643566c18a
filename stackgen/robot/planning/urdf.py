"""The arm's URDF: the chain from its base to its flange, its collision pairs, and the same arm with jaws on its flange.

Lengths in metres, angles in radians.
"""

from __future__ import annotations

import math
from importlib.metadata import PackageNotFoundError, distribution
from itertools import combinations, pairwise
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from stackgen.errors import StackgenError
from stackgen.robot.workcell import ArmDescription, Jaws

PALM, FINGERS, FINGER_JOINTS = "palm", ("left_finger", "right_finger"), ("left_jaw", "right_jaw")

_PACKAGE = "example-robot-data"


def arm_file(name: str) -> Path:
    """Find a file of an arm's description.

    Args:
        name: A path, or `package://example-robot-data/...`.

    Raises:
        StackgenError: If there is no such file, or the package is not installed.
    """
    path = Path(name).expanduser()
    if name.startswith(f"package://{_PACKAGE}/"):
        try:
            share = distribution(_PACKAGE).locate_file("cmeel.prefix/share")
        except PackageNotFoundError:
            raise StackgenError(f"this needs the package {_PACKAGE!r}: pip install 'stackgen[robot]'") from None
        path = Path(str(share)) / name.removeprefix("package://")
    if not path.is_file():
        raise StackgenError(f"cell.arm: {path} does not exist; name a URDF and an SRDF file")
    return path


def chain_urdf(arm: ArmDescription) -> Element:
    """Read the part of a URDF between an arm's base and its flange; what hangs beside or beyond is left out.

    Joints without limits turn by two turns; meshes get their full paths.

    Raises:
        StackgenError: If there is no such chain, a joint of it does not turn, or a mesh is missing.
    """
    file = arm_file(arm.urdf)
    root = _parsed(file, "URDF")
    above = {_named(joint, "child", "link"): joint for joint in root.iter("joint") if joint.find("child") is not None}
    joints, links = [], [arm.flange]
    while links[-1] != arm.base:
        joint = above.pop(links[-1], None)  # so that a circle ends, too
        if joint is None:
            raise StackgenError(
                f"{file}: no chain leads from {arm.base} to {arm.flange} (cell.arm.base, cell.arm.flange)"
            )
        joints.append(joint)
        links.append(_named(joint, "parent", "link"))
    kinds = {joint.get("type") for joint in joints}
    if not kinds <= {"revolute", "continuous", "fixed"} or kinds <= {"fixed"}:
        raise StackgenError(
            f"{file}: the joints from {arm.base} to {arm.flange} must be revolute, got {sorted(map(str, kinds))}"
        )
    missing = set(links) - {link.get("name", "") for link in root.iter("link")}
    if missing:
        raise StackgenError(f"{file}: the chain has no link {', '.join(sorted(missing))}")
    for part in list(root):
        if part.tag != "material" and part not in joints and not (part.tag == "link" and part.get("name") in links):
            root.remove(part)
    for joint in joints:
        limit = joint.find("limit")
        if joint.get("type") == "continuous" or (joint.get("type") == "revolute" and limit is None):
            joint.set("type", "revolute")
            limit = SubElement(joint, "limit", effort="100", velocity="3") if limit is None else limit
            limit.set("lower", f"{-2 * math.pi}")
            limit.set("upper", f"{2 * math.pi}")
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(_mesh_file(mesh.get("filename", ""), file)))
    return root


def _parsed(file: Path, what: str) -> Element:
    try:
        return ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise StackgenError(f"{file}: is no {what}: {error}") from error


def _mesh_file(name: str, urdf: Path) -> Path:
    """Find a mesh of the package, beside its URDF, or in a ROS package that one of the URDF's folders is or holds."""
    if name.startswith(f"package://{_PACKAGE}/"):
        return arm_file(name)
    relative = name.removeprefix("package://").removeprefix("file://")
    for folder in urdf.absolute().parents:
        if (folder / relative).is_file():
            return folder / relative
    raise StackgenError(f"{urdf}: the mesh {name} is not there; put its package beside the URDF or above it")


def unusable(arm: ArmDescription, error: Exception) -> StackgenError:
    """Make the line about a chain that a reader of URDFs refuses."""
    reason = " ".join(str(error).split())
    return StackgenError(f"{arm_file(arm.urdf)}: the chain from {arm.base} to {arm.flange} cannot be read: {reason}")


def chain_links(arm: ArmDescription) -> tuple[str, ...]:
    """Names of the links that a joint of the arm moves, after that of its base.

    >>> chain_links(ArmDescription())[:3]
    ('base_link', 'shoulder_link', 'upper_arm_link')
    """
    moved = {_named(j, "parent", "link"): j for j in chain_urdf(arm).iter("joint")}
    links, link = [arm.base], arm.base
    while link in moved:
        joint = moved[link]
        link = _named(joint, "child", "link")
        if joint.get("type") != "fixed":
            links.append(link)
    return tuple(links)


def self_collision_pairs(arm: ArmDescription) -> list[tuple[str, str]]:
    """Pairs of links that must not touch; the jaws are a part of the last link.

    >>> [other for link, other in self_collision_pairs(ArmDescription()) if link == "base_link"][:2]
    ['forearm_link', 'wrist_1_link']
    """
    links = chain_links(arm)
    harmless = {frozenset(pair) for pair in pairwise(links)}
    if arm.srdf:
        named = _parsed(arm_file(arm.srdf), "SRDF").iter("disable_collisions")
        harmless |= {frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in named}
    tool = [(link, part) for link in links[:4] for part in (PALM, *FINGERS)]
    return [pair for pair in combinations(links, 2) if frozenset(pair) not in harmless] + tool


def with_jaws(arm: ArmDescription, jaws: Jaws, visual: bool = True) -> str:
    """Mount parallel jaws on an arm's flange, in the text of its URDF.

    The palm is a box that starts at the flange; the fingers are boxes that slide along the flange's y axis,
    each by half of the opening.

    Args:
        arm: Description of the arm.
        jaws: Their sizes.
        visual: Whether with the meshes for pictures.
    """
    root = chain_urdf(arm)
    if not visual:
        for link in root.iter("link"):
            for shape in link.findall("visual"):
                link.remove(shape)
    root.append(_box_link(PALM, jaws.palm, (0, 0, jaws.palm[2] / 2), 0.8))
    root.append(_joint("palm_joint", "fixed", arm.flange, PALM, (0, 0, 0)))
    finger = (jaws.pad_width, jaws.pad_thickness, jaws.pad_length)
    for name, joint, side in zip(FINGERS, FINGER_JOINTS, (1, -1), strict=True):
        root.append(_box_link(name, finger, (0, side * jaws.pad_thickness / 2, 0), 0.1))
        sliding = _joint(joint, "prismatic", PALM, name, (0, 0, jaws.palm[2] + jaws.pad_length / 2))
        SubElement(sliding, "axis", xyz=f"0 {side} 0")
        SubElement(sliding, "limit", lower="0", upper=f"{jaws.opening / 2}", effort=f"{jaws.force}", velocity="0.2")
        root.append(sliding)
    return ElementTree.tostring(root, encoding="unicode")


def _box_link(name: str, size: tuple[float, float, float], at: tuple[float, ...], mass: float) -> Element:
    link = Element("link", name=name)
    for kind in ("visual", "collision"):
        shape = SubElement(link, kind)
        SubElement(shape, "origin", xyz=_text(at), rpy="0 0 0")
        SubElement(SubElement(shape, "geometry"), "box", size=_text(size))
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_text(at), rpy="0 0 0")
    SubElement(inertial, "mass", value=f"{mass}")
    x, y, z = (mass / 12 * (sum(s * s for s in size) - s * s) for s in size)
    SubElement(inertial, "inertia", ixx=f"{x}", iyy=f"{y}", izz=f"{z}", ixy="0", ixz="0", iyz="0")
    return link


def _joint(name: str, kind: str, parent: str, child: str, at: tuple[float, ...]) -> Element:
    joint = Element("joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=_text(at), rpy="0 0 0")
    return joint


def _text(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


def _named(element: Element, child: str, key: str) -> str:
    found = element.find(child)
    return "" if found is None else found.get(key, "")
