"""In which order to place the blocks, so that the structure stands after every one of them.

Assembly by disassembly: from the finished stack blocks are taken away until none is left, and the order is read
backwards. Each state on the way is a set of blocks; it must stand, and the gripper must get at the block that comes
next. Of all orders that pass, the one is taken whose least stable state is the most stable: a widest path over the
sets (Dijkstra, with a minimum in the place of the sum). The paper places greedily, left to right and bottom up
("Block Stacking in the Real World"), and never asks.

A step that no order can avoid and that does not stand by itself needs a temporary support (assembly planning's third
hand). Lengths in cells, margins in degrees. A set of blocks is an integer whose bit i says whether block i is in it.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices, centers_of_mass, row_intervals
from stackgen.protocols import StabilityChecker
from stackgen.robot.workcell import Jaws
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack

Floats = NDArray[np.float64]
Strategy = Literal["safest", "greedy"]

Approach = Callable[[Stack, tuple[int, ...], int], bool]
"""(stack, blocks placed before, block) -> whether the gripper gets the block to its place and away again."""

BESIDE = 0.005
"""Blocks that overlap sideways by less than this stand side by side, but for rounding [cell]: a block that lies over
another's end by half a millimetre is in its way from above."""

BELOW = 0.3
"""A block may reach this far up into the one that is lowered onto it: they touch [cell]."""

STILL = 0.3
"""A state in which a block moves further than this when simulated does not stand [cell]: it leans on a block
that is there by chance, and the next one would miss its place."""

WIDTH = 252
"""Sets looked at of each size. There are no more of any size up to 10 blocks, so until there the search is exact."""


@dataclass(frozen=True)
class BuildOrder:
    """An order of placing, and what is known of it.

    Args:
        blocks: Indices of the blocks, the first to place first.
        margins: Largest tilt of the ground that the state after each of them survives [deg].
        safe: Whether every state stands, and every block can be brought to its place.
        blocked: Where it is not safe, a sentence that names the first step that needs a temporary support.
        checks: Number of sets of blocks that were checked.

    >>> BuildOrder((1, 0), (26.6, 18.4), safe=True).least_margin
    18.4
    """

    blocks: tuple[int, ...]
    margins: tuple[float, ...]
    safe: bool
    blocked: str | None = None
    checks: int = 0

    @property
    def least_margin(self) -> float:
        """Margin of the least stable state [deg]."""
        return min(self.margins, default=90.0)


def plan_order(
    stack: Stack,
    *,
    checker: StabilityChecker | None = None,
    approach: Approach | None = None,
    strategy: Strategy = "safest",
) -> BuildOrder:
    """Find the order in which to place the blocks of a stack.

    The poses should be those in which the stack rests, `Verdict.settled`: blocks that float or overlap as a
    sampler left them are in each other's way.

    Args:
        stack: Stack as it is to stand in the end.
        checker: Checker that says which states stand; statics by default. The margins always come from statics, with
            its physics.
        approach: Function that says which blocks can be brought to their places; :class:`TopDownJaws` by default.
        strategy: `safest`, or `greedy`: the paper's order, checked in the same way, but not changed.

    Returns:
        An order of all blocks. If no order is safe, one with as few steps as possible that need a temporary support.

    Raises:
        StackgenError: If there is no such strategy.

    >>> low, high = [0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]
    >>> plan_order(Stack([0, 0], [high, low])).blocks
    (1, 0)
    """
    checks = _StateChecks(stack, checker, approach or TopDownJaws())
    if strategy not in ("safest", "greedy"):
        raise StackgenError(f"order: there are safest and greedy, got {strategy!r}")
    blocks = greedy_order(stack) if strategy == "greedy" else _safest(stack, checks)
    sets = list(_growing(blocks))
    margins = tuple(checks.state(after).margin for _, after in sets)
    blocked = next(filter(None, (checks.trouble(step, *sets[step], blocks[step]) for step in range(len(sets)))), None)
    return BuildOrder(blocks, margins, blocked is None, blocked, len(checks.states))


def greedy_order(stack: Stack) -> tuple[int, ...]:
    """Order the blocks as the paper does: layer by layer from the ground, each from left to right.

    >>> greedy_order(Stack([0, 0, 0], [[0.5, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0], [-0.5, 0, 0.5, 0, 0, 0]]))
    (2, 0, 1)
    """
    layers = np.floor(stack.poses[:, 2])  # a block is in the layer nearest to its centre
    return tuple(np.lexsort((stack.poses[:, 0], layers)).tolist())


@dataclass(frozen=True)
class _State:
    """Whether a set of blocks stands, its margin [deg], and which blocks fall if it does not."""

    stands: bool
    margin: float
    falling: NDArray[np.bool_]


