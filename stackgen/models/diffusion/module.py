"""Training the diffusion model: a thin Lightning shell around PoseDiffusion."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stackgen._lightning import pl
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.models.diffusion.network import DiffusionConfig, DiffusionSampler, PoseDiffusion
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.module import WorldMixin
from stackgen.models.optimization import OptimizerConfig, configure_optimizer


class DDPM(WorldMixin, pl.LightningModule):
    """StackGen's denoising diffusion model (paper, "Method"); the defaults are the paper's.

    Args:
        denoiser: Architecture.
        schedule: Noise schedule.
        diffusion: Target and normalisation.
        optimizer: Learning rate and its course.
        draws: Noise draws of each sample in a training step.
    """

    kind = "ddpm"

    def __init__(
        self,
        denoiser: DenoiserConfig = DenoiserConfig(),  # noqa: B008 - frozen
        schedule: ScheduleConfig = ScheduleConfig(),  # noqa: B008
        diffusion: DiffusionConfig = DiffusionConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
        draws: int = 1,
    ) -> None:
        super().__init__()
        self.config: dict[str, Any] = {
            "denoiser": asdict(denoiser),
            "schedule": asdict(schedule),
            "diffusion": asdict(diffusion),
        }
        self.optimizer_config = optimizer
        self.draws = draws
        self._parts = (denoiser, schedule, diffusion)
        self.model: PoseDiffusion

    def build(self) -> None:
        """Make the network once its world is known."""
        if not hasattr(self, "model"):
            self.model = PoseDiffusion(*self._parts, len(self.catalogue), self.grid.image_size, self.max_blocks)

    def setup(self, stage: str) -> None:
        """Build the network and take the normalisation from the training data; a checkpoint's comes later."""
        super().setup(stage)
        data = getattr(self.trainer, "datamodule", None)
        if data is not None and stage == "fit":
            self.model.fit_normalization(*data.pose_statistics())

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """One step of Eq. 3's loss, logged by quarter of the steps too."""
        generator = self._noise_of_step(index, batch["poses"].device)
        losses, t = self.model.loss(batch, self.draws, generator, self.model.config.drop_silhouette)
        loss = losses.mean()
        self.log("train/loss", loss, prog_bar=True)
        if self.trainer.global_step % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            self._log_quarters("train", losses.detach(), t)
        return loss

    def _noise_of_step(self, index: int, device: torch.device) -> torch.Generator:
        """A generator that depends on seed, process, epoch and step alone: a resumed fit draws what the
        uninterrupted one would have, and no two processes draw the same."""
        place = (torch.initial_seed() % 2**63, self.global_rank, self.current_epoch, index)
        seed = int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0] >> 1)
        return torch.Generator(device=device).manual_seed(seed)

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """The same loss on held-out stacks, with the same noise every time."""
        generator = torch.Generator(device=batch["poses"].device).manual_seed(index)
        losses, t = self.model.loss(batch, 1, generator)
        self.log_mean("validation/loss", losses.mean(), len(losses), prog_bar=True)
        self._log_quarters("validation", losses, t)

    def _log_quarters(self, stage: str, losses: Tensor, t: Tensor) -> None:
        quarter = (t - 1) * 4 // self.model.schedule.steps
        for q in range(4):
            part, name = losses[quarter == q], f"{stage}/loss_t{q + 1}of4"
            if stage == "train" and len(part):
                self.log(name, part.mean())
            elif stage != "train" and (len(part) or self.trainer.world_size > 1):
                # Of several processes all say something, or one waits for ever.
                self.log_mean(name, part.sum() / max(1, len(part)), len(part))

    def configure_optimizers(self) -> Any:
        """AdamW and its learning-rate course."""
        return configure_optimizer(self, self.optimizer_config)

    def sampler(self) -> DiffusionSampler:
        """The model as a StackSampler, sharing its weights."""
        was_training = self.model.training
        sampler = DiffusionSampler(self.model, self.catalogue, self.grid, self.max_blocks)
        self.model.train(was_training)
        return sampler
