"""The block-list CNN: silhouette in, a distribution over block lists out (paper, "Model Architecture")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.models.block_list.heads import MOST_CLASSES, ChainHead, ClassHead, number_of_lists
from stackgen.world import World


@dataclass(frozen=True)
class CNNConfig:
    """Architecture of the block-list CNN; the defaults are the paper's where it gives them.

    Args:
        channels: Number of channels of the stem and of every residual layer (paper: 10).
        layers: Number of residual layers, each of two 3 x 3 convolutions (paper: 30).
        stem_stride: Stride of the first convolution; above 1 the residual layers see a smaller picture (ours).
        pool: Edge of the feature map after max pooling [entries].
        hidden: Width between the two fully connected layers.
        head: Last layer: `classes`, one for each block list (paper); `chain`, one shape's count after the other, for
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
        config: Architecture.
        world: Block lists that there are, and the area that one can fill.
    """

    def __init__(self, config: CNNConfig, world: World) -> None:
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
        """Find the most likely block lists (B, top, S), see BlockListPredictor.predict."""
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
