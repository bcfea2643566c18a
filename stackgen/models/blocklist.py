"""The block-list CNN: silhouette in, a class per multiset of shapes out (paper, "Model Architecture")."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.geometry import PAPER_GRID, Grid, Mask
from stackgen.stack import MAX_BLOCKS, PAPER_CATALOGUE, Catalogue, StackgenError

_MOST_CLASSES = 100_000


@dataclass(frozen=True)
class CNNConfig:
    """Architecture; the defaults are the paper's where it gives them.

    Args:
        channels: Of the stem and of every residual layer (paper: 10).
        layers: Residual layers of two 3 x 3 convolutions each (paper: 30).
        stem_stride: Of the first convolution; above 1 the residual layers see a smaller picture (ours).
        pool: Edge of the feature map after max pooling [cells of the map].
        hidden: Width between the two fully connected layers.
    """

    channels: int = 10
    layers: int = 30
    stem_stride: int = 1
    pool: int = 8
    hidden: int = 512


class BlockListNetwork(nn.Module):
    """Silhouettes (B, H, W) to logits (B, classes); class i stands for the block list `lists[i]`.

    Args:
        config: See CNNConfig.
        num_shapes, max_blocks: Size of the catalogue and N; together they fix the classes.
    """

    lists: Tensor
    keys: Tensor

    def __init__(self, config: CNNConfig, num_shapes: int = 4, max_blocks: int = MAX_BLOCKS) -> None:
        super().__init__()
        self.max_blocks = max_blocks
        lists = torch.from_numpy(all_block_lists(num_shapes, max_blocks))
        self.register_buffer("lists", lists, persistent=False)
        self.register_buffer("keys", self._key(lists), persistent=False)
        stride = config.stem_stride
        self.stem = nn.Conv2d(1, config.channels, 2 * stride + 1, stride=stride, padding=stride)
        self.layers = nn.Sequential(*(Residual(config.channels) for _ in range(config.layers)))
        self.pool = nn.AdaptiveMaxPool2d(config.pool)
        self.hidden = nn.Linear(config.channels * config.pool**2, config.hidden)
        self.out = nn.Linear(config.hidden, len(lists))

    def forward(self, silhouettes: Tensor) -> Tensor:
        """Logits (B, classes)."""
        x = self.layers(self.stem(silhouettes[:, None]))
        return self.out(F.relu(self.hidden(self.pool(x).flatten(1))))

    def classes(self, counts: Tensor) -> Tensor:
        """Class (B,) of each block list (B, S).

        Raises:
            StackgenError: If a list is empty or has more than N blocks.
        """
        total = counts.sum(-1)
        if bool(((total < 1) | (total > self.max_blocks)).any()):
            raise StackgenError(f"block lists of 1 to {self.max_blocks} blocks have a class")
        return torch.searchsorted(self.keys, self._key(counts))

    def _key(self, counts: Tensor) -> Tensor:
        base = (self.max_blocks + 1) ** torch.arange(counts.shape[-1] - 1, -1, -1, device=counts.device)
        return (counts * base).sum(-1)


class Residual(nn.Module):
    """Two 3 x 3 convolutions with batch norm around a skip (He et al. 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm1, self.norm2 = nn.BatchNorm2d(channels), nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        return F.relu(x + self.norm2(self.conv2(F.relu(self.norm1(self.conv1(x))))))


class CNNPredictor:
    """A BlockListPredictor: the network with its world.

    Args:
        network: Trained.
        catalogue, grid, max_blocks: The world it was trained in.
        card: What is known about the weights.
    """

    def __init__(
        self,
        network: BlockListNetwork,
        catalogue: Catalogue = PAPER_CATALOGUE,
        grid: Grid = PAPER_GRID,
        max_blocks: int = MAX_BLOCKS,
        card: dict[str, Any] | None = None,
    ) -> None:
        self.network = network.eval()
        self.catalogue, self.grid, self.max_blocks = catalogue, grid, max_blocks
        self.card = card or {}

    @torch.inference_mode()
    def predict(self, silhouettes: Mask, top: int = 1) -> NDArray[np.int64]:
        """(B, H, W) silhouettes to the `top` most likely block lists of each, (B, top, S)."""
        best, device = [], self.network.lists.device
        for part in np.array_split(silhouettes, max(1, math.ceil(len(silhouettes) / 256))):
            logits = self.network(torch.from_numpy(np.ascontiguousarray(part, dtype=np.float32)).to(device))
            best.append(self.network.lists[logits.topk(top).indices].cpu().numpy())
        return np.concatenate(best)


def all_block_lists(num_shapes: int, max_blocks: int) -> NDArray[np.int64]:
    """(classes, S) every multiset of 1..max_blocks blocks, in lexicographic order.

    Raises:
        StackgenError: If there are too many to be classes.

    >>> all_block_lists(2, 2).tolist()
    [[0, 1], [0, 2], [1, 0], [1, 1], [2, 0]]
    """
    number = math.comb(num_shapes + max_blocks, num_shapes) - 1
    if number > _MOST_CLASSES:
        raise StackgenError(
            f"{num_shapes} shapes and up to {max_blocks} blocks make {number} block lists, too many for a class each"
        )
    # Stars and bars: choose where S bars stand among N stars; what is behind the last bar is left over.
    bars = np.array(list(itertools.combinations(range(num_shapes + max_blocks), num_shapes)))
    counts = np.diff(bars, axis=1, prepend=-1) - 1
    counts = counts[counts.sum(axis=1) > 0]
    return counts[np.lexsort(counts.T[::-1])].astype(np.int64)
