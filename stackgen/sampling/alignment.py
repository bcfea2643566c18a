"""Structures that do not stand on the cells of the grid, for samplers that know only those that do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.protocols import StackSampler
from stackgen.sampling.wrapped import WrappedSampler
from stackgen.search.sampler import NAME as SEARCH
from stackgen.stack import Stack
from stackgen.vision.drawings import grid_offset
from stackgen.vision.masks import bounding_box
from stackgen.world import Grid, Mask

Floats = NDArray[np.float64]

SCALES = np.arange(80, 126) / 100
"""Scales at which a structure may have been drawn, by which it is enlarged."""

CLEARLY = 0.15
"""Another scale counts where it brings so much more of a structure's edges onto cell lines, as a share of them all."""

_NEAR = 2.0  # an edge is on a cell line if it is nearer [pixel]


@dataclass(frozen=True)
class AlignedSampler(WrappedSampler):
    """A StackSampler that shows another each structure on the cells of its grid, and moves the answer back."""

    sampler: StackSampler

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler."""
        shown, offsets = zip(*(as_shown(mask, self.sampler) for mask in silhouettes), strict=True)
        scenes = self.sampler.sample_batch(np.stack(shown), counts, num_samples, seed)
        back = [np.array([-offset / self.world.grid.pixels_per_cell, 0, 0, 0, 0, 0]) for offset in offsets]
        return [[s.with_poses(s.poses + b) for s in stacks] for stacks, b in zip(scenes, back, strict=True)]


def as_shown(silhouette: Mask, sampler: StackSampler) -> tuple[Mask, int]:
    """Give what a sampler, and who predicts its block lists, are shown of a silhouette (H, W), as `aligned` does.

    The search puts blocks at any pixel, and is shown the silhouette as it is.
    """
    return (silhouette, 0) if sampler.card.get("kind") == SEARCH else aligned(silhouette, sampler.world.grid)


def aligned(silhouette: Mask, grid: Grid) -> tuple[Mask, int]:
    """Show a silhouette (H, W) at the scale and in the place at which its edges lie on cell lines.

    Blocks have one size, so what was drawn at nine tenths of its scale is best built at its scale, where it was drawn.

    Returns:
        (H, W) what samplers are shown, and by how many pixels it was moved to the right.
    """
    shown = _enlarged(silhouette, cell_scale(silhouette, grid), grid)
    offset = grid_offset(shown, grid)
    return np.roll(shown, offset, axis=1), offset


def cell_scale(silhouette: Mask, grid: Grid) -> float:
    """Find by how much to enlarge a silhouette (H, W) for its edges to lie on cell lines; 1 unless that is clear.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[35:60, 19:44] = True  # four cubes, at nine tenths of their scale
    >>> round(cell_scale(picture, Grid()), 1)
    1.1
    """
    if not silhouette.any():
        return 1.0
    rows, columns = bounding_box(silhouette)
    steps = silhouette.astype(np.int8)
    upright, level = (np.abs(np.diff(steps, axis=axis, prepend=0, append=0)).sum(axis=axis - 1) for axis in (1, 0))
    foot, middle = round(grid.image_size - grid.ground_margin), (columns.start + columns.stop) / 2
    across = SCALES[:, None, None] * (np.arange(len(upright)) - middle)
    across = across + np.arange(grid.pixels_per_cell)[:, None]  # wherever it may stand
    down = SCALES[:, None] * (np.arange(len(level)) - foot)
    on_lines = _on_lines(across, grid) @ upright
    share = (on_lines.max(axis=1) + _on_lines(down, grid) @ level) / (upright.sum() + level.sum())
    own = share[SCALES == 1][0]
    high, half = SCALES * (foot - rows.start), SCALES * (columns.stop - columns.start) / 2
    room = min(middle, grid.image_size - middle)  # it is enlarged about its middle
    share[(high > grid.height * grid.pixels_per_cell + _NEAR) | (half > room)] = 0
    found = int(np.lexsort((np.abs(SCALES - 1), -share))[0])
    return float(SCALES[found]) if share[found] >= own + CLEARLY else 1.0


def _on_lines(places: Floats, grid: Grid) -> Floats:
    """Tell how near places [pixel] are to cell lines: 1 for on one, 0 from `_NEAR` on."""
    cells = places / grid.pixels_per_cell
    return np.asarray(np.maximum(0, 1 - np.abs(cells - np.round(cells)) * grid.pixels_per_cell / _NEAR))


def _enlarged(silhouette: Mask, scale: float, grid: Grid) -> Mask:
    """Enlarge a silhouette (H, W) about the middle of its box, on the ground line."""
    if scale == 1:
        return silhouette
    foot, columns = round(grid.image_size - grid.ground_margin), bounding_box(silhouette)[1]
    middle = (columns.start + columns.stop) / 2
    y, x = (
        np.floor((np.arange(length) + 0.5 - still) / scale + still).astype(int)
        for length, still in zip(silhouette.shape, (foot, middle), strict=True)
    )
    inside = ((y >= 0) & (y < len(silhouette)))[:, None] & ((x >= 0) & (x < silhouette.shape[1]))
    return inside & silhouette[np.clip(y, 0, len(silhouette) - 1)][:, np.clip(x, 0, silhouette.shape[1] - 1)]
