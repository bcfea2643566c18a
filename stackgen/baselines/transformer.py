"""What the learned baselines share: the denoiser's Transformer without noise, and poses as a regression target.

Where the denoiser tells equal blocks apart by their noisy poses, here "positional encodings [are]
added to the shape embeddings" (paper, "Transformer-VAE Baseline"): every block has a place in a list.
The list is shuffled for each stack in training and for each sample afterwards (SPEC: how the
deterministic methods get three samples).

Legend: B scenes, N block tokens, C silhouette tokens, d width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.errors import StackgenError
from stackgen.models.diffusion.denoiser import (
    POSE,
    CrossLayer,
    DenoiserConfig,
    EncoderLayer,
    Patches,
    ranks,
    raster_order,
    sinusoids,
)
from stackgen.models.network_sampler import NetworkSampler
from stackgen.stack import Stack
from stackgen.world import Mask, World

_FORBIDDEN = 1e6  # cost of giving a block another shape's pose


@dataclass(frozen=True)
class RegressionConfig:
    """How estimated poses are compared with the true ones. The paper gives none of these; they are ours.

    Args:
        assignment: Which of several equal blocks' poses is whose target: `raster`, by their order
            from the bottom up and left to right; or `matched`, as fits the estimate best.
        loss: `squared`, whose best answer is the mean of the possible poses, or `absolute`, their median.
        least_std: Lower bound of the standard deviation that a dimension is divided by [cell, rad].
    """

    assignment: Literal["raster", "matched"] = "raster"
    loss: Literal["squared", "absolute"] = "squared"
    least_std: float = 0.0


class BlockTokens(nn.Module):
    """Shapes to tokens: codebook entry plus positional encoding, and the rank among equal blocks if `ordered`."""

    positions: Tensor

    def __init__(self, config: DenoiserConfig, world: World) -> None:
        super().__init__()
        self.shape_embedding = nn.Embedding(len(world.catalogue), config.width)
        self.rank_embedding = nn.Embedding(world.max_blocks, config.width) if config.ordered else None
        self.register_buffer(
            "positions", sinusoids(torch.arange(world.max_blocks).float(), config.width), persistent=False
        )

    def forward(self, shapes: Tensor) -> Tensor:
        """(B, N) indices, negative at padding, to (B, N, d)."""
        tokens = self.shape_embedding(shapes.clamp(min=0)) + self.positions[: shapes.shape[1]]
        return tokens if self.rank_embedding is None else tokens + self.rank_embedding(ranks(shapes))


class SilhouetteTokens(nn.Module):
    """Silhouette to tokens, as the denoiser makes them: patches, and in `cross` a short encoder over them."""

    def __init__(self, config: DenoiserConfig, image_size: int) -> None:
        super().__init__()
        self.patches = Patches(config.patch, config.stride, image_size, config.width)
        layers = config.memory_layers if config.conditioning == "cross" else 0
        self.layers = nn.ModuleList(EncoderLayer(config, norm_first=True) for _ in range(layers))

    def forward(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) in {0, 1} to (B, C, d)."""
        tokens = self.patches(silhouette)
        for layer in self.layers:
            tokens = layer(tokens, None)
        return tokens


