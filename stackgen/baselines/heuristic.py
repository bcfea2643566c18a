"""What the heuristics share: one stack at a time, each from a random stream of its own.

Legend: B scenes, S shapes, H x W pixels.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import row_intervals
from stackgen.stack import Stack, check_block_list
from stackgen.world import PAPER_WORLD, Mask, Shape, World

Interval = tuple[float, float]
"""Left and right end of a part of the x axis [cell]."""


@dataclass(frozen=True)
class Heuristic(ABC):
    """A StackSampler that places blocks by rules; every block of the list gets a pose.

    A stack depends on the seed, the silhouette, the block list and its number among the samples, and
    on nothing else: not on the other scenes of the batch, and not on how many samples are drawn.

    Args:
        world: Shapes, scale of the silhouettes, and the longest block list it takes.
    """

    kind: ClassVar[str]
    """Its name on the command line."""

    world: World = PAPER_WORLD

    @abstractmethod
    def place(self, silhouette: Mask, block_list: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        """Make one stack for a silhouette (H, W) and a block list (S,)."""

    @property
    def settings(self) -> dict[str, Any]:
        """Its numbers, as JSON allows."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "world"}

    @property
    def card(self) -> dict[str, Any]:
        """What is known about it, like the card of weights; the checksum is that of kind and settings."""
        content = {"kind": self.kind, "config": self.settings}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        return {**content, "name": self.kind, "sha256": digest}

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler.

        Raises:
            StackgenError: If a block list is empty or too long or has a shape that is not one cell high,
                or sizes differ.
        """
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        size, shapes = self.world.grid.image_size, len(self.world.catalogue)
        if silhouettes.ndim != 3 or silhouettes.shape[1:] != (size, size):
            raise StackgenError(f"sampling needs silhouettes (B, {size}, {size}), got {silhouettes.shape}")
        if np.shape(counts) != (len(silhouettes), shapes):
            raise StackgenError(f"sampling needs a block list (S = {shapes}) for each silhouette")
        for shape, used in zip(self.world.catalogue, np.any(counts, axis=0), strict=True):
            if used and abs(shape.size[2] - 1) > 1e-6:
                raise StackgenError(f"{self.kind} places shapes one cell high, not {shape.name!r}")
        scenes = []
        for picture, block_list in zip(np.asarray(silhouettes, dtype=bool), np.asarray(counts), strict=True):
            check_block_list(block_list, self.world.max_blocks)
            streams = (random_stream(seed, picture, block_list, number) for number in range(num_samples))
            scenes.append([self.place(picture, block_list, rng) for rng in streams])
        return scenes

    def _largest_first(self, block_list: NDArray[np.int64]) -> list[int]:
        """List the shape index of each block, the ones of most area first."""
        order = sorted(range(len(block_list)), key=lambda s: (-self.world.catalogue[s].volume, s))
        return [s for s in order for _ in range(int(block_list[s]))]


def random_stream(seed: int, silhouette: Mask, block_list: NDArray[np.int64], number: int) -> np.random.Generator:
    """Make the random numbers of one sample of one scene."""
    content = np.packbits(silhouette).tobytes() + np.asarray(block_list, dtype="<i8").tobytes()
    scene = int.from_bytes(hashlib.sha256(content).digest()[:16], "little")
    return np.random.default_rng([seed, scene, number])


def section(shape: Shape) -> float:
    """Measure the width of an upright block at half its height [cell].

    >>> section(PAPER_WORLD.catalogue[3])  # the triangle
    0.5
    """
    left, right = row_intervals(np.asarray(shape.outline), np.zeros(1))
    return float(right[0] - left[0])
