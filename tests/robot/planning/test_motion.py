"""Motions start and end at rest, keep to their limits, and go straight."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.kinematics import ClosedForm
from stackgen.robot.planning.motion import Motion, joint_motion, line_motion
from stackgen.robot.planning.staging import TIP_UP
from stackgen.robot.workcell import Speeds, Workcell, pose

ARM = arm_model(Workcell().arm)
WORKCELL, SPEEDS = Workcell(), Speeds()
HOME = WORKCELL.home_joints
GOAL = HOME + np.array([0.8, -0.2, 0.3, 0.1, 0.0, -0.4])


def motion() -> Motion:
    found = joint_motion("transit", HOME, GOAL, SPEEDS)
    assert found is not None
    return found


def accelerations(some: Motion) -> NDArray[np.float64]:
    return np.diff(some.velocities, axis=0) / np.diff(some.times)[:, None]


def test_a_joint_motion_starts_and_ends_at_rest_and_goes_straight() -> None:
    found = motion()
    assert np.allclose(found.positions[0], HOME) and np.allclose(found.end, GOAL)
    assert np.allclose(found.velocities[[0, -1]], 0, atol=1e-9)
    shares = (found.positions - HOME)[:, [0, 1, 2, 3, 5]] / (GOAL - HOME)[[0, 1, 2, 3, 5]]
    assert np.allclose(shares, shares[:, :1])


def test_a_joint_motion_keeps_to_its_limits_and_meets_them() -> None:
    fastest, hardest = np.radians(SPEEDS.joint), np.radians(SPEEDS.joint_acceleration)
    long = joint_motion("transit", HOME, HOME + np.array([2.0, 0, 0, 0, 0, 0]), SPEEDS)
    assert long is not None
    for found in (motion(), long):
        assert np.abs(found.velocities).max() <= fastest * (1 + 1e-6)
        assert np.abs(accelerations(found)).max() <= hardest * (1 + 1e-3)
    assert np.abs(long.velocities).max() == pytest.approx(fastest)  # as fast as it may


def test_nothing_to_do_is_no_motion() -> None:
    assert joint_motion("transit", HOME, HOME.copy(), SPEEDS) is None


def test_a_line_is_straight_in_space_and_as_slow_as_asked_for() -> None:
    kinematics = ClosedForm(ARM, HOME)
    heights = np.linspace(0.25, 0.02, 13)
    joints = [HOME]
    for height in heights:
        joints.append(kinematics.solve(WORKCELL.flange_in_base(pose((0.1, 0.0, height)) @ TIP_UP), joints[-1]).joints)
    found = line_motion("lower", np.array(joints[1:]), heights[0] - heights, speed=0.1, speeds=SPEEDS)
    tips = np.array([WORKCELL.tip_in_table(ARM.forward(q))[:3, 3] for q in found.positions])
    assert np.abs(tips[:, :2] - [0.1, 0.0]).max() < 2e-4
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(found.times)
    assert speeds.max() == pytest.approx(0.1, rel=0.02)
    assert found.duration > 0.23 / 0.1


def test_a_motion_is_known_at_any_time() -> None:
    found = motion()
    positions, velocities = found.at(found.times)
    assert np.allclose(positions, found.positions) and np.allclose(velocities, found.velocities)
    after, still = found.at(found.duration + 1)
    assert np.allclose(after, GOAL) and np.allclose(still, 0, atol=1e-9)