class _StateChecks:
    """Answers about sets of blocks of one stack, each found once."""

    def __init__(self, stack: Stack, checker: StabilityChecker | None, approach: Approach) -> None:
        self.stack = stack
        physics = None if checker is None else checker.physics
        self.statics = checker if isinstance(checker, StaticsChecker) else StaticsChecker(physics)  # type: ignore[arg-type]
        self.checker = checker or self.statics
        self.approach = approach
        self.states: dict[int, _State] = {}
        self.free: dict[tuple[int, int], bool] = {}

    def state(self, members: int) -> _State:
        """Check whether these blocks stand without the others."""
        if members not in self.states:
            self.states[members] = self._checked(self._part(members))
        return self.states[members]

    def reachable(self, before: int, block: int) -> bool:
        """Check whether the block can be brought to its place when these blocks are there."""
        if (before, block) not in self.free:
            self.free[before, block] = self.approach(self.stack, _members(before), block)
        return self.free[before, block]

    def trouble(self, step: int, before: int, after: int, block: int) -> str | None:
        """Say why a step needs a temporary support, None where it does not."""
        what = f"step {step + 1} of {len(self.stack)} needs a temporary support"
        if not self.reachable(before, block):
            return f"{what}: {self._in_the_way(before, block)}"
        if self.state(after).stands:
            return None
        return f"{what}: once {self._called(block)} is placed, {self._falls(after, block)}"

    def _in_the_way(self, before: int, block: int) -> str:
        """Say which blocks are in the way of one, and what would fall if they came after it."""
        alone = [other for other in _members(before) if not self.reachable(1 << other, block)]
        others = alone or list(_members(before))
        if not others:
            return f"the gripper does not get {self._called(block)} to its place"
        names = " and ".join(map(self._called, others))
        sentence = f"{names} {'is' if len(others) == 1 else 'are'} in the way of {self._called(block)}"
        without = before & ~sum(1 << other for other in others) | 1 << block
        if self.state(without).stands:
            return sentence
        return f"{sentence}, and without {'it' if len(others) == 1 else 'them'} {self._falls(without, block)}"

    def _falls(self, members: int, block: int) -> str:
        """Say which of these blocks would not hold, and why; `block` where the checker names none."""
        here, part = _members(members), self._part(members)
        reasons = self.statics.reasons(part, self.statics.answer(part))
        falling = list(reasons) or np.flatnonzero(self.state(members).falling).tolist() or [here.index(block)]
        first = min(falling, key=lambda i: part.poses[i, 2])  # what lies higher may only lose its support
        return f"{self._called(here[first])} would not hold ({reasons.get(first, 'falls in the simulator')})"

    def _checked(self, part: Stack) -> _State:
        verdict = self.checker.check(part)
        moved = np.linalg.norm(verdict.settled.poses[:, :3] - part.poses[:, :3], axis=1)
        falling = verdict.fell | (moved > STILL)
        margin = verdict.margin if verdict.margin is not None else self.statics.answer(part).margin
        return _State(verdict.stable and not falling.any(), math.degrees(margin), falling)

    def _part(self, members: int) -> Stack:
        here = list(_members(members))
        return Stack(self.stack.shapes[here], self.stack.poses[here], self.stack.catalogue)

    def _called(self, block: int) -> str:
        return f"block {block} ({self.stack.names[block]})"


def _safest(stack: Stack, checks: _StateChecks) -> tuple[int, ...]:
    """Find the order with the fewest unsafe steps, of those the one with the largest least margin.

    Both only grow worse as blocks are taken away, so whatever leaves the queue first was reached in the best way.
    Of equals the deepest set goes first, then the one whose last removed block is the last of the paper's order.
    """
    rank = {block: place for place, block in enumerate(greedy_order(stack))}
    everything = (1 << len(stack)) - 1
    queue: list[_Queued] = [_Queued(0, -math.inf, len(stack), 0, everything, ())]
    done: set[int] = set()
    opened = [0] * (len(stack) + 1)
    while queue:
        entry = heapq.heappop(queue)
        if entry.members in done or (opened[entry.size] >= WIDTH and entry.size):
            continue
        if not entry.members:
            return entry.placed_after
        done.add(entry.members)
        opened[entry.size] += 1
        state = checks.state(entry.members)
        for block in _members(entry.members):
            before = entry.members & ~(1 << block)
            unsafe = entry.unsafe + (not checks.reachable(before, block))
            least = max(entry.least, -state.margin)
            if before and before not in done:
                below = checks.state(before)
                unsafe, least = unsafe + (not below.stands), max(least, -below.margin)
            order = (block, *entry.placed_after)
            heapq.heappush(queue, _Queued(unsafe, least, entry.size - 1, -rank[block], before, order))
    return greedy_order(stack)  # only of an empty stack


