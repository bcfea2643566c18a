"""Upright blocks on pixels: which of them a block covers, for many places along x at once.

A block that stands upright covers in each row of pixels one interval, and moving it along x moves the
intervals with it. So what it covers of a picture is, in each row, the difference of two running sums,
and hundreds of places cost one gather (Crow 1984, summed-area tables, in one dimension).

Legend: n places, R rows of pixels that the block covers, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.geometry import Floats, row_intervals
from stackgen.world import Grid, Shape

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Cover:
    """The pixels that a block covers at each of n places.

    Args:
        rows: (R,) rows of pixels.
        start: (n, R) first column.
        stop: (n, R) column after the last; equal to `start` where there is none.
    """

    rows: Integers
    start: Integers
    stop: Integers

    def sum(self, running: Integers) -> Integers:
        """Sum a picture over the pixels covered (n,), given its running sums (see :func:`running_sums`)."""
        return (running[self.rows, self.stop] - running[self.rows, self.start]).sum(axis=1)

    def beside(self, reach: int, width: int) -> tuple[Cover, Cover]:
        """Take the `reach` pixels to the left and to the right in each row, as far as a picture of `width` goes."""
        some = reach * (self.stop > self.start)
        left, right = np.maximum(self.start - some, 0), np.minimum(self.stop + some, width)
        return Cover(self.rows, left, self.start), Cover(self.rows, self.stop, right)

    def take(self, indices: ArrayLike) -> Cover:
        """Take some of the places."""
        i = np.asarray(indices)
        return Cover(self.rows, self.start[i], self.stop[i])


def cover(shape: Shape, x: ArrayLike, z: float, grid: Grid) -> Cover:
    """Find the pixels of the front view that an upright block covers with its frame at each (x, z) [cell], x (n,).

    A pixel is covered when its centre is, as :func:`stackgen.geometry.silhouette` has it.
    """
    rows, left, right = _intervals(shape, z, grid)
    places, last = np.asarray(x, dtype=np.float64)[:, None], grid.image_size
    middle = (grid.image_size - 1) / 2  # column whose centre has x = 0
    start = np.ceil((places + left) * grid.pixels_per_cell + middle).astype(np.int64)
    stop = np.floor((places + right) * grid.pixels_per_cell + middle).astype(np.int64) + 1
    start = np.clip(start, 0, last)
    return Cover(rows, start, np.clip(stop, start, last))


def running_sums(picture: ArrayLike) -> Integers:
    """(H, W) to (H, W + 1): the sum of each row's pixels left of each column.

    >>> running_sums([[1, 0, 2]]).tolist()
    [[0, 1, 1, 3]]
    """
    return np.pad(np.cumsum(picture, axis=1, dtype=np.int64), ((0, 0), (1, 0)))


@lru_cache(maxsize=256)
def _intervals(shape: Shape, z: float, grid: Grid) -> tuple[Integers, Floats, Floats]:
    """Rows (R,) that a block at x = 0 covers, and the interval [cell] it covers in each, (R,) and (R,)."""
    outline = np.asarray(shape.outline) + np.array([0.0, z])
    left, right = row_intervals(outline, grid.vertical("front"))
    rows = np.flatnonzero(left <= right)
    return rows, left[rows], right[rows]
