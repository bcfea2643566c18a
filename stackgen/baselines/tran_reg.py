"""Tran-Reg's network: shapes and silhouette in, poses out (paper, "Transformer-Regression Baseline")."""

from __future__ import annotations

import torch
from torch import Tensor

from stackgen.baselines.transformer import PoseNetwork, RegressionConfig, Trunk
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.world import MAX_BLOCKS


class PoseRegression(PoseNetwork):
    """The denoiser without noisy poses and time, with positional encodings: one forward pass, no randomness but order.

    Args:
        transformer: Architecture, described as the denoiser's.
        regression: See RegressionConfig.
        num_shapes: Size of the catalogue.
        image_size: Edge of the silhouette [pixel].
        max_blocks: N.
    """

    def __init__(
        self,
        transformer: DenoiserConfig,
        regression: RegressionConfig,
        num_shapes: int = 4,
        image_size: int = 64,
        max_blocks: int = MAX_BLOCKS,
    ) -> None:
        super().__init__(transformer, regression, num_shapes, image_size, max_blocks)
        self.trunk = Trunk(transformer, transformer.layers, conditioned=False)

    def forward(self, shapes: Tensor, mask: Tensor, memory: Tensor) -> Tensor:
        """Normalised poses (B, N, 6) for shapes (B, N) and the silhouette's tokens."""
        return self.head(self.trunk(self.blocks(shapes), mask, memory))

    def loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> Tensor:
        """(B,) error of the estimated poses.

        Args:
            batch: As the DataModule makes it.
            generator: Of the blocks' order; the global one by default.
        """
        shapes, mask, poses = self.scene(batch, generator)
        return self.error(self(shapes, mask, self.silhouette(batch["silhouette"])), poses, shapes, mask)

    def draw(self, shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        """See PoseNetwork."""
        return self(shapes, mask, memory)
