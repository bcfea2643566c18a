"""From a pose of the flange to joint angles, by one of two solvers behind one interface.

Both read the arm's URDF. Whatever a solver proposes is checked: forward kinematics must lead back to the pose, the
angles must lie within their limits, and all solutions of an arm like the UR5 belong to one branch, that of the
workcell's home position. Elbow, shoulder and wrist then never flip, and the arm never swings through the table on its
way between two near poses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError, require
from stackgen.robot.planning.arm_model import ArmModel

Floats = NDArray[np.float64]
SolverName = Literal["urdf", "closed-form"]

TOLERANCE = 1e-6
"""Largest distance of a solution from its pose [m], and largest turn [rad]."""

_MARGIN = 1e-3  # kept from the joint limits [rad]
_CLOSE = 1e-9  # the iteration ends here [m, rad]
_STEPS = 100  # of an iteration, at most; from a good start it takes about five
_DAMPING = 1e-6
_LARGEST_STEP = 0.5  # of any joint [rad]
_RESTARTS = 20  # from angles around home, where both good starts fail


class Unreachable(StackgenError):
    """No joint angles of the arm's branch lead to a pose."""


@dataclass(frozen=True)
class JointSolution:
    """Joint angles that were checked.

    Args:
        joints: (n,) angles [rad].
        distance: Distance from the pose, by forward kinematics [m].
        turn: Turn from the pose, by forward kinematics [rad].
    """

    joints: Floats
    distance: float
    turn: float


class InverseKinematics(ABC):
    """A solver for one arm on one branch.

    Args:
        arm: Model of the arm.
        home: (n,) joint angles whose branch all solutions share [rad].

    Raises:
        StackgenError: If `home` has another number of joints than the arm.
    """

    def __init__(self, arm: ArmModel, home: ArrayLike) -> None:
        self.arm, self.home = arm, np.asarray(home, dtype=float)
        if self.home.shape != (len(arm),):
            raise StackgenError(f"cell.home: the arm has {len(arm)} joints, got {self.home.size} angles")
        self.branch = branch_of(arm, self.home)

    @abstractmethod
    def candidates(self, flange_in_base: Floats, near: Floats) -> Iterable[Floats]:
        """Joint angles (n,) that may lead to the pose; nothing is promised of them."""

    def solve(self, flange_in_base: Floats, near: ArrayLike | None = None) -> JointSolution:
        """Find the solution next to some joint angles.

        Args:
            flange_in_base: (4, 4) pose.
            near: (n,) joint angles [rad]; home by default.

        Raises:
            Unreachable: If there is none within the limits, on the branch, and within the tolerance.
        """
        start = self.home if near is None else np.asarray(near, dtype=float)
        fitting = []
        for angles in self.candidates(flange_in_base, start):
            joints = self._wrapped(angles, start)
            if joints is None or branch_of(self.arm, joints) != self.branch:
                continue
            distance, turn = residual(self.arm.forward(joints), flange_in_base)
            if max(distance, turn) <= TOLERANCE:
                fitting.append(JointSolution(joints, distance, turn))
        if not fitting:
            x, y, z = flange_in_base[:3, 3]
            raise Unreachable(f"the flange cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m from the base in that direction")
        return min(fitting, key=lambda solution: float(np.abs(solution.joints - start).max()))

    def _wrapped(self, angles: Floats, near: Floats) -> Floats | None:
        """Turn angles by whole turns next to `near`; None where that is beyond a limit."""
        lower, upper = self.arm.lower + _MARGIN, self.arm.upper - _MARGIN
        joints = angles + 2 * np.pi * np.round((near - angles) / (2 * np.pi))
        joints = np.where(joints > upper, joints - 2 * np.pi, np.where(joints < lower, joints + 2 * np.pi, joints))
        return joints if ((joints >= lower) & (joints <= upper)).all() else None


