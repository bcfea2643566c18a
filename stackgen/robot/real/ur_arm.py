"""A real UR5 through ur-rtde (extra `stackgen[ur]`).

Motions are started and then watched from here: the client's own waiting does not end for minutes when the connection
is lost. While it is watched the arm is fed a watchdog; a program that is not fed stops on the controller.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError, require
from stackgen.robot.backend import ArmState
from stackgen.robot.planning.motion import Motion
from stackgen.robot.planning.plan import BlockPlan
from stackgen.robot.real.gripper import DigitalJaws, Gripper, RealJaws, RobotiqJaws
from stackgen.robot.real.program import Controller, Grasps, Move, controller_move, controller_pose, tool_offset
from stackgen.robot.real.readiness import in_a_line, require_ready
from stackgen.robot.workcell import Workcell

Floats = NDArray[np.float64]

PORT = 30004
_RATE = 50.0  # states a second that are looked at
_VARIABLES = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "runtime_state",
    "safety_status_bits",
    "robot_status_bits",
)
_LOOK = 0.02  # between looks at the arm [s]
_FEED = 0.1  # between feeds of the watchdog [s]
_HUNGER = 0.5  # feeds a second below which the controller stops the program
_SILENCE = 1.5  # states older than this mean a lost connection [s]
_STANDING = 5.0  # an arm that stands so long short of its goal has stopped [s]
_STILL = 0.005  # joints slower than this stand [rad/s]
_AT_GOAL = (0.0005, 0.005)  # the finger tips are there [m, rad]
_AT_START = 0.05  # each joint is where a motion starts [rad]; a calibrated arm stands a little elsewhere
_KINEMATICS = 0.05  # the controller's solution may differ from the planned angles by so much [rad]
_PLAYING = 2  # runtime_state of a program that runs
_BRAKING = 2.0  # [rad/s^2]


class ArmStopped(StackgenError):
    """The arm does not move on."""


class UrArm:
    """A UR arm with jaws; on leaving the context its program is ended and the connections are closed.

    Args:
        host: Address of its controller.
        workcell: Limits, tool and home position of the arm.
        controller: Payload of the tool, and tolerances.
        gripper: Settings of the jaws.

    Raises:
        StackgenError: If there is no controller, it is not ready, the arm is not at home, or it is not the
            workcell's arm with the workcell's tool. Nothing has moved then.
    """

    def __init__(self, host: str, workcell: Workcell, controller: Controller, gripper: Gripper) -> None:
        self.host, self.workcell, self.controller, self.gripper = host, workcell, controller, gripper
        control, receive = require("rtde_control", "ur"), require("rtde_receive", "ur")
        require_ready(host)
        _require_rtde(host, PORT)
        self._control: Any = None
        self._jaws: RealJaws | None = None
        self._stopped: str | None = None
        self._grasps = Grasps()
        self._fed = 0.0
        self._seen = (-1.0, time.monotonic())  # timestamp of the newest state, and when it came
        try:
            self._receive: Any = receive.RTDEReceiveInterface(host, _RATE, list(_VARIABLES))
        except (RuntimeError, ValueError, OSError) as error:
            raise StackgenError(f"the controller at {host} does not speak RTDE: {in_a_line(error)}") from error
        try:
            self._require_home()
            self._take_control(control)
            self._require_same_arm()
            self._jaws = self._connect_jaws()
        except BaseException:
            self.disconnect()
            raise

    def move(self, motion: Motion) -> None:
        """Follow a motion to its end.

        Raises:
            ArmStopped: If the arm stops on the way, or the connection is lost.
            StackgenError: If the motion is not within the workcell's limits, or starts elsewhere; nothing moves then.
        """
        move = controller_move(motion, self.workcell)
        self._check()
        away = float(np.abs(self._joints() - motion.positions[0]).max())
        if away > _AT_START:
            raise self._stop_for(
                f"it is {np.degrees(away):.1f} degrees from where its next motion ({move.name}) starts"
            )
        if not self._start(move):
            self._check()
            raise self._stop_for(f"the controller refused a motion ({move.name})")
        self._follow(move)

    def begin(self, step: BlockPlan) -> None:
        """Note that a block is begun: the last closing of its plan must take hold of it."""
        self._grasps.begin(step)

    def open(self, width: float) -> None:
        """Open the jaws [m]."""
        self._check()
        with self._blamed():
            self._hands.open(width)

    def close(self, force: float) -> None:
        """Close the jaws [N].

        Raises:
            ArmStopped: If they were to take a block, and there was none.
        """
        self._check()
        grasp = self._grasps.is_grasp()
        with self._blamed():
            self._hands.close(force)
            if grasp and self._hands.holds() is False:
                raise StackgenError("the jaws closed on nothing: is the block in its slot?")

    def opening(self) -> float | None:
        """Distance between the pads [m]; None where the jaws cannot tell."""
        return self._hands.opening()

    def state(self) -> ArmState:
        """Tell where it stands, and why if it does not move on."""
        opening = None if self._jaws is None or self._stopped else self.opening()
        return ArmState(self._joints(), np.nan if opening is None else opening, self._stopped)

    def stop(self) -> None:
        """Brake, and end the program on the controller; does nothing where the connection is lost."""
        if self._control is None or self._lost() is not None:
            return
        with contextlib.suppress(RuntimeError, ValueError):
            self._control.stopJ(_BRAKING)
            self._control.stopScript()

    def _connect_jaws(self) -> RealJaws:
        if self.gripper.kind == "digital":
            outputs = require("rtde_io", "ur").RTDEIOInterface(self.host)

            def set_output(number: int, level: bool) -> None:
                if not outputs.setStandardDigitalOut(number, level):
                    raise self._stop_for(f"digital output {number} could not be set")

            return DigitalJaws(self.gripper, set_output, self._check)
        jaws = RobotiqJaws(self.gripper, self.host, self._check)
        jaws.activate()
        return jaws

    def _require_home(self) -> None:
        self._wait_for_state()
        away = np.degrees(np.abs(self._joints() - self.workcell.home_joints))
        worst = int(np.argmax(away))
        if away[worst] > self.controller.near_home:
            home = ", ".join(f"{angle:g}" for angle in self.workcell.home)
            raise StackgenError(
                f"the arm is not at its home position (joint {worst + 1} is {away[worst]:.0f} degrees away): bring it"
                f" to {home} degrees at the pendant; the way there from elsewhere is not checked for collisions"
            )

    def _take_control(self, control: Any) -> None:
        """Upload the client's program, tell it the tool, and set the watchdog."""
        try:
            self._control = control.RTDEControlInterface(
                self.host, -1.0, control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
            )
            fine = (
                self._control.setTcp(list(tool_offset(self.workcell)))
                and self._control.setPayload(self.controller.payload, list(self.controller.center_of_gravity))
                and self._control.setWatchdog(_HUNGER)
            )
        except (RuntimeError, ValueError, OSError) as error:
            raise StackgenError(f"the controller at {self.host} does not take control: {in_a_line(error)}") from error
        if not fine:
            raise StackgenError(f"the controller at {self.host} refuses tool, payload or watchdog")

    def _require_same_arm(self) -> None:
        """The controller's own kinematics must lead where the URDF's do."""
        end = time.monotonic() + 2.0
        while True:
            self._check()
            expected = controller_pose(self._joints(), self.workcell)
            distance, turn = difference(self._pose(), expected)
            if distance <= self.controller.agreement and turn <= 3 * self.controller.agreement:
                return
            if time.monotonic() > end:  # the new tool takes a moment to be seen
                raise StackgenError(
                    f"the controller at {self.host} has the finger tips {distance * 1e3:.0f} mm from where the URDF"
                    " has them: is it the arm of cell.arm, mounted upright, and are cell.jaws right?"
                )
            time.sleep(_LOOK)

    def _start(self, move: Move) -> bool:
        try:
            if move.kind == "line":
                return bool(self._control.moveL(move.pose.tolist(), move.speed, move.acceleration, True))
            solved = self._control.getInverseKinematics(move.pose.tolist(), move.joints.tolist())
            if len(solved) != 6 or np.abs(np.array(solved) - move.joints).max() > _KINEMATICS:
                raise self._stop_for(f"its own joint angles for the end of a motion ({move.name}) are not the planned")
            return bool(self._control.moveJ(list(solved), move.speed, move.acceleration, True))
        except (RuntimeError, ValueError) as error:
            raise self._stop_for(f"lost the connection to {self.host}: {in_a_line(error)}") from error

    def _follow(self, move: Move) -> None:
        """Watch a motion until the finger tips rest at its end."""
        moved = time.monotonic()
        while True:
            self._check()
            distance, turn = difference(self._pose(), move.pose)
            still = np.abs(self._receive.getActualQd()).max() < _STILL
            if still and distance < _AT_GOAL[0] and turn < _AT_GOAL[1]:
                return
            now = time.monotonic()
            if not still:
                moved = now
            elif now - moved > _STANDING:
                raise self._stop_for(f"it stands {distance * 1e3:.0f} mm short of the end of a motion ({move.name})")
            time.sleep(_LOOK)

    @property
    def _hands(self) -> RealJaws:
        assert self._jaws is not None, "connected as long as the arm is"
        return self._jaws

    @contextlib.contextmanager
    def _blamed(self) -> Iterator[None]:
        """Stop the arm for what goes wrong with the jaws."""
        try:
            yield
        except ArmStopped:
            raise
        except StackgenError as error:
            raise self._stop_for(str(error)) from error

    def _check(self) -> None:
        """Feed the watchdog, and see that the arm still does what it is told.

        Raises:
            ArmStopped: If it does not.
        """
        why = self._lost() or self._safety()
        if why is not None:
            raise self._stop_for(why)
        now = time.monotonic()
        if self._control is not None and now - self._fed > _FEED:
            self._fed = now
            if self._receive.getRuntimeState() != _PLAYING:
                raise self._stop_for("the program was stopped or paused at the controller")
            with contextlib.suppress(RuntimeError, ValueError):  # what is wrong is seen at the next look
                self._control.kickWatchdog()

    def _safety(self) -> str | None:
        if self._receive.isEmergencyStopped():
            return "emergency stop"
        return "protective stop" if self._receive.isProtectiveStopped() else None

    def _lost(self) -> str | None:
        stamp, now = self._receive.getTimestamp(), time.monotonic()
        if stamp != self._seen[0]:
            self._seen = stamp, now
        silent = now - self._seen[1] > _SILENCE
        return f"lost the connection to {self.host}" if silent or not self._receive.isConnected() else None

    def _wait_for_state(self) -> None:
        end = time.monotonic() + _SILENCE
        while self._receive.getTimestamp() <= 0 and time.monotonic() < end:
            time.sleep(_LOOK)
        self._check()

    def _stop_for(self, why: str) -> ArmStopped:
        self._stopped = why
        return ArmStopped(why)

    def _joints(self) -> Floats:
        return np.array(self._receive.getActualQ(), dtype=float)

    def _pose(self) -> Floats:
        return np.array(self._receive.getActualTCPPose(), dtype=float)

    def disconnect(self) -> None:
        """End the program on the controller and close the connections; the jaws keep their grip."""
        if self._jaws is not None:
            self._jaws.disconnect()
            self._jaws = None
        alive = self._lost() is None
        if self._control is not None:
            with contextlib.suppress(RuntimeError, ValueError):
                if alive and self._stopped is None:
                    self._control.stopScript()
                self._control.disconnect()
            self._control = None
        with contextlib.suppress(RuntimeError, ValueError):
            self._receive.disconnect()

    def __enter__(self) -> UrArm:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.disconnect()


