"""The robot's workcell: which arm stands where, what it holds with, where blocks wait, how fast it may move.

Lengths in metres, angles in degrees, forces in newtons: the units in which people write a configuration. The table
frame is the world frame of the stacks in metres: x to the right as the camera sees it, y away from the camera, z up,
the table at z = 0, the structure around the origin. configs/robot/ur5.yaml holds these numbers for the UR5.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError

Floats = NDArray[np.float64]

Grasp = Literal["jaws", "fixed"]
"""How a simulated block is held: by friction between the jaws, or by a fixed constraint."""


@dataclass(frozen=True)
class ArmDescription:
    """The files and links that describe the arm.

    Args:
        urdf: URDF file: a path, or package://example-robot-data/... for an arm of that package.
        srdf: SRDF file that names the pairs of links whose contact is harmless; empty for links side by side.
        base: Name of the link that is bolted down.
        flange: Name of the link that carries the jaws; its z axis points out of the flange.
    """

    urdf: str = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
    srdf: str = "package://example-robot-data/robots/ur_description/srdf/ur5.srdf"
    base: str = "base_link"
    flange: str = "tool0"


@dataclass(frozen=True)
class Base:
    """The place where the arm is bolted down.

    Args:
        position: Origin of the base link in the table frame [m].
        yaw: Turn of the base link about z [deg].
    """

    position: tuple[float, float, float] = (0.0, 0.40, 0.0)
    yaw: float = -90.0

    @property
    def table_from_base(self) -> Floats:
        """(4, 4) pose of the base link in the table frame."""
        return pose(self.position, self.yaw)


@dataclass(frozen=True)
class Jaws:
    """Parallel jaws on the flange; they close along the block's depth, from the front and the back.

    Args:
        opening: Distance between the pads when open [m].
        clearance: Least distance between each pad and the block before they close [m].
        pad_width: Width of a pad along the block [m].
        pad_thickness: Thickness of a finger, across the block [m].
        pad_length: Length of a finger, downwards from the palm [m].
        palm: Box between flange and fingers: along the block, across, and high [m].
        force: Closing force [N].
        friction: Friction of the pads; between a pad and a block it is this times the block's own.
        grip_height: Height of the finger tips above a block's lowest point when it is held [m].
    """

    opening: float = 0.085
    clearance: float = 0.008
    pad_width: float = 0.020
    pad_thickness: float = 0.012
    pad_length: float = 0.065
    palm: tuple[float, float, float] = (0.070, 0.130, 0.095)
    force: float = 40.0
    friction: float = 1.2
    grip_height: float = 0.010

    def tips_above(self, height: float) -> float:
        """Height of the finger tips above the lowest point of a block of some height [m]: the palm clears its top."""
        return max(self.grip_height, height + self.grip_height - self.pad_length)

    @property
    def reach(self) -> float:
        """Distance from the flange to the finger tips, the tool centre point [m]."""
        return self.palm[2] + self.pad_length

    @property
    def flange_from_tip(self) -> Floats:
        """(4, 4) pose of the tool centre point in the flange's frame."""
        return pose((0.0, 0.0, self.reach))


_SLOTS = tuple((x, y, 0.0) for y in (-0.22, -0.10, 0.02, 0.14, 0.26) for x in (-0.29, 0.29))


@dataclass(frozen=True)
class Staging:
    """The area where blocks wait, each in the middle of a slot, with its length along the slot's.

    Args:
        slots: Middle x, y [m] and turn [deg] of each slot.
        length: Length of a slot [m], with the room beside a block in which the fingers straighten it.
        depth: Depth of a slot [m], with the room for the open jaws.
        straighten: Push every block from both ends to the middle of its slot before it is grasped: it may
            then lie a few millimetres off.
    """

    slots: tuple[tuple[float, float, float], ...] = _SLOTS
    length: float = 0.23
    depth: float = 0.115
    straighten: bool = True


