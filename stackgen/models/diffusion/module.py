"""Training the diffusion model: a thin Lightning shell around PoseDiffusion."""

from __future__ import annotations

import torch
from torch import Tensor

from stackgen.models.diffusion.network import DiffusionConfig, PoseDiffusion
from stackgen.models.diffusion.sampler import DiffusionSampler
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.module import PoseModule
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.transformer import TransformerConfig


class DDPM(PoseModule):
    """StackGen's denoising diffusion model (paper, "Method"); the defaults are the paper's.

    Args:
        denoiser: Architecture of the denoiser.
        schedule: Noise schedule.
        diffusion: Target of the training and normalisation of the poses.
        optimizer: Learning rate and its course over the training.
        draws: Number of noise draws of each sample in a training step.
    """

    kind = "ddpm"
    network = PoseDiffusion
    model: PoseDiffusion

    def __init__(
        self,
        denoiser: TransformerConfig = TransformerConfig(),  # noqa: B008 - frozen
        schedule: ScheduleConfig = ScheduleConfig(),  # noqa: B008
        diffusion: DiffusionConfig = DiffusionConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
        draws: int = 1,
    ) -> None:
        super().__init__(optimizer, denoiser=denoiser, schedule=schedule, diffusion=diffusion)
        self.draws = draws

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """Compute the loss of Eq. 3, and log it by quarter of the steps too."""
        generator = self.generator_of_step(index, batch["poses"].device)
        losses, t = self.model.loss(batch, self.draws, generator, self.model.config.drop_silhouette)
        loss = losses.mean()
        self.log("train/loss", loss, prog_bar=True)
        if self.trainer.global_step % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            self._log_quarters("train", losses.detach(), t)
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Log the same loss on held-out stacks, with the same noise every time."""
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
                # Every one of several processes must log, or the others wait for ever.
                self.log_mean(name, part.sum() / max(1, len(part)), len(part))

    def sampler(self) -> DiffusionSampler:
        """Make a StackSampler of the model, sharing its weights."""
        return self.wrapped(DiffusionSampler)
