"""A window on a simulated build: it mirrors arm and blocks and has no part in the physics, the same without it."""

from __future__ import annotations

import ctypes
import os
import sys
from types import TracebackType

from stackgen.errors import StackgenError
from stackgen.robot.planning.clearance import load_arm
from stackgen.robot.simulated.arm import SimulatedArm, block_visual
from stackgen.sim.simulator import bullet, connect

RATE = 25.0
"""Pictures in a simulated second."""


class Window:
    """Shows an arm and its blocks while they move; closing it does not stop the build.

    Args:
        arm: The arm that is shown.
        mode: Mode of Bullet's connection; a window by default.

    Raises:
        StackgenError: If there is no display to open one on.
    """

    def __init__(self, arm: SimulatedArm, mode: int = bullet.GUI) -> None:
        if mode == bullet.GUI:
            require_display()
        self.arm = arm
        self.client = connect(arm.physics, mode)
        # Drawing waits until everything is loaded: with a software renderer every mesh would take a minute.
        for switch in (bullet.COV_ENABLE_GUI, bullet.COV_ENABLE_SHADOWS, bullet.COV_ENABLE_RENDERING):
            bullet.configureDebugVisualizer(switch, 0, physicsClientId=self.client)
        bullet.resetDebugVisualizerCamera(1.1, 20, -25, [0, 0.05, 0.15], physicsClientId=self.client)
        self.body = load_arm(arm.workcell, self.client, visual=True)
        self.blocks = [self._block(number) for number in range(len(arm.stack))]
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 1, physicsClientId=self.client)
        self._every = max(1, round(1 / RATE / arm.physics.time_step))
        self.show()

    def step(self) -> None:
        """Show a picture, if it is time; called after every step of the arm."""
        if self.arm.steps % self._every == 0:
            self.show()

    def show(self) -> None:
        """Put everything where it is now."""
        if self.client < 0:
            return
        try:
            joints = range(bullet.getNumJoints(self.body, physicsClientId=self.client))
            states = bullet.getJointStates(self.arm.arm, joints, physicsClientId=self.arm.client)
            for joint, state in zip(joints, states, strict=True):
                bullet.resetJointState(self.body, joint, state[0], physicsClientId=self.client)
            for ours, theirs in zip(self.blocks, self.arm.blocks, strict=True):
                place = bullet.getBasePositionAndOrientation(theirs, physicsClientId=self.arm.client)
                bullet.resetBasePositionAndOrientation(ours, *place, physicsClientId=self.client)
        except bullet.error:  # the window was closed
            self.client = -1

    def close(self) -> None:
        """Close it, if it is open."""
        if self.client >= 0 and bullet.isConnected(self.client):
            bullet.disconnect(self.client)
        self.client = -1

    def __enter__(self) -> Window:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _block(self, number: int) -> int:
        stack = self.arm.stack
        shape = int(stack.shapes[number])
        visual = block_visual(stack.catalogue[shape], shape, self.arm.physics.cell_size, self.client)
        return int(bullet.createMultiBody(0, -1, visual, physicsClientId=self.client))


def require_display() -> None:
    """See that a window can be opened: without a display Bullet ends the whole process.

    Raises:
        StackgenError: If there is no display, or none that answers.
    """
    if sys.platform != "linux":
        return
    name = os.environ.get("DISPLAY")
    if not name or not _answers(name):
        what = f"the display {name} does not answer" if name else "there is no display to open a window on"
        raise StackgenError(f"--gui: {what}; leave it out, or use --video")


def _answers(display: str) -> bool:
    """Check whether an X server is there, by the library that Bullet's window uses."""
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XOpenDisplay.argtypes = [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    connection = x11.XOpenDisplay(display.encode())
    if connection:
        x11.XCloseDisplay(connection)
    return bool(connection)