@dataclass(frozen=True, order=True)
class _Queued:
    """A set of blocks in the queue, the best first.

    Args:
        unsafe: Number of steps from here on that need a temporary support.
        least: Minus the least margin from here on [deg].
        size: Number of blocks.
        late: Minus the place of the block taken last in the paper's order.
        members: The set of blocks.
        placed_after: The blocks that are not in it, in their order.
    """

    unsafe: int
    least: float
    size: int
    late: int
    members: int = field(compare=False)
    placed_after: tuple[int, ...] = field(compare=False)


def _members(blocks: int) -> tuple[int, ...]:
    return tuple(i for i in range(blocks.bit_length()) if blocks >> i & 1)


def _growing(blocks: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Yield the sets before and after each block of an order."""
    before = 0
    for block in blocks:
        after = before | 1 << block
        yield before, after
        before = after


@dataclass(frozen=True)
class TopDownJaws:
    """Parallel jaws that come straight down over a block's middle and close on its front and back.

    The way is free if nothing placed stands above the block's underside in its column, and nothing is where the
    open fingers and the palm go. It is the box test of :class:`~stackgen.robot.workcell.Jaws`; the arm is not in it.

    Args:
        jaws: Extents of the jaws [m].
        cell_size: Edge of a cube [m].
        clearance: Least distance of fingers and palm from everything else [m].

    >>> deep, beside = [0, 0, 0.5, 0, 0, 0], [[x, 0, z, 0, 0, 0] for x in (-1, 1) for z in (0.5, 1.5)]
    >>> TopDownJaws()(Stack([0] * 5, [deep, *beside]), (1, 2, 3, 4), 0)  # the palm is wider than the hole
    False
    """

    jaws: Jaws = Jaws()  # noqa: RUF009 - it is frozen
    cell_size: float = 0.05
    clearance: float = 0.002

    def __call__(self, stack: Stack, placed: tuple[int, ...], block: int) -> bool:
        """Check whether the way of `block` is free of the blocks `placed`."""
        corners = block_vertices(stack)
        boxes = self._boxes(centers_of_mass(stack)[block], corners[block])
        return not any(
            _covers(corners[other], corners[block]) or any(_above(corners[other], box) for box in boxes)
            for other in placed
        )

    def _boxes(self, center: Floats, corners: Floats) -> list[tuple[Floats, Floats]]:
        """Find lower and upper corner of what fingers and palm sweep on their way up [cell].

        Args:
            center: (3,) centre of mass of the block, over which they come down.
            corners: (V, 3) corners of the block.
        """
        jaws, scale = self.jaws, 1 / self.cell_size
        room = self.clearance * scale
        tips = float(corners[:, 2].min()) + jaws.tips_above(float(np.ptp(corners[:, 2])) / scale) * scale
        palm = tips + jaws.pad_length * scale
        middle, out = center[:2], (jaws.opening / 2 + jaws.pad_thickness) * scale
        closed = float(np.ptp(corners[:, 1])) / 2 + BESIDE  # where the pads stop, but for rounding
        finger, across = jaws.pad_width / 2 * scale + room, jaws.palm[1] / 2 * scale + room
        along = jaws.palm[0] / 2 * scale + room
        spans = [
            ((-finger, -out - room), (finger, -closed), tips),
            ((-finger, closed), (finger, out + room), tips),
            ((-along, -across), (along, across), palm),
        ]
        return [(np.append(middle + low, z), np.append(middle + high, np.inf)) for low, high, z in spans]


def _covers(other: Floats, block: Floats) -> bool:
    """Check whether part of a placed block (V, 3) is above the underside of the block that is lowered (V, 3)."""
    low = np.maximum(other.min(axis=0), block.min(axis=0))
    high = np.minimum(other.max(axis=0), block.max(axis=0))
    if (high - low)[:2].min() <= BESIDE:
        return False
    # Top of the one minus underside of the other is concave in x over both: a few places find its largest value.
    x = np.linspace(low[0] + BESIDE / 2, high[0] - BESIDE / 2, 9)
    _, top = row_intervals(other[:, [2, 0]], x)
    underside, _ = row_intervals(block[:, [2, 0]], x)
    return bool((top - underside).max() > BELOW)


def _above(corners: Floats, box: tuple[Floats, Floats]) -> bool:
    """Check whether the box of a block (V, 3) meets a box open at the top."""
    low, high = box
    return bool((corners.max(axis=0) > low).all() and (corners.min(axis=0)[:2] < high[:2]).all())
