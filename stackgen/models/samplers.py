"""Samplers: plain functions that turn noise into samples, given something that estimates the clean poses."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from stackgen.models.schedules import Schedule

Predict = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x_t, t) to estimates of the clean sample and of the noise in it."""


def ancestral(
    predict: Predict,
    noise: Tensor,
    schedule: Schedule,
    generator: torch.Generator,
    clip: float | None = None,
    posterior_variance: bool = False,
    callback: Callable[[int, Tensor], None] | None = None,
) -> Tensor:
    """DDPM's reverse process (paper, Eq. 3), no noise at the last step.

    Written with the clean estimate instead of the noise, which is the same formula as long as the
    estimate is not clipped: the mean of q(x_{t-1} | x_t, x_0) (Ho et al. 2020, Eq. 7).

    Args:
        predict: The model.
        noise: (B, N, D) sample of N(0, I), x_T.
        schedule: T and the betas.
        generator: Of the noise on the way; its draws are shaped like `noise`.
        clip: Bound of the clean estimate, in standard deviations.
        posterior_variance: Of the noise on the way: sigma_t^2 = beta_t (paper), or that of
            q(x_{t-1} | x_t, x_0), which is smaller. In few steps the former leaves more noise in x_1
            than the last step takes away: a standard deviation of 0.06 in 50 steps.
        callback: Called with (t, x_t) before each step and (0, x_0) at the end.
    """
    x = noise
    for step in range(schedule.steps, 0, -1):
        if callback:
            callback(step, x)
        t = torch.full((len(x),), step, device=x.device)
        clean, _ = predict(x, t)
        if clip is not None:
            clean = clean.clamp(-clip, clip)
        beta, alpha = schedule.beta[step].item(), schedule.alpha[step].item()
        bar, bar_before = schedule.alpha_bar[step].item(), schedule.alpha_bar[step - 1].item()
        x = (bar_before**0.5 * beta * clean + alpha**0.5 * (1 - bar_before) * x) / (1 - bar)
        if step > 1:
            fresh = torch.randn(x.shape, generator=generator, device=generator.device, dtype=x.dtype)
            variance = beta * (1 - bar_before) / (1 - bar) if posterior_variance else beta
            x = x + variance**0.5 * fresh.to(x.device)
    if callback:
        callback(0, x)
    return x
