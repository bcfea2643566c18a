"""Brute-Force (paper, "Brute-Force Baseline"): try many places for each block, keep the one that fits best.

Legend: n candidate places, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stackgen.baselines.heuristic import Heuristic
from stackgen.baselines.swap import swap
from stackgen.baselines.upright import cover, running_sums
from stackgen.errors import StackgenError
from stackgen.geometry import Floats
from stackgen.stack import Stack
from stackgen.world import Mask

Integers = NDArray[np.int64]

REACH = 3
"""How far to the left and right of a block its neighbourhood goes, where candidates tie [pixel]."""


@dataclass(frozen=True)
class BruteForce(Heuristic):
    """Blocks one after the other, the largest first, each where its score is highest of all candidates.

    The score of a place is the number of pixels of the silhouette that the block covers there, less
    `penalty` for each pixel of each block placed before. Of equal places the one with fewest free
    pixels of the silhouette right beside it is taken (it leaves no gap that nothing fits), then the
    highest, then the leftmost.

    Args:
        world: Shapes, scale of the silhouettes, and the longest block list it takes.
        sigma: Probability of the swap.
        starts: Number of starting points of the search for each block: x uniform on the grid's width less
            half a cell on each side, layer uniform.
        steps: Number of candidates along x from each start, half of them to each side.
        step: Distance between them [cell].
        penalty: Cost of a pixel of collision, in pixels of the silhouette.

    Raises:
        StackgenError: If a number is out of its range.
    """

    kind: ClassVar[str] = "brute-force"

    sigma: float = 0.6
    starts: int = 20
    steps: int = 20
    step: float = 0.15
    penalty: float = 1.0

    def __post_init__(self) -> None:
        steps = self.steps >= 2 and self.steps % 2 == 0
        if not (0 <= self.sigma <= 1 and self.starts >= 1 and steps and self.step > 0 and self.penalty >= 0):
            raise StackgenError(
                "brute force: sigma must lie in 0..1, starts be at least 1, steps even and at least 2, "
                "step positive and penalty not negative"
            )

    def place(self, silhouette: Mask, block_list: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Search a place for each block, then perhaps swap."""
        return swap(self.search(silhouette, block_list, rng), self.sigma, rng)

    def search(self, silhouette: Mask, block_list: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Make the stack before the swap."""
        target = running_sums(silhouette)
        taken = np.zeros(silhouette.shape, dtype=np.int64)  # (H, W) number of blocks on each pixel
        shapes, poses = self._largest_first(block_list), []
        for shape in shapes:
            x, level = self.best(shape, *self.candidates(rng), silhouette, target, taken)
            poses.append([x, 0, level + 0.5, 0, 0, 0])
            covered = cover(self.world.catalogue[shape], [x], level + 0.5, self.world.grid)
            for row, start, stop in zip(covered.rows, covered.start[0], covered.stop[0], strict=True):
                taken[row, start:stop] += 1
        return Stack(np.array(shapes), np.array(poses), self.world.catalogue)

    def best(
        self, shape: int, x: Floats, level: Integers, silhouette: Mask, target: Integers, taken: Integers
    ) -> tuple[float, int]:
        """Find the candidate of the highest score: its x [cell] and layer.

        Args:
            shape: Shape of the block.
            x: (n,) places of the candidates [cell].
            level: (n,) layers of the candidates.
            silhouette: (H, W) target.
            target: (H, W + 1) running sums of the silhouette.
            taken: (H, W) number of blocks on each pixel.
        """
        collisions = running_sums(taken)
        layers = {
            k: (np.flatnonzero(level == k), cover(self.world.catalogue[shape], x[level == k], k + 0.5, self.world.grid))
            for k in np.unique(level).tolist()
        }
        score = np.empty(len(x))
        for places, covered in layers.values():
            score[places] = covered.sum(target) - self.penalty * covered.sum(collisions)
        free = running_sums(silhouette & (taken == 0))
        found = []
        for k, (places, covered) in layers.items():
            tied = np.flatnonzero(score[places] == score.max())
            if len(tied):
                left, right = covered.take(tied).beside(REACH, self.world.grid.image_size)
                loose = (left.sum(free) + right.sum(free)).tolist()
                found += [(pixels, -k, place) for pixels, place in zip(loose, x[places[tied]], strict=True)]
        _, below, place = min(found)
        return float(place), -below

    def candidates(self, rng: np.random.Generator) -> tuple[Floats, Integers]:
        """Draw places (n,) [cell] and their layers (n,): the paper's x in [-3, 3], z in {1, 3, 5, 7} half cells."""
        reach = self.world.grid.width / 2 - 0.5
        x = rng.uniform(-reach, reach, self.starts)
        level = rng.integers(0, self.world.grid.height, self.starts)
        one_side = np.arange(1, self.steps // 2 + 1) * self.step
        return (x[:, None] + np.concatenate([-one_side, one_side])).ravel(), np.repeat(level, self.steps)
