"""The search as a method like any other: a StackSampler for given block lists, and a BlockListPredictor.

Legend: B scenes, S shapes, T block lists, H x W pixels.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.search.problem import SearchSettings
from stackgen.search.solver import solve
from stackgen.stack import Stack, check_block_list, shapes_of
from stackgen.world import PAPER_WORLD, Mask, World

Ints = NDArray[np.int64]

NAME = "search"
"""Its name wherever weights are asked for."""


@dataclass(frozen=True)
class SearchMethod:
    """The search, as those see it who only know weights.

    It draws nothing at random: the seed changes nothing.

    Args:
        world: Shapes, grid and longest block list.
        search: How long and for what it looks.
    """

    world: World = PAPER_WORLD
    search: SearchSettings = SearchSettings()  # noqa: RUF009 - frozen

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings, as JSON allows; what has no limit is left out."""
        return {name: value for name, value in asdict(self.search).items() if value is not None}

    @property
    def card(self) -> dict[str, Any]:
        """What is known about it, like the card of weights; the checksum is that of its settings."""
        content = {"kind": NAME, "config": self.settings}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        return {**content, "name": NAME, "sha256": digest}


@dataclass(frozen=True)
class SearchSampler(SearchMethod):
    """A StackSampler that searches: the best stacks of distinct layouts, from the first again where there are few."""

    def sample_batch(self, silhouettes: Mask, counts: Ints, num_samples: int, seed: int) -> list[list[Stack]]:
        """See StackSampler. Blocks that no stack was found for are laid side by side on the ground.

        Raises:
            StackgenError: If a block list is empty or too long, or sizes differ.
        """
        if num_samples < 1:
            raise StackgenError(f"the number of samples must be at least 1, got {num_samples}")
        if np.shape(counts) != (len(silhouettes), len(self.world.catalogue)):
            shapes = len(self.world.catalogue)
            raise StackgenError(f"sampling needs a block list (S = {shapes}) for each silhouette")
        scenes = []
        for silhouette, block_list in zip(silhouettes, np.asarray(counts), strict=True):
            check_block_list(block_list, self.world.max_blocks)
            found = solve(silhouette, self.world, num_samples, block_list, settings=self.search)
            stacks = [answer.stack for answer in found] or [side_by_side(block_list, self.world)]
            scenes.append([stacks[i % len(stacks)] for i in range(num_samples)])
        return scenes


@dataclass(frozen=True)
class SearchBlockLists(SearchMethod):
    """A BlockListPredictor that searches: the block lists of the best stacks."""

    def predict(self, silhouettes: Mask, top: int = 1, limit: Ints | None = None) -> Ints:
        """See BlockListPredictor. Where fewer lists than `top` are found the last is repeated.

        Raises:
            StackgenError: If no block list can make a silhouette.
        """
        settings = replace(self.search, near=1.0)
        lists = []
        for silhouette in silhouettes:
            found = solve(silhouette, self.world, top, inventory=limit, settings=settings)
            if not found:
                raise StackgenError("search: nothing that stands was found for the silhouette; give a block list")
            distinct = list(dict.fromkeys(tuple(answer.stack.counts.tolist()) for answer in found))
            lists.append((distinct + distinct[-1:] * top)[:top])
        return np.array(lists, dtype=np.int64)


def side_by_side(block_list: Ints | Sequence[int], world: World) -> Stack:
    """Lay blocks on the ground, side by side around the middle.

    >>> side_by_side([1, 1, 0, 0], PAPER_WORLD).poses[:, 0].tolist()
    [-1.0, 0.5]
    """
    shapes = shapes_of(block_list)
    sizes = np.array([world.catalogue[shape].size for shape in shapes])
    poses = np.zeros((len(shapes), 6))
    poses[:, 0] = np.cumsum(sizes[:, 0]) - sizes[:, 0] / 2 - sizes[:, 0].sum() / 2
    poses[:, 2] = sizes[:, 2] / 2
    return Stack(shapes, poses, world.catalogue)