class Iterative(InverseKinematics):
    """Damped Newton steps with Pinocchio's Jacobian, for an arm of any number of joints."""

    def candidates(self, flange_in_base: Floats, near: Floats) -> Iterator[Floats]:
        """Where the steps end that start at `near` and at home turned to the pose, else at angles around home."""
        met = False
        for start in (near, self._pointed(flange_in_base)):
            joints, reached = self._descend(start, flange_in_base)
            met |= reached and self._wrapped(joints, near) is not None and branch_of(self.arm, joints) == self.branch
            yield joints
        random = np.random.default_rng(0)
        for _ in range(0 if met else _RESTARTS):
            yield self._descend(self.home + random.normal(0, 0.5, len(self.arm)), flange_in_base)[0]

    def _descend(self, start: Floats, goal: Floats) -> tuple[Floats, bool]:
        """Damped steps from `start` until the pose is met, or enough are taken; and whether it is met."""
        pin, model, data, flange = self.arm.pinocchio, self.arm.model, self.arm.data, self.arm.flange
        wanted, joints = pin.SE3(goal), np.array(start)
        lower, upper = self.arm.lower + _MARGIN, self.arm.upper - _MARGIN
        for _ in range(_STEPS):
            pin.framesForwardKinematics(model, data, joints)
            away = data.oMf[flange].actInv(wanted)
            error = pin.log6(away).vector
            if np.abs(error).max() < _CLOSE:
                return joints, True
            slope = pin.Jlog6(away.inverse()) @ pin.computeFrameJacobian(model, data, joints, flange, pin.LOCAL)
            step = slope.T @ np.linalg.solve(slope @ slope.T + _DAMPING * np.eye(6), error)
            step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
            joints = np.clip(joints + step, lower, upper)
        return joints, False

    def _pointed(self, flange_in_base: Floats) -> Floats:
        """(n,) home with its first joint turned so that the flange lies in the direction of the pose."""
        there, here = flange_in_base[:2, 3], self.arm.forward(self.home)[:2, 3]
        joints = self.home.copy()
        joints[0] += np.arctan2(there[1], there[0]) - np.arctan2(here[1], here[0])
        joints[0] -= 2 * np.pi * np.round((joints[0] - self.home[0]) / (2 * np.pi))
        return joints


class ClosedForm(InverseKinematics):
    """All solutions of a pose at once, by EAIK: for the UR arms, and others of six joints whose axes allow it.

    Raises:
        StackgenError: If the arm has no closed form.
    """

    def __init__(self, arm: ArmModel, home: ArrayLike) -> None:
        super().__init__(arm, home)
        robot = require("eaik.IK_HP", "robot").HPRobot
        zeros = np.zeros(len(arm))
        flange = arm.forward(zeros)
        points = np.concatenate([[np.zeros(3)], arm.joint_frames(zeros)[:, :3, 3], [flange[:3, 3]]])
        self._robot: Any = robot(arm.axes, np.diff(points, axis=0)) if len(arm) == 6 else None
        if self._robot is None or not self._robot.hasKnownDecomposition():
            raise StackgenError("--solver closed-form: this arm has no closed form; use --solver urdf")
        self._turn = flange[:3, :3]  # EAIK's flange is parallel to the base at angle 0

    def candidates(self, flange_in_base: Floats, near: Floats) -> Iterable[Floats]:
        """All branches."""
        goal = flange_in_base.copy()
        goal[:3, :3] = flange_in_base[:3, :3] @ self._turn.T
        return [np.asarray(joints) for joints in self._robot.IK(goal).Q]


SOLVERS: dict[SolverName, type[InverseKinematics]] = {"urdf": Iterative, "closed-form": ClosedForm}


def branch_of(arm: ArmModel, joints: ArrayLike) -> tuple[bool, ...]:
    """Tell which of the eight ways to a pose an arm like the UR5 takes.

    Returns:
        Whether the wrist is before the shoulder, the elbow bent one way, and the wrist turned one way; nothing for
        an arm whose second to fourth axis are not parallel: its solutions follow the angles that they start from.
    """
    if not arm.like_ur5:
        return ()
    angles = np.asarray(joints, dtype=float)
    frames = arm.joint_frames(angles)
    forward = frames[0, :3, :3].T @ (frames[3, :3, 3] - frames[0, :3, 3])
    return bool(forward[0] > 0), bool(np.sin(angles[2]) > 0), bool(np.sin(angles[4]) > 0)


def residual(reached: Floats, wanted: Floats) -> tuple[float, float]:
    """Distance [m] and turn [rad] between two poses (4, 4)."""
    turn = Rotation.from_matrix(wanted[:3, :3] @ reached[:3, :3].T).magnitude()
    return float(np.linalg.norm(wanted[:3, 3] - reached[:3, 3])), float(turn)
