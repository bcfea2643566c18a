"""Silhouettes as cells of the grid, each full, empty or a triangle (paper, "Block Stacking in the Real World").

Each row of cells lies on the cell lines or half a cell beside them, as in a pyramid, so cells are told by their halves.

Legend: H x W pixels, rows and half columns from the lower left, S shapes.
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
from stackgen.vision.reader import Reading
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, Grid, Mask

Ints = NDArray[np.int64]

EMPTY, FULL, RISING, FALLING = range(4)
"""The kinds of half cells; a triangle rises in its left half and falls in the other."""

_CELLS = ((EMPTY, EMPTY), (FULL, FULL), (RISING, FALLING))  # both halves of each kind of cell

ALIKE = 0.93
"""Least IoU with the stretched figure for it to count as made of whole cells."""

STRETCH = 1.25
"""A cell that was drawn by hand is at most this much wider than high, or higher than wide."""

_COST = 0.1  # IoU that a stretch by e costs

_LITTLE = 0.05  # logarithm of a stretch that is none

PIECE = 0.4
"""Edge of a square in which cells may not differ from the figure all over [cell]: a roof is no row of cells."""

NEAR = 0.3
"""The sides of a structure of whole cells are at most this far from whole numbers [cell]."""


def in_cells(figure: Mask, grid: Grid, high: float | None = None) -> tuple[Mask, Ints | None, Ints | None]:
    """Replace a figure by the cells it is made of, where it is made of whole cells.

    Its scale is that at which it is most alike: three steps are three cells high, though the grid has four. Of scales
    that are equally good the largest counts.

    Args:
        figure: (h, w), cut out to its box.
        grid: Grid of the silhouette.
        high: Height of the figure [cell] where it is known.

    Returns:
        (H, W) silhouette, (rows, half columns) cells and (S,) block list; without whole cells the figure as it fills
        the grid, or as high as it is known to be, None and None.
    """
    full = filling(figure, grid) if high is None else high
    heights = [full, *range(math.ceil(full) - 1, 0, -1)] if high is None else [full]
    tried = [_as_cells(place(figure, grid, height), grid) for height in heights]
    best, cells = tried[0]
    for score, fewer in tried[1:]:
        if score >= max(ALIKE, best + 0.03):
            best, cells = score, fewer
    if best < ALIKE:
        return place(figure, grid, full), None, None
    whole, rows = picture_of(cells, grid), int((cells != EMPTY).any(axis=1).sum())
    return place(whole[bounding_box(whole)], grid, rows), cells, block_list_of(cells)


def squared(reading: Reading, grid: Grid) -> Reading:
    """Make the cells of a sketch square where its hand drew all of them wider, or higher; then its scale is known, too.

    >>> steps = np.kron(np.tri(3, dtype=bool), np.ones((58, 48), bool))
    >>> sketch = squared(Reading(steps, "photo", 1.0, np.zeros((9, 9, 3), np.uint8)), Grid())
    >>> sketch.figure.shape, sketch.cell, sketch.notes
    ((174, 174), 58.0, ('The cells were drawn 1.2 times as high as wide, and were made square.',))
    """
    if reading.kind != "photo" or reading.cell is not None:
        return reading
    tall = reading.figure.shape[0] / reading.figure.shape[1]
    tried = []
    for high, wide in np.ndindex(grid.height, grid.width):
        stretch = (wide + 1) / (high + 1) * tall
        if 1 / STRETCH <= stretch <= STRETCH:
            size = (round(len(reading.figure) * (wide + 1) / (high + 1)), len(reading.figure))
            square = cv2.resize(reading.figure.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            score, _ = _as_cells(place(square, grid, high + 1), grid)
            tried.append((score - _COST * abs(math.log(stretch)), score, stretch, high + 1, square))
    _, score, stretch, high, square = max(tried, key=lambda one: one[0], default=(0.0, 0.0, 1.0, 1, reading.figure))
    if score < ALIKE or abs(math.log(stretch)) < _LITTLE:
        return reading
    ratio = f"{stretch:.1f} times as high as wide" if stretch > 1 else f"{1 / stretch:.1f} times as wide as high"
    note = f"The cells were drawn {ratio}, and were made square."
    return replace(reading, figure=square, cell=len(square) / high, notes=(*reading.notes, note))


def _as_cells(as_read: Mask, grid: Grid) -> tuple[float, Ints]:
    """Find the cells nearest to a silhouette (H, W), and how alike they are: not at all where a piece differs."""
    picture = stretched(as_read, grid)
    cells = occupancy(picture, grid)
    whole = picture_of(cells, grid)
    piece = np.ones((round(PIECE * grid.pixels_per_cell),) * 2, np.uint8)
    differs = cv2.erode((whole != picture).astype(np.uint8), piece).any()
    return 0.0 if differs else iou(whole, picture), cells


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
    """Find the kinds (rows, half columns) of cells that a silhouette (H, W) differs from least.

    A triangle has nothing on top of it, and something under it.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[46:60, 4:32] = True
    >>> occupancy(picture, Grid())[0].tolist()
    [1, 1, 1, 1, 0, 0, 0, 0]
    """
    cells = np.zeros((grid.height + 1, 2 * grid.width), dtype=np.int64)
    for row in reversed(range(grid.height)):
        rows = [_row(silhouette, grid, row, cells[row + 1], shift) for shift in (0, 1)]
        cells[row] = min(rows, key=lambda found: found[0])[1]
    for row in range(1, grid.height):
        cells[row, (cells[row] >= RISING) & (cells[row - 1] == EMPTY)] = EMPTY
    return cells[:-1]


def _row(silhouette: Mask, grid: Grid, row: int, above: Ints, shift: int) -> tuple[int, Ints]:
    """Find the cells of a row that lie `shift` halves beside the cell lines.

    Returns:
        How many pixels differ, and the kinds (half columns,) of the halves.
    """
    seen = silhouette[_window(grid, row)]
    found = np.zeros(2 * grid.width, dtype=np.int64)
    for left in range(shift, 2 * grid.width - 1, 2):
        tried = []
        for kinds in _CELLS:
            if kinds[0] != RISING or not above[left : left + 2].any():
                found[left : left + 2] = kinds
                tried.append((np.count_nonzero(seen != picture_of(found[None], grid)[_window(grid, 0)]), kinds))
        found[left : left + 2] = min(tried)[1]
    return int(np.count_nonzero(seen != picture_of(found[None], grid)[_window(grid, 0)])), found


def _window(grid: Grid, row: int) -> slice:
    """Return the pixels of a row of cells."""
    bottom = grid.image_size - grid.ground_margin - row * grid.pixels_per_cell
    return slice(round(bottom - grid.pixels_per_cell), round(bottom))


def picture_of(cells: Ints, grid: Grid) -> Mask:
    """Draw the silhouette (H, W) of cells (rows, half columns)."""
    picture = np.zeros((grid.image_size,) * 2, dtype=bool)
    x, z = grid.horizontal(), grid.vertical("front")[:, None]
    for row, column in np.argwhere(cells != EMPTY):
        across = 2 * x + cells.shape[1] / 2 - column  # 0..1 from the left to the right of the half
        limit = {FULL: np.ones_like(x), RISING: across, FALLING: 1 - across}[int(cells[row, column])]
        picture |= (row <= z) & (z - row < limit) & (0 <= across) & (across < 1)
    return picture


def block_list_of(cells: Ints) -> Ints | None:
    """Guess the block list (S,) of the paper's shapes; None if it would be empty or longer than the paper's stacks.

    Each run of full cells is covered with the longest blocks that fit.

    >>> block_list_of(np.array([[1, 1, 1, 1, 1, 1, 1, 1], [0, 1, 1, 2, 3, 0, 0, 0]])).tolist()
    [2, 0, 1, 1]
    """
    block_list = np.zeros(len(PAPER_CATALOGUE), dtype=np.int64)
    block_list[PAPER_CATALOGUE.index("triangle")] = np.count_nonzero(cells == RISING)
    for row in np.pad((cells == FULL).astype(int), ((0, 0), (1, 1))):
        starts, ends = np.flatnonzero(np.diff(row) == 1), np.flatnonzero(np.diff(row) == -1)
        for length in (ends - starts) // 2:
            for name, size in (("long_rectangle", 3), ("rectangle", 2), ("cube", 1)):
                block_list[PAPER_CATALOGUE.index(name)] += length // size
                length %= size
    return block_list if 1 <= block_list.sum() <= MAX_BLOCKS else None
