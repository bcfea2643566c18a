"""Tran-Reg's network: shapes and silhouette in, poses out (paper, "Transformer-Regression Baseline")."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from stackgen.baselines.regression import PoseRegressor, RegressionConfig, Trunk
from stackgen.models.sampler import NetworkSampler
from stackgen.models.transformer import TransformerConfig
from stackgen.world import World


class TranRegNetwork(PoseRegressor):
    """The denoiser without noisy poses and time, with positional encodings: one forward pass, no randomness but order.

    Args:
        transformer: Architecture, that of the denoiser.
        regression: Comparison of the estimated poses with the true ones.
        world: Shapes, size of the silhouette, and N.
    """

    def __init__(self, transformer: TransformerConfig, regression: RegressionConfig, world: World) -> None:
        super().__init__(transformer, regression, world)
        self.trunk = Trunk(transformer, transformer.layers, conditioned=False)

    def forward(self, shapes: Tensor, mask: Tensor, memory: Tensor) -> Tensor:
        """Normalised poses (B, N, 6) for shapes (B, N) and the silhouette's tokens."""
        return self.head(self.trunk(self.blocks(shapes), mask, memory))

    def loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> Tensor:
        """Compute the error (B,) of the estimated poses.

        Args:
            batch: Batch of the data module.
            generator: Source of the blocks' order; the global one by default.
        """
        shapes, mask, poses = self.scene(batch, generator)
        return self.error(self(shapes, mask, self.silhouette(batch["silhouette"])), poses, shapes, mask)

    def draw(self, shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        """See PoseRegressor."""
        return self(shapes, mask, memory)


def make_tran_reg(config: dict[str, Any], world: World) -> tuple[nn.Module, Any]:
    """Make Tran-Reg of a card; see stackgen.models.weights.Maker."""
    parts = TransformerConfig(**config["transformer"]), RegressionConfig(**config["regression"])
    return TranRegNetwork(*parts, world), NetworkSampler
