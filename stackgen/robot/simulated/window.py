"""A window on a simulated build: it mirrors arm and blocks and has no part in the physics, the same without it."""

from __future__ import annotations

import ctypes
import os
import sys

from stackgen.errors import StackgenError
from stackgen.robot.planning.clearance import load_arm
from stackgen.robot.planning.connection import Connected
from stackgen.robot.simulated.arm import SimulatedArm, block_visual
from stackgen.sim.bullet_engine import bullet, connect

RATE = 25.0
"""Pictures in a simulated second."""


class Window(Connected):
    """Shows an arm and its blocks while they move; closing it does not stop the build.

    Args:
        arm: The arm that is shown.
        mode: Mode of Bullet's connection; a window by default.

    Raises:
        StackgenError: If there is no display to open one on.
    """

    def __init__(self, arm: SimulatedArm, mode: int | None = None) -> None:
        mode = bullet.GUI if mode is None else mode
        if mode == bullet.GUI:
            require_display()
        super().__init__(connect(arm.physics, mode))
        self.arm = arm
        # Drawing waits until everything is loaded: with a software renderer every mesh would take a minute.
        for switch in (bullet.COV_ENABLE_GUI, bullet.COV_ENABLE_SHADOWS, bullet.COV_ENABLE_RENDERING):
            self.bullet.configureDebugVisualizer(switch, 0)
        self.bullet.resetDebugVisualizerCamera(1.1, 20, -25, [0, 0.05, 0.15])
        self.body = load_arm(arm.workcell, self.client, visual=True)
        self.blocks = [self._block(number) for number in range(len(arm.stack))]
        self.bullet.configureDebugVisualizer(bullet.COV_ENABLE_RENDERING, 1)
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
            joints = range(self.bullet.getNumJoints(self.body))
            states = self.arm.bullet.getJointStates(self.arm.arm, joints)
            for joint, state in zip(joints, states, strict=True):
                self.bullet.resetJointState(self.body, joint, state[0])
            for ours, theirs in zip(self.blocks, self.arm.blocks, strict=True):
                place = self.arm.bullet.getBasePositionAndOrientation(theirs)
                self.bullet.resetBasePositionAndOrientation(ours, *place)
        except bullet.error:  # the window was closed
            self.client = -1

    def _block(self, number: int) -> int:
        stack = self.arm.stack
        shape = int(stack.shapes[number])
        visual = block_visual(stack.catalogue[shape], shape, self.arm.physics.cell_size, self.client)
        return int(self.bullet.createMultiBody(0, -1, visual))


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
