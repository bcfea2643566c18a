"""Tran-VAE's network: a conditional variational autoencoder of poses (paper, "Transformer-VAE Baseline").

Two layers read a stack and say what its layout is, in one latent vector (the posterior); four layers
make poses of shapes, silhouette and latent vector. Without a stack, the latent vector is drawn
from N(0, I). The paper gives the numbers of layers; latent size and weight of the divergence are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from stackgen.baselines.regression import BlockTokens, PoseRegressor, RegressionConfig, Trunk
from stackgen.errors import StackgenError
from stackgen.models.poses import POSE
from stackgen.models.sampler import NetworkSampler
from stackgen.models.transformer import TransformerConfig, mlp
from stackgen.world import World


@dataclass(frozen=True)
class VAEConfig:
    """Settings of the autoencoder.

    Args:
        encoder_layers: Number of the Transformer's layers that read the stack; the others make poses (paper: 2 and 4).
        latent: Size of the latent vector.
        kl_weight: Weight of the divergence from N(0, I) [1 / nat], beside an error averaged over blocks and
            dimensions. With k blocks, Gaussian poses of variance v would make it v / (3 k).
        kl_warmup: Number of training steps in which that weight rises from zero, so that the latent vector is put
            to use before it is taxed.
    """

    encoder_layers: int = 2
    latent: int = 32
    kl_weight: float = 0.003
    kl_warmup: int = 1000

    def weight(self, step: int) -> float:
        """Compute the weight of the divergence at a training step.

        >>> [VAEConfig(kl_weight=0.01, kl_warmup=100).weight(step) for step in (0, 50, 200)]
        [0.0, 0.005, 0.01]
        """
        return self.kl_weight * min(1.0, step / max(1, self.kl_warmup))


class TranVAENetwork(PoseRegressor):
    """Encoder, latent vector and decoder.

    Args:
        transformer: Architecture, that of the denoiser; `layers` are those of encoder and decoder together.
        regression: Comparison of the reconstructed poses with the true ones.
        vae: Settings of the autoencoder.
        world: Shapes, size of the silhouette, and N.

    Raises:
        StackgenError: If encoder or decoder would have no layer.
    """

    def __init__(
        self, transformer: TransformerConfig, regression: RegressionConfig, vae: VAEConfig, world: World
    ) -> None:
        super().__init__(transformer, regression, world)
        if not 0 < vae.encoder_layers < transformer.layers:
            raise StackgenError(
                f"Tran-VAE: encoder_layers must leave some of the {transformer.layers} layers to the decoder, "
                f"got {vae.encoder_layers}"
            )
        self.config = vae
        d = transformer.width
        self.encoder_blocks = BlockTokens(transformer, world)
        self.pose_embedding = mlp(POSE, d, d)
        self.encoder = Trunk(transformer, vae.encoder_layers, conditioned=False)
        self.posterior = nn.Linear(d, 2 * vae.latent)
        self.latent_embedding = mlp(vae.latent, d, d)
        self.decoder = Trunk(transformer, transformer.layers - vae.encoder_layers, conditioned=True)

    def encode(self, poses: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance (B, latent) of the posterior of normalised poses (B, N, 6)."""
        tokens = self.encoder_blocks(shapes) + self.pose_embedding(poses)
        tokens = self.encoder(tokens, mask, memory) * mask[..., None]
        mean, log_variance = self.posterior(tokens.sum(1) / mask.sum(-1, keepdim=True)).chunk(2, dim=-1)
        return mean, log_variance.clamp(-10.0, 10.0)

    def decode(self, latent: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor) -> Tensor:
        """Normalised poses (B, N, 6) for latent vectors (B, latent)."""
        return self.head(self.decoder(self.blocks(shapes), mask, memory, self.latent_embedding(latent)))

    def losses(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Compute the two parts of the evidence bound (Kingma & Welling 2014), one draw of the posterior each.

        Args:
            batch: Batch of the data module.
            generator: Source of order and latent vectors; the global one by default.

        Returns:
            Error of each reconstruction, and divergence of each posterior [nat], both (B,).
        """
        shapes, mask, poses = self.scene(batch, generator)
        memory = self.silhouette(batch["silhouette"])
        mean, log_variance = self.encode(poses, shapes, mask, memory)
        latent = mean + (0.5 * log_variance).exp() * self._noise(mean.shape, mean, generator)
        error = self.error(self.decode(latent, shapes, mask, memory), poses, shapes, mask)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1)
        return error, divergence

    def draw(self, shapes: Tensor, mask: Tensor, memory: Tensor, generator: torch.Generator) -> Tensor:
        """See PoseRegressor; latent vectors from N(0, I)."""
        latent = self._noise((len(shapes), self.config.latent), memory, generator)
        return self.decode(latent, shapes, mask, memory)

    @staticmethod
    def _noise(size: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw from N(0, 1), with another tensor's type and device."""
        device = generator.device if generator is not None else like.device
        return torch.randn(size, generator=generator, device=device).to(like)


def make_tran_vae(config: dict[str, Any], world: World) -> tuple[nn.Module, Any]:
    """Make Tran-VAE of a card; see stackgen.models.weights.Maker."""
    parts = TransformerConfig(**config["transformer"]), RegressionConfig(**config["regression"])
    return TranVAENetwork(*parts, VAEConfig(**config["vae"]), world), NetworkSampler
