"""The last layer of the block-list network: features in, a distribution over block lists out.

It has two forms. `ClassHead` is the paper's: a class for each multiset of shapes. There are 1,000 of them in
the paper's world, and 888,029 of 7 shapes and up to 20 blocks. `ChainHead` is ours, for worlds of too many: it
counts one shape after the other. Both are exact: their probabilities add up to one over all lists of
1 to N blocks, and their best lists are the best of all that an inventory allows.

Legend: B silhouettes, F features, M lists, S shapes, N blocks at most, A the area that is told apart,
P places, K the width of the layer in which features and area meet.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.errors import StackgenError
from stackgen.world import World

MOST_CLASSES = 100_000
"""Largest number of block lists that have a class each."""

_WIDTH = 128  # K, of the layer in which features and area meet
_GAIN = 3.0  # of that layer, which so learns as fast as the other
_AT_ONCE = 32  # silhouettes whose best lists are searched together: bounds the memory


class ClassHead(nn.Linear):
    """Logits (B, classes) from features (B, F); class i stands for the block list `lists[i]`.

    Args:
        features: Number of features F.
        num_shapes: Number of shapes S.
        max_blocks: Longest block list N; with S it fixes the classes.

    Raises:
        StackgenError: If there are too many classes.
    """

    lists: Tensor
    keys: Tensor

    def __init__(self, features: int, num_shapes: int, max_blocks: int) -> None:
        lists = torch.from_numpy(all_block_lists(num_shapes, max_blocks))
        super().__init__(features, len(lists))
        self.max_blocks = max_blocks
        self.register_buffer("lists", lists, persistent=False)
        self.register_buffer("keys", self._key(lists), persistent=False)

    def log_probabilities(self, features: Tensor, counts: Tensor) -> Tensor:
        """Compute the log-probability (B, M) of block lists (B, M, S)."""
        return self(features).log_softmax(-1).gather(1, self.classes(counts))

    def best(self, features: Tensor, top: int, limit: Tensor | None = None) -> Tensor:
        """Find the most likely lists (B, top, S) with counts of at most `limit` (S,); fewer if there are fewer."""
        allowed = torch.ones_like(self.keys, dtype=torch.bool)
        if limit is not None:
            allowed = (self.lists <= limit).all(-1)
        top = min(top, int(allowed.sum()))
        if not top:
            raise _nothing_fits(self.max_blocks)
        logits = self(features).masked_fill(~allowed, -torch.inf)
        return self.lists[logits.topk(top).indices]

    def classes(self, counts: Tensor) -> Tensor:
        """Find the class (...) of each block list (..., S).

        Raises:
            StackgenError: If a list is empty or has more than N blocks.
        """
        _check(counts, self.max_blocks)
        return torch.searchsorted(self.keys, self._key(counts))

    def _key(self, counts: Tensor) -> Tensor:
        base = (self.max_blocks + 1) ** torch.arange(counts.shape[-1] - 1, -1, -1, device=counts.device)
        return (counts * base).sum(-1)


class ChainHead(nn.Module):
    """The count of each shape in turn, given the silhouette and the area that the shapes before it fill.

    P(list) is the product of P(count of shape s | features, area so far), of which counts that would
    make more than N blocks, and the empty list, are left out. A silhouette shows the area of its blocks
    almost exactly, so that is what the counts of different shapes must agree on. And because so little
    of the past is remembered, the best lists are found exactly, whatever an inventory allows. The largest
    shapes come first: how many small ones there are follows from the area that is left. The layer `common`
    serves all areas and is learnt first; `read`, `place` and `count` are a layer for each shape in which
    features and area meet, so that what holds at one area is a good guess at the next.

    Args:
        features: Number of features F.
        sizes: (S,) area of each shape, whole and at least 1.
        max_blocks: Longest block list N.
        most: Area A from which on areas are not told apart.
    """

    order: Tensor
    back: Tensor
    waves: Tensor

    def __init__(self, features: int, sizes: Sequence[int], max_blocks: int, most: int) -> None:
        super().__init__()
        order = sorted(range(len(sizes)), key=lambda shape: -sizes[shape])
        self.register_buffer("order", torch.tensor(order), persistent=False)
        self.register_buffer("back", torch.argsort(self.order), persistent=False)
        self.register_buffer("waves", _waves(most), persistent=False)
        self.sizes = tuple(sizes[shape] for shape in order)
        self.max_blocks, self.most = max_blocks, most
        self.norm = nn.LayerNorm(features)
        self.common = nn.Linear(features, len(sizes) * (max_blocks + 1))
        self.read = nn.Linear(features, len(sizes) * _WIDTH)
        self.place = nn.Parameter(torch.randn(len(sizes), _WIDTH, _WIDTH) / _WIDTH**0.5)
        self.count = nn.Parameter(torch.randn(len(sizes), _WIDTH, max_blocks + 1) * 0.02)

    @staticmethod
    def of_world(features: int, world: World) -> ChainHead:
        """Make the head of a world, with areas in half cells."""
        sizes = [max(1, round(2 * shape.area)) for shape in world.catalogue]
        return ChainHead(features, sizes, world.max_blocks, 2 * world.grid.width * world.grid.height)

    def log_probabilities(self, features: Tensor, counts: Tensor) -> Tensor:
        """Compute the log-probability (B, M) of block lists (B, M, S).

        Raises:
            StackgenError: If a list is empty or has more than N blocks.
        """
        _check(counts, self.max_blocks)
        counts = counts[..., self.order]
        before = counts.cumsum(-1) - counts  # (B, M, S) blocks of the shapes before
        areas = counts * torch.tensor(self.sizes, device=counts.device)
        areas = (areas.cumsum(-1) - areas).clamp(max=self.most)
        shapes = torch.arange(len(self.sizes), device=counts.device)
        places = self._places()[shapes, areas].transpose(1, 2)  # (B, S, M, K)
        logits = self._possible(self._logits(features, places).transpose(1, 2), before)  # (B, M, S, N + 1)
        empty = torch.zeros_like(logits, dtype=torch.bool)
        empty[..., -1, 0] = before[..., -1] == 0
        chosen = logits.masked_fill(empty, -torch.inf).log_softmax(-1).gather(-1, counts[..., None])
        return chosen[..., 0].sum(-1)

    def best(self, features: Tensor, top: int, limit: Tensor | None = None) -> Tensor:
        """Find the most likely lists (B, top, S) with counts of at most `limit` (S,); fewer if there are fewer."""
        most = None if limit is None else limit[self.order]
        found = [self._best(part, top, most) for part in features.split(_AT_ONCE)]
        return torch.cat(found)[..., self.back]

    def _best(self, features: Tensor, top: int, limit: Tensor | None) -> Tensor:
        """Search forward, keeping `top` beginnings, led by what the rest of each is worth at best.

        Each beginning is scored with its best completion, so one of the `top` best lists is never
        dropped: that would take `top` others that end better.
        """
        steps, rest = self._steps(features, limit)
        rows = torch.arange(len(features), device=features.device)[:, None]
        lists = features.new_zeros((len(features), 1, 0), dtype=torch.long)
        blocks, areas = lists.sum(-1), lists.sum(-1)  # (B, 1)
        score = features.new_zeros(blocks.shape)
        for shape, size in enumerate(self.sizes):
            value = score[..., None] + steps[shape][rows, blocks, areas]  # (B, k, N + 1)
            number = torch.arange(self.max_blocks + 1, device=features.device)
            after = (blocks[..., None] + number).clamp(max=self.max_blocks)
            filled = (areas[..., None] + size * number).clamp(max=self.most)
            reached = value + rest[shape + 1][rows[..., None], after, filled]
            chosen = reached.flatten(1).topk(min(top, reached[0].numel())).indices  # (B, k)
            beginning, count = chosen // len(number), chosen % len(number)
            lists = torch.cat([lists[rows, beginning], count[..., None]], -1)
            blocks, areas, score = (x.flatten(1).gather(1, chosen) for x in (after, filled, value))
        kept = int(score.isfinite().sum(-1).min())
        if not kept:
            raise _nothing_fits(self.max_blocks)
        return lists[:, :kept]

    def _steps(self, features: Tensor, limit: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
        """Compute, for each shape, the log-probability (B, N + 1, A + 1, N + 1) of its count after so many blocks
        and so much area, -inf where the limit forbids it; and what the rest is worth at best from there on
        (B, N + 1, A + 1), for the end too."""
        number = torch.arange(self.max_blocks + 1, device=features.device)
        blocks, areas = number[:, None, None], torch.arange(self.most + 1, device=features.device)[:, None]
        after = (blocks + number).clamp(max=self.max_blocks)  # (N + 1, 1, N + 1)
        tables = self._logits(features, self._places())
        steps: list[Tensor] = []
        rest = [features.new_zeros((len(features), self.max_blocks + 1, self.most + 1))]
        for shape in reversed(range(len(self.sizes))):
            logits = tables[:, shape, None].expand(-1, len(number), -1, -1)  # (B, N + 1, A + 1, N + 1)
            logits = self._possible(logits, number[:, None])
            if shape == len(self.sizes) - 1:
                empty = torch.zeros_like(logits[0], dtype=torch.bool)
                empty[0, 0, 0] = True
                logits = logits.masked_fill(empty, -torch.inf)
            step = logits.log_softmax(-1)
            if limit is not None:
                step = step.masked_fill(number > limit[shape], -torch.inf)
            filled = (areas + self.sizes[shape] * number).clamp(max=self.most)  # (A + 1, N + 1)
            steps.insert(0, step)
            rest.insert(0, (step + rest[0][:, after, filled]).amax(-1))
        return steps, rest

    def _places(self) -> Tensor:
        """Compute what each area means to each shape: (S, A + 1, K)."""
        return self.waves @ self.place

    def _logits(self, features: Tensor, places: Tensor) -> Tensor:
        """Compute the logits (B, S, P, N + 1) of each count of each shape at its places (S, P, K) or (B, S, P, K)."""
        features = self.norm(features)
        common = self.common(features).unflatten(1, (len(self.sizes), 1, -1))
        meeting = F.relu(self.read(features).unflatten(1, (len(self.sizes), 1, -1)) + places)
        return (common + _GAIN * meeting @ self.count).float()

    def _possible(self, logits: Tensor, before: Tensor) -> Tensor:
        """Mask the logits (..., N + 1) of counts that make more than N blocks with those before (...)."""
        number = torch.arange(self.max_blocks + 1, device=logits.device)
        return logits.masked_fill(before[..., None] + number > self.max_blocks, -torch.inf)


def _waves(most: int) -> Tensor:
    """Show each area 0..A as waves (A + 1, K), from hundreds of areas long down to eight."""
    rates = torch.logspace(-2, math.log10(0.75), _WIDTH // 2)
    angles = torch.arange(most + 1)[:, None] * rates
    return 0.5 * torch.cat([angles.sin(), angles.cos()], 1)


def _check(counts: Tensor, max_blocks: int) -> None:
    total = counts.sum(-1)
    if bool(((total < 1) | (total > max_blocks) | (counts < 0).any(-1)).any()):
        raise StackgenError(f"only block lists of 1 to {max_blocks} blocks have a probability")


def _nothing_fits(max_blocks: int) -> StackgenError:
    return StackgenError(f"block list: no list of 1 to {max_blocks} blocks can be made of the inventory")


def number_of_lists(num_shapes: int, max_blocks: int) -> int:
    """Count the block lists of 1..max_blocks blocks.

    >>> number_of_lists(4, 10)
    1000
    """
    return math.comb(num_shapes + max_blocks, num_shapes) - 1


def all_block_lists(num_shapes: int, max_blocks: int) -> NDArray[np.int64]:
    """List every multiset of 1..max_blocks blocks (classes, S), in lexicographic order.

    Raises:
        StackgenError: If there are too many to be classes.

    >>> all_block_lists(2, 2).tolist()
    [[0, 1], [0, 2], [1, 0], [1, 1], [2, 0]]
    """
    number = number_of_lists(num_shapes, max_blocks)
    if number > MOST_CLASSES:
        raise StackgenError(
            f"{num_shapes} shapes and up to {max_blocks} blocks make {number} block lists, too many for a class each:"
            " set the network's head to chain"
        )
    # Stars and bars: choose where S bars stand among N stars; what is behind the last bar is left over.
    bars = np.array(list(itertools.combinations(range(num_shapes + max_blocks), num_shapes)))
    counts = np.diff(bars, axis=1, prepend=-1) - 1
    counts = counts[counts.sum(axis=1) > 0]
    return counts[np.lexsort(counts.T[::-1])].astype(np.int64)
