"""From a pose of the flange to joint angles, by one of three solvers behind one interface.

Whatever a solver proposes is checked: the chain of the URDF must lead back to the pose, the angles must lie
within their limits, and all solutions belong to one arm branch, that of the cell's home position. Elbow, shoulder
and wrist then never flip, and the arm never swings through the table on its way between two near poses.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError
from stackgen.robot.planning.urdf import Chain, ur5_chain, ur5_urdf

Floats = NDArray[np.float64]
SolverName = Literal["urdf", "closed-form", "bullet"]

TOLERANCE_M = 1e-4
"""Largest distance of a solution from its pose [m]; that of the turn is as many radians."""

_MARGIN = 1e-3  # [rad] kept from the joint limits


class Unreachable(StackgenError):
    """No joint angles of the arm's branch lead to a pose."""


@dataclass(frozen=True)
class JointSolution:
    """Joint angles that were checked.

    Args:
        joints: (6,) [rad].
        distance: From the pose, by forward kinematics [m].
        turn: From the pose, likewise [rad].
    """

    joints: Floats
    distance: float
    turn: float


class InverseKinematics(ABC):
    """One arm, one branch.

    Args:
        home: (6,) joint angles whose branch all solutions share [rad].
        chain: Of the arm; the UR5's by default.
    """

    def __init__(self, home: ArrayLike, chain: Chain | None = None) -> None:
        self.chain = chain or ur5_chain()
        self.home = np.asarray(home, dtype=float)
        self.branch = branch_of(self.chain, self.home)

    @abstractmethod
    def candidates(self, flange_in_base: Floats, near: Floats) -> Sequence[Floats]:
        """Joint angles (6,) that may lead to the pose; nothing is promised of them."""

    def solve(self, flange_in_base: Floats, near: ArrayLike | None = None) -> JointSolution:
        """The solution next to some joint angles.

        Args:
            flange_in_base: (4, 4) pose.
            near: (6,) [rad]; home by default.

        Raises:
            Unreachable: If there is none within the limits, on the branch, and within the tolerance.
        """
        start = self.home if near is None else np.asarray(near, dtype=float)
        fitting = []
        for angles in self.candidates(flange_in_base, start):
            joints = self._wrapped(angles, start)
            if joints is None or branch_of(self.chain, joints) != self.branch:
                continue
            distance, turn = residual(self.chain.forward(joints), flange_in_base)
            if max(distance, turn) <= TOLERANCE_M:
                fitting.append(JointSolution(joints, distance, turn))
        if not fitting:
            x, y, z = flange_in_base[:3, 3]
            raise Unreachable(f"the flange cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m from the base in that direction")
        return min(fitting, key=lambda solution: float(np.abs(solution.joints - start).max()))

    def _wrapped(self, angles: Floats, near: Floats) -> Floats | None:
        """The same angles by whole turns next to `near`; None where that is beyond a limit."""
        lower, upper = self.chain.lower + _MARGIN, self.chain.upper - _MARGIN
        joints = angles + 2 * np.pi * np.round((near - angles) / (2 * np.pi))
        joints = np.where(joints > upper, joints - 2 * np.pi, np.where(joints < lower, joints + 2 * np.pi, joints))
        return joints if ((joints >= lower) & (joints <= upper)).all() else None


class ClosedForm(InverseKinematics):
    """The UR5's closed form, by ur-analytic-ik: all branches of every pose in 15 microseconds.

    Raises:
        StackgenError: If the chain is not that of a UR5.
    """

    def __init__(self, home: ArrayLike, chain: Chain | None = None) -> None:
        super().__init__(home, chain)
        from ur_analytic_ik import ur5

        self._inverse = ur5.inverse_kinematics
        for joints in (np.full(6, 0.3), self.home):
            if (
                np.abs(_CONTROLLER_FROM_BASE @ self.chain.forward(joints) - ur5.forward_kinematics(*joints)).max()
                > 1e-6
            ):
                raise StackgenError("the closed form is the UR5's, but the URDF is of another arm")

    def candidates(self, flange_in_base: Floats, near: Floats) -> Sequence[Floats]:
        """All branches."""
        return [np.asarray(q) for q in self._inverse(np.ascontiguousarray(_CONTROLLER_FROM_BASE @ flange_in_base))]


