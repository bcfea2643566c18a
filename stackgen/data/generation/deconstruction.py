"""Construction by deconstruction: from one settled template, all the stacks inside it (paper, Fig. 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.sim.verdict import AcceptLimits, accept
from stackgen.sim.world import Simulator
from stackgen.stack import Stack


@dataclass(frozen=True)
class Judge:
    """Settles a stack and says whether it may be data.

    Args:
        simulator: Of the dataset's catalogue and physics.
        limits: See AcceptLimits.
        settle_twice: Simulate the settled stack again, from a fresh start: it must stand once more.
            The paper settles once; a marginal stack or two then slips in.
    """

    simulator: Simulator
    limits: AcceptLimits
    settle_twice: bool

    def settle(self, stack: Stack) -> Stack | None:
        """The settled stack, or None."""
        if surely_falls(stack):
            return None
        for _ in range(1 + self.settle_twice):
            rollout = self.simulator.rollout(stack, until_moved=self.limits.displacement)
            if not accept(rollout, self.limits):
                return None
            stack = rollout.end
        return stack


def deconstruct(template: Stack, judge: Judge, max_removals: int = 4) -> Iterator[tuple[tuple[int, ...], Stack]]:
    """The template and what is left of it after every way of taking blocks out, as long as it stands.

    Blocks are taken out one at a time, from settled and stable stacks only; what two orders of removal
    both reach is simulated once. The top row keeps at least one block, so every stack keeps its height.

    Yields:
        The numbers of the removed blocks and the settled rest, fewest removals first.
    """
    settled = judge.settle(template)
    if settled is None:
        return
    bottoms = np.round(template.poses[:, 2], 3)
    top = frozenset(np.flatnonzero(bottoms == bottoms.max()).tolist())
    level: dict[tuple[int, ...], Stack] = {(): settled}
    for removals in range(max_removals + 1):
        yield from level.items()
        if removals == max_removals:
            return
        below: dict[tuple[int, ...], Stack | None] = {}
        for removed, stack in level.items():
            left = [b for b in range(len(template)) if b not in removed]
            for place, block in enumerate(left):
                taken = tuple(sorted((*removed, block)))
                if taken in below or not top - set(taken):
                    continue
                keep = [i for i in range(len(left)) if i != place]
                below[taken] = judge.settle(Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue))
        level = {taken: stack for taken, stack in below.items() if stack is not None}


def surely_falls(stack: Stack, reach: float = 0.1, slack: float = 0.05) -> bool:
    """Whether a block of a nearly upright stack hangs in the air, or one that bears nothing has its
    centre of mass beside its supports. Half of all removals end so; this spares the simulator them.

    Args:
        stack: Any stack; tilts are neglected, so it may only be asked of settled or designed ones.
        reach: Faces nearer than this [cell] touch.
        slack: By how much the centre of mass must be outside [cell].
    """
    sizes = np.array([stack.catalogue[s].size for s in stack.shapes])
    coms = np.array([stack.catalogue[s].center_of_mass[0] for s in stack.shapes])
    x, z = stack.poses[:, 0], stack.poses[:, 2]
    left, right = x - sizes[:, 0] / 2, x + sizes[:, 0] / 2
    bottom, top = z - sizes[:, 2] / 2, z + sizes[:, 2] / 2
    overlap = (left[:, None] < right) & (left < right[:, None])
    rests = (np.abs(bottom[:, None] - top) < reach) & overlap  # [upper, lower]
    bears: NDArray[np.bool_] = np.any(rests, axis=0)
    for block in np.flatnonzero(bottom > reach):
        supports = rests[block]
        if not supports.any():
            return True
        if not bears[block]:
            low = max(left[block], left[supports].min())
            high = min(right[block], right[supports].max())
            center = x[block] + coms[block]
            if center < low - slack or center > high + slack:
                return True
    return False
