"""Structures that do not stand on the cells of the grid, for samplers that know only those that do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.protocols import StackSampler
from stackgen.sampling.wrapped import WrappedSampler
from stackgen.stack import Stack
from stackgen.vision.drawings import grid_offset
from stackgen.world import Mask


@dataclass(frozen=True)
class AlignedSampler(WrappedSampler):
    """A StackSampler that shows another each structure on the cells of its grid, and moves the answer back."""

    sampler: StackSampler

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler."""
        grid = self.world.grid
        offsets = [grid_offset(mask, grid) for mask in silhouettes]
        shifted = np.stack([np.roll(mask, offset, axis=1) for mask, offset in zip(silhouettes, offsets, strict=True)])
        scenes = self.sampler.sample_batch(shifted, counts, num_samples, seed)
        back = [np.array([-offset / grid.pixels_per_cell, 0, 0, 0, 0, 0]) for offset in offsets]
        return [[s.with_poses(s.poses + b) for s in stacks] for stacks, b in zip(scenes, back, strict=True)]