_CONTROLLER_FROM_BASE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The controller's base frame is the URDF's base_link turned by 180 degrees about z."""


class DampedLeastSquares(InverseKinematics):
    """Newton steps over the URDF's own chain; where the arm is a UR5 they start at the closed form.

    Args:
        home, chain: As there.
        seeds: Whether to start at the closed form, too.
    """

    def __init__(self, home: ArrayLike, chain: Chain | None = None, seeds: bool = True) -> None:
        super().__init__(home, chain)
        self._closed: ClosedForm | None = None
        if seeds:
            with contextlib.suppress(StackgenError):
                self._closed = ClosedForm(home, self.chain)

    def candidates(self, flange_in_base: Floats, near: Floats) -> Sequence[Floats]:
        """Where the steps end that start at the closed form, or else at `near` and at home turned to the pose."""
        if self._closed is not None:
            starts = self._closed.candidates(flange_in_base, near)
            starts = [start for start in starts if branch_of(self.chain, start) == self.branch]
        else:
            starts = [near, pointed(self.home, flange_in_base, self.chain)]
        return [self._descend(start, flange_in_base) for start in starts]

    def _descend(self, start: Floats, goal: Floats, steps: int = 100, damping: float = 1e-3) -> Floats:
        """Damped steps from `start` until the pose is met, or `steps` are taken."""
        joints = np.array(start)
        for _ in range(steps):
            error = _twist(self.chain.forward(joints), goal)
            if np.abs(error).max() < 1e-9:
                break
            jacobian = self.chain.jacobian(joints)
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping**2 * np.eye(6), error)
            joints = joints + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        return joints


class Bullet(InverseKinematics):
    """PyBullet's solver, started at home turned to the pose; asked again from where it ended until it is near."""

    def __init__(self, home: ArrayLike, chain: Chain | None = None) -> None:
        super().__init__(home, chain)
        from stackgen.sim.simulator import bullet

        self._bullet, self._client = bullet, bullet.connect(bullet.DIRECT)
        self._arm = bullet.loadURDF(str(ur5_urdf()), useFixedBase=True, physicsClientId=self._client)
        numbers = range(bullet.getNumJoints(self._arm, physicsClientId=self._client))
        infos = [bullet.getJointInfo(self._arm, i, physicsClientId=self._client) for i in numbers]
        self._moving = [info[0] for info in infos if info[2] == bullet.JOINT_REVOLUTE]
        self._flange = next(info[0] for info in infos if info[12] == b"tool0")

    def candidates(self, flange_in_base: Floats, near: Floats) -> Sequence[Floats]:
        """Where the solver ends."""
        found = []
        for start in (near, pointed(self.home, flange_in_base, self.chain)):
            joints = self._settle(start, flange_in_base)
            found.append(joints)
            if residual(self.chain.forward(joints), flange_in_base)[0] <= TOLERANCE_M / 2:
                break
        return found

    def _settle(self, start: Floats, goal: Floats, calls: int = 40) -> Floats:
        quaternion = Rotation.from_matrix(goal[:3, :3]).as_quat().tolist()
        joints = start
        for _ in range(calls):
            for index, angle in zip(self._moving, joints, strict=True):
                self._bullet.resetJointState(self._arm, index, angle, physicsClientId=self._client)
            joints = np.array(
                self._bullet.calculateInverseKinematics(
                    self._arm,
                    self._flange,
                    goal[:3, 3].tolist(),
                    quaternion,
                    maxNumIterations=100,
                    residualThreshold=1e-9,
                    physicsClientId=self._client,
                )
            )
            if max(residual(self.chain.forward(joints), goal)) < TOLERANCE_M / 4:
                break
        return joints

    def close(self) -> None:
        """Give the world's memory back."""
        if self._client >= 0:
            self._bullet.disconnect(self._client)
            self._client = -1

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()


SOLVERS: dict[SolverName, type[InverseKinematics]] = {
    "urdf": DampedLeastSquares,
    "closed-form": ClosedForm,
    "bullet": Bullet,
}


def branch_of(chain: Chain, joints: ArrayLike) -> tuple[bool, bool, bool]:
    """Which of the eight ways to a pose: wrist before the shoulder, elbow bent one way, wrist turned one way."""
    angles = np.asarray(joints, dtype=float)
    frames = chain.frames(angles)
    forward = frames[0, :3, :3].T @ (frames[3, :3, 3] - frames[0, :3, 3])
    return bool(forward[0] > 0), bool(np.sin(angles[2]) > 0), bool(np.sin(angles[4]) > 0)


def residual(reached: Floats, wanted: Floats) -> tuple[float, float]:
    """Distance [m] and turn [rad] between two poses (4, 4)."""
    error = _twist(reached, wanted)
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


def _twist(reached: Floats, wanted: Floats) -> Floats:
    """(6,) displacement and rotation vector from one pose to the other, in the base."""
    turn = Rotation.from_matrix(wanted[:3, :3] @ reached[:3, :3].T).as_rotvec()
    return np.concatenate([wanted[:3, 3] - reached[:3, 3], turn])


def pointed(home: Floats, flange_in_base: Floats, chain: Chain) -> Floats:
    """(6,) home with its first joint turned so that the flange lies in the direction of the pose."""
    there, here = flange_in_base[:2, 3], chain.forward(home)[:2, 3]
    joints = home.copy()
    joints[0] += np.arctan2(there[1], there[0]) - np.arctan2(here[1], here[0])
    joints[0] -= 2 * np.pi * np.round((joints[0] - home[0]) / (2 * np.pi))
    return joints
