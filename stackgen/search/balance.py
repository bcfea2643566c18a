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
        left = np.array([levels.left_end(block.left) for block in blocks])
        base = np.array([block.level for block in blocks])
        top = base + np.array([piece.height for piece in pieces])
        foot = np.array([piece.foot for piece in pieces], dtype=float) + left[:, None]
        head = np.array([piece.head or (np.nan, np.nan) for piece in pieces]) + left[:, None]
        self.weights = np.array([piece.weight for piece in pieces])
        middle = np.array([piece.middle for piece in pieces])
        self.centres = np.stack([left + middle[:, 0], base * levels.step + middle[:, 1]], axis=1)
        self.step, self.top, self.head = levels.step, top, head
        upper, lower = np.nonzero(base[:, None] == top[None, :])
        low = np.maximum(foot[upper, 0], head[lower, 0]) + inset
        high = np.minimum(foot[upper, 1], head[lower, 1]) - inset
        there = high - low >= -_NEAR  # false for nan: what bears nothing
        ground = np.flatnonzero(base == 0)
        self.block = np.concatenate([upper[there], ground])
        self.by = np.concatenate([lower[there], np.full(len(ground), -1)])
        self.ends = np.concatenate([np.stack([low, high], axis=1)[there], foot[ground] + np.array([inset, -inset])])
        self.height = levels.step * base[self.block]

    @property
    def hangs(self) -> bool:
        """Whether a block has nothing under it."""
        return len(np.unique(self.block)) < len(self.weights)

    def holds(self, slope: float = 0.0, loaded: Sequence[int] = ()) -> bool:
        """Tell whether forces hold all blocks on ground of a slope.

        Args:
            slope: Tangent of the tilt, positive to the right.
            loaded: Blocks that any weight may be put on: what cannot be held then will fall whatever comes on top.
        """
        if not len(self.weights) or self.hangs:
            return not len(self.weights)
        lack, certain = self._passed_on(slope)
        if not lack or (certain and not loaded):
            return not lack
        effects = self._effects(slope, loaded)
        return has_solution(linear_program(effects, np.zeros(effects.shape[1]), self._needed))

    def lack(self, slope: float = 0.0) -> float:
        """Add up how far from their supports loads come to lie that are passed on to the nearest [weight x cell]."""
        return np.inf if self.hangs else self._passed_on(slope)[0]

    def _passed_on(self, slope: float) -> tuple[float, bool]:
        """Pass all loads on from the top.

        Returns:
            How far loads come to lie from their supports, in all: 0 if forces were found that hold the blocks. And
            whether other forces could do no better.
        """
        centres = (self.centres[:, 0] + slope * self.centres[:, 1]).tolist()
        supports: list[list[_Support]] = [[] for _ in centres]
        ends = (self.ends + slope * self.height[:, None]).tolist()
        for block, by, (low, high) in zip(self.block.tolist(), self.by.tolist(), ends, strict=True):
            supports[block].append((low, high, by))
        upwards = np.argsort(self.centres[:, 1], kind="stable").tolist()
        firm: list[list[_Support]] = [[] for _ in centres]
        for i in upwards:
            firm[i] = _firm(centres[i], supports[i], firm)
        force = self.weights.tolist()
        torque = [weight * centre for weight, centre in zip(force, centres, strict=True)]
        shared = [False] * len(centres)  # who bears a part of a load that could be shared out otherwise
        lack, certain = 0.0, False
        for i in reversed(upwards):
            place = torque[i] / force[i]
            parts = firm[i] if _distance(place, firm[i]) <= _CLOSE else supports[i]
            if (distance := _distance(place, parts)) > _CLOSE:
                lack += force[i] * distance
                certain |= not shared[i]
            for share, at, by in _shares(place, parts, centres):
                if by >= 0:
                    force[by] += share * force[i]
                    torque[by] += share * force[i] * at
            for _, _, by in supports[i]:
                shared[by] |= by >= 0 and (shared[i] or len(supports[i]) > 1)
        return lack, certain or not lack

    @property
    def _needed(self) -> Floats:
        return np.concatenate([self.weights, np.zeros(len(self.weights))])

    def _effects(self, slope: float, loaded: Sequence[int] = ()) -> Floats:
        """Force and torque (2 k, 2 (c + n)) on the blocks by a unit of force at each end of each contact and load."""
        k, c, n = len(self.weights), len(self.block), len(loaded)
        centre = self.centres[:, 0] + slope * self.centres[:, 1]
        at = self.ends + slope * self.height[:, None]
        effects = np.zeros((2 * k, 2 * (c + n)))
        columns = np.arange(c)
        carried = np.flatnonzero(self.by >= 0)
        for end in (0, 1):
            effects[self.block, 2 * columns + end] = 1
            effects[k + self.block, 2 * columns + end] = at[:, end] - centre[self.block]
            by = self.by[carried]
            effects[by, 2 * carried + end] = -1
            effects[k + by, 2 * carried + end] = -(at[carried, end] - centre[by])
            for i, block in enumerate(loaded):
                place = self.head[block, end] + slope * self.step * self.top[block]
                effects[block, 2 * (c + i) + end] = -1
                effects[k + block, 2 * (c + i) + end] = -(place - centre[block])
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


def _firm(centre: float, supports: Sequence[_Support], firm: Sequence[Sequence[_Support]]) -> list[_Support]:
    """Find the parts of a block's supports between which it holds whatever comes to lie; none if it is not firm.

    Args:
        centre: Where the block's own weight lies.
        supports: What it stands on.
        firm: The same parts of each block below.
    """
    parts = []
    for low, high, by in supports:
        if by >= 0:  # a block that is not firm need not bear anything
            low = max(low, min(firm[by], default=(np.inf,))[0])
            high = min(high, max((end for _, end, _ in firm[by]), default=-np.inf))
        if low <= high:
            parts.append((low, high, by))
    return parts if _distance(centre, parts) <= _CLOSE else []


def _distance(place: float, supports: Sequence[_Support]) -> float:
    """Measure how far a place is from lying between supports; without any it is infinitely far."""
    low, high = min(supports, default=(np.inf, 0.0, 0))[0], max((high for _, high, _ in supports), default=-np.inf)
    return max(low - place, place - high, 0.0)


def _shares(place: float, supports: Sequence[_Support], centres: Sequence[float]) -> list[tuple[float, float, int]]:
    """Share a load out to the nearest supports on both sides, by the lever's law, as near to their centres as they bear.

    Returns:
        For each that bears, its share, where it bears, and which it is. A place beyond all supports counts as the end.
    """
    points = sorted((min(max(centres[by], low), high) if by >= 0 else low, by) for low, high, by in supports)
    left = max((point for point in points if point[0] <= place), default=None)
    right = min((point for point in points if point[0] >= place), default=None)
    if left is None:
        low, _, by = min(supports)
        return [(1.0, max(place, low), by)]
    if right is None:
        _, high, by = max(supports, key=lambda support: support[1])
        return [(1.0, min(place, high), by)]
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
