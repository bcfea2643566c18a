"""Whether blocks that stand in rows hold each other, fast enough to be asked thousands of times.

All blocks stand upright, so forces between them may all point against gravity. On ground that is tilted by t, such
forces lie in the friction cone as long as t is below the friction; seen along gravity, whatever lies at height z has
moved aside by z tan(t). So one plane problem with forces of a single direction answers for level and for tilted ground:
each block needs the sum of its forces and of their torques to be its weight and nothing. Non-negative least squares
finds such forces if there are any, as in :mod:`stackgen.sim.statics.plane`, which has more kinds of contacts and says
"stands" of whatever stands here.

Legend: k blocks, c contacts. Lengths in cells, forces in weights of a cube.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from stackgen.search.rows import Levels, Placed

Floats = NDArray[np.float64]

INSET = 0.015
"""Part of both ends of each contact that bears nothing [cell]; as `StaticsMargins.inset`."""

SLOPE = 0.025
"""Slope of the ground, to either side, on which a stack that stands must hold; as `StaticsMargins.pull`."""

STEEPEST = 0.5
"""Slope that no stack holds: friction ends there."""

_BALANCED = 1e-6
_NEAR = 1e-9


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
        """Tell whether forces hold all blocks on ground of a slope; see :meth:`missing`."""
        return self.missing(slope, loaded) < _BALANCED

    def missing(self, slope: float = 0.0, loaded: Sequence[int] = ()) -> float:
        """Measure the forces and torques that are missing on ground of a slope.

        Args:
            slope: Tangent of the tilt, positive to the right.
            loaded: Blocks that any weight may be put on: what cannot be held then will fall whatever comes on top.
        """
        k, c, n = len(self.weights), len(self.block), len(loaded)
        if not k or self.hangs:
            return np.inf if k else 0.0
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
        needed = np.concatenate([self.weights, np.zeros(k)])
        try:
            return float(nnls(effects, needed)[1])
        except RuntimeError:  # too many iterations
            return np.inf

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


def steadied(blocks: Sequence[Placed], levels: Levels, rounds: int = 3) -> tuple[Placed, ...] | None:
    """Move blocks, and all that stands from some level up, by up to two pixels until they stand, or give None.

    What almost stands is one overhang too far, or rests on a neighbour by less than a pixel. Each round makes the one
    move that leaves least missing.
    """
    if not Balance(blocks, levels, inset=-LOOSE).holds():
        return None
    best, least = list(blocks), np.inf
    for _ in range(rounds):
        candidates = [(_lacks(moved, levels), moved) for moved in _moves(best, levels)]
        lacking, moved = min(candidates, key=lambda item: item[0], default=(np.inf, best))
        if lacking >= least:
            return None
        best, least = moved, lacking
        if least < 2 * _BALANCED:
            return tuple(best)
    return None


LOOSE = 0.1
"""Length added to both ends of each contact [cell], with which what small moves could make stand holds."""


def _lacks(blocks: Sequence[Placed], levels: Levels) -> float:
    balance = Balance(blocks, levels)
    return balance.missing(SLOPE) + balance.missing(-SLOPE)


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