class Trunk(nn.Module):
    """The denoiser's layers: block tokens that see each other and the silhouette.

    Args:
        config: The denoiser's; `layers` does not count here.
        layers: How many.
        conditioned: Whether a vector takes the place of the denoiser's time. Otherwise nothing does, or
            in `cross`, where it scales and shifts every layer, one that is learned.
    """

    def __init__(self, config: DenoiserConfig, layers: int, conditioned: bool) -> None:
        super().__init__()
        self.mask_padding = config.mask_padding
        self.joint = config.conditioning == "joint"
        if self.joint:
            self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(layers))
        else:
            self.layers = nn.ModuleList(CrossLayer(config) for _ in range(layers))
            self.norm = nn.LayerNorm(config.width)
            if not conditioned:
                self.condition = nn.Parameter(torch.randn(config.width))

    def forward(self, blocks: Tensor, mask: Tensor, memory: Tensor, condition: Tensor | None = None) -> Tensor:
        """Tokens (B, N, d) for tokens (B, N, d); mask (B, N), condition (B, d).

        Memory is (B, C, d), or (B / n, C, d), serving n consecutive rows each.
        """
        if self.joint:
            if condition is not None:
                blocks = blocks + condition[:, None]
            memory = memory.repeat_interleave(len(blocks) // len(memory), 0)
            tokens = torch.cat([blocks * mask[..., None], memory], dim=1)  # (B, N + C, d), zero vectors as padding
            seen = F.pad(mask, (0, memory.shape[1]), value=True) if self.mask_padding else None
            for layer in self.layers:
                tokens = layer(tokens, seen)
            return tokens[:, : blocks.shape[1]]
        vector = self.condition.expand(len(blocks), -1) if condition is None else condition
        seen = None if bool(mask.all()) else mask
        for layer in self.layers:
            blocks = layer(blocks, vector, seen, memory)
        return self.norm(blocks)


class PoseNetwork(nn.Module):
    """What Tran-Reg and Tran-VAE have in common: normalisation, order of the blocks, error and sampling.

    A subclass implements `draw`.

    Args:
        transformer: Architecture, described as the denoiser's.
        regression: See RegressionConfig.
        world: Shapes, size of the silhouette, and N.

    Raises:
        StackgenError: If the architecture asks for what only a denoiser has.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        transformer: DenoiserConfig,
        regression: RegressionConfig,
        world: World,
    ) -> None:
        super().__init__()
        if transformer.self_conditioning:
            raise StackgenError("self_conditioning: only a denoiser has an earlier estimate to look at")
        self.transformer, self.regression = transformer, regression
        self.blocks = BlockTokens(transformer, world)
        self.silhouette = SilhouetteTokens(transformer, world.grid.image_size)
        self.head = nn.Linear(transformer.width, POSE)
        if transformer.conditioning == "cross":
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)
        self.register_buffer("mean", torch.zeros(POSE))
        self.register_buffer("std", torch.ones(POSE))

    @property
    def trims(self) -> bool:
        """See DenoiserConfig."""
        return self.transformer.trims

    def fit_normalization(self, mean: ArrayLike, std: ArrayLike) -> None:
        """Take over the training poses' statistics (6,) [cell, rad]."""
        self.mean.copy_(torch.as_tensor(np.asarray(mean)))
        self.std.copy_(torch.as_tensor(np.asarray(std)).clamp(min=max(self.regression.least_std, 1e-6)))

    def scene(self, batch: dict[str, Tensor], generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
        """Shapes (B, N), mask (B, N) and normalised poses (B, N, 6) of a batch, the shapes in random order.

        The blocks of one shape keep their order from the bottom up and left to right.
        """
        order = raster_order(batch["poses"], batch["shapes"])
        shapes = batch["shapes"].gather(1, order)
        order = order.gather(1, shuffled(shapes, generator))
        shapes, mask = batch["shapes"].gather(1, order), batch["mask"].gather(1, order)
        poses = batch["poses"].gather(1, order[..., None].expand_as(batch["poses"]))
        return shapes, mask, (poses - self.mean) / self.std

    def error(self, estimate: Tensor, target: Tensor, shapes: Tensor, mask: Tensor) -> Tensor:
        """(B,) error of normalised poses (B, N, 6), averaged over dimensions and real blocks."""
        if self.regression.assignment == "matched":
            match = best_match(self._distance(estimate[:, :, None], target[:, None]), shapes)
            target = target.gather(1, match[..., None].expand_as(target))
        return (self._distance(estimate, target) * mask).sum(-1) / mask.sum(-1)

    def _distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Mean over the six dimensions."""
        difference = a - b
        return (difference.square() if self.regression.loss == "squared" else difference.abs()).mean(-1)

    def draw(self, shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        """Normalised poses (B, N, 6)."""
        raise NotImplementedError

    @torch.inference_mode()
    def sample(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
        """Poses (B, N, 6) [cell, rad] for silhouettes (B / n, H, W), each serving n rows of shapes (B, N)."""
        keys = torch.rand(shapes.shape, generator=generator, device=generator.device).to(shapes.device)
        order = (keys + 2 * ~mask).argsort(-1)  # padding stays last
        poses = self.draw(shapes.gather(1, order), mask.gather(1, order), self.silhouette(silhouettes), generator)
        poses = poses.gather(1, order.argsort(-1)[..., None].expand_as(poses))
        return poses * self.std + self.mean


def shuffled(shapes: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """(B, N) random order of blocks that are sorted by shape; those of one shape stay in order, padding comes last.

    Args:
        shapes: (B, N) sorted, but for the padding at the end, which is negative.
        generator: The global one by default.
    """
    device = generator.device if generator is not None else shapes.device
    keys = torch.rand(shapes.shape, generator=generator, device=device).to(shapes.device)
    kind = torch.where(shapes < 0, shapes.max() + 1, shapes).to(keys.dtype)
    keys = (2 * kind + keys).sort(-1).values - 2 * kind  # ascending within each shape
    return (keys + 2 * (shapes < 0)).argsort(-1)


def best_match(cost: Tensor, shapes: Tensor) -> Tensor:
    """(B, N) the target of each block: the permutation within equal shapes that costs least (Kuhn 1955).

    Args:
        cost: (B, N, N) of giving block i target j.
        shapes: (B, N) of blocks and of targets.

    >>> cost = torch.tensor([[[2.0, 1.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.0, 3.0]]])
    >>> best_match(cost, torch.tensor([[0, 0, 1]])).tolist()
    [[1, 0, 2]]
    """
    same = shapes[:, :, None] == shapes[:, None, :]
    costs = torch.where(same, cost.detach(), _FORBIDDEN).double().cpu().numpy()
    found = np.stack([linear_sum_assignment(matrix)[1] for matrix in costs])
    return torch.from_numpy(found).to(shapes.device)


class TransformerSampler(NetworkSampler[PoseNetwork]):
    """A StackSampler: a learned baseline with its world."""

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """See StackSampler.

        Raises:
            StackgenError: If a block list is empty or longer than the model takes, or sizes differ.
        """
        return self._answer(silhouettes, counts, num_samples, seed, self.model.sample)
