"""What a search for stacks builds on: the silhouette, the blocks that may be used, and what is built so far.

Lengths in pixels, heights in levels.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.names import Preference
from stackgen.search.balance import LOOSE, Balance, steadied
from stackgen.search.rows import Levels, Placed, Row
from stackgen.world import World

Ints = NDArray[np.int64]

CANDIDATES = 400
"""Stacks, whole or begun, that the search judges for a silhouette at effort 1, at most."""

_MENDINGS = 1200  # squares of the numbers of blocks of the finished stacks that are made to stand by small moves
_MENDABLE = 16  # largest number of blocks for which moves are tried
_LONGEST_ROW = 10  # blocks of a row


@dataclass(frozen=True)
class SearchSettings:
    """How long and for what the search looks.

    Args:
        effort: Multiple of the `CANDIDATES` that are judged, and of all other work; the same effort gives the same
            answers.
        seconds: Time for a silhouette [s], where it is not null; the answers then depend on the machine.
        near: How much less IoU than the best answer another layout may have and be an answer too.
        prefer: What comes first: the best `fit`, or of all that fit nearly as well the largest `margin`.

    Raises:
        StackgenError: If a number is out of range.
    """

    effort: float = 1.0
    seconds: float | None = None
    near: float = 0.02
    prefer: Preference = "fit"

    def __post_init__(self) -> None:
        if not (0 < self.effort < np.inf and 0 <= self.near <= 1 and (self.seconds is None or self.seconds > 0)):
            raise StackgenError(
                "search: effort and seconds must be positive and near in 0..1, got"
                f" {self.effort}, {self.seconds} and {self.near}"
            )


@dataclass(frozen=True)
class Limits:
    """The blocks that may be used.

    Args:
        most: (S,) blocks that there are of each shape.
        total: Largest number of blocks.
        all_of_them: Whether every one must be used.
    """

    most: Ints
    total: int
    all_of_them: bool = False


@dataclass(frozen=True)
class Beginning:
    """What is built up to some level: blocks from the ground up, what they gain, what is left, and what comes on top.

    Args:
        gain: Gain of all blocks [pixel].
        blocks: The blocks.
        left: (S,) blocks that are left, of each shape.
        top: (W,) level up to which each column is taken.
        bears: (W,) whether something can stand on it there.
        sequence: Level and shapes of each row.
    """

    gain: float
    blocks: tuple[Placed, ...]
    left: tuple[int, ...]
    top: NDArray[np.int16]
    bears: NDArray[np.bool_]
    sequence: tuple[tuple[int, tuple[int, ...]], ...] = ()


@dataclass
class Problem:
    """A silhouette that is to be built, and the moves that every search for it makes.

    Args:
        levels: What each shape gains at each place of the silhouette.
        world: Shapes, grid, and the largest number of blocks.
        limits: The blocks that may be used.
        settings: How long and for what is looked.
        number: Number of answers that are wanted.
    """

    levels: Levels
    world: World
    limits: Limits
    settings: SearchSettings
    number: int
    began: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.depth = min(self.limits.total, int(self.levels.columns // self.levels.widths.min()), _LONGEST_ROW)
        self.mendings = round(_MENDINGS * self.settings.effort)

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        seconds = self.settings.seconds
        return seconds is not None and time.perf_counter() - self.began > seconds

    def start(self) -> Beginning:
        """Begin with nothing on the ground."""
        ground = np.ones(self.levels.columns, dtype=bool)
        return Beginning(0.0, (), tuple(self.limits.most.tolist()), np.zeros(self.levels.columns, np.int16), ground)

    def on(self, begin: Beginning, row: Row, level: int) -> Beginning:
        """Put a row on a beginning."""
        top, bears, left = begin.top.copy(), begin.bears.copy(), list(begin.left)
        for s, a in row.blocks:
            piece = self.levels.pieces[s]
            top[a : a + piece.width] = level + piece.height
            bears[a : a + piece.width] = False
            if piece.head is not None:
                ppc = self.world.grid.pixels_per_cell
                first, last = np.ceil(piece.head[0] * ppc - 1e-6), np.floor(piece.head[1] * ppc + 1e-6)
                bears[a + int(first) : a + int(last)] = True
            left[s] -= 1
        blocks = begin.blocks + tuple(Placed(s, a, level) for s, a in row.blocks)
        sequence = (*begin.sequence, (level, row.shapes))
        return Beginning(begin.gain + row.gain, blocks, tuple(left), top, bears, sequence)

    def could_hold(self, begin: Beginning, level: int) -> bool:
        """Tell whether blocks could hold each other with some weight on those whose heads are still free."""
        balance = Balance(begin.blocks, self.levels, inset=-LOOSE)
        free = [
            i
            for i, block in enumerate(begin.blocks)
            if self.levels.pieces[block.shape].head is not None
            and block.level + self.levels.pieces[block.shape].height >= level
        ]
        return balance.holds(loaded=free)

    def standing(self, end: Beginning) -> Beginning | None:
        """Give what is finished as it stands, where it must after small moves; None if it does not stand."""
        if Balance(end.blocks, self.levels).stands:
            return end
        if self.mendings <= 0 or len(end.blocks) > _MENDABLE:
            return None
        self.mendings -= len(end.blocks) ** 2
        moved = steadied(end.blocks, self.levels)
        return None if moved is None else replace(end, blocks=moved)
