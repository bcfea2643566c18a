"""The denoiser: a Transformer over noisy blocks that sees the silhouette and the time (paper, "Model Architecture").

Legend: B scenes, N block tokens, C silhouette tokens, d width.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from stackgen.models.poses import POSE, ranks
from stackgen.models.transformer import (
    WAVES,
    Patches,
    TransformerConfig,
    block_layers,
    final_norm,
    memory_layers,
    mlp,
    pose_head,
    run_blocks,
    sinusoids,
    waves,
)
from stackgen.world import World


class Denoiser(nn.Module):
    """Noisy poses, time, shapes and a silhouette in; an estimate per block out.

    Args:
        config: Architecture.
        world: Size of the shape codebook, grid of the silhouette, and N.
    """

    def __init__(self, config: TransformerConfig, world: World) -> None:
        super().__init__()
        self.config = config
        d = config.width
        self.pose_embedding = mlp(POSE, d, d)
        self.shape_embedding = nn.Embedding(len(world.catalogue), d)
        if config.ordered:
            self.rank_embedding = nn.Embedding(world.max_blocks, d)
        if config.self_conditioning:
            self.estimate_embedding = nn.Linear(POSE, d, bias=False)
            nn.init.zeros_(self.estimate_embedding.weight)
        if config.places:
            self.place_embedding = nn.Linear(4 * WAVES, d, bias=False)
            self.estimate_place_embedding = nn.Linear(4 * WAVES, d, bias=False)
            nn.init.zeros_(self.estimate_place_embedding.weight)
        self.time_embedding = mlp(d, d, d)
        self.patches = Patches(config, world.grid)
        self.memory_encoder = memory_layers(config)
        self.layers = block_layers(config, config.layers)
        self.final_norm = final_norm(config)
        self.head = pose_head(config)

    def encode(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) silhouettes in {0, 1} to silhouette tokens (B, C, d), the same for every t."""
        tokens = self.patches(silhouette)
        for layer in self.memory_encoder:
            tokens = layer(tokens, None)
        return tokens

    def forward(
        self,
        poses: Tensor,
        t: Tensor,
        shapes: Tensor,
        mask: Tensor,
        memory: Tensor,
        estimate: Tensor | None = None,
        places: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Estimate (B, N, 6) for normalised noisy poses (B, N, 6).

        Args:
            poses: Normalised poses; what stands at padding does not matter.
            t: (B,) diffusion step, 1..T.
            shapes: (B, N) indices, negative at padding; if `ordered`, those of one shape in their order.
            mask: (B, N) True at blocks.
            memory: (B, C, d) of `encode`; or (B / n, C, d), serving n consecutive rows each.
            estimate: (B, N, 6) last estimate of the clean poses, normalised; None if there is none yet,
                or the network takes none.
            places: Function from normalised poses to places (B, N, 2) across and up [cell]; used if `config.places`.
        """
        time = self.time_embedding(sinusoids(t.float(), self.config.width))  # (B, d)
        tokens = self.pose_embedding(poses) + self.shape_embedding(shapes.clamp(min=0))
        if self.config.ordered:
            tokens = tokens + self.rank_embedding(ranks(shapes))
        if estimate is not None and self.config.self_conditioning:
            tokens = tokens + self.estimate_embedding(estimate)
        if self.config.places:
            assert places is not None
            tokens = tokens + self.place_embedding(waves(places(poses)))
            if estimate is not None and self.config.self_conditioning:
                at_first = waves(places(torch.zeros_like(estimate)))  # no estimate yet, as zeros, must add nothing
                tokens = tokens + self.estimate_place_embedding(waves(places(estimate)) - at_first)
        tokens = run_blocks(self.layers, self.config, blocks=tokens, mask=mask, memory=memory, condition=time)
        return self.head(self.final_norm(tokens))
