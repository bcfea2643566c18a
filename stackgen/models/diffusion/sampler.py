"""The diffusion model as a StackSampler."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from stackgen.models.diffusion.network import DiffusionConfig, PoseDiffusion, Watch
from stackgen.models.diffusion.schedules import ScheduleConfig
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.models.sampler import NetworkSampler
from stackgen.models.transformer import TransformerConfig
from stackgen.world import World


class DiffusionSampler(NetworkSampler):
    """A StackSampler: the diffusion model with its world.

    Args:
        model: Trained network.
        world: World it was trained in.
        card: What is known about the weights.
        batch: Largest number of stacks that are denoised together.
        sampler: How to get from noise to poses; what is null is taken from the card, else from the model.

    Raises:
        StackgenError: If the settings do not fit the model.
    """

    model: PoseDiffusion
    watch: Watch | None = None
    """Sees the poses of all stacks that are denoised together, step by step."""

    def __init__(
        self,
        model: PoseDiffusion,
        world: World,
        card: dict[str, Any] | None = None,
        batch: int = 512,
        sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
    ) -> None:
        super().__init__(model, world, card, batch)
        self.sampler = model.complete(sampler.over(SamplerConfig.of_card(self.card)))

    def configured(self, sampler: SamplerConfig) -> DiffusionSampler:
        """Make a sampler of the same model with other settings, where they are not null."""
        return DiffusionSampler(self.model, self.world, self.card, self.batch, sampler)

    @property
    def settings(self) -> dict[str, Any]:
        """How it samples, for the record."""
        return self.sampler.given()

    def draw(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
        """See NetworkSampler."""
        return self.model.sample(silhouettes, shapes, mask, generator, self.sampler, self.watch)


def make_diffusion(config: dict[str, Any], world: World) -> tuple[nn.Module, Any]:
    """Make the diffusion model of a card; see stackgen.models.weights.Maker."""
    parts = TransformerConfig(**config["denoiser"]), ScheduleConfig(**config["schedule"])
    return PoseDiffusion(*parts, DiffusionConfig(**config["diffusion"]), world), DiffusionSampler
