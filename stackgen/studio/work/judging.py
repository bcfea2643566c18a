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
from stackgen.sim.simulator import Pull, Rollout, Simulator
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from stackgen.studio.requests import MOST_BLOCKS, PushRequest, StackRequest, TiltRequest
from stackgen.studio.work.drawings import views
from stackgen.viz.scene import quaternion_poses

Message = dict[str, Any]

FRAMES = 60
"""Frames of a rollout in a second."""

TILTED = 10.0
"""How fast the table tilts [degree/s]."""

PUSHED = 0.5
"""How fast a push grows [weight of the block/s]."""

_GONE = 0.1  # distance from its start at which a block has left its place [cell]
_FAR = 4.0  # distance from its start from which nobody looks after it [cell]
_STILL = 0.1  # speed below which it has not begun to move [cell/s]
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
        self.every = round(1 / FRAMES / physics.step)
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

    def rollout(self, stack: Stack, pull: Pull | None = None, until_fall: bool = False) -> Rollout:
        """Watch a stack, and record it."""
        return self._simulator.rollout(stack, until_fall=until_fall, record_every=self.every, pull=pull)

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
    if verdict.stable:
        return None
    return int(np.where(verdict.fell, _left(rollout, _GONE), np.inf).argmin())


def _left(rollout: Rollout, distance: float) -> NDArray[np.int64]:
    """Find the frame (k,) in which each block is this far from where it was, or the number of frames."""
    assert rollout.trajectory is not None
    path = rollout.trajectory[..., :3]
    gone = np.linalg.norm(path - path[0], axis=-1) > distance
    return np.where(gone.any(axis=0), gone.argmax(axis=0), len(path))


def _held_until(rollout: Rollout, block: int) -> int:
    """Find the last frame in which a block that fell had not begun to move."""
    assert rollout.trajectory is not None
    path = rollout.trajectory[: _left(rollout, _GONE)[block] + 1, block, :3]
    still = np.linalg.norm(np.diff(path, axis=0), axis=-1) * FRAMES < _STILL
    return int(np.flatnonzero(still).max(initial=-1)) + 1


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
    """Tilt the table under a stack, slowly, until a block falls: gravity turns, as seen from the table."""
    towards = math.radians(request.direction)

    def forces(k: int, degrees: float) -> NDArray[np.float64]:
        angle = math.radians(degrees)
        along = math.sin(angle)
        return np.tile([along * math.cos(towards), along * math.sin(towards), 1 - math.cos(angle)], (k, 1))

    _disturbed(request, send, forces, request.degrees, TILTED)


def pushed(request: PushRequest, send: Callable[[Message], None]) -> None:
    """Push one block of a stack, harder and harder, until a block falls.

    Raises:
        StackgenError: If there is no such block.
    """
    towards = math.radians(request.direction)

    def forces(k: int, force: float) -> NDArray[np.float64]:
        if request.block >= k:
            raise StackgenError(f"block must lie in 0..{k - 1}, got {request.block}")
        shares = np.zeros((k, 3))
        shares[request.block, :2] = force * math.cos(towards), force * math.sin(towards)
        return shares

    _disturbed(request, send, forces, request.force, PUSHED)


def _disturbed(
    request: StackRequest,
    send: Callable[[Message], None],
    forces: Callable[[int, float], NDArray[np.float64]],
    most: float,
    rate: float,
) -> None:
    """Let something grow at a rate, up to the most of it or until a block falls, and hold it there."""
    content, entry = chosen_stack(request)
    physics, k = physics_of(content), len(entry.stack)
    recorder = Recorder(physics)

    def up_to(amount: float, until_fall: bool) -> Rollout:
        pull = Pull(lambda time: forces(k, min(amount, rate * time)), amount / rate)
        return recorder.rollout(entry.stack, pull, until_fall)

    rollout, reached, fell_at, seen = up_to(most, until_fall=True), most, None, None
    verdict = judged(rollout, physics)
    if not verdict.stable:
        first, frame = first_to_go(rollout, verdict) or 0, rate * recorder.every * physics.step
        fell_at = round(min(most, frame * _held_until(rollout, first)), 2)
        left = int(_left(rollout, _GONE)[first])
        reached = min(most, frame * left)  # the hand that sees it go stops there
        rollout = up_to(reached, until_fall=False)
        seen = min(left + FRAMES, int(_left(rollout, _FAR).min()))  # later, all may have slid off the table
    facts = {**rollout_facts(rollout, physics), "reached": reached, "growth": rate, "fell_at": fell_at}
    send({"shapes": entry.stack.shapes.tolist(), **facts, "frames": facts["frames"][:seen]})


def checked(request: StackRequest, send: Callable[[Message], None]) -> None:
    """Judge a stack as it is sent."""
    content, entry = chosen_stack(request)
    send(entry_facts(entry, content, Recorder(physics_of(content)).rollout(entry.stack)))