@dataclass(frozen=True)
class Speeds:
    """Limits of the motion.

    Args:
        line: Speed of the tool on straight lines [m/s].
        line_acceleration: Acceleration of the tool on straight lines [m/s^2].
        line_jerk: Jerk of the tool on straight lines [m/s^3].
        touch: Speed near a block: the last bit of the way down, and pushing [m/s].
        joint: Speed of each joint [deg/s].
        joint_acceleration: Acceleration of each joint [deg/s^2].
        joint_jerk: Jerk of each joint [deg/s^3].
    """

    line: float = 0.25
    line_acceleration: float = 0.8
    line_jerk: float = 8.0
    touch: float = 0.04
    joint: float = 70.0
    joint_acceleration: float = 140.0
    joint_jerk: float = 1200.0


@dataclass(frozen=True)
class Workspace:
    """The bounds and distances that the arm keeps to.

    Args:
        low: Lower corner of the box in which the finger tips stay [m].
        high: Upper corner of that box [m].
        clearance: Least distance of arm and jaws from everything that they do not handle [m].
        lift: Height of what hangs lowest above everything else on the way [m].
        gap: Room between blocks side by side in the structure [m]: blocks that touch are moved apart by this.
        drop: Height above its place in which a block is let go [m].
    """

    low: tuple[float, float, float] = (-0.55, -0.40, 0.003)
    high: tuple[float, float, float] = (0.55, 0.40, 0.60)
    clearance: float = 0.002
    lift: float = 0.03
    gap: float = 0.0015
    drop: float = 0.0003


_HOME = (-15.8, -103.6, 97.7, -84.1, -90.0, -15.8)


@dataclass(frozen=True)
class Workcell:
    """The robot's workcell.

    Args:
        arm: Description of the arm.
        base: Place where the arm is bolted down.
        home: Joint angles at the beginning and the end; the arm stays on their branch [deg].
        jaws: Jaws on its flange.
        staging: Area where the blocks wait.
        speeds: Limits of the motion.
        workspace: Bounds and distances that the arm keeps to.

    Raises:
        StackgenError: If a number makes no sense.

    >>> Workcell().jaws.reach
    0.16
    """

    arm: ArmDescription = field(default_factory=ArmDescription)
    base: Base = field(default_factory=Base)
    home: tuple[float, ...] = _HOME
    jaws: Jaws = field(default_factory=Jaws)
    staging: Staging = field(default_factory=Staging)
    speeds: Speeds = field(default_factory=Speeds)
    workspace: Workspace = field(default_factory=Workspace)

    def __post_init__(self) -> None:
        groups = (self.base, self.jaws, self.staging, self.speeds, self.workspace)
        for name, value in [("home", self.home), *(item for group in groups for item in vars(group).items())]:
            if not np.isfinite(np.asarray(value, dtype=float)).all():
                raise StackgenError(f"cell: {name} must be finite, got {value}")
            if isinstance(value, float) and value <= 0 and name != "yaw":
                raise StackgenError(f"cell: {name} must be positive, got {value:g}")
        if not self.staging.slots:
            raise StackgenError("cell: staging.slots is empty: name the middle of at least one slot")
        if not all(low < high for low, high in zip(self.workspace.low, self.workspace.high, strict=True)):
            raise StackgenError("cell: workspace.low must lie below workspace.high along x, y and z")

    @property
    def home_joints(self) -> Floats:
        """(n,) joint angles of the home position [rad]."""
        return np.radians(self.home)

    def flange_in_base(self, tip_in_table: Floats) -> Floats:
        """(4, 4) pose of the flange in the base, for a pose of the finger tips in the table frame."""
        return np.linalg.inv(self.base.table_from_base) @ tip_in_table @ np.linalg.inv(self.jaws.flange_from_tip)

    def tip_in_table(self, flange_in_base: Floats) -> Floats:
        """Inverse of :meth:`flange_in_base`."""
        return self.base.table_from_base @ flange_in_base @ self.jaws.flange_from_tip

    def to_json(self) -> dict[str, Any]:
        """Plain form, for reports."""
        return asdict(self)


def pose(position: tuple[float, float, float] | Floats, yaw: float = 0.0) -> Floats:
    """(4, 4) pose at a position [m], turned about z [deg]."""
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec([0, 0, math.radians(yaw)]).as_matrix()
    frame[:3, 3] = position
    return frame
