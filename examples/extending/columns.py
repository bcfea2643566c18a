"""A method of your own that learns nothing: it stacks blocks in columns. `stackgen test` and the report take it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.stack import Stack, shapes_of
from stackgen.world import PAPER_WORLD, Mask


class Columns:
    """Fills columns of the grid from the left, wide blocks first, as high as the silhouette is there."""

    world = PAPER_WORLD
    settings: Mapping[str, Any] = {}
    card: Mapping[str, Any] = {}

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        return [[self.place(s, c)] * num_samples for s, c in zip(silhouettes, counts, strict=True)]

    def place(self, silhouette: Mask, counts: NDArray[np.int64]) -> Stack:
        left, right = self.world.grid.horizontal()[[0, -1]]
        filled = self.world.grid.horizontal()[silhouette.any(axis=0)]
        left, right = (filled.min(), filled.max()) if len(filled) else (left, right)
        shapes = sorted(shapes_of(counts), key=lambda s: -self.world.catalogue[int(s)].size[0])
        poses, x, level = [], left, 0
        for shape in shapes:
            width = self.world.catalogue[int(shape)].size[0]
            if x + width > right + 0.3 and x > left:
                x, level = left, level + 1
            poses.append([x + width / 2, 0, level + 0.5, 0, 0, 0])
            x += width + 0.02
        return Stack(np.array(shapes), np.array(poses), self.world.catalogue)
