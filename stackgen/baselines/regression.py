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
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from stackgen.errors import StackgenError
from stackgen.models.poses import PoseNetwork, ranks, raster_order
from stackgen.models.transformer import (
    Patches,
    TransformerConfig,
    block_layers,
    final_norm,
    memory_layers,
    pose_head,
    run_blocks,
    sinusoids,
)
from stackgen.world import Grid, World

_FORBIDDEN = 1e6  # cost of giving a block another shape's pose


@dataclass(frozen=True)
class RegressionConfig:
    """How estimated poses are compared with the true ones. The paper gives none of these; they are ours.

    Args:
        assignment: Rule for whose pose is whose target among equal blocks: `raster`, by their order from the
            bottom up and left to right; or `matched`, as fits the estimate best.
        loss: Loss: `squared`, whose best answer is the mean of the possible poses, or `absolute`, their median.
        least_std: Lower bound of the standard deviation that a dimension of the poses is divided by [cell, rad].
    """

    assignment: Literal["raster", "matched"] = "raster"
    loss: Literal["squared", "absolute"] = "squared"
    least_std: float = 0.0


class BlockTokens(nn.Module):
    """Shapes to tokens: codebook entry plus positional encoding, and the rank among equal blocks if `ordered`."""

    positions: Tensor

    def __init__(self, config: TransformerConfig, world: World) -> None:
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

    def __init__(self, config: TransformerConfig, grid: Grid) -> None:
        super().__init__()
        self.patches = Patches(config, grid)
        self.layers = memory_layers(config)

    def forward(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) in {0, 1} to (B, C, d)."""
        tokens = self.patches(silhouette)
        for layer in self.layers:
            tokens = layer(tokens, None)
        return tokens


class Trunk(nn.Module):
    """The denoiser's layers: block tokens that see each other and the silhouette.

    Args:
        config: Architecture; its `layers` does not count here.
        layers: Number of layers.
        conditioned: Whether a vector is given in place of the denoiser's time. If not, nothing is added in
            `joint`, and in `cross`, where it scales and shifts every layer, the vector is learned.
    """

    def __init__(self, config: TransformerConfig, layers: int, conditioned: bool) -> None:
        super().__init__()
        self.config = config
        self.layers = block_layers(config, layers)
        self.norm = final_norm(config)
        learned = config.conditioning == "cross" and not conditioned
        self.condition = nn.Parameter(torch.randn(config.width)) if learned else None

    def forward(self, blocks: Tensor, mask: Tensor, memory: Tensor, condition: Tensor | None = None) -> Tensor:
        """Tokens (B, N, d) for tokens (B, N, d); condition (B, d), mask and memory as in `run_blocks`."""
        if self.condition is not None:
            condition = self.condition.expand(len(blocks), -1)
        tokens = run_blocks(self.layers, self.config, blocks=blocks, mask=mask, memory=memory, condition=condition)
        return self.norm(tokens)


class PoseRegressor(PoseNetwork):
    """What Tran-Reg and Tran-VAE have in common: order of the blocks, error and sampling.

    A subclass implements `draw`.

    Args:
        transformer: Architecture, that of the denoiser.
        regression: Comparison of the estimated poses with the true ones.
        world: Shapes, size of the silhouette, and N.

    Raises:
        StackgenError: If the architecture asks for what only a denoiser has.
    """

    def __init__(self, transformer: TransformerConfig, regression: RegressionConfig, world: World) -> None:
        super().__init__(regression.least_std)
        if transformer.self_conditioning:
            raise StackgenError("self_conditioning: only a denoiser has an earlier estimate to look at")
        self.transformer, self.regression = transformer, regression
        self.blocks = BlockTokens(transformer, world)
        self.silhouette = SilhouetteTokens(transformer, world.grid)
        self.head = pose_head(transformer)

    @property
    def trims(self) -> bool:
        """See PoseNetwork."""
        return self.transformer.trims

    def scene(self, batch: dict[str, Tensor], generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
        """Take shapes (B, N), mask (B, N) and normalised poses (B, N, 6) from a batch, the shapes in random order.

        The blocks of one shape keep their order from the bottom up and left to right.
        """
        order = raster_order(batch["poses"], batch["shapes"])
        shapes = batch["shapes"].gather(1, order)
        order = order.gather(1, shuffled(shapes, generator))
        shapes, mask = batch["shapes"].gather(1, order), batch["mask"].gather(1, order)
        poses = batch["poses"].gather(1, order[..., None].expand_as(batch["poses"]))
        return shapes, mask, (poses - self.mean) / self.std

    def error(self, estimate: Tensor, target: Tensor, shapes: Tensor, mask: Tensor) -> Tensor:
        """Compute the error (B,) of normalised poses (B, N, 6), averaged over dimensions and real blocks."""
        if self.regression.assignment == "matched":
            match = best_match(self._distance(estimate[:, :, None], target[:, None]), shapes)
            target = target.gather(1, match[..., None].expand_as(target))
        return (self._distance(estimate, target) * mask).sum(-1) / mask.sum(-1)

    def _distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Average over the six dimensions."""
        difference = a - b
        return (difference.square() if self.regression.loss == "squared" else difference.abs()).mean(-1)

    def draw(self, shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        """Draw normalised poses (B, N, 6) for shapes (B, N), their mask and the silhouette's tokens."""
        raise NotImplementedError

    @torch.inference_mode()
    def sample(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
        """See PoseNetwork; the blocks are shown in random order."""
        keys = torch.rand(shapes.shape, generator=generator, device=generator.device).to(shapes.device)
        order = (keys + 2 * ~mask).argsort(-1)  # padding stays last
        poses = self.draw(shapes.gather(1, order), mask.gather(1, order), self.silhouette(silhouettes), generator)
        poses = poses.gather(1, order.argsort(-1)[..., None].expand_as(poses))
        return poses * self.std + self.mean


def shuffled(shapes: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw a random order (B, N) of blocks that are sorted by shape; those of one shape stay in order, padding last.

    Args:
        shapes: (B, N) sorted, but for the padding at the end, which is negative.
        generator: Source of the order; the global one by default.
    """
    device = generator.device if generator is not None else shapes.device
    keys = torch.rand(shapes.shape, generator=generator, device=device).to(shapes.device)
    kind = torch.where(shapes < 0, shapes.max() + 1, shapes).to(keys.dtype)
    keys = (2 * kind + keys).sort(-1).values - 2 * kind  # ascending within each shape
    return (keys + 2 * (shapes < 0)).argsort(-1)


def best_match(cost: Tensor, shapes: Tensor) -> Tensor:
    """Find the target of each block (B, N): the permutation within equal shapes that costs least (Kuhn 1955).

    Args:
        cost: (B, N, N) cost of giving block i target j.
        shapes: (B, N) shapes of blocks and of targets.

    >>> cost = torch.tensor([[[2.0, 1.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.0, 3.0]]])
    >>> best_match(cost, torch.tensor([[0, 0, 1]])).tolist()
    [[1, 0, 2]]
    """
    same = shapes[:, :, None] == shapes[:, None, :]
    costs = torch.where(same, cost.detach(), _FORBIDDEN).double().cpu().numpy()
    found = np.stack([linear_sum_assignment(matrix)[1] for matrix in costs])
    return torch.from_numpy(found).to(shapes.device)
