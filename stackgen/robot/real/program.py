"""The motions of a plan as a UR controller is asked for them: poses in its own base frame, within the limits.

A plan's motions are joint angles of the nominal arm. Every real arm is a little different, and its controller knows
how: it is told where the finger tips are to be, and which joint angles are near. So it places blocks as exactly as it
was calibrated, on a path that differs from the checked one by no more than the arm from its description.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.motion import Close, Motion
from stackgen.robot.planning.plan import BlockPlan
from stackgen.robot.workcell import Workcell, pose

Floats = NDArray[np.float64]

CONTROLLER_FROM_BASE = pose((0.0, 0.0, 0.0), 180.0)
"""(4, 4) the URDF's base_link in the controller's base frame: the same origin, turned by 180 degrees about z."""

_SAMPLES = 17  # of a motion, to find its speeds and to look for the workspace's walls
_SLACK = 1e-6
_SLOWEST = 0.002  # that the controller is ever asked for [m/s, rad/s]


_HOST = re.compile(r"[A-Za-z0-9._:%-]{0,253}")


def check_host(what: str, host: str) -> None:
    """See that an address is a name or a number, for it stands in the robot's program.

    Raises:
        StackgenError: If it is anything else.
    """
    if not _HOST.fullmatch(host):
        raise StackgenError(f"{what}: host must be a name or an address of letters, digits and .:-, got {host!r:.60}")


@dataclass(frozen=True)
class Controller:
    """The real arm's controller, and what hangs on its flange.

    Args:
        host: Address of the controller; --host overrides it.
        payload: Mass of the jaws [kg].
        center_of_gravity: Centre of gravity of the jaws in the flange's frame [m].
        near_home: Largest angle of each joint from the home position when a build begins [deg].
        agreement: Largest distance between where the controller says the finger tips are and where the URDF does
            [m]; more is another arm, or another tool.
    """

    host: str = ""
    payload: float = 1.0
    center_of_gravity: tuple[float, float, float] = (0.0, 0.0, 0.06)
    near_home: float = 5.0
    agreement: float = 0.01

    def __post_init__(self) -> None:
        check_host("controller", self.host)
        if not np.isfinite(self.center_of_gravity).all():
            raise StackgenError("controller: center_of_gravity must be three finite numbers")
        for name in ("payload", "near_home", "agreement"):
            if not 0 < getattr(self, name) < np.inf:
                raise StackgenError(f"controller: {name} must be positive, got {getattr(self, name):g}")


@dataclass(frozen=True, kw_only=True)
class Move:
    """One motion as a controller is asked for it.

    Args:
        name: Part in the work.
        kind: `joint` (movej) or `line` (movel).
        pose: (6,) pose of the finger tips in the controller's base frame, position [m] and rotation vector [rad].
        joints: (6,) joint angles of the nominal arm there [rad].
        speed: Speed of the leading joint [rad/s], or of the tool [m/s].
        acceleration: Acceleration of the leading joint [rad/s^2], or of the tool [m/s^2].
    """

    name: str
    kind: Literal["joint", "line"]
    pose: Floats
    joints: Floats
    speed: float
    acceleration: float


def tool_offset(workcell: Workcell) -> tuple[float, ...]:
    """Pose (6,) of the finger tips in the flange's frame, as `set_tcp` takes it."""
    return (*workcell.jaws.flange_from_tip[:3, 3].tolist(), 0.0, 0.0, 0.0)


def controller_pose(joints: Floats, workcell: Workcell) -> Floats:
    """Pose (6,) of the finger tips in the controller's base frame, for joint angles (6,) [rad]."""
    tip = CONTROLLER_FROM_BASE @ arm_model(workcell.arm).forward(joints) @ workcell.jaws.flange_from_tip
    return np.concatenate([tip[:3, 3], Rotation.from_matrix(tip[:3, :3]).as_rotvec()])


def controller_move(motion: Motion, workcell: Workcell) -> Move:
    """Give a motion the largest speed and acceleration that were planned for it.

    Raises:
        StackgenError: If it leaves the workcell's workspace, or is faster than the workcell allows.
    """
    times = np.linspace(0, motion.duration, _SAMPLES)
    positions, velocities = motion.at(times)
    check_workspace(motion.name, positions, workcell)
    if motion.kind == "joint":
        rates = np.abs(velocities).max(axis=1)
        limits, unit = np.radians([workcell.speeds.joint, workcell.speeds.joint_acceleration]), "rad"
    else:
        tool = np.array(
            [arm_model(workcell.arm).jacobian(q)[:3] @ v for q, v in zip(positions, velocities, strict=True)]
        )
        rates = np.linalg.norm(tool, axis=1)
        limits, unit = np.array([workcell.speeds.line, workcell.speeds.line_acceleration]), "m"
    speed, acceleration = float(rates.max()), float(np.abs(np.diff(rates) / np.diff(times)).max())
    if speed > limits[0] * 1.01 or acceleration > limits[1] * 1.01:
        raise StackgenError(
            f"{motion.name} would be too fast: {speed:.2f} {unit}/s and {acceleration:.2f} {unit}/s^2, cell.speeds"
            f" allows {limits[0]:.2f} and {limits[1]:.2f}"
        )
    end = motion.end
    return Move(
        name=motion.name,
        kind=motion.kind,
        pose=controller_pose(end, workcell),
        joints=end,
        speed=float(np.clip(speed, _SLOWEST, limits[0])),
        acceleration=float(np.clip(acceleration, _SLOWEST, limits[1])),
    )


def check_workspace(name: str, positions: Floats, workcell: Workcell) -> None:
    """See that the finger tips stay in the workspace at joint angles (T, 6) [rad].

    Raises:
        StackgenError: If they do not.
    """
    low, high = np.array(workcell.workspace.low) - _SLACK, np.array(workcell.workspace.high) + _SLACK
    for joints in positions:
        tip = workcell.tip_in_table(arm_model(workcell.arm).forward(joints))[:3, 3]
        if (tip < low).any() or (tip > high).any():
            x, y, z = tip
            raise StackgenError(
                f"{name} would bring the finger tips to ({x:.3f}, {y:.3f}, {z:.3f}) m, outside cell.workspace"
            )


class Grasps:
    """Tells the closing that takes a block from those that only make a pusher of the jaws: it is the last one."""

    def __init__(self) -> None:
        self._left = 0

    def begin(self, step: BlockPlan) -> None:
        """Note that a block is begun."""
        self._left = sum(isinstance(action, Close) for action in step.actions)

    def is_grasp(self) -> bool:
        """Tell whether the jaws that close now take the block."""
        self._left -= 1
        return self._left == 0
