"""Training Tran-Reg and Tran-VAE: thin Lightning shells around their networks."""

from __future__ import annotations

import torch
from torch import Tensor

from stackgen.baselines.regression import RegressionConfig
from stackgen.baselines.tran_reg import TranRegNetwork
from stackgen.baselines.tran_vae import TranVAENetwork, VAEConfig
from stackgen.models.module import PoseModule
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.transformer import TransformerConfig

Parts = dict[str, Tensor]
"""Terms of a loss by name, each a scalar, to be logged beside it."""


class PoseBaseline(PoseModule):
    """A LightningModule around a PoseRegressor. A subclass sets `kind` and `network`, and implements `_loss`."""

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """Compute the mean loss of a batch, and its parts."""
        raise NotImplementedError

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """Compute the loss, and log its parts."""
        loss, parts = self._loss(batch, self.generator_of_step(index, batch["poses"].device))
        self.log("train/loss", loss, prog_bar=True)
        self.log_dict({f"train/{name}": part.detach() for name, part in parts.items()})
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Log the same loss on held-out stacks, with the same randomness every time."""
        generator = torch.Generator(device=batch["poses"].device).manual_seed(index)
        loss, parts = self._loss(batch, generator)
        size = len(batch["mask"])
        self.log_mean("validation/loss", loss, size, prog_bar=True)
        for name, part in parts.items():
            self.log_mean(f"validation/{name}", part, size)


class TranReg(PoseBaseline):
    """The paper's Transformer-Regression baseline; the defaults are the paper's where it gives them.

    Args:
        transformer: Architecture, that of the denoiser.
        regression: Comparison of the estimated poses with the true ones.
        optimizer: Learning rate and its course over the training.
    """

    kind = "tran-reg"
    network = TranRegNetwork
    model: TranRegNetwork

    def __init__(
        self,
        transformer: TransformerConfig = TransformerConfig(),  # noqa: B008 - frozen
        regression: RegressionConfig = RegressionConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__(optimizer, transformer=transformer, regression=regression)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        return self.model.loss(batch, generator).mean(), {}


class TranVAE(PoseBaseline):
    """The paper's Transformer-VAE baseline; the defaults are the paper's where it gives them.

    Args:
        transformer: Architecture, that of the denoiser; its layers are shared by encoder and decoder.
        regression: Comparison of the reconstructed poses with the true ones.
        vae: Settings of the autoencoder.
        optimizer: Learning rate and its course over the training.
    """

    kind = "tran-vae"
    network = TranVAENetwork
    model: TranVAENetwork

    def __init__(
        self,
        transformer: TransformerConfig = TransformerConfig(),  # noqa: B008 - frozen
        regression: RegressionConfig = RegressionConfig(),  # noqa: B008
        vae: VAEConfig = VAEConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__(optimizer, transformer=transformer, regression=regression, vae=vae)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """Add the weighted divergence to the error; its weight rises in training, and is the last one elsewhere."""
        error, divergence = (part.mean() for part in self.model.losses(batch, generator))
        vae = self.model.config
        weight = vae.weight(self.global_step) if self.training else vae.kl_weight
        return error + weight * divergence, {"error": error, "divergence": divergence}
