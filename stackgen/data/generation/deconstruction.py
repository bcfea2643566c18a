"""Construction by deconstruction: from one settled template, all the stacks inside it (paper, Fig. 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.sim.checkers import AcceptLimits, accept
from stackgen.sim.simulator import Simulator
from stackgen.sim.statics.plane import Outcome, PlaneStatics, StaticsMargins
from stackgen.stack import Stack

NEVER = StaticsMargins(enabled=False)
"""Margins of a settler that never asks statics."""


@dataclass(frozen=True)
class Settled:
    """A stack at rest, and the simulated stack that it is a part of.

    Args:
        stack: The blocks that are left, at rest.
        part: (k,) their numbers among the blocks of the stack that was simulated last on the way here.
        statics: What is known of that stack's parts; None if statics is not asked.
    """

    stack: Stack
    part: NDArray[np.int64]
    statics: PlaneStatics | None

    @property
    def outcome(self) -> Outcome:
        """What is known of the stack without a simulation."""
        if self.statics is not None:
            return self.statics.outcome(self.part)
        return "falls" if surely_falls(self.stack) else "unsure"

    def less(self, place: int) -> Settled:
        """Take one block out; the rest may stand or fall."""
        keep = np.delete(np.arange(len(self.stack)), place)
        stack = Stack(self.stack.shapes[keep], self.stack.poses[keep], self.stack.catalogue)
        return Settled(stack, self.part[keep], self.statics)


@dataclass(frozen=True)
class Settler:
    """Settles a stack and says whether it may be data.

    Args:
        simulator: Simulator with the dataset's physics.
        limits: See AcceptLimits.
        settle_twice: Simulate the settled stack again, from a fresh start: it must stand once more, unless
            statics confirms that it does. The paper settles once; a marginal stack or two then slips in.
        margins: When statics may speak for the simulator; by default never.
    """

    simulator: Simulator
    limits: AcceptLimits
    settle_twice: bool
    margins: StaticsMargins = NEVER

    def settle(self, stack: Stack) -> Settled | None:
        """Settle a design; None if it is not accepted. Designs are not at rest, so even a sure one is simulated."""
        outcome = self.at_rest(stack).outcome
        sure = outcome == "stands" or not (self.margins.enabled and self.margins.sure_designs)
        return self._simulated(stack) if sure and outcome != "falls" else None

    def settle_rest(self, rest: Settled) -> Settled | None:
        """Settle what is left of a settled stack, or touches as if it had settled; None if it falls.

        What surely stands is at rest already.
        """
        match rest.outcome:
            case "stands":
                return rest
            case "falls":
                return None
            case "unsure":
                return self._simulated(rest.stack)

    def _simulated(self, stack: Stack) -> Settled | None:
        for _ in range(1 + self.settle_twice):
            rollout = self.simulator.rollout(stack, until_moved=self.limits.displacement)
            if not accept(rollout, self.limits):
                return None
            stack = rollout.end
            settled = self.at_rest(stack)
            if settled.statics is None or settled.statics.silent:
                continue
            if not settled.statics.holds(0.0):
                return None
            if settled.statics.holds(self.margins.confirm):
                break
        return settled

    def at_rest(self, stack: Stack) -> Settled:
        """Take a stack for one at rest, and ask statics what it knows of it."""
        friction, margins = self.simulator.physics.friction, self.margins
        statics = PlaneStatics(stack, friction, margins) if margins.enabled else None
        return Settled(stack, np.arange(len(stack)), statics)


def deconstruct(template: Stack, settler: Settler, max_removals: int = 4) -> Iterator[tuple[tuple[int, ...], Stack]]:
    """Settle a design, then take blocks out in every way, as long as the rest stands.

    Blocks are taken out one at a time, from settled and stable stacks only; what two orders of removal
    both reach is settled once. The top row keeps at least one block, so every stack keeps its height.

    Yields:
        The numbers of the removed blocks and the settled rest, fewest removals first.
    """
    settled = settler.settle(template)
    if settled is None:
        return
    bottoms = np.round(template.poses[:, 2], 3)
    top = frozenset(np.flatnonzero(bottoms == bottoms.max()).tolist())
    level: dict[tuple[int, ...], Settled] = {(): settled}
    for removals in range(max_removals + 1):
        yield from ((removed, settled.stack) for removed, settled in level.items())
        if removals == max_removals:
            return
        below: dict[tuple[int, ...], Settled | None] = {}
        for removed, settled in level.items():
            left = [b for b in range(len(template)) if b not in removed]
            for place, block in enumerate(left):
                taken = tuple(sorted((*removed, block)))
                if taken in below or not top - set(taken):
                    continue
                below[taken] = settler.settle_rest(settled.less(place))
        level = {taken: settled for taken, settled in below.items() if settled is not None}


def surely_falls(stack: Stack, reach: float = 0.1, slack: float = 0.05) -> bool:
    """Tell whether a block of a nearly upright stack hangs in the air, or one that bears nothing has its
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
