"""The window shows what the simulation has, and the simulation does not notice."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.robot.planning.clearance import ArmIndices
from stackgen.robot.planning.motion import joint_motion
from stackgen.robot.simulated.arm import Floats, SimulatedArm
from stackgen.robot.simulated.window import Window
from stackgen.robot.workcell import Workcell
from stackgen.sim.bullet_engine import bullet
from stackgen.sim.physics import Physics
from stackgen.stack import Stack

STACK = Stack(np.array([0, 3]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))


def arm() -> SimulatedArm:
    frames = [np.eye(4), np.eye(4)]
    frames[0][:3, 3], frames[1][:3, 3] = (0.2, 0, 0.05), (-0.2, 0, 0.08)  # they fall
    return SimulatedArm(Workcell(), STACK, frames, Physics())


def moved(simulated: SimulatedArm) -> list[Floats]:
    """Where everything is after a short motion."""
    home = simulated.workcell.home_joints
    motion = joint_motion("transit", home, home + 0.05, simulated.workcell.speeds)
    assert motion is not None
    simulated.move(motion)
    places = [np.array(simulated.frame(block)) for block in range(len(STACK))]
    return [simulated.state().joints, *places]


def test_it_shows_arm_and_blocks_where_they_are() -> None:
    with arm() as simulated, Window(simulated, bullet.DIRECT) as window:
        simulated.on_step = window.step
        moved(simulated)
        window.show()
        for ours, theirs in zip(window.blocks, simulated.blocks, strict=True):
            shown = bullet.getBasePositionAndOrientation(ours, physicsClientId=window.client)
            assert np.concatenate(shown) == pytest.approx(
                np.concatenate(bullet.getBasePositionAndOrientation(theirs, physicsClientId=simulated.client)), abs=1e-6
            )
        joints = ArmIndices.of(window.body, window.client).arm
        shown = [state[0] for state in bullet.getJointStates(window.body, joints, physicsClientId=window.client)]
        assert shown == pytest.approx(simulated.state().joints, abs=1e-6)


def test_the_build_is_the_same_without_it() -> None:
    with arm() as alone:
        expected = moved(alone)
    with arm() as simulated, Window(simulated, bullet.DIRECT) as window:
        simulated.on_step = window.step
        found = moved(simulated)
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_who_closes_it_does_not_stop_the_build() -> None:
    with arm() as simulated, Window(simulated, bullet.DIRECT) as window:
        simulated.on_step = window.step
        bullet.disconnect(window.client)
        moved(simulated)
        assert window.client == -1
