"""Silhouettes as cells of the grid, each full, empty or a triangle (paper, "Block Stacking in the Real World").

Legend: H x W pixels, rows and columns of cells from the lower left, S shapes.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import iou
from stackgen.vision.drawings import grid_offset, read_silhouette
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID, Grid, Mask

Ints = NDArray[np.int64]

EMPTY, FULL, TRIANGLE = range(3)
"""What a cell may be."""

NEAR = 0.3
"""How far from whole numbers the sides of what is made of whole cells may be [cell]."""


def in_cells(silhouette: Mask, alike: float, grid: Grid = PAPER_GRID) -> tuple[Ints, Mask] | None:
    """What each cell is, and the silhouette (H, W) that those cells make; None if it is not made of whole cells.

    Args:
        silhouette: (H, W) on the grid, anywhere between its cell lines, not empty.
        alike: IoU of the two, the first `stretched`, from which on it is taken to be made of whole cells.
        grid: Of both.
    """
    picture = stretched(silhouette, grid)
    cells = occupancy(picture, grid)
    whole = picture_of(cells, grid)
    return (cells, read_silhouette(whole, grid, exact=False)) if iou(whole, picture) >= alike else None


def stretched(silhouette: Mask, grid: Grid = PAPER_GRID) -> Mask:
    """The silhouette (H, W), its box stretched to whole cells where nearly so, its edges on the grid's cell lines.

    Where a block sticks out, what was scaled to fit its width is too low, and half a cell looks like a triangle.
    """
    rows, columns = np.flatnonzero(silhouette.any(axis=1)), np.flatnonzero(silhouette.any(axis=0))
    cut = silhouette[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    size = np.array(cut.shape) / grid.pixels_per_cell
    near = np.maximum(np.round(size), 1)
    height, width = np.round(np.where(np.abs(size - near) < NEAR, near, size) * grid.pixels_per_cell).astype(int)
    bottom, left = round(grid.image_size - grid.ground_margin), (grid.image_size - width) // 2
    picture = np.zeros_like(silhouette)
    resized = cv2.resize(cut.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    picture[bottom - height : bottom, left : left + width] = resized >= 0.5
    return np.roll(picture, grid_offset(picture, grid), axis=1)


def occupancy(silhouette: Mask, grid: Grid = PAPER_GRID) -> Ints:
    """(height, width) what each cell of the grid is: of full, empty and triangle what it differs from least.

    A triangle has nothing on top of it.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[46:60, 4:32] = True
    >>> occupancy(picture)[0].tolist()
    [1, 1, 0, 0]
    """
    patterns = {
        kind: picture_of(np.full((1, 1), kind), Grid(1, 1, grid.image_size, grid.pixels_per_cell, grid.ground_margin))
        for kind in (EMPTY, FULL, TRIANGLE)
    }
    cells = np.zeros((grid.height, grid.width), dtype=np.int64)
    for row in reversed(range(grid.height)):
        for column in range(grid.width):
            window = _window(grid, row, column)
            middle = _window(Grid(1, 1, grid.image_size, grid.pixels_per_cell, grid.ground_margin), 0, 0)
            wrong = {kind: np.count_nonzero(silhouette[window] != p[middle]) for kind, p in patterns.items()}
            if row + 1 < grid.height and cells[row + 1, column] != EMPTY:
                del wrong[TRIANGLE]
            cells[row, column] = min(wrong, key=lambda kind: wrong[kind])
    return cells


def _window(grid: Grid, row: int, column: int) -> tuple[slice, slice]:
    """The pixels of a cell."""
    scale = grid.pixels_per_cell
    left = grid.image_size / 2 + (column - grid.width / 2) * scale
    bottom = grid.image_size - grid.ground_margin - row * scale
    return slice(round(bottom - scale), round(bottom)), slice(round(left), round(left + scale))


def picture_of(cells: Ints, grid: Grid = PAPER_GRID) -> Mask:
    """(H, W) silhouette of cells (rows, columns)."""
    picture = np.zeros((grid.image_size,) * 2, dtype=bool)
    x, z = grid.horizontal(), grid.vertical("front")[:, None]
    for row, column in np.argwhere(cells != EMPTY):
        middle = column + 0.5 - cells.shape[1] / 2
        height = z - row
        half = 0.5 if cells[row, column] == FULL else (1 - height) / 2
        picture |= (0 <= height) & (height < 1) & (np.abs(x - middle) < half)
    return picture


def block_list(cells: Ints) -> Ints | None:
    """(S,) counts: each run of full cells is covered with the longest blocks that fit; None if that takes too many.

    >>> block_list(np.array([[1, 1, 1, 1], [0, 1, 2, 0]])).tolist()
    [2, 0, 1, 1]
    """
    counts = np.zeros(len(PAPER_CATALOGUE), dtype=np.int64)
    counts[PAPER_CATALOGUE.index("triangle")] = np.count_nonzero(cells == TRIANGLE)
    for row in np.pad((cells == FULL).astype(int), ((0, 0), (1, 1))):
        starts, ends = np.flatnonzero(np.diff(row) == 1), np.flatnonzero(np.diff(row) == -1)
        for length in ends - starts:
            for name, size in (("long_rectangle", 3), ("rectangle", 2), ("cube", 1)):
                counts[PAPER_CATALOGUE.index(name)] += length // size
                length %= size
    return counts if 1 <= counts.sum() <= MAX_BLOCKS else None
