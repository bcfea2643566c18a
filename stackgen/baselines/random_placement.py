"""Random placement: what a method scores that never looks at the silhouette, the lower end of the table.

A place of a block is legal if the block lies in the grid's width, overlaps no other, and stands on the
ground or, at least in part, over a block of the layer below. Whether anything balances is not asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stackgen.baselines.heuristic import Heuristic, Interval
from stackgen.stack import Stack, shapes_of
from stackgen.world import Mask


@dataclass(frozen=True)
class RandomPlacement(Heuristic):
    """Blocks in random order, each at a place drawn uniformly from all legal ones in the grid's layers.

    Only if there is none left, in the lowest layer above the grid that has one.
    """

    kind: ClassVar[str] = "random-placement"

    def place(self, silhouette: Mask, block_list: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Make a legal stack of the block list; the silhouette is not looked at."""
        shapes = rng.permutation(shapes_of(block_list))
        layers: list[list[Interval]] = [[] for _ in range(self.world.grid.height)]  # the blocks' extents
        poses = []
        for shape in shapes:
            width = self.world.catalogue[int(shape)].size[0]
            x, level = self._draw(width, layers, rng)
            layers[level].append((x - width / 2, x + width / 2))
            poses.append([x, 0, level + 0.5, 0, 0, 0])
        return Stack(shapes, np.array(poses), self.world.catalogue)

    def _draw(self, width: float, layers: list[list[Interval]], rng: np.random.Generator) -> tuple[float, int]:
        """Draw middle [cell] and layer, uniform over the legal places; a layer is added if there are none."""
        places = [(level, free) for level in range(len(layers)) for free in self.legal(width, level, layers)]
        if not places:
            layers.append([])
            places = [(len(layers) - 1, free) for free in self.legal(width, len(layers) - 1, layers)]
        lengths = np.array([end - begin for _, (begin, end) in places])
        share = lengths / lengths.sum() if lengths.sum() else None  # a block as wide as the grid has single points
        level, (begin, end) = places[rng.choice(len(places), p=share)]
        return float(rng.uniform(begin, end)), level

    def legal(self, width: float, level: int, layers: Sequence[Sequence[Interval]]) -> list[Interval]:
        """Find where in a layer the middle of a block may be [cell], from left to right, no two intervals meeting.

        Args:
            width: Width of the block [cell].
            level: Number of the layer.
            layers: Extents of the blocks that stand, for each layer.
        """
        half = max(0.0, (self.world.grid.width - width) / 2)
        room = [(-half, half)]
        if level:
            above = union((left - width / 2, right + width / 2) for left, right in layers[level - 1])
            room = [(max(left, -half), min(right, half)) for left, right in above]
        for left, right in layers[level]:
            room = [part for whole in room for part in _without(whole, (left - width / 2, right + width / 2))]
        return room


def union(intervals: Iterable[Interval]) -> list[Interval]:
    """Put intervals that meet together, from left to right.

    >>> union([(2, 3), (0, 1), (0.5, 2)])
    [(0, 3)]
    """
    found: list[Interval] = []
    for left, right in sorted(intervals):
        if found and left <= found[-1][1]:
            found[-1] = (found[-1][0], max(found[-1][1], right))
        else:
            found.append((left, right))
    return found


def _without(whole: Interval, hole: Interval) -> list[Interval]:
    """Take an open interval out of a closed one."""
    if hole[1] <= whole[0] or whole[1] <= hole[0]:
        return [whole]
    left, right = (whole[0], hole[0]), (hole[1], whole[1])
    return [part for part in (left, right) if part[0] <= part[1]]
