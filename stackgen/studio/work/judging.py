"""What the studio says of a stack: how it settles or falls and why, on a level table, a tilted one, or pushed.

Legend: k blocks. Poses in messages are positions [cell] and quaternions; angles in messages are in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import centers_of_mass
from stackgen.io.stacks_file import StackEntry, StacksFile, from_json
from stackgen.protocols import Verdict
from stackgen.sim.checkers import judged
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Rollout, Simulator
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from stackgen.studio.requests import MOST_BLOCKS, PushRequest, StackRequest, TiltRequest
from stackgen.studio.work.drawings import views
from stackgen.viz.scene import quaternion_poses

Message = dict[str, Any]

FRAMES = 60
"""Frames of a rollout in a second."""

_BEGUN = 0.1  # distance from its start at which a block has begun to fall [cell]
_MOST_STACKS = 100  # of a file that is sent


class Recorder:
    """A StabilityChecker that keeps the rollouts behind its verdicts.

    Args:
        physics: Numbers of the physics.
        on_check: Called with each verdict.
    """

    def __init__(self, physics: Physics, on_check: Callable[[Verdict], None] = lambda verdict: None) -> None:
        self.physics = physics
        self.rollouts: list[Rollout] = []
        self._simulator, self._on_check = Simulator(physics), on_check

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        self.rollouts.append(self.rollout(stack))
        verdict = judged(self.rollouts[-1], self.physics)
        self._on_check(verdict)
        return verdict

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order."""
        return [self.check(stack) for stack in stacks]

    def rollout(self, stack: Stack, pull: NDArray[np.float64] | None = None) -> Rollout:
        """Watch a stack, and record it."""
        return self._simulator.rollout(stack, record_every=round(1 / FRAMES / self.physics.step), pull=pull)

    def behind(self, stack: Stack) -> Rollout:
        """Find how a stack came to lie as it does: the rollout that ended with it, or began with it, or a new one."""
        for rollout in self.rollouts:
            if np.array_equal(rollout.end.poses, stack.poses) and np.array_equal(rollout.end.shapes, stack.shapes):
                return rollout
        for rollout in self.rollouts:
            if np.array_equal(rollout.start.poses, stack.poses) and np.array_equal(rollout.start.shapes, stack.shapes):
                return rollout
        return self.rollout(stack)


def entry_facts(entry: StackEntry, content: StacksFile, rollout: Rollout) -> Message:
    """Tell all that the page shows of one stack."""
    stack, verdict = entry.stack, entry.verdict or judged(rollout, physics_of(content))
    shown = verdict.settled if verdict.stable else stack
    return {
        "shapes": stack.shapes.tolist(),
        "poses": quaternion_poses(stack.poses, 4),
        **rollout_facts(rollout, physics_of(content)),
        "front_iou": entry.front_iou,
        "matches": entry.matches,
        "comment": entry.comment,
        "statics": statics_facts(stack, physics_of(content)),
        "views": None if content.target is None else views(shown, content.target, content.world.grid),
    }


def rollout_facts(rollout: Rollout, physics: Physics) -> Message:
    """Tell how a rollout went: its frames, the verdict, and which block went first."""
    verdict = judged(rollout, physics)
    assert rollout.trajectory is not None
    return {
        "stable": verdict.stable,
        "at_rest": verdict.at_rest,
        "fell": np.flatnonzero(verdict.fell).tolist(),
        "first": first_to_go(rollout, verdict),
        "seconds": round(rollout.time, 3),
        "frames": [quaternion_poses(frame, 4) for frame in rollout.trajectory],
        "rate": 1 / (round(1 / FRAMES / physics.step) * physics.step),
    }


def first_to_go(rollout: Rollout, verdict: Verdict) -> int | None:
    """Find the block of those that fell which left its place first; None where none fell."""
    if verdict.stable or rollout.trajectory is None:
        return None
    path = rollout.trajectory[..., :3]
    gone = np.linalg.norm(path - path[0], axis=-1) > _BEGUN
    when = np.where(gone.any(axis=0), gone.argmax(axis=0), len(path))
    return int(np.where(verdict.fell, when, len(path) + 1).argmin())


