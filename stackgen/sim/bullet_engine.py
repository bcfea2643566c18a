"""PyBullet as an engine of the simulator. The simulated arm shares its molds and its kind of client.

One client serves for any number of stacks, since opening one costs 25 ms and 34 MB: the blocks of the
last rollout are removed, which drops their contacts, and overlapping pairs are sorted.
"""

from __future__ import annotations

import contextlib
import os
import sys
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.sim.physics import Physics, unit_inertia
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


class _Bullet:
    """PyBullet, imported when something of it is first asked for: what only plans, or prints a help, does without."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # asked of any object by who looks around in a module
            raise AttributeError(name)
        try:
            with _quiet():
                import pybullet
        except ModuleNotFoundError as error:
            raise StackgenError(
                "this needs PyBullet, which has wheels for CPython 3.11: use that, or build it by pip install pybullet"
            ) from error
        self.__dict__.update(vars(pybullet))
        return getattr(pybullet, name)


bullet: Any = _Bullet()


class BulletEngine:
    """A client of PyBullet, kept for many stacks.

    Args:
        physics: Numbers of the physics.
    """

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        self.number = connect(physics)
        self.molds: dict[Shape, Mold] = {}
        self.bodies: list[int] = []
        self._end = weakref.finalize(self, bullet.disconnect, self.number)

    def put(self, shapes: Sequence[Shape], positions: Floats, quaternions: Floats) -> None:
        """Clear the ground and spawn blocks."""
        for body in self.bodies:
            bullet.removeBody(body, physicsClientId=self.number)
        # A variable of the whole process in Bullet: another physics may have set it meanwhile.
        threshold = self.physics.contact_threshold
        bullet.setPhysicsEngineParameter(contactBreakingThreshold=threshold, physicsClientId=self.number)
        self.bodies = [
            self._mold(shape).spawn(position, quaternion, self.number)
            for shape, position, quaternion in zip(shapes, positions.tolist(), quaternions.tolist(), strict=True)
        ]

    def _mold(self, shape: Shape) -> Mold:
        if shape not in self.molds:
            self.molds[shape] = Mold.cast(shape, self.physics, self.number)
        return self.molds[shape]

    def step(self, number: int, forces: Floats | None = None) -> None:
        """Let a number of steps pass, under forces (k, 3) [N] on the centres of mass."""
        pulled = (
            [] if forces is None else [pair for pair in zip(self.bodies, forces.tolist(), strict=True) if any(pair[1])]
        )
        for _ in range(number):
            for body, force in pulled:  # Bullet forgets them with each step
                center, _turn = bullet.getBasePositionAndOrientation(body, physicsClientId=self.number)
                bullet.applyExternalForce(body, -1, force, center, bullet.WORLD_FRAME, physicsClientId=self.number)
            bullet.stepSimulation(physicsClientId=self.number)

    def states(self) -> Floats:
        """Read centres of mass [m] and quaternions, (k, 7)."""
        states = [bullet.getBasePositionAndOrientation(b, physicsClientId=self.number) for b in self.bodies]
        return np.array([position + quaternion for position, quaternion in states]).reshape(-1, 7)

    def close(self) -> None:
        """Give PyBullet's memory back; that is done, too, when nobody holds the engine any more."""
        self._end()


def connect(physics: Physics, mode: int | None = None) -> int:
    """Open a client of PyBullet with gravity, ground and the solver's settings, by default without a window."""
    client = bullet.connect(bullet.DIRECT if mode is None else mode)
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
    return int(client)


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
            dynamics["localInertiaDiagonal"] = (mass * physics.cell_size**2 * unit_inertia(shape)).tolist()
        return Mold(collision, mass, dynamics)

    def spawn(self, position: list[float], quaternion: list[float], client: int) -> int:
        """Add a block with its centre of mass at `position` [m]; return the number of its body."""
        body = bullet.createMultiBody(self.mass, self.collision, -1, position, quaternion, physicsClientId=client)
        bullet.changeDynamics(body, -1, **self.dynamics, physicsClientId=client)
        return int(body)
