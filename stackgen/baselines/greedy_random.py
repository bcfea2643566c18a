"""Greedy-Random (paper, "Greedy-Random Baseline"): fill the silhouette from the ground up with the longest blocks.

Legend: H x W pixels, S shapes. A run is a row of pixels without a gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stackgen.baselines.heuristic import Heuristic, Interval, section
from stackgen.baselines.swap import swap
from stackgen.errors import StackgenError
from stackgen.stack import Stack, shapes_of
from stackgen.world import Grid, Mask


@dataclass(frozen=True)
class GreedyRandom(Heuristic):
    """Layer by layer from the ground up: the longest block that fits the longest run of pixels, at its left end.

    Runs are measured at half the layer's height, and so are blocks: a triangle is half a cell wide
    there, so it goes where nothing longer does. What is left of a run after a block is a run again.
    Blocks that fit nowhere are laid on the ground beside the structure.

    Args:
        world: Shapes, scale of the silhouettes, and the longest block list it takes.
        sigma: Probability of the swap.
        tolerance: How much a block may be wider than its run [cell]; a run that is left over by no
            more is filled, and its block stands in its middle.

    Raises:
        StackgenError: If a number is out of its range.
    """

    kind: ClassVar[str] = "greedy-random"

    sigma: float = 0.6
    tolerance: float = 0.24

    def __post_init__(self) -> None:
        if not 0 <= self.sigma <= 1 or not 0 <= self.tolerance < 0.5:
            raise StackgenError("greedy: sigma must lie in 0..1 and tolerance in 0..0.5")

    @cached_property
    def _sections(self) -> list[float]:
        return [section(shape) for shape in self.world.catalogue]

    def place(self, silhouette: Mask, block_list: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Fill the silhouette, perhaps swap, and lay down what is left."""
        structure, left = self.fill(silhouette, block_list)
        return self._with_the_rest(swap(structure, self.sigma, rng), left)

    def fill(self, silhouette: Mask, block_list: NDArray[np.int64]) -> tuple[Stack, NDArray[np.int64]]:
        """Make the structure, and the block list (S,) of what fits nowhere."""
        left = block_list.copy()
        shapes: list[int] = []
        poses: list[list[float]] = []
        for level in range(self.world.grid.height):
            runs = layer_runs(silhouette, level, self.world.grid)
            while runs:
                run = max(runs, key=lambda r: r[1] - r[0])  # the leftmost of equal ones
                runs.remove(run)
                shape = self._longest(left, run)
                if shape is None:
                    continue
                x, rest = self._lay(shape, run)
                shapes.append(shape)
                poses.append([x, 0, level + 0.5, 0, 0, 0])
                left[shape] -= 1
                runs = sorted([*runs, rest]) if rest else runs
        return Stack(np.array(shapes, dtype=np.int64), np.array(poses).reshape(-1, 6), self.world.catalogue), left

    def _longest(self, left: NDArray[np.int64], run: Interval) -> int | None:
        """Choose the longest block that is left and fits."""
        fitting = [s for s, w in enumerate(self._sections) if left[s] and w <= run[1] - run[0] + self.tolerance]
        return max(fitting, key=lambda s: self._sections[s], default=None)

    def _lay(self, shape: int, run: Interval) -> tuple[float, Interval | None]:
        """Say where a block stands in a run, and what it leaves of it."""
        begin, end = run
        if end - begin - self._sections[shape] <= self.tolerance:
            return (begin + end) / 2, None
        width = self.world.catalogue[shape].size[0]
        return begin + width / 2, (begin + width, end) if begin + width < end else None

    def _with_the_rest(self, structure: Stack, left: NDArray[np.int64]) -> Stack:
        """Lay the blocks that are left on the ground to the right, half a cell between all of them."""
        shapes, poses = list(structure.shapes), list(structure.poses)
        edge = self.world.grid.width / 2
        for shape in shapes_of(left).tolist():
            width = self.world.catalogue[shape].size[0]
            shapes.append(shape)
            poses.append(np.array([edge + 0.5 + width / 2, 0, 0.5, 0, 0, 0]))
            edge += 0.5 + width
        return Stack(np.array(shapes), np.array(poses), self.world.catalogue)


def layer_runs(silhouette: Mask, level: int, grid: Grid) -> list[Interval]:
    """Find the runs of pixels at half the height of a layer, from left to right.

    >>> layer_runs(np.pad(np.ones((14, 28), bool), ((46, 4), (18, 18))), 0, Grid())
    [(-1.0, 1.0)]
    """
    row = int(np.argmin(np.abs(grid.vertical("front") - level - 0.5)))
    filled = np.concatenate([[False], silhouette[row], [False]])
    edges = (np.flatnonzero(filled[1:] != filled[:-1]) - grid.image_size / 2) / grid.pixels_per_cell
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
