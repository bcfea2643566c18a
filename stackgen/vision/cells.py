"""Silhouettes as cells of the grid, each full, empty or a triangle (paper, "Block Stacking in the Real World").

Legend: H x W pixels, rows and columns of cells from the lower left, S shapes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import iou
from stackgen.vision.drawings import grid_offset
from stackgen.vision.masks import bounding_box, filling, place
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, Grid, Mask

Ints = NDArray[np.int64]

EMPTY, FULL, TRIANGLE = range(3)
"""The kinds of cells."""

NEAR = 0.3
"""The sides of a structure of whole cells are at most this far from whole numbers [cell]."""

CLEARLY = 0.9
"""Least IoU with cells at less than the largest scale, which are fewer and suit by chance."""


def in_cells(
    figure: Mask, alike: float, grid: Grid, high: float | None = None
) -> tuple[Mask, Ints | None, Ints | None]:
    """Replace a figure by the cells it is made of, where it is made of whole cells.

    Its scale is that at which it is most alike: three steps are three cells high, though the grid has four. Of scales
    that are equally good the largest counts.

    Args:
        figure: (h, w), cut out to its box.
        alike: Least IoU of the cells' picture with the stretched figure for it to count as made of whole cells.
        grid: Grid of the silhouette.
        high: Height of the figure [cell] where it is known.

    Returns:
        (H, W) silhouette, (rows, columns) cells and (S,) block list; without whole cells the figure as it fills the
        grid, or as high as it is known to be, None and None.
    """
    full = filling(figure, grid) if high is None else high
    heights = [full, *range(math.ceil(full) - 1, 0, -1)] if high is None else [full]
    tried = [_as_cells(place(figure, grid, height), grid) for height in heights]
    best, cells = tried[0]
    for score, fewer in tried[1:]:
        if score >= max(CLEARLY, best + 0.03):
            best, cells = score, fewer
    if best < alike:
        return place(figure, grid, full), None, None
    whole, rows = picture_of(cells, grid), int((cells != EMPTY).any(axis=1).sum())
    return place(whole[bounding_box(whole)], grid, rows), cells, block_list_of(cells)


def _as_cells(as_read: Mask, grid: Grid) -> tuple[float, Ints]:
    """Find the cells nearest to a silhouette (H, W), and how alike their picture is."""
    picture = stretched(as_read, grid)
    cells = occupancy(picture, grid)
    return iou(picture_of(cells, grid), picture), cells


def stretched(silhouette: Mask, grid: Grid) -> Mask:
    """Stretch the box of a silhouette (H, W) to whole cells where nearly so, and set its edges on the cell lines.

    Where a block sticks out, what was scaled to fit its width is too low, and half a cell looks like a triangle.
    """
    cut = silhouette[bounding_box(silhouette)]
    size = np.array(cut.shape) / grid.pixels_per_cell
    near = np.maximum(np.round(size), 1)
    height, width = np.round(np.where(np.abs(size - near) < NEAR, near, size) * grid.pixels_per_cell).astype(int)
    bottom, left = round(grid.image_size - grid.ground_margin), (grid.image_size - width) // 2
    picture = np.zeros_like(silhouette)
    resized = cv2.resize(cut.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    picture[bottom - height : bottom, left : left + width] = resized >= 0.5
    return np.roll(picture, grid_offset(picture, grid), axis=1)


def occupancy(silhouette: Mask, grid: Grid) -> Ints:
    """Find the kind (height, width) of each cell of the grid: the one that it differs from least.

    A triangle has nothing on top of it.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[46:60, 4:32] = True
    >>> occupancy(picture, Grid())[0].tolist()
    [1, 1, 0, 0]
    """
    one = replace(grid, width=1, height=1)
    patterns = {kind: picture_of(np.full((1, 1), kind), one)[_window(one, 0, 0)] for kind in (EMPTY, FULL, TRIANGLE)}
    cells = np.zeros((grid.height, grid.width), dtype=np.int64)
    for row in reversed(range(grid.height)):
        for column in range(grid.width):
            seen = silhouette[_window(grid, row, column)]
            wrong = {kind: np.count_nonzero(seen != pattern) for kind, pattern in patterns.items()}
            if row + 1 < grid.height and cells[row + 1, column] != EMPTY:
                del wrong[TRIANGLE]
            cells[row, column] = min(wrong, key=lambda kind: wrong[kind])
    return cells


def _window(grid: Grid, row: int, column: int) -> tuple[slice, slice]:
    """Return the rows and columns of a cell's pixels."""
    scale = grid.pixels_per_cell
    left = grid.image_size / 2 + (column - grid.width / 2) * scale
    bottom = grid.image_size - grid.ground_margin - row * scale
    return slice(round(bottom - scale), round(bottom)), slice(round(left), round(left + scale))


def picture_of(cells: Ints, grid: Grid) -> Mask:
    """Draw the silhouette (H, W) of cells (rows, columns)."""
    picture = np.zeros((grid.image_size,) * 2, dtype=bool)
    x, z = grid.horizontal(), grid.vertical("front")[:, None]
    for row, column in np.argwhere(cells != EMPTY):
        middle = column + 0.5 - cells.shape[1] / 2
        height = z - row
        half = 0.5 if cells[row, column] == FULL else (1 - height) / 2
        picture |= (0 <= height) & (height < 1) & (np.abs(x - middle) < half)
    return picture


def block_list_of(cells: Ints) -> Ints | None:
    """Guess the block list (S,) of the paper's shapes; None if it would be empty or longer than the paper's stacks.

    Each run of full cells is covered with the longest blocks that fit.

    >>> block_list_of(np.array([[1, 1, 1, 1], [0, 1, 2, 0]])).tolist()
    [2, 0, 1, 1]
    """
    block_list = np.zeros(len(PAPER_CATALOGUE), dtype=np.int64)
    block_list[PAPER_CATALOGUE.index("triangle")] = np.count_nonzero(cells == TRIANGLE)
    for row in np.pad((cells == FULL).astype(int), ((0, 0), (1, 1))):
        starts, ends = np.flatnonzero(np.diff(row) == 1), np.flatnonzero(np.diff(row) == -1)
        for length in ends - starts:
            for name, size in (("long_rectangle", 3), ("rectangle", 2), ("cube", 1)):
                block_list[PAPER_CATALOGUE.index(name)] += length // size
                length %= size
    return block_list if 1 <= block_list.sum() <= MAX_BLOCKS else None