def statics_facts(stack: Stack, physics: Physics) -> Message:
    """Tell what statics says: the margins, where the weights are, where blocks touch, and why one is not held."""
    checker = StaticsChecker(physics)
    found = checker.answer(stack, with_push=True)
    centers = centers_of_mass(stack)
    weights = np.array([stack.catalogue[int(shape)].volume for shape in stack.shapes])
    return {
        "stable": found.stable,
        "margin": round(math.degrees(found.margin), 2),
        "push": None if found.push is None else round(found.push, 3),
        "missing": round(found.residual, 3),
        "unheld": np.flatnonzero(found.unheld).tolist(),
        "reasons": {str(block): reason for block, reason in checker.reasons(stack, found).items()},
        "centers": centers.round(4).tolist(),
        "center": (weights @ centers / max(weights.sum(), 1e-9)).round(4).tolist(),
        "contacts": [
            {"blocks": [contact.block, contact.by], "points": np.asarray(contact.points).round(4).tolist()}
            for contact in found.contacts
        ],
    }


def physics_of(content: StacksFile) -> Physics:
    """The physics that the stacks of a file are simulated with."""
    return Physics.recorded(content.physics)


def chosen_stack(request: StackRequest) -> tuple[StacksFile, StackEntry]:
    """Read the file of a request, and pick the stack that it names.

    Raises:
        StackgenError: If the file is none, is too large, or has no such stack.
    """
    content = from_json(request.file)
    if len(content.entries) > _MOST_STACKS:
        raise StackgenError(f"file.stacks has {len(content.entries)} stacks; send at most {_MOST_STACKS}")
    if request.stack >= len(content.entries):
        raise StackgenError(f"stack must lie in 0..{len(content.entries) - 1}, got {request.stack}")
    entry = content.entries[request.stack]
    if not 1 <= len(entry.stack) <= MOST_BLOCKS:
        raise StackgenError(f"the stack has {len(entry.stack)} blocks; the studio takes 1 to {MOST_BLOCKS}")
    if len(entry.stack) and np.abs(entry.stack.poses).max() > 1000:
        raise StackgenError("the stack has a block further than 1000 cells from the middle; move it nearer")
    return content, entry


def tilted(request: TiltRequest, send: Callable[[Message], None]) -> None:
    """Tilt the table under a stack: gravity turns, as seen from the table."""
    angle, towards = math.radians(request.degrees), math.radians(request.direction)
    along = math.sin(angle)
    pull = np.array([along * math.cos(towards), along * math.sin(towards), 1 - math.cos(angle)])
    _disturbed(request, send, lambda k: np.tile(pull, (k, 1)))


def pushed(request: PushRequest, send: Callable[[Message], None]) -> None:
    """Push one block of a stack all the while.

    Raises:
        StackgenError: If there is no such block.
    """
    towards = math.radians(request.direction)

    def pull(k: int) -> NDArray[np.float64]:
        if request.block >= k:
            raise StackgenError(f"block must lie in 0..{k - 1}, got {request.block}")
        forces = np.zeros((k, 3))
        forces[request.block, :2] = request.force * math.cos(towards), request.force * math.sin(towards)
        return forces

    _disturbed(request, send, pull)


def _disturbed(
    request: StackRequest, send: Callable[[Message], None], pull: Callable[[int], NDArray[np.float64]]
) -> None:
    content, entry = chosen_stack(request)
    physics = physics_of(content)
    rollout = Recorder(physics).rollout(entry.stack, pull(len(entry.stack)))
    send({"shapes": entry.stack.shapes.tolist(), **rollout_facts(rollout, physics)})


def checked(request: StackRequest, send: Callable[[Message], None]) -> None:
    """Judge a stack as it is sent."""
    content, entry = chosen_stack(request)
    send(entry_facts(entry, content, Recorder(physics_of(content)).rollout(entry.stack)))
