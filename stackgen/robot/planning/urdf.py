"""What the arm's URDF says: its kinematic chain, its collision pairs, and the same arm with jaws on its flange.

The UR5's description comes with the package example-robot-data. Lengths in metres, angles in radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError
from stackgen.robot.workcell import Jaws

Floats = NDArray[np.float64]

BASE, FLANGE = "base_link", "tool0"
LINKS = (
    BASE,
    "shoulder_link",
    "upper_arm_link",
    "forearm_link",
    "wrist_1_link",
    "wrist_2_link",
    "wrist_3_link",
)
"""The UR5's moving bodies, from the base on."""

PALM, FINGERS, FINGER_JOINTS = "palm", ("left_finger", "right_finger"), ("left_jaw", "right_jaw")


def description_folder() -> Path:
    """Folder `robots/ur_description` of example-robot-data.

    Raises:
        StackgenError: If the package is not installed.
    """
    try:
        files = distribution("example-robot-data")
    except PackageNotFoundError:
        raise StackgenError(
            "the UR5's description is missing: pip install example-robot-data (part of stackgen's requirements)"
        ) from None
    return Path(str(files.locate_file("cmeel.prefix/share/example-robot-data/robots/ur_description")))


def ur5_urdf() -> Path:
    """The UR5's URDF."""
    return description_folder() / "urdf" / "ur5_robot.urdf"


@dataclass(frozen=True)
class Chain:
    """A serial chain of n revolute joints between two links.

    Args:
        names: (n,) of the joints.
        origins: (n, 4, 4) each joint's frame in that of the joint before it, at angle 0.
        axes: (n, 3) in the joint's frame.
        lower, upper: (n,) limits [rad].
        speed: (n,) limits [rad/s].
        effort: (n,) limits [N m].
        tail: (4, 4) the last link in the last joint's frame.
    """

    names: tuple[str, ...]
    origins: Floats
    axes: Floats
    lower: Floats
    upper: Floats
    speed: Floats
    effort: Floats
    tail: Floats

    def __len__(self) -> int:
        return len(self.names)

    def frames(self, joints: ArrayLike) -> Floats:
        """(n + 1, 4, 4) frames of the links after each joint, and of the tip, in the base."""
        angles = np.asarray(joints, dtype=float)
        frame, frames = np.eye(4), np.empty((len(self) + 1, 4, 4))
        turns = Rotation.from_rotvec(self.axes * angles[:, None]).as_matrix()
        for number, (origin, turn) in enumerate(zip(self.origins, turns, strict=True)):
            frame = frame @ origin
            frame[:3, :3] = frame[:3, :3] @ turn
            frames[number] = frame
        frames[-1] = frame @ self.tail
        return frames

    def forward(self, joints: ArrayLike) -> Floats:
        """(4, 4) pose of the tip in the base."""
        return self.frames(joints)[-1]

    def jacobian(self, joints: ArrayLike) -> Floats:
        """(6, n) velocity and angular velocity of the tip in the base, for each joint's."""
        frames = self.frames(joints)
        axes = np.einsum("nij,nj->ni", frames[:-1, :3, :3], self.axes)
        arms = frames[-1, :3, 3] - frames[:-1, :3, 3]
        return np.concatenate([np.cross(axes, arms), axes], axis=1).T


def read_chain(file: Path, base: str = BASE, tip: str = FLANGE) -> Chain:
    """The chain between two links of a URDF.

    Raises:
        StackgenError: If the file has no such chain of revolute joints.
    """
    joints = {_child(joint): joint for joint in ElementTree.parse(file).getroot().iter("joint")}
    path: list[ElementTree.Element] = []
    link = tip
    while link != base:
        if link not in joints:
            raise StackgenError(f"{file}: no chain leads from {base} to {tip}")
        path.insert(0, joints[link])
        link = _named(joints[link], "parent", "link")
    turning = [joint for joint in path if joint.get("type") in ("revolute", "continuous")]
    if not turning or any(joint.get("type") not in ("revolute", "continuous", "fixed") for joint in path):
        raise StackgenError(f"{file}: the chain from {base} to {tip} must be of revolute joints")
    origins, pending = [], np.eye(4)
    for joint in path:
        pending = pending @ _origin(joint)
        if joint.get("type") != "fixed":
            origins.append(pending)
            pending = np.eye(4)
    return Chain(
        tuple(joint.get("name", "") for joint in turning),
        np.array(origins),
        np.array([_numbers(joint, "axis", "xyz", "1 0 0") for joint in turning]),
        lower=_limits(turning, "lower"),
        upper=_limits(turning, "upper"),
        speed=_limits(turning, "velocity"),
        effort=_limits(turning, "effort"),
        tail=pending,
    )


def _limits(joints: list[ElementTree.Element], key: str) -> Floats:
    return np.array([float(_named(joint, "limit", key)) for joint in joints])