def difference(a: Floats, b: Floats) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (6,).

    >>> difference(np.zeros(6), np.array([0.3, 0, 0.4, 0, 0, 0.1]))
    (0.5, 0.1)
    """
    turn = Rotation.from_rotvec(a[3:]).inv() * Rotation.from_rotvec(b[3:])
    return float(np.linalg.norm(a[:3] - b[:3])), round(float(turn.magnitude()), 12)


@contextlib.contextmanager
def client_messages(file: Path) -> Iterator[None]:
    """Send what the client's own threads print to a file: an error is one line of ours.

    Python's own output stays where it was.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(stream, os.dup(number)) for stream, number in (("stdout", 1), ("stderr", 2))]
    before = sys.stdout, sys.stderr
    try:
        with file.open("ab") as log:
            for number in (1, 2):
                os.dup2(log.fileno(), number)
        for (name, copy), stream in zip(kept, before, strict=True):
            if _descriptor(stream) in (1, 2):
                setattr(sys, name, os.fdopen(os.dup(copy), "w", buffering=1))
        yield
    finally:
        for number, (_, copy) in enumerate(kept, 1):
            os.dup2(copy, number)
            os.close(copy)
        sys.stdout, sys.stderr = before


def _descriptor(stream: Any) -> int | None:
    try:
        return int(stream.fileno())
    except (AttributeError, OSError, ValueError):
        return None


_HELLO, _WELCOME = struct.pack(">HBH", 5, ord("V"), 2), struct.pack(">HBB", 4, ord("V"), 1)
"""Question for version 2 of RTDE's protocol, and the answer that accepts it."""


def _require_rtde(host: str, port: int) -> None:
    """See that the port answers as RTDE does: the client itself would wait for minutes, or for ever."""
    try:
        with socket.create_connection((host, port), timeout=3.0) as link:
            link.sendall(_HELLO)
            answer = link.recv(len(_WELCOME), socket.MSG_WAITALL)
    except OSError as error:
        raise StackgenError(f"the controller at {host} does not open port {port}: {error.strerror or error}") from error
    if answer != _WELCOME:
        raise StackgenError(f"the controller at {host} does not speak RTDE on port {port}")
