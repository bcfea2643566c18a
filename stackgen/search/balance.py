"""Whether blocks that stand in rows hold each other, fast enough to be asked thousands of times.

All blocks stand upright, so forces between them may all point against gravity. On ground that is tilted by t, such
forces lie in the friction cone as long as t is below the friction; seen along gravity, whatever lies at height z has
moved aside by z tan(t). So one plane problem with forces of a single direction answers for level and for tilted ground:
each block needs the sum of its forces and of their torques to be its weight and nothing. The contacts of
:mod:`stackgen.sim.statics.plane` are of more kinds; it says "stands" of whatever stands here.

Most stacks need no program: loads are passed on from the top. A block with one support hands its whole load on, so its
place decides. One with several shares it out between the nearest two: if that holds, forces are found. A block is
**firm** between two places if whatever comes to lie between them holds, and loads go there where they can. Only where
a load that was shared out so does not hold, a linear program looks for other forces.

Legend: k blocks, c contacts. Lengths in cells, forces in weights of a cube.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from stackgen.search.rows import Levels, Placed
from stackgen.sim.statics.linear import has_solution, linear_program

Floats = NDArray[np.float64]

INSET = 0.015
"""Part of both ends of each contact that bears nothing [cell]; as `StaticsMargins.inset`."""

SLOPE = 0.025
"""Slope of the ground, to either side, on which a stack that stands must hold; as `StaticsMargins.pull`."""

STEEPEST = 0.5
"""Slope that no stack holds: friction ends there."""

_BALANCED = 1e-6
_NEAR = 1e-9
_CLOSE = 1e-7
"""Distances below this are rounding [cell]."""


class Balance:
    """The contacts of some blocks in rows.

    Args:
        blocks: The blocks.
        levels: Where their levels are.
        inset: Part of both ends of each contact that bears nothing [cell]; below 0 contacts are longer than they are.
    """

    def __init__(self, blocks: Sequence[Placed], levels: Levels, inset: float = INSET) -> None:
        pieces = [levels.pieces[block.shape] for block in blocks]
        lefts = [levels.left_end(block.left) for block in blocks]
        self.weights = [piece.weight for piece in pieces]
        self.heights = [block.level * levels.step for block in blocks]  # of the feet
        self.heads = [
            (left + piece.head[0], left + piece.head[1], (block.level + piece.height) * levels.step)
            if piece.head
            else None
            for block, piece, left in zip(blocks, pieces, lefts, strict=True)
        ]
        self.centres = [
            (left + piece.middle[0], height + piece.middle[1])
            for piece, left, height in zip(pieces, lefts, self.heights, strict=True)
        ]
        below: dict[int, list[_Support]] = {0: [(-np.inf, np.inf, -1)]}
        for i, (block, piece, head) in enumerate(zip(blocks, pieces, self.heads, strict=True)):
            if head:
                below.setdefault(block.level + piece.height, []).append((head[0], head[1], i))
        self.supports: list[list[_Support]] = [[] for _ in blocks]
        for block, piece, left, those in zip(blocks, pieces, lefts, self.supports, strict=True):
            if piece.foot:
                first, last = left + piece.foot[0], left + piece.foot[1]
                for low, high, by in below.get(block.level, ()):
                    low, high = max(first, low) + inset, min(last, high) - inset
                    if high - low >= -_NEAR:
                        those.append((low, high, by))
        self.upwards = sorted(range(len(blocks)), key=lambda i: blocks[i].level)

    @property
    def hangs(self) -> bool:
        """Whether a block has nothing under it."""
        return not all(self.supports)

    def holds(self, slope: float = 0.0, loaded: Sequence[int] = ()) -> bool:
        """Tell whether forces hold all blocks on ground of a slope.

        Args:
            slope: Tangent of the tilt, positive to the right.
            loaded: Blocks that any weight may be put on: what cannot be held then will fall whatever comes on top.
        """
        if self.hangs:
            return False
        lack, certain = self._passed_on(slope, loaded)
        if not lack or certain:
            return not lack
        effects = self._effects(slope, loaded)
        return has_solution(linear_program(effects, np.zeros(effects.shape[1]), self._needed))

    def lack(self, slope: float = 0.0) -> float:
        """Add up how far from their supports loads come to lie that are passed on to the nearest [weight x cell]."""
        return np.inf if self.hangs else self._passed_on(slope)[0]

    def _passed_on(self, slope: float, loaded: Sequence[int] = ()) -> tuple[float, bool]:
        """Pass all loads on from the top; weights are put on blocks that may be `loaded` where that brings balance.

        Returns:
            How far loads come to lie from their supports, in all: 0 if forces were found that hold the blocks. And
            whether other forces could do no better.
        """
        centres = [x + slope * z for x, z in self.centres]
        supports = [
            [(low + slope * height, high + slope * height, by) for low, high, by in those]
            for those, height in zip(self.supports, self.heights, strict=True)
        ]
        parts: list[_Reach | None] = [None] * len(centres)
        firm = parts.copy()
        for i in self.upwards:
            parts[i] = reach = _firm_parts(supports[i], firm)
            firm[i] = reach if reach and _is_within(centres[i], reach) else None
        force = list(self.weights)
        torque = [weight * centre for weight, centre in zip(force, centres, strict=True)]
        shared = [False] * len(centres)  # who bears a part of a load that could be shared out otherwise
        lack, certain = 0.0, False
        for i in reversed(self.upwards):
            load, those = force[i], supports[i]
            place, reach = torque[i] / load, firm[i]
            if not reach or not _is_within(place, reach):
                reach = (parts[i] if i in loaded else None) or _reach(those)
                if not _is_within(place, reach) and i in loaded:
                    load, place = self._weighed_down(i, slope, load, place, reach)
                if not _is_within(place, reach):
                    reach = _reach(those)
                    lack += load * max(reach[0] - place, place - reach[1], 0.0)
                    certain |= not shared[i] and not loaded
            for share, at, by in _shares(place, reach, centres):
                if by >= 0:
                    force[by] += share * load
                    torque[by] += share * load * at
            if shared[i] or len(those) > 1:
                for _, _, by in those:
                    shared[by] |= by >= 0
        return lack, certain or not lack

    def _weighed_down(self, block: int, slope: float, load: float, place: float, reach: _Reach) -> tuple[float, float]:
        """Put a weight on the end of a block's head, if that brings its load to the near end of what it stands on."""
        first, last, height = self.heads[block] or (place, place, 0.0)
        goal, end = (reach[0], last) if place < reach[0] else (reach[1], first)
        way, beyond = goal - place, end + slope * height - goal
        if way * beyond <= 0:
            return load, place
        return load * (1 + way / beyond), goal

    @property
    def _needed(self) -> Floats:
        return np.array(self.weights + [0.0] * len(self.weights))

    def _effects(self, slope: float, loaded: Sequence[int] = ()) -> Floats:
        """Force and torque (2 k, 2 (c + n)) on the blocks by a unit of force at each end of each contact and load."""
        k = len(self.weights)
        centres = [x + slope * z for x, z in self.centres]
        contacts = [
            (block, by, end + slope * height)
            for block, (those, height) in enumerate(zip(self.supports, self.heights, strict=True))
            for *ends, by in those
            for end in ends
        ]
        for block in loaded:
            first, last, height = self.heads[block] or (0.0, 0.0, 0.0)
            contacts += [(-1, block, first + slope * height), (-1, block, last + slope * height)]
        effects = np.zeros((2 * k, len(contacts)))
        for column, (block, by, at) in enumerate(contacts):
            for whom, sign in ((block, 1.0), (by, -1.0)):
                if whom >= 0:
                    effects[whom, column] = sign
                    effects[k + whom, column] = sign * (at - centres[whom])
        return effects

    @property
    def stands(self) -> bool:
        """Whether the blocks hold with both margins: narrowed contacts, and ground that slopes to either side."""
        return self.holds(SLOPE) and self.holds(-SLOPE)

    def slope(self, steps: int = 6) -> float:
        """Find the largest slope, to either side, that the blocks survive: by halving, to `STEEPEST` / 2^steps."""
        if not self.stands:
            return 0.0
        low, high = SLOPE, STEEPEST
        for _ in range(steps):
            middle = (low + high) / 2
            held = self.holds(middle) and self.holds(-middle)
            low, high = (middle, high) if held else (low, middle)
        return low


