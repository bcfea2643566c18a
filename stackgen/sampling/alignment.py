"""Structures that do not stand on the cells of the grid, for samplers that know no others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.protocols import StackSampler
from stackgen.stack import Stack
from stackgen.vision.drawings import grid_offset
from stackgen.world import PAPER_GRID, Grid, Mask


class AlignedSampler:
    """A StackSampler that shows another each structure on the cells of its grid, and moves the answer back.

    Args:
        sampler: The other.
        grid: Scale of the silhouettes.
    """

    def __init__(self, sampler: StackSampler, grid: Grid = PAPER_GRID) -> None:
        self.sampler, self.grid = sampler, grid
        self.settings: dict[str, Any] = getattr(sampler, "settings", {})

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler."""
        offsets = [grid_offset(mask, self.grid) for mask in silhouettes]
        shifted = np.stack([np.roll(mask, offset, axis=1) for mask, offset in zip(silhouettes, offsets, strict=True)])
        scenes = self.sampler.sample_batch(shifted, counts, num_samples, seed)
        back = [np.array([-offset / self.grid.pixels_per_cell, 0, 0, 0, 0, 0]) for offset in offsets]
        return [[s.with_poses(s.poses + b) for s in stacks] for stacks, b in zip(scenes, back, strict=True)]
