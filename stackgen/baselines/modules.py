"""Training the learned baselines: what their Lightning shells share."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from stackgen._lightning import pl
from stackgen.baselines.transformer import PoseNetwork, TransformerSampler
from stackgen.models.module import WorldMixin
from stackgen.models.optimization import OptimizerConfig, configure_optimizer

Parts = dict[str, Tensor]
"""Terms of a loss by name, each a scalar, to be logged beside it."""


class PoseBaseline(WorldMixin, pl.LightningModule):
    """A LightningModule around a PoseNetwork. A subclass sets `kind` and implements `build` and `_loss`.

    Args:
        config: From which the network can be built again.
        optimizer: Learning rate and its course.
    """

    model: PoseNetwork

    def __init__(self, config: dict[str, Any], optimizer: OptimizerConfig) -> None:
        super().__init__()
        self.config = config
        self.optimizer_config = optimizer

    def setup(self, stage: str) -> None:
        """Build the network and take the normalisation from the training data; a checkpoint's comes later."""
        super().setup(stage)
        data = getattr(self.trainer, "datamodule", None)
        if data is not None and stage == "fit":
            self.model.fit_normalization(*data.pose_statistics())

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        """Mean loss of a batch, and its parts."""
        raise NotImplementedError

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """One step of the loss."""
        loss, parts = self._loss(batch, self._randomness_of_step(index, batch["poses"].device))
        self.log("train/loss", loss, prog_bar=True)
        self.log_dict({f"train/{name}": part.detach() for name, part in parts.items()})
        return loss

    def _randomness_of_step(self, index: int, device: torch.device) -> torch.Generator:
        """A generator that depends on seed, process, epoch and step alone, so that a resumed fit draws the same."""
        place = (torch.initial_seed() % 2**63, self.global_rank, self.current_epoch, index)
        seed = int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0] >> 1)
        return torch.Generator(device=device).manual_seed(seed)

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """The same loss on held-out stacks, with the same randomness every time."""
        generator = torch.Generator(device=batch["poses"].device).manual_seed(index)
        loss, parts = self._loss(batch, generator)
        size = len(batch["mask"])
        self.log_mean("validation/loss", loss, size, prog_bar=True)
        for name, part in parts.items():
            self.log_mean(f"validation/{name}", part, size)

    def configure_optimizers(self) -> Any:
        """AdamW and its learning-rate course."""
        return configure_optimizer(self, self.optimizer_config)

    def sampler(self) -> TransformerSampler:
        """The model as a StackSampler, sharing its weights."""
        was_training = self.model.training
        sampler = TransformerSampler(self.model, self.catalogue, self.grid, self.max_blocks)
        self.model.train(was_training)
        return sampler