_Support = tuple[float, float, int]
"""Both ends of a contact, and the block that bears there or -1 for the ground."""

_Reach = tuple[float, float, Sequence[_Support]]
"""Some supports, and the two ends between which they bear."""


def _reach(supports: Sequence[_Support]) -> _Reach:
    if len(supports) == 1:
        return (*supports[0][:2], supports)
    return min(supports)[0], max(high for _, high, _ in supports), supports


def _is_within(place: float, reach: _Reach) -> bool:
    return reach[0] - _CLOSE <= place <= reach[1] + _CLOSE


def _firm_parts(supports: Sequence[_Support], firm: Sequence[_Reach | None]) -> _Reach | None:
    """Find the parts of a block's supports that bear whatever comes; None if no support does.

    Args:
        supports: What it stands on.
        firm: The same of each block below, None for those that are not firm: they need not bear anything.
    """
    parts = []
    for low, high, by in supports:
        below = firm[by] if by >= 0 else (-np.inf, np.inf, ())
        if below is not None:
            low, high = max(low, below[0]), min(high, below[1])
            if low <= high:
                parts.append((low, high, by))
    return _reach(parts) if parts else None


def _shares(place: float, reach: _Reach, centres: Sequence[float]) -> list[tuple[float, float, int]]:
    """Share a load out to the nearest supports on both sides by the lever's law, as near to their centres as they bear.

    Returns:
        For each that bears, its share, where it bears, and which it is. A place beyond all supports counts as the end.
    """
    first, last, supports = reach
    if len(supports) == 1:
        return [(1.0, min(max(place, first), last), supports[0][2])]
    points = sorted((min(max(centres[by], low), high) if by >= 0 else low, by) for low, high, by in supports)
    left = max((point for point in points if point[0] <= place), default=None)
    right = min((point for point in points if point[0] >= place), default=None)
    if left is None:
        return [(1.0, max(place, first), min(supports)[2])]
    if right is None:
        return [(1.0, min(place, last), max(supports, key=lambda support: support[1])[2])]
    share = (place - left[0]) / (right[0] - left[0]) if left[0] < right[0] else 0.0
    return [(1 - share, *left), (share, *right)]


