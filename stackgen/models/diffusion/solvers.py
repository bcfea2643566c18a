"""Solvers: plain functions that turn noise into samples, given a function that estimates the clean poses.

They walk down a subset of the steps T, ..., 1 and end with the estimate at the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from stackgen.models.diffusion.schedules import Schedule

Predict = Callable[[Tensor, Tensor], Tensor]
"""x_t (B, N, D) and t (1,) to an estimate of the clean sample (B, N, D)."""


def ancestral(
    predict: Predict,
    noise: Tensor,
    schedule: Schedule,
    generator: torch.Generator,
    steps: Sequence[int] | None = None,
    posterior_variance: bool = False,
    apart: int = 1,
    temperature: float = 1.0,
) -> Tensor:
    """Run DDPM's reverse process (paper, Eq. 3), without noise at the last step.

    Written with the clean estimate instead of the noise, which is the same formula as long as the
    estimate is not bounded: the mean of q(x_s | x_t, x_0) (Ho et al. 2020, Eq. 7). Where steps are left
    out, beta is that of the whole step from t to s.

    Args:
        predict: Estimate of the clean sample.
        noise: (B, N, D) sample of N(0, I), x_T.
        schedule: T and the betas.
        generator: Source of the noise on the way; its draws are shaped like `noise`.
        steps: Steps to take, falling from T; all by default.
        posterior_variance: Whether the noise on the way has the variance of q(x_s | x_t, x_0) instead of the
            larger sigma_t^2 = beta_t (paper). In few steps the latter leaves more noise in x_1 than the last
            step takes away: a standard deviation of 0.06 in 50 steps.
        apart: See `standard_normal`.
        temperature: Factor of the noise on the way in the lower half of the T steps, where the layout is decided
            and only places are left.
    """
    x = noise
    for t, s in _pairs(steps or range(schedule.steps, 0, -1)):
        clean = predict(x, torch.tensor([t], device=x.device))
        bar, bar_after = schedule.alpha_bar[t].item(), schedule.alpha_bar[s].item()
        alpha = bar / bar_after
        beta = 1 - alpha
        x = (bar_after**0.5 * beta * clean + alpha**0.5 * (1 - bar_after) * x) / (1 - bar)
        if s > 0:
            variance = beta * (1 - bar_after) / (1 - bar) if posterior_variance else beta
            factor = temperature if 2 * s < schedule.steps else 1.0
            x = x + factor * variance**0.5 * _fresh(x, generator, apart)
    return x


def multistep(
    predict: Predict,
    noise: Tensor,
    schedule: Schedule,
    generator: torch.Generator,
    steps: Sequence[int] | None = None,
    order: int = 1,
    eta: float = 0.0,
    apart: int = 1,
) -> Tensor:
    """Run DDIM (order 1) or DPM-Solver++ (2M) with data prediction (order 2), with or without fresh noise.

    Both are one formula. DDIM (Song et al. 2021, Eq. 12) goes from x_t to

        x_s = sqrt(abar_s) x_0 + sqrt(1 - abar_s - sigma^2) eps + sigma z

    with eps = (x_t - sqrt(abar_t) x_0) / sqrt(1 - abar_t) and
    sigma^2 = eta^2 (1 - abar_s) / (1 - abar_t) (1 - abar_t / abar_s): at eta = 1 that is `ancestral` with
    the posterior's variance. DPM-Solver++ (Lu et al. 2022, Algorithm 2) is the same with x_0 extrapolated
    to the middle of the step, in half the log of the signal-to-noise ratio, through this estimate and
    the last; at eta = 1 its SDE form. The first step and the last, which ends at the clean sample, are of
    order 1.

    Args:
        predict: Estimate of the clean sample.
        noise: (B, N, D) sample of N(0, I), x_T.
        schedule: T and the betas.
        generator: Source of the noise on the way; its draws are shaped like `noise`.
        steps: Steps to take, falling from T; all by default.
        order: Order of the solver, 1 or 2.
        eta: Share of fresh noise, 0..1.
        apart: See `standard_normal`.
    """
    x, before = noise, None
    for t, s in _pairs(steps or range(schedule.steps, 0, -1)):
        clean = predict(x, torch.tensor([t], device=x.device))
        target = clean
        if order == 2 and before is not None and s > 0:
            last, u = before
            ratio = schedule.half_log_snr(s, t) / (2 * schedule.half_log_snr(t, u))
            target = clean + ratio * (clean - last)
        before = clean, t
        bar, bar_after = schedule.alpha_bar[t].item(), schedule.alpha_bar[s].item()
        variance = eta**2 * (1 - bar_after) / (1 - bar) * (1 - bar / bar_after)
        noise_in_x = (x - bar**0.5 * target) / (1 - bar) ** 0.5
        x = bar_after**0.5 * target + max(0.0, 1 - bar_after - variance) ** 0.5 * noise_in_x
        if variance > 0:
            x = x + variance**0.5 * _fresh(x, generator, apart)
    return x


def _pairs(steps: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Pair each step with the one after it; 0 comes after the last."""
    return zip(steps, [*steps[1:], 0], strict=True)


def _fresh(x: Tensor, generator: torch.Generator, apart: int) -> Tensor:
    return standard_normal(x.shape, generator, apart, x.dtype).to(x.device)


def standard_normal(
    shape: Sequence[int], generator: torch.Generator, apart: int = 1, dtype: torch.dtype | None = None
) -> Tensor:
    """Draw a sample of N(0, I), each `apart` rows in a row of which are antithetic.

    Such rows are taken from their mean and lengthened, so each of them alone is a sample of N(0, I), and any two have a
    correlation of -1 / (apart - 1), the least that so many can have; two are opposites (Hammersley & Morton 1956).
    Samples that grow from such noise are distributed as others, and differ from each other more often.

    Args:
        shape: (B, ...) of the result; `apart` divides B.
        generator: Source of the noise.
        apart: Number of rows that belong together; 1 makes all independent.
        dtype: Type of the result.
    """
    noise = torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=dtype)
    if apart == 1:
        return noise
    groups = noise.unflatten(0, (-1, apart))
    return ((groups - groups.mean(dim=1, keepdim=True)) * (apart / (apart - 1)) ** 0.5).flatten(0, 1)
