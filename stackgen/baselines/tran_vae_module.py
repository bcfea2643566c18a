"""Training Tran-VAE: a thin Lightning shell around PoseVAE."""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor

from stackgen.baselines.modules import Parts, PoseBaseline
from stackgen.baselines.tran_vae import PoseVAE, VAEConfig
from stackgen.baselines.transformer import RegressionConfig
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.models.optimization import OptimizerConfig


class TranVAE(PoseBaseline):
    """The paper's Transformer-VAE baseline; the defaults are the paper's where it gives them.

    Args:
        transformer: Architecture, the same as the denoiser's; its layers are shared by encoder and decoder.
        regression: How reconstructed poses are compared with the true ones.
        vae: Latent vector and its divergence.
        optimizer: Learning rate and its course.
    """

    kind = "tran-vae"

    def __init__(
        self,
        transformer: DenoiserConfig = DenoiserConfig(),  # noqa: B008 - frozen
        regression: RegressionConfig = RegressionConfig(),  # noqa: B008
        vae: VAEConfig = VAEConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        config = {"transformer": asdict(transformer), "regression": asdict(regression), "vae": asdict(vae)}
        super().__init__(config, optimizer)
        self._parts = (transformer, regression, vae)
        self.model: PoseVAE

    def build(self) -> None:
        """Make the network once its world is known."""
        if not hasattr(self, "model"):
            self.model = PoseVAE(*self._parts, len(self.catalogue), self.grid.image_size, self.max_blocks)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """The error plus the weighted divergence; its weight rises in training, and is the last one elsewhere."""
        losses = self.model.losses(batch, generator)
        error, divergence = losses.error.mean(), losses.divergence.mean()
        vae = self.model.config
        weight = vae.weight(self.global_step) if self.training else vae.kl_weight
        return error + weight * divergence, {"error": error, "divergence": divergence}
