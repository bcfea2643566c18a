"""Trained networks as StackSamplers: questions in batches, answers as stacks.

Legend: B scenes, S shapes, N blocks at most, n stacks per scene, H x W pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stackgen.errors import StackgenError
from stackgen.models.poses import POSE, PoseNetwork
from stackgen.stack import Stack, shapes_of
from stackgen.world import Mask, World


class NetworkSampler:
    """A StackSampler: a network of poses with its world, asked for some stacks at a time.

    Args:
        model: Trained network.
        world: World it was trained in.
        card: What is known about the weights.
        batch: Largest number of stacks that are made together.
    """

    def __init__(self, model: PoseNetwork, world: World, card: dict[str, Any] | None = None, batch: int = 512) -> None:
        self.world = world
        self.card: dict[str, Any] = card or {}
        self.batch = batch
        self.model: Any = model.eval()

    @property
    def settings(self) -> dict[str, Any]:
        """How it samples, for the record."""
        return {}

    def draw(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
        """Draw poses (B * n, N, 6) [cell, rad]; see PoseNetwork.sample."""
        return self.model.sample(silhouettes, shapes, mask, generator)

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler.

        Raises:
            StackgenError: If a block list is empty, longer than the model takes or of other shapes, or sizes differ.
        """
        totals = self._check(silhouettes, counts, num_samples)
        stacks: list[list[Stack]] = []
        scenes = max(1, self.batch // num_samples)
        device = self.model.mean.device
        generator = torch.Generator().manual_seed(seed)
        for start in range(0, len(counts), scenes):
            part = slice(start, start + scenes)
            longest = int(totals[part].max()) if self.model.trims else self.world.max_blocks
            shapes, mask = pad_shapes(counts[part], longest)
            poses = self.draw(
                torch.from_numpy(np.ascontiguousarray(silhouettes[part], dtype=np.float32)).to(device),
                torch.from_numpy(np.repeat(shapes, num_samples, axis=0)).to(device),
                torch.from_numpy(np.repeat(mask, num_samples, axis=0)).to(device),
                generator,
            )
            found = poses.double().cpu().numpy().reshape(len(shapes), num_samples, -1, POSE)
            for row, real, drawn in zip(shapes, mask, found, strict=True):
                stacks.append([Stack(row[real], p[: real.sum()], self.world.catalogue) for p in drawn])
        return stacks

    def _check(self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int) -> NDArray[np.int64]:
        """Count the blocks of each list (B,)."""
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        size, shapes = self.world.grid.image_size, len(self.world.catalogue)
        if silhouettes.ndim != 3 or silhouettes.shape[1:] != (size, size) or len(counts) != len(silhouettes):
            raise StackgenError(f"sampling needs silhouettes (B, {size}, {size}) and as many block lists")
        if np.shape(counts) != (len(silhouettes), shapes) or np.any(np.asarray(counts) < 0):
            raise StackgenError(
                f"a block list has {shapes} counts of 0 or more, one for each shape of the model's world"
            )
        totals = np.asarray(counts).sum(axis=1)
        if len(totals) and not (totals.min() >= 1 and totals.max() <= self.world.max_blocks):
            raise StackgenError(
                f"this model takes 1 to {self.world.max_blocks} blocks, got {sorted(set(totals.tolist()))}"
            )
        return totals


def pad_shapes(counts: NDArray[np.int64], length: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Block lists (B, S) as shape indices (B, length), padded with -1, and the mask of real blocks."""
    rows = [shapes_of(row) for row in counts]
    shapes = np.full((len(rows), length), -1, dtype=np.int64)
    for i, row in enumerate(rows):
        shapes[i, : len(row)] = row
    return shapes, shapes >= 0
