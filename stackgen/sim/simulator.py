"""PyBullet: put a stack down, let time pass, say where the blocks went.

One client of PyBullet serves for any number of stacks, since opening one costs 25 ms and 34 MB: the
blocks of the last rollout are removed, which drops their contacts, and new ones are created in an order
of their own. Overlapping pairs are sorted. So a rollout depends on the stack alone: not on what was
simulated before, nor on the order of its blocks (tests/sim).
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import Shape

Floats = NDArray[np.float64]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence what native code prints: PyBullet greets at import, on the error stream."""
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        sys.stderr.flush()
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


with _quiet():
    import pybullet as bullet


@dataclass(frozen=True)
class Rollout:
    """What the simulator saw of a stack.

    Args:
        start: The stack as it was put down.
        end: The stack when the rollout ended.
        at_rest: Whether it ended because nothing moved any more.
        time: Simulated time [s].
        trajectory: (frames, k, 6) poses on the way, the first those of the start; None if they were not recorded.
    """

    start: Stack
    end: Stack
    at_rest: bool
    time: float
    trajectory: Floats | None = None

    @property
    def drop(self) -> Floats:
        """How far each block's centre sank [cell], (k,)."""
        return self.start.poses[:, 2] - self.end.poses[:, 2]


class Simulator:
    """Simulates stacks under one physics.

    >>> with Simulator() as simulator:
    ...     rollout = simulator.rollout(Stack([0], [[0, 0, 0.5, 0, 0, 0]]))
    >>> rollout.at_rest
    True
    """

    def __init__(self, physics: Physics | None = None) -> None:
        self.physics = physics or Physics()
        self._client: _Client | None = None

    def rollout(
        self, stack: Stack, *, until_fall: bool = False, until_moved: float = np.inf, record_every: int = 0
    ) -> Rollout:
        """Spawn a stack at its poses and watch it until it rests or the watch is over.

        Args:
            stack: The stack.
            until_fall: End as soon as a block fell: enough for a verdict, and much faster.
            until_moved: End as soon as a block moved further than this from its start [cell].
            record_every: Keep every n-th step's poses in the trajectory; 0 keeps none.
        """
        if self._client is None:
            self._client = _Client(self.physics)
        order = np.lexsort((*stack.poses.T, stack.shapes))  # the order of the blocks must not matter
        self._client.put([stack.catalogue[shape] for shape in stack.shapes[order]], stack.poses[order])
        poses, at_rest, steps, frames = self._client.run(until_fall, until_moved, record_every)
        back = np.argsort(order)
        trajectory = np.array([frame[back] for frame in frames]) if record_every else None
        return Rollout(stack, stack.with_poses(poses[back]), at_rest, steps * self.physics.time_step, trajectory)

    def close(self) -> None:
        """Give PyBullet's memory back; the simulator stays usable."""
        if self._client is not None:
            bullet.disconnect(self._client.number)
            self._client = None

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class _Client:
    """The PyBullet side of a simulator: metres inside, cells outside."""

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        self.number = connect(physics)
        self.molds: dict[Shape, Mold] = {}
        self.bodies: list[int] = []

    def put(self, shapes: Sequence[Shape], poses: Floats) -> None:
        """Clear the ground and spawn blocks."""
        for body in self.bodies:
            bullet.removeBody(body, physicsClientId=self.number)
        # A variable of the whole process in Bullet: another physics may have set it meanwhile.
        threshold = self.physics.contact_threshold
        bullet.setPhysicsEngineParameter(contactBreakingThreshold=threshold, physicsClientId=self.number)
        self.start = poses
        self.com = np.array([shape.center_of_mass for shape in shapes]).reshape(-1, 3)  # in the block frame [cell]
        rotation = Rotation.from_rotvec(poses[:, 3:])
        positions = (poses[:, :3] + rotation.apply(self.com)) * self.physics.cell_size
        self.bodies = [
            self._mold(shape).spawn(position, quaternion, self.number)
            for shape, position, quaternion in zip(shapes, positions.tolist(), rotation.as_quat().tolist(), strict=True)
        ]

    def _mold(self, shape: Shape) -> Mold:
        if shape not in self.molds:
            self.molds[shape] = Mold.cast(shape, self.physics, self.number)
        return self.molds[shape]

    def run(self, until_fall: bool, until_moved: float, record_every: int) -> tuple[Floats, bool, int, list[Floats]]:
        """Let time pass; return the final poses (k, 6), whether all rests, the steps taken and the recorded frames."""
        physics = self.physics
        window = max(1, round(physics.rest_window / physics.time_step))
        look = max(1, window // 5)
        frames = [self.start] if record_every else []
        start = anchor = self._states()
        anchor_step = 0
        # Until a coordinate of a centre of mass or of a quaternion changed by this much, no block can have moved
        # far enough: turning by an angle changes the quaternion's length by at least a quarter of it.
        arm = np.linalg.norm(self.com, axis=1).max(initial=0)
        stir = min(until_moved, physics.fall_height if until_fall else np.inf) / (1 + 10 * arm)
        for step in range(1, max(1, round(physics.watch / physics.time_step)) + 1):
            bullet.stepSimulation(physicsClientId=self.number)
            if record_every and step % record_every == 0:
                frames.append(self._poses(self._states()))
            if step % look:
                continue
            state = self._states()
            if np.abs(state - start).max(initial=0) > stir:
                poses = self._poses(state)
                moved = np.abs(poses[:, :3] - self.start[:, :3]).max(initial=0)
                sank = (self.start[:, 2] - poses[:, 2]).max(initial=0)
                if moved > until_moved or (until_fall and sank > physics.fall_height):
                    return poses, False, step, frames
            if np.abs(state - anchor).max(initial=0) > physics.rest_motion:
                anchor, anchor_step = state, step
            elif step - anchor_step >= window:
                return self._poses(state), True, step, frames
        return self._poses(self._states()), False, step, frames

    def _states(self) -> Floats:
        """Read centres of mass [cell] and quaternions, (k, 7)."""
        states = [bullet.getBasePositionAndOrientation(b, physicsClientId=self.number) for b in self.bodies]
        array = np.array([position + quaternion for position, quaternion in states]).reshape(-1, 7)
        array[:, :3] /= self.physics.cell_size
        return array

    def _poses(self, states: Floats) -> Floats:
        """Convert states (k, 7) to poses (k, 6) of the block frames [cell, rad]."""
        rotation = Rotation.from_quat(states[:, 3:])
        return np.concatenate([states[:, :3] - rotation.apply(self.com), rotation.as_rotvec()], axis=1)


def connect(physics: Physics, mode: int = bullet.DIRECT) -> int:
    """Open a client of PyBullet with gravity, ground and the solver's settings; return its number."""
    client = bullet.connect(mode)
    bullet.setGravity(0, 0, -physics.gravity, physicsClientId=client)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=physics.time_step,
        numSolverIterations=physics.solver_iterations,
        solverResidualThreshold=physics.solver_residual,
        contactBreakingThreshold=physics.contact_threshold,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
    ground = bullet.createMultiBody(0, plane, physicsClientId=client)
    bullet.changeDynamics(ground, -1, lateralFriction=physics.friction**0.5, physicsClientId=client)
    return client


@dataclass(frozen=True)
class Mold:
    """What the blocks of one shape have in common in one client: collision shape, mass and surface."""

    collision: int
    mass: float
    dynamics: dict[str, Any]

    @staticmethod
    def cast(shape: Shape, physics: Physics, client: int) -> Mold:
        """Prepare a shape; its body frame is at the centre of mass."""
        mass = physics.density * shape.volume * physics.cell_size**3
        dynamics: dict[str, Any] = {"lateralFriction": physics.friction**0.5}  # Bullet multiplies the two surfaces'
        if shape.is_box:
            half = [extent / 2 * physics.cell_size for extent in shape.size]
            collision = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
        else:
            corners = ((shape.vertices - shape.center_of_mass) * physics.cell_size).tolist()
            collision = bullet.createCollisionShape(bullet.GEOM_MESH, vertices=corners, physicsClientId=client)
            dynamics["collisionMargin"] = 0.0  # a mesh would float by its margin
            dynamics["localInertiaDiagonal"] = (mass * physics.cell_size**2 * _unit_inertia(shape)).tolist()
        return Mold(collision, mass, dynamics)

    def spawn(self, position: list[float], quaternion: list[float], client: int) -> int:
        """Add a block with its centre of mass at `position` [m]; return the number of its body."""
        body = bullet.createMultiBody(self.mass, self.collision, -1, position, quaternion, physicsClientId=client)
        bullet.changeDynamics(body, -1, **self.dynamics, physicsClientId=client)
        return int(body)


def _unit_inertia(shape: Shape) -> Floats:
    """Compute the diagonal inertia (3,) of a prism of mass 1 about its centre of mass [cell^2], without products."""
    a = np.asarray(shape.outline) - shape.center_of_mass[[0, 2]]
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    second = ((a**2 + a * b + b**2) * cross[:, None]).sum(axis=0) / (6 * cross.sum())  # means of x^2 and z^2
    xx, zz, yy = second[0], second[1], shape.depth**2 / 12
    return np.array([yy + zz, xx + zz, xx + yy])