@lru_cache(maxsize=1)
def ur5_chain() -> Chain:
    """The UR5 from its base link to its flange.

    >>> ur5_chain().names[:2], len(ur5_chain())
    (('shoulder_pan_joint', 'shoulder_lift_joint'), 6)
    """
    return read_chain(ur5_urdf())


def self_collision_pairs() -> list[tuple[str, str]]:
    """Pairs of links that may touch, by the SRDF; the jaws are a part of the last link.

    >>> [other for link, other in self_collision_pairs() if link == "base_link"][:2]
    ['forearm_link', 'wrist_1_link']
    """
    root = ElementTree.parse(description_folder() / "srdf" / "ur5.srdf").getroot()
    never = {frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in root.iter("disable_collisions")}
    pairs = [(a, b) for i, a in enumerate(LINKS) for b in LINKS[i + 1 :] if frozenset((a, b)) not in never]
    tool = [(link, part) for link in LINKS[:4] for part in (PALM, *FINGERS)]
    return pairs + tool


def with_jaws(jaws: Jaws, visual: bool = True) -> str:
    """The UR5's URDF as text, parallel jaws mounted on its flange, mesh files by their full paths.

    The palm is a box that starts at the flange; the fingers are boxes that slide along the flange's y axis,
    each by half of the opening. What only other programs read is left out.

    Args:
        jaws: Their sizes.
        visual: Whether with the meshes for pictures.
    """
    root = ElementTree.parse(ur5_urdf()).getroot()
    drop = {"world", "ee_link", "base"}
    for part in list(root):
        is_joint_of_dropped = part.tag == "joint" and {_child(part), _named(part, "parent", "link")} & drop
        if part.tag in ("gazebo", "transmission") or part.get("name") in drop or is_joint_of_dropped:
            root.remove(part)
    if not visual:
        for link in root.iter("link"):
            for shape in link.findall("visual"):
                link.remove(shape)
    root_folder = description_folder().parents[1]
    for mesh in root.iter("mesh"):
        mesh.set("filename", mesh.get("filename", "").replace("package://example-robot-data", str(root_folder)))
    half = jaws.opening / 2
    finger_z = jaws.palm[2] + jaws.pad_length / 2
    root.append(_box_link(PALM, jaws.palm, (0, 0, jaws.palm[2] / 2), 0.8))
    root.append(_joint("palm_joint", "fixed", FLANGE, PALM, (0, 0, 0)))
    finger = (jaws.pad_width, jaws.pad_thickness, jaws.pad_length)
    for name, joint, side in zip(FINGERS, FINGER_JOINTS, (1, -1), strict=True):
        root.append(_box_link(name, finger, (0, side * jaws.pad_thickness / 2, 0), 0.1))
        sliding = _joint(joint, "prismatic", PALM, name, (0, 0, finger_z))
        ElementTree.SubElement(sliding, "axis", xyz=f"0 {side} 0")
        limits = {"lower": "0", "upper": f"{half}", "effort": f"{jaws.force}", "velocity": "0.2"}
        ElementTree.SubElement(sliding, "limit", limits)
        root.append(sliding)
    return ElementTree.tostring(root, encoding="unicode")


def _box_link(name: str, size: tuple[float, float, float], at: tuple[float, ...], mass: float) -> ElementTree.Element:
    link = ElementTree.Element("link", name=name)
    for kind in ("visual", "collision"):
        shape = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(shape, "origin", xyz=_text(at), rpy="0 0 0")
        ElementTree.SubElement(ElementTree.SubElement(shape, "geometry"), "box", size=_text(size))
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_text(at), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=f"{mass}")
    x, y, z = (mass / 12 * (sum(s * s for s in size) - s * s) for s in size)
    moments = {"ixx": f"{x}", "iyy": f"{y}", "izz": f"{z}", "ixy": "0", "ixz": "0", "iyz": "0"}
    ElementTree.SubElement(inertial, "inertia", moments)
    return link


def _joint(name: str, kind: str, parent: str, child: str, at: tuple[float, ...]) -> ElementTree.Element:
    joint = ElementTree.Element("joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(at), rpy="0 0 0")
    return joint


def _text(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


def _named(element: ElementTree.Element, child: str, key: str) -> str:
    found = element.find(child)
    return "" if found is None else found.get(key, "")


def _child(joint: ElementTree.Element) -> str:
    return _named(joint, "child", "link")


def _numbers(element: ElementTree.Element, child: str, key: str, default: str) -> Floats:
    return np.array([float(word) for word in (_named(element, child, key) or default).split()])


def _origin(joint: ElementTree.Element) -> Floats:
    """(4, 4) transform of a joint's `origin`."""
    frame = np.eye(4)
    frame[:3, 3] = _numbers(joint, "origin", "xyz", "0 0 0")
    frame[:3, :3] = Rotation.from_euler("xyz", _numbers(joint, "origin", "rpy", "0 0 0")).as_matrix()
    return frame
