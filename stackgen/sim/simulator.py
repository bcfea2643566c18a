"""Put a stack down, let time pass, say where the blocks went.

One engine serves for any number of stacks. Their blocks are put down in an order of their own, so a
rollout depends on the stack alone: not on what was simulated before, nor on the order of its blocks
(tests/sim).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import quaternion_matrices, quaternions, rotation_vectors
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import Shape

Floats = NDArray[np.float64]


class Engine(Protocol):
    """What computes how blocks move; `bullet_engine` and `mujoco_engine` have one each."""

    def put(self, shapes: Sequence[Shape], positions: Floats, quaternions: Floats) -> None:
        """Put blocks on an empty ground, at rest.

        Args:
            shapes: The k shapes.
            positions: (k, 3) centres of mass [m].
            quaternions: (k, 4) orientations (x, y, z, w).
        """
        ...

    def step(self, number: int, forces: Floats | None = None) -> None:
        """Let a number of steps pass; forces (k, 3) [N] act on the centres of mass all the while."""
        ...

    def states(self) -> Floats:
        """Read centres of mass [m] and quaternions, (k, 7)."""
        ...

    def close(self) -> None:
        """Give the memory back."""
        ...


def open_engine(physics: Physics) -> Engine:
    """Open the engine that a physics names; only that one is imported."""
    if physics.engine == "mujoco":
        from stackgen.sim.mujoco_engine import MujocoEngine

        return MujocoEngine(physics)
    from stackgen.sim.bullet_engine import BulletEngine

    return BulletEngine(physics)


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


@dataclass(frozen=True)
class Pull:
    """Forces on the centres of mass of blocks that grow, and are then held.

    Args:
        forces: Gives the force on each block at a time [s], (k, 3), as a share of its weight.
        seconds: Time until which they grow [s].
    """

    forces: Callable[[float], Floats]
    seconds: float

    def ordered(self, order: NDArray[np.int64]) -> Pull:
        """The same forces on blocks in another order."""
        return Pull(lambda time: self.forces(time)[order], self.seconds)


class Simulator:
    """Simulates stacks under one physics.

    >>> with Simulator() as simulator:
    ...     rollout = simulator.rollout(Stack([0], [[0, 0, 0.5, 0, 0, 0]]))
    >>> rollout.at_rest
    True
    """

    def __init__(self, physics: Physics | None = None) -> None:
        self.physics = physics or Physics()
        self._scaled = replace(self.physics, cell_size=Physics.cell_size)
        self._engine: Engine | None = None

    def rollout(
        self,
        stack: Stack,
        *,
        until_fall: bool = False,
        until_moved: float = np.inf,
        record_every: int = 0,
        pull: Pull | None = None,
    ) -> Rollout:
        """Spawn a stack at its poses and watch it until it rests or the watch is over.

        Args:
            stack: The stack.
            until_fall: End as soon as a block fell: enough for a verdict, and much faster.
            until_moved: End as soon as a block moved further than this from its start [cell].
            record_every: Keep every n-th step's poses in the trajectory; 0 keeps none.
            pull: Forces beside gravity; the watch begins when they are held.
        """
        if self._engine is None:
            self._engine = open_engine(self._scaled)
        order = np.lexsort((*stack.poses.T, stack.shapes))  # the order of the blocks must not matter
        shapes = [stack.catalogue[shape] for shape in stack.shapes[order]]
        ordered = None if pull is None else pull.ordered(order)
        watch = _Watch(self._engine, self._scaled, shapes, stack.poses[order], ordered)
        poses, at_rest, steps, frames = watch.run(until_fall, until_moved, record_every)
        back = np.argsort(order)
        trajectory = np.array([frame[back] for frame in frames]) if record_every else None
        return Rollout(stack, stack.with_poses(poses[back]), at_rest, steps * self.physics.step, trajectory)

    def close(self) -> None:
        """Give the engine's memory back; the simulator stays usable."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class _Watch:
    """One stack in an engine: metres there, cells here."""

    def __init__(
        self, engine: Engine, physics: Physics, shapes: Sequence[Shape], poses: Floats, pull: Pull | None
    ) -> None:
        self.engine, self.physics, self.start, self.pull = engine, physics, poses, pull
        self.grown = 0 if pull is None else round(pull.seconds / physics.step)  # step from which forces are held
        self.weights = (
            np.array([shape.volume for shape in shapes]) * physics.density * physics.cell_size**3 * physics.gravity
        )
        self.com = np.array([shape.center_of_mass for shape in shapes]).reshape(-1, 3)  # in the block frame [cell]
        turned = quaternions(poses[:, 3:])
        engine.put(shapes, (poses[:, :3] + self._arms(turned)) * physics.cell_size, turned)

    def run(self, until_fall: bool, until_moved: float, record_every: int) -> tuple[Floats, bool, int, list[Floats]]:
        """Let time pass; return the final poses (k, 6), whether all rests, the steps taken and the recorded frames."""
        physics = self.physics
        window = max(1, round(physics.rest_window / physics.step))
        look = max(1, window // 5)
        frames = [self.start] if record_every else []
        start = anchor = self._states()
        anchor_step = self.grown
        # Until a coordinate of a centre of mass or of a quaternion changed by this much, no block can have moved
        # far enough: turning by an angle changes the quaternion's length by at least a quarter of it.
        arm = np.linalg.norm(self.com, axis=1).max(initial=0)
        stir = min(until_moved, physics.fall_height if until_fall else np.inf) / (1 + 10 * arm)
        for step in self._pass_time(look, record_every):
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
                anchor, anchor_step = state, max(step, self.grown)
            elif step - anchor_step >= window:
                return self._poses(state), True, step, frames
        return self._poses(self._states()), False, step, frames

    def _pass_time(self, look: int, record_every: int) -> Iterator[int]:
        """Let the watch pass; stop where it is looked at or recorded, and at its end. Yield the number of steps."""
        step, last = 0, self.grown + max(1, round(self.physics.watch / self.physics.step))
        while step < last:
            stop = min(last, *((step // every + 1) * every for every in (look, record_every) if every))
            self.engine.step(stop - step, self._forces(step * self.physics.step))
            yield (step := stop)

    def _forces(self, time: float) -> Floats | None:
        """Give the forces (k, 3) [N] at a time [s]."""
        return None if self.pull is None else self.pull.forces(time) * self.weights[:, None]

    def _states(self) -> Floats:
        """Read centres of mass [cell] and quaternions, (k, 7)."""
        return self.engine.states() / [*[self.physics.cell_size] * 3, 1, 1, 1, 1]

    def _poses(self, states: Floats) -> Floats:
        """Convert states (k, 7) to poses (k, 6) of the block frames [cell, rad]."""
        turned = states[:, 3:]
        unit = turned / np.sqrt((turned**2).sum(axis=1, keepdims=True))
        return np.concatenate([states[:, :3] - self._arms(unit), rotation_vectors(turned)], axis=1)

    def _arms(self, turned: Floats) -> Floats:
        """Give the ways (k, 3) from the blocks' references to their centres of mass, turned by quaternions [cell]."""
        return np.einsum("kij,kj->ki", quaternion_matrices(turned), self.com)
