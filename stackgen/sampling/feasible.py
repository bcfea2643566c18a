"""The block lists that can make a silhouette row by row."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from stackgen.baselines.heuristic import Interval, section
from stackgen.errors import StackgenError
from stackgen.world import Catalogue, Grid, Mask, Shape, World

VALID_IOU = 0.8
"""Front IoU from which a standing stack counts as matching the target, for valid diversity."""


RUN_TOLERANCE = 0.24
"""How much a run of pixels may be wider or narrower than the blocks that fill it [cell]: what
displacement, settling, tilt and whole pixels do. Less than half the step between a triangle's middle
(0.5) and a cube, so that no run has two meanings."""


def can_make(silhouette: ArrayLike, block_list: ArrayLike, world: World) -> bool:
    """Say whether a block list can make a silhouette, its blocks lying in rows of cells.

    At half height of each row the silhouette is cut into runs of pixels; the blocks of the list must
    fill all runs, each block once. Shapes that taper (the triangle is half as wide there) never touch
    their neighbours at half height, so each is a run of its own. Whether the structure would stand is
    not asked.

    Args:
        silhouette: (H, W).
        block_list: (S,) number of blocks of each shape.
        world: Shapes, each one cell high, and grid.

    Raises:
        StackgenError: If a shape of the list is not one cell high.
    """
    wanted = tuple(int(c) for c in np.asarray(block_list))
    return wanted in lists_that_make(silhouette, wanted, world)


def lists_that_make(silhouette: ArrayLike, limit: ArrayLike, world: World) -> set[tuple[int, ...]]:
    """Find all block lists of at most `limit` (S,) of each shape that can make a silhouette; see :func:`can_make`."""
    most = tuple(int(c) for c in np.asarray(limit))
    shapes = zip(world.catalogue, most, strict=True)
    sections = tuple(cross_section(shape) if c else (np.inf, True) for shape, c in shapes)
    used = {(0,) * len(most)}
    for left, right in (run for row in row_runs(np.asarray(silhouette, dtype=bool), world.grid) for run in row):
        fillings = _fillings(round(right - left, 9), sections)
        sums = {tuple(a + b for a, b in zip(u, f, strict=True)) for u in used for f in fillings}
        used = {s for s in sums if all(a <= b for a, b in zip(s, most, strict=True))}
    return {s for s in used if any(s)}


def has_plain_rows(catalogue: Catalogue) -> bool:
    """Say whether all shapes are one cell high, so that :func:`can_make` can answer."""
    return all(abs(shape.size[2] - 1) < 1e-6 for shape in catalogue)


def cross_section(shape: Shape) -> tuple[float, bool]:
    """Measure the width at half height [cell], and say whether the shape is narrower there than its box."""
    width, _, height = shape.size
    if abs(height - 1) > 1e-6:
        raise StackgenError(f"block lists can be matched with silhouettes for shapes one cell high, not {shape.name!r}")
    return section(shape), section(shape) < width - 1e-6


def row_runs(silhouette: Mask, grid: Grid) -> list[list[Interval]]:
    """Find the runs of pixels at half height of each row of cells, from the ground up."""
    z, x = grid.vertical("front"), grid.horizontal()
    half = 0.5 / grid.pixels_per_cell
    rows = []
    for level in range(grid.height):
        band = silhouette[np.abs(z - level - 0.5) < 0.15]
        filled = np.concatenate([[False], 2 * band.sum(axis=0) >= len(band), [False]])
        edges = np.flatnonzero(filled[1:] != filled[:-1])
        rows.append(
            [(float(x[a] - half), float(x[b - 1] + half)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        )
    return rows


@lru_cache(maxsize=4096)
def _fillings(width: float, sections: tuple[tuple[float, bool], ...]) -> frozenset[tuple[int, ...]]:
    """Find the block lists that fill a run: one tapering shape, or boxes side by side."""
    alone = {i for i, (w, tapers) in enumerate(sections) if tapers and abs(w - width) <= RUN_TOLERANCE}
    found = {tuple(int(i == j) for j in range(len(sections))) for i in alone}

    def fill(first: int, left: float, taken: tuple[int, ...]) -> None:
        if abs(left) <= RUN_TOLERANCE and any(taken):
            found.add(taken)
        for i in range(first, len(sections)):
            w, tapers = sections[i]
            if not tapers and w <= left + RUN_TOLERANCE:
                fill(i, left - w, tuple(t + (i == j) for j, t in enumerate(taken)))

    fill(0, width, (0,) * len(sections))
    return frozenset(found)
