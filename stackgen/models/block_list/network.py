"""The block-list CNN: silhouette in, a distribution over block lists out (paper, "Model Architecture")."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.errors import StackgenError
from stackgen.models.block_list.heads import MOST_CLASSES, ChainHead, ClassHead, number_of_lists
from stackgen.world import Mask, World


@dataclass(frozen=True)
class CNNConfig:
    """Architecture; the defaults are the paper's where it gives them.

    Args:
        channels: Of the stem and of every residual layer (paper: 10).
        layers: Residual layers of two 3 x 3 convolutions each (paper: 30).
        stem_stride: Of the first convolution; above 1 the residual layers see a smaller picture (ours).
        pool: Edge of the feature map after max pooling [cells of the map].
        hidden: Width between the two fully connected layers.
        head: `classes`, one for each block list (paper); `chain`, one shape's count after the other, for
            worlds of too many lists (ours, see stackgen.models.block_list.heads); `auto` takes classes up to 100,000.
    """

    channels: int = 10
    layers: int = 30
    stem_stride: int = 1
    pool: int = 8
    hidden: int = 512
    head: Literal["auto", "classes", "chain"] = "auto"


class BlockListNetwork(nn.Module):
    """Silhouettes (B, H, W) to a distribution over the block lists of a world.

    Args:
        config: See CNNConfig.
        world: Says which block lists there are, and the area that one can fill.
    """

    def __init__(
        self,
        config: CNNConfig,
        world: World,
    ) -> None:
        super().__init__()
        stride = config.stem_stride
        self.stem = nn.Conv2d(1, config.channels, 2 * stride + 1, stride=stride, padding=stride)
        self.layers = nn.Sequential(*(Residual(config.channels) for _ in range(config.layers)))
        self.pool = nn.AdaptiveMaxPool2d(config.pool)
        self.hidden = nn.Linear(config.channels * config.pool**2, config.hidden)
        few = number_of_lists(len(world.catalogue), world.max_blocks) <= MOST_CLASSES
        self.out: ClassHead | ChainHead
        if config.head == "classes" or (config.head == "auto" and few):
            self.out = ClassHead(config.hidden, len(world.catalogue), world.max_blocks)
        else:
            self.out = ChainHead.of_world(config.hidden, world)

    def features(self, silhouettes: Tensor) -> Tensor:
        """(B, H, W) silhouettes to what the head reads (B, hidden)."""
        x = self.layers(self.stem(silhouettes[:, None]))
        return F.relu(self.hidden(self.pool(x).flatten(1)))

    def forward(self, silhouettes: Tensor, counts: Tensor) -> Tensor:
        """Log-probability (B, M) of block lists (B, M, S)."""
        return self.out.log_probabilities(self.features(silhouettes), counts)

    def best(self, silhouettes: Tensor, top: int, limit: Tensor | None = None) -> Tensor:
        """The most likely block lists (B, top, S), see BlockListPredictor.predict."""
        return self.out.best(self.features(silhouettes), top, limit)


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
        network: The trained network.
        world: The world it was trained in.
        card: What is known about the weights.
    """

    def __init__(
        self,
        network: BlockListNetwork,
        world: World,
        card: dict[str, Any] | None = None,
    ) -> None:
        self.network = network.eval()
        self.world = world
        self.card: dict[str, Any] = card or {}

    @torch.inference_mode()
    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """See BlockListPredictor."""
        if top < 1:
            raise StackgenError(f"block list: at least one is predicted, not {top}")
        most = None if limit is None else self._lists(limit, 1)
        return np.concatenate([self.network.best(part, top, most).cpu().numpy() for part in self._parts(silhouettes)])

    @torch.inference_mode()
    def log_probabilities(self, silhouettes: Mask, lists: ArrayLike) -> NDArray[np.float64]:
        """(B, M) natural logarithm of the probability of each of M block lists (M, S), for each silhouette.

        Raises:
            StackgenError: If a list has no block, or more than N.
        """
        counts = self._lists(lists, 2)
        parts = [self.network(part, counts.expand(len(part), -1, -1)) for part in self._parts(silhouettes)]
        return torch.cat(parts).double().cpu().numpy()

    def _parts(self, silhouettes: Mask) -> list[Tensor]:
        """The silhouettes (B, H, W) as the network takes them, in batches."""
        device = self.network.hidden.weight.device
        parts = np.array_split(silhouettes, max(1, math.ceil(len(silhouettes) / 256)))
        return [torch.from_numpy(np.ascontiguousarray(part, dtype=np.float32)).to(device) for part in parts]

    def _lists(self, counts: ArrayLike, dimensions: int) -> Tensor:
        """Counts (..., S) where the network is."""
        array = np.asarray(counts, dtype=np.int64)
        if array.ndim != dimensions or array.shape[-1] != len(self.world.catalogue):
            names = ", ".join(self.world.catalogue.names)
            raise StackgenError(f"block list: one count for each of {names}, got an array {array.shape}")
        return torch.from_numpy(array).to(self.network.hidden.weight.device)
