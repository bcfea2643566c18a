"""Training Tran-Reg and Tran-VAE: thin Lightning shells around their networks."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from stackgen.baselines.tran_reg import PoseRegression
from stackgen.baselines.tran_vae import PoseVAE, VAEConfig
from stackgen.baselines.transformer import PoseNetwork, RegressionConfig, TransformerSampler
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.models.module import StackgenModule
from stackgen.models.optimization import OptimizerConfig
from stackgen.world import World

Parts = dict[str, Tensor]
"""Terms of a loss by name, each a scalar, to be logged beside it."""


class PoseBaseline(StackgenModule):
    """A LightningModule around a PoseNetwork. A subclass sets `kind` and implements `make` and `_loss`.

    Args:
        config: From which the network can be built again.
        optimizer: Learning rate and its course.
    """

    model: PoseNetwork

    def prepare(self, data: Any) -> None:
        """Take the normalisation of poses from the training data."""
        self.model.fit_normalization(*data.pose_statistics())

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """Mean loss of a batch, and its parts."""
        raise NotImplementedError

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """One step of the loss."""
        loss, parts = self._loss(batch, self.generator_of_step(index, batch["poses"].device))
        self.log("train/loss", loss, prog_bar=True)
        self.log_dict({f"train/{name}": part.detach() for name, part in parts.items()})
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """The same loss on held-out stacks, with the same randomness every time."""
        generator = torch.Generator(device=batch["poses"].device).manual_seed(index)
        loss, parts = self._loss(batch, generator)
        size = len(batch["mask"])
        self.log_mean("validation/loss", loss, size, prog_bar=True)
        for name, part in parts.items():
            self.log_mean(f"validation/{name}", part, size)

    def sampler(self) -> TransformerSampler:
        """The model as a StackSampler, sharing its weights."""
        was_training = self.model.training
        sampler = TransformerSampler(self.model, self.world)
        self.model.train(was_training)
        return sampler


class TranReg(PoseBaseline):
    """The paper's Transformer-Regression baseline; the defaults are the paper's where it gives them.

    Args:
        transformer: Architecture, the same as the denoiser's.
        regression: How estimated poses are compared with the true ones.
        optimizer: Learning rate and its course.
    """

    kind = "tran-reg"

    def __init__(
        self,
        transformer: DenoiserConfig = DenoiserConfig(),  # noqa: B008 - frozen
        regression: RegressionConfig = RegressionConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__({"transformer": asdict(transformer), "regression": asdict(regression)}, optimizer)
        self._parts = (transformer, regression)
        self.model: PoseRegression

    def make(self, world: World) -> PoseRegression:
        """See StackgenModule."""
        return PoseRegression(*self._parts, world)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        return self.model.loss(batch, generator).mean(), {}


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

    def make(self, world: World) -> PoseVAE:
        """See StackgenModule."""
        return PoseVAE(*self._parts, world)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """The error plus the weighted divergence; its weight rises in training, and is the last one elsewhere."""
        losses = self.model.losses(batch, generator)
        error, divergence = losses.error.mean(), losses.divergence.mean()
        vae = self.model.config
        weight = vae.weight(self.global_step) if self.training else vae.kl_weight
        return error + weight * divergence, {"error": error, "divergence": divergence}
