"""Brute-Force (paper, "Brute-Force Baseline"): try many places for each block, keep the one that fits best.

Legend: n candidate places, H x W pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.baselines.heuristic import Heuristic
from stackgen.baselines.swap import swap
from stackgen.baselines.upright import running_sums, span
from stackgen.errors import StackgenError
from stackgen.geometry import Floats
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD, Mask, World

Integers = NDArray[np.int64]

REACH = 3
"""How far to the left and right of a block its neighbourhood goes, where candidates tie [pixel]."""


class BruteForce(Heuristic):
    """Blocks one after the other, the largest first, each where its score is highest of all candidates.

    The score of a place is the number of pixels of the silhouette that the block covers there, less
    `penalty` for each pixel of each block placed before. Of equal places the one with fewest free
    pixels of the silhouette right beside it is taken (it leaves no gap that nothing fits), then the
    highest, then the leftmost.

    Args:
        sigma: Probability of the swap.
        starts: Starting points of the search for each block: x uniform on the grid's width less half
            a cell on each side, layer uniform.
        steps: Candidates along x from each start, half of them to each side.
        step: Distance between them [cell].
        penalty: What a pixel of collision costs, in pixels of the silhouette.
        world: See Heuristic.
    """

    kind = "brute-force"

    def __init__(
        self,
        sigma: float = 0.6,
        starts: int = 20,
        steps: int = 20,
        step: float = 0.15,
        penalty: float = 1.0,
        world: World = PAPER_WORLD,
    ) -> None:
        super().__init__(world)
        if not 0 <= sigma <= 1 or starts < 1 or steps < 2 or steps % 2 or step <= 0 or penalty < 0:
            raise StackgenError(
                "brute force: sigma must lie in 0..1, starts be at least 1, steps even and at least 2, "
                "step positive and penalty not negative"
            )
        self.sigma, self.starts, self.steps, self.step, self.penalty = sigma, starts, steps, step, penalty

    @property
    def settings(self) -> dict[str, Any]:
        """Its numbers."""
        return {name: getattr(self, name) for name in ("sigma", "starts", "steps", "step", "penalty")}

    def place(self, silhouette: Mask, counts: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Search a place for each block, then perhaps swap."""
        return swap(self.search(silhouette, counts, rng), self.sigma, rng)

    def search(self, silhouette: Mask, counts: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """The stack before the swap."""
        target = running_sums(silhouette)
        taken = np.zeros(silhouette.shape, dtype=np.int64)  # (H, W) number of blocks on each pixel
        shapes, poses = self._largest_first(counts), []
        for shape in shapes:
            x, level = self.best(shape, *self.candidates(rng), silhouette, target, taken)
            poses.append([x, 0, level + 0.5, 0, 0, 0])
            covered = span(self.world.catalogue[shape], [x], level + 0.5, self.world.grid)
            for row, start, stop in zip(covered.rows, covered.start[0], covered.stop[0], strict=True):
                taken[row, start:stop] += 1
        return Stack(np.array(shapes), np.array(poses), self.world.catalogue)

    def best(
        self, shape: int, x: Floats, level: Integers, silhouette: Mask, target: Integers, taken: Integers
    ) -> tuple[float, int]:
        """The candidate of the highest score: its x [cell] and layer.

        Args:
            shape: Of the block.
            x, level: (n,) candidates.
            silhouette: (H, W).
            target: (H, W + 1) its running sums.
            taken: (H, W) number of blocks on each pixel.
        """
        collisions = running_sums(taken)
        spans = {
            k: (np.flatnonzero(level == k), span(self.world.catalogue[shape], x[level == k], k + 0.5, self.world.grid))
            for k in np.unique(level).tolist()
        }
        score = np.empty(len(x))
        for places, covered in spans.values():
            score[places] = covered.sum(target) - self.penalty * covered.sum(collisions)
        free = running_sums(silhouette & (taken == 0))
        found = []
        for k, (places, covered) in spans.items():
            tied = np.flatnonzero(score[places] == score.max())
            if len(tied):
                left, right = covered.take(tied).beside(REACH, self.world.grid.image_size)
                loose = (left.sum(free) + right.sum(free)).tolist()
                found += [(pixels, -k, place) for pixels, place in zip(loose, x[places[tied]], strict=True)]
        _, below, place = min(found)
        return float(place), -below

    def candidates(self, rng: np.random.Generator) -> tuple[Floats, Integers]:
        """Places (n,) along x [cell] and their layers (n,): the paper's x in [-3, 3], z in {1, 3, 5, 7} half cells."""
        reach = self.world.grid.width / 2 - 0.5
        x = rng.uniform(-reach, reach, self.starts)
        level = rng.integers(0, self.world.grid.height, self.starts)
        one_side = np.arange(1, self.steps // 2 + 1) * self.step
        return (x[:, None] + np.concatenate([-one_side, one_side])).ravel(), np.repeat(level, self.steps)
