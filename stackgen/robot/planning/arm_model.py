"""Kinematics of an arm, read from its URDF by Pinocchio. Lengths in metres, angles in radians; n joints."""

from __future__ import annotations

from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import require
from stackgen.robot.planning.urdf import chain_urdf, unusable
from stackgen.robot.workcell import ArmDescription

Floats = NDArray[np.float64]


class ArmModel:
    """A serial arm of n revolute joints, from its base to its flange.

    Args:
        arm: Its description.

    Raises:
        StackgenError: If Pinocchio is not installed, or cannot read the description, or that has no such chain.
    """

    def __init__(self, arm: ArmDescription) -> None:
        self.pinocchio: Any = require("pinocchio", "robot")
        text = ElementTree.tostring(chain_urdf(arm), encoding="unicode")
        try:
            self.model = self.pinocchio.buildModelFromXML(text)
        except (ValueError, RuntimeError) as error:
            raise unusable(arm, error) from error
        self.data = self.model.createData()
        self.flange = self.model.getFrameId(arm.flange)
        self.names = tuple(self.model.names)[1:]
        self.lower, self.upper = self.model.lowerPositionLimit, self.model.upperPositionLimit
        self.effort = self.model.effortLimit
        self.axes = self.jacobian(np.zeros(len(self)))[3:].T.copy()  # (n, 3) in the base, at angle 0
        self.like_ur5 = len(self) == 6 and bool(np.abs(np.cross(self.axes[1], self.axes[2:4])).max() < 1e-3)

    def __len__(self) -> int:
        return int(self.model.nv)

    def forward(self, joints: ArrayLike) -> Floats:
        """(4, 4) pose of the flange in the base, for joint angles (n,)."""
        self.pinocchio.framesForwardKinematics(self.model, self.data, np.asarray(joints, dtype=float))
        return np.asarray(self.data.oMf[self.flange].homogeneous)

    def joint_frames(self, joints: ArrayLike) -> Floats:
        """(n, 4, 4) frames of the links after each joint, in the base."""
        self.pinocchio.forwardKinematics(self.model, self.data, np.asarray(joints, dtype=float))
        return np.array([self.data.oMi[number].homogeneous for number in range(1, self.model.njoints)])

    def jacobian(self, joints: ArrayLike) -> Floats:
        """(6, n) velocity and angular velocity of the flange in the base, for the speed of each joint."""
        angles, world = np.asarray(joints, dtype=float), self.pinocchio.LOCAL_WORLD_ALIGNED
        return np.asarray(self.pinocchio.computeFrameJacobian(self.model, self.data, angles, self.flange, world))


@lru_cache(maxsize=8)
def arm_model(arm: ArmDescription) -> ArmModel:
    """The model of an arm, read once.

    >>> arm_model(ArmDescription()).names[:2], len(arm_model(ArmDescription()))
    (('shoulder_pan_joint', 'shoulder_lift_joint'), 6)
    """
    return ArmModel(arm)
