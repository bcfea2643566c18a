"""Diffusion over block poses: normalisation, training target and sampling, without any training framework."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from stackgen.errors import StackgenError
from stackgen.models.diffusion.denoiser import Denoiser
from stackgen.models.diffusion.mending import mended, pushed_apart
from stackgen.models.diffusion.schedules import Schedule, ScheduleConfig
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.models.diffusion.solvers import Predict, ancestral, multistep, standard_normal
from stackgen.models.poses import POSE, PoseNetwork, raster_order
from stackgen.models.transformer import TransformerConfig
from stackgen.world import World

MENDED_FROM = 0.4
"""Share of T from which a mended stack is denoised anew: its layout is decided there, its places are not."""

Watch = Callable[[Tensor], None]
"""Sees the noisy poses (B, N, 6) [cell, rad] before each step."""


@dataclass(frozen=True)
class DiffusionConfig:
    """What is diffused and what the network estimates.

    Args:
        prediction: Target of the network: `epsilon`, the noise (paper), or `v` (Salimans & Ho 2022), which
            weights the noisy steps, where the layout is decided, more.
        clip: Bound of the clean estimate while sampling, in standard deviations; null for none.
        least_std: Lower bound of the standard deviation that a dimension of the poses is divided by [cell, rad].
            Settled stacks hardly vary in y and in rotation; without a bound the rare slanted block
            would be hundreds of standard deviations away.
        variance: Variance of the noise that `ddpm` adds while sampling: `beta` (paper) or the smaller `posterior`.
        drop_silhouette: Share of the training samples that are shown an empty picture, so that classifier-free
            guidance is possible (Ho & Salimans 2022).
        guidance: Weight of classifier-free guidance while sampling; 1 is none. It needs `drop_silhouette`.
        antithetic: Whether the samples of one silhouette are drawn apart; see SamplerConfig.
        temperature: Factor of the noise that `ddpm` adds where only places are left to decide; see SamplerConfig.
        mend: Number of times that a stack is mended whose blocks lie in each other; see SamplerConfig.

    Raises:
        StackgenError: If a number is out of its range.
    """

    prediction: Literal["epsilon", "v"] = "epsilon"
    clip: float | None = None
    least_std: float = 0.0
    variance: Literal["beta", "posterior"] = "beta"
    drop_silhouette: float = 0.0
    guidance: float = 1.0
    antithetic: bool = False
    temperature: float = 1.0
    mend: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.drop_silhouette < 1:
            raise StackgenError(f"diffusion.drop_silhouette must lie in [0, 1), got {self.drop_silhouette}")
        if self.guidance != 1 and not self.drop_silhouette:
            raise StackgenError("diffusion.guidance needs diffusion.drop_silhouette, such as 0.1")
        if not 0 <= self.temperature <= 10:
            raise StackgenError(f"diffusion.temperature must lie in 0..10, got {self.temperature}")
        if not 0 <= self.mend <= 10:
            raise StackgenError(f"diffusion.mend must lie in 0..10, got {self.mend}")


class PoseDiffusion(PoseNetwork):
    """The denoiser with its schedule and the normalisation of poses.

    Args:
        denoiser: Architecture of the denoiser.
        schedule: Noise schedule.
        diffusion: What is diffused and what the network estimates.
        world: Shapes, size of the silhouette, and N.
    """

    def __init__(
        self, denoiser: TransformerConfig, schedule: ScheduleConfig, diffusion: DiffusionConfig, world: World
    ) -> None:
        super().__init__(diffusion.least_std)
        self.config = diffusion
        self.schedule = Schedule(schedule)
        self.denoiser = Denoiser(denoiser, world)
        self.world = world

    @property
    def trims(self) -> bool:
        """See PoseNetwork."""
        return self.denoiser.config.trims

    def loss(
        self,
        batch: dict[str, Tensor],
        draws: int = 1,
        generator: torch.Generator | None = None,
        drop_silhouette: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Compute the mean squared error per sample and draw, averaged over its real blocks (paper, Eq. 3).

        Args:
            batch: Batch of the data module.
            draws: Number of noise draws of every sample; they share one look at the silhouette.
            generator: Source of steps and noise; the global one by default.
            drop_silhouette: Share of the samples that are shown an empty picture.

        Returns:
            Losses and their steps t, both (B * draws,).
        """
        poses, shapes, mask = batch["poses"], batch["shapes"], batch["mask"]
        if self.denoiser.config.ordered:
            order = raster_order(poses, shapes)
            poses = poses.gather(1, order[..., None].expand_as(poses))
            shapes, mask = shapes.gather(1, order), mask.gather(1, order)
        clean = ((poses - self.mean) / self.std).repeat_interleave(draws, 0)
        mask, shapes = mask.repeat_interleave(draws, 0), shapes.repeat_interleave(draws, 0)
        t = torch.randint(1, self.schedule.steps + 1, (len(clean),), generator=generator, device=clean.device)
        noise = torch.randn(clean.shape, generator=generator, device=clean.device, dtype=clean.dtype)
        noisy = self.schedule.diffuse(clean, noise, t)
        silhouettes = batch["silhouette"]
        if drop_silhouette:
            kept = torch.rand(len(silhouettes), generator=generator, device=clean.device) >= drop_silhouette
            silhouettes = silhouettes * kept[:, None, None]
        memory = self.denoiser.encode(silhouettes)
        seen = (
            self._own_estimate(noisy, t, shapes, mask, memory, draws)
            if self.denoiser.config.self_conditioning
            else None
        )
        estimate = self.denoiser(noisy, t, shapes, mask, memory, seen, self._places)
        target = noise if self.config.prediction == "epsilon" else self._velocity(clean, noise, t)
        error = (estimate - target).square().mean(-1) * mask
        return error.sum(-1) / mask.sum(-1), t

    @torch.no_grad()
    def _own_estimate(
        self, noisy: Tensor, t: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor, draws: int
    ) -> Tensor:
        """Estimate the clean poses of every second draw (or sample, where each has one draw); zeros elsewhere."""
        rows = torch.arange(len(noisy), device=noisy.device)
        chosen = rows % 2 == 0
        if draws == 1:
            memory = memory[chosen]
        elif draws % 2:
            chosen = rows % draws < draws // 2
        found = torch.zeros_like(noisy)
        estimate = self.denoiser(noisy[chosen], t[chosen], shapes[chosen], mask[chosen], memory, None, self._places)
        found[chosen] = self._clean(noisy[chosen], t[chosen], estimate)
        return found

    def _clean(self, x: Tensor, t: Tensor, estimate: Tensor) -> Tensor:
        """Turn an output of the network into the clean poses it means, bounded as while sampling."""
        signal, sigma = self.schedule.signal_and_noise(t)
        clean = signal * x - sigma * estimate if self.config.prediction == "v" else (x - sigma * estimate) / signal
        return self._bounded(clean)

    def _places(self, poses: Tensor) -> Tensor:
        """Places (B, N, 2) across and up [cell] of normalised poses."""
        return (poses * self.std + self.mean)[..., [0, 2]]

    def _bounded(self, clean: Tensor) -> Tensor:
        return clean if self.config.clip is None else clean.clamp(-self.config.clip, self.config.clip)

    def _velocity(self, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        signal, sigma = self.schedule.signal_and_noise(t)
        return signal * noise - sigma * clean

    @torch.inference_mode()
    def sample(
        self,
        silhouettes: Tensor,
        shapes: Tensor,
        mask: Tensor,
        generator: torch.Generator,
        sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
        watch: Watch | None = None,
    ) -> Tensor:
        """See PoseNetwork; `sampler` says how noise becomes poses, and `watch` sees it, before anything is mended."""
        config = self.complete(sampler)
        predict = self._asked(silhouettes, shapes, mask, config)
        if watch is not None:
            predict = self._watched(predict, watch)
        apart = len(shapes) // len(silhouettes) if config.antithetic else 1
        noise = standard_normal((*shapes.shape, POSE), generator, apart).to(shapes.device)
        assert config.steps and config.spacing
        steps = self.schedule.subset(config.steps, config.spacing)
        x = self._denoised(predict, noise, steps, config, generator, apart)
        silhouettes = silhouettes.repeat_interleave(len(shapes) // len(silhouettes), 0) if config.mend else silhouettes
        for _ in range(config.mend or 0):
            x = self._mended(x, silhouettes, shapes, mask, steps, config, generator)
        return x * self.std + self.mean

    def _denoised(
        self,
        predict: Predict,
        noisy: Tensor,
        steps: Sequence[int],
        config: SamplerConfig,
        generator: torch.Generator,
        apart: int = 1,
    ) -> Tensor:
        """Walk down some steps from what is noisy at the first of them."""
        if config.kind == "ddpm":
            posterior = config.variance == "posterior"
            temperature = 1.0 if config.temperature is None else config.temperature
            return ancestral(predict, noisy, self.schedule, generator, steps, posterior, apart, temperature)
        order, eta = 2 if config.kind == "dpm" else 1, config.eta or 0.0
        return multistep(predict, noisy, self.schedule, generator, steps, order, eta, apart)

    def _mended(
        self,
        x: Tensor,
        silhouettes: Tensor,
        shapes: Tensor,
        mask: Tensor,
        steps: Sequence[int],
        config: SamplerConfig,
        generator: torch.Generator,
    ) -> Tensor:
        """Mend the samples (B, N, 6) whose blocks lie in each other: some of these move, then all are denoised anew."""
        rows, poses = mended(x * self.std + self.mean, shapes, mask, silhouettes, self.world)
        if not rows:
            return x
        clean = (poses - self.mean) / self.std
        again = [t for t in steps if t <= MENDED_FROM * self.schedule.steps] or steps[-1:]
        noise = standard_normal(clean.shape, generator, dtype=clean.dtype).to(clean.device)
        noisy = self.schedule.diffuse(clean, noise, torch.full((len(rows),), again[0], device=clean.device))
        predict = self._asked(silhouettes[rows], shapes[rows], mask[rows], config)
        x = x.clone()
        x[rows] = self._denoised(self._apart(predict, shapes[rows], mask[rows]), noisy, again, config, generator)
        return x

    def complete(self, sampler: SamplerConfig) -> SamplerConfig:
        """Take this model's own settings for what is null in a sampler's.

        Raises:
            StackgenError: If they do not fit the model.
        """
        own = self.config.guidance if self.config.drop_silhouette else None
        config = self.config
        return sampler.complete(
            self.schedule.steps, config.variance, own, config.antithetic, config.temperature, config.mend
        )

    def _asked(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, config: SamplerConfig) -> Predict:
        """Make the function that estimates the clean poses of some scenes, with guidance where there is to be any."""
        predict = self._predictor(silhouettes, shapes, mask)
        if config.guidance is None or config.guidance == 1:
            return predict
        return self._guided(predict, self._predictor(torch.zeros_like(silhouettes), shapes, mask), config)

    def _predictor(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor) -> Predict:
        """Make the function that estimates the clean poses of some scenes; it reads their silhouettes once."""
        memory = self.denoiser.encode(silhouettes)
        last: Tensor | None = None

        def predict(x: Tensor, t: Tensor) -> Tensor:
            nonlocal last
            last = self._clean(x, t, self.denoiser(x, t, shapes, mask, memory, last, self._places))
            return last

        return predict

    def _apart(self, own: Predict, shapes: Tensor, mask: Tensor) -> Predict:
        """Push the estimates of blocks apart where they overlap."""
        sizes = [[shape.size[0], shape.size[2]] for shape in self.world.catalogue]
        size = torch.tensor(sizes, dtype=torch.float32, device=mask.device)

        def predict(x: Tensor, t: Tensor) -> Tensor:
            return (pushed_apart(own(x, t) * self.std + self.mean, shapes, mask, size) - self.mean) / self.std

        return predict

    def _watched(self, own: Predict, watch: Watch) -> Predict:
        def predict(x: Tensor, t: Tensor) -> Tensor:
            watch(x * self.std + self.mean)
            return own(x, t)

        return predict

    def _guided(self, own: Predict, blind: Predict, config: SamplerConfig) -> Predict:
        """Lead away from what the model does without the silhouette (classifier-free guidance, Ho & Salimans 2022)."""
        assert config.guided is not None and config.guidance is not None
        first, last = (share * self.schedule.steps for share in config.guided)
        weight = config.guidance

        def predict(x: Tensor, t: Tensor) -> Tensor:
            if not first <= int(t) <= last:
                return own(x, t)
            theirs = blind(x, t)
            return self._bounded(theirs + weight * (own(x, t) - theirs)) if weight else theirs

        return predict
