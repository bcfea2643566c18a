"""Silhouettes of stacks that share blocks: what is left of a stack is drawn from what was drawn before."""

from __future__ import annotations

import numpy as np

from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.world import Grid, Mask


class Pictures:
    """Front silhouettes, each block in its place drawn once.

    Args:
        grid: Scale of the pictures.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._drawn: dict[tuple[int, bytes], Mask] = {}

    def front(self, stack: Stack) -> Mask:
        """Draw what `silhouette(stack, grid, "front")` does."""
        picture = np.zeros((self.grid.image_size, self.grid.image_size), dtype=bool)
        for shape, pose in zip(stack.shapes.tolist(), stack.poses, strict=True):
            place = (shape, pose.tobytes())
            if place not in self._drawn:
                self._drawn[place] = silhouette(
                    Stack(np.array([shape]), pose[None], stack.catalogue), self.grid, "front"
                )
            picture |= self._drawn[place]
        return picture