def steadied(blocks: Sequence[Placed], levels: Levels, rounds: int = 3) -> tuple[Placed, ...] | None:
    """Move blocks, and all that stands from some level up, by up to two pixels until they stand, or give None.

    What almost stands is one overhang too far, or rests on a neighbour by less than a pixel. Each round makes the one
    move that leaves the least lack.
    """
    if not Balance(blocks, levels, inset=-LOOSE).holds():
        return None
    best, least = list(blocks), np.inf
    for _ in range(rounds):
        candidates = sorted(((_lack(moved, levels), moved) for moved in _moves(best, levels)), key=lambda item: item[0])
        for _, moved in candidates[:_PROMISING]:
            if Balance(moved, levels).stands:
                return tuple(moved)
        if not candidates or candidates[0][0] >= least:
            return None
        least, best = candidates[0]
    return None


_PROMISING = 4
"""Number of moves of a round that are looked at closely, those of least lack first."""


LOOSE = 0.1
"""Length added to both ends of each contact [cell], with which what small moves could make stand holds."""


def _lack(blocks: Sequence[Placed], levels: Levels) -> float:
    balance = Balance(blocks, levels)
    return balance.lack(SLOPE) + balance.lack(-SLOPE)


def _moves(blocks: Sequence[Placed], levels: Levels) -> Iterator[list[Placed]]:
    """Give the blocks with one of them moved, or all from some level up."""
    groups = [
        {i for i, block in enumerate(blocks) if block.level >= k} for k in {block.level for block in blocks} - {0}
    ]
    groups += [{i} for i in range(len(blocks)) if {i} not in groups]
    for group in groups:
        for step in (-0.5, 0.5, -1.0, 1.0, -2.0, 2.0):
            moved = [b._replace(left=b.left + step) if i in group else b for i, b in enumerate(blocks)]
            if not _collide(moved, levels):
                yield moved


def _collide(blocks: Sequence[Placed], levels: Levels) -> bool:
    """Tell whether two blocks share columns on a level, or one leaves the picture."""
    width = [levels.pieces[block.shape].width for block in blocks]
    top = [block.level + levels.pieces[block.shape].height for block in blocks]
    order = sorted(range(len(blocks)), key=lambda i: blocks[i].left)
    if blocks and (
        blocks[order[0]].left < 0 or max(b.left + w for b, w in zip(blocks, width, strict=True)) > levels.columns
    ):
        return True
    return any(
        blocks[j].left < blocks[i].left + width[i] - 1e-9 and blocks[j].level < top[i] and blocks[i].level < top[j]
        for place, i in enumerate(order)
        for j in order[place + 1 :]
    )
