"""The reverse process where its result is known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from stackgen.models.samplers import Predict, ancestral
from stackgen.models.schedules import Schedule, ScheduleConfig

SCHEDULE = Schedule(ScheduleConfig())
LONG = Schedule(ScheduleConfig(steps=400, beta_end=0.04))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def start(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def gaussian(schedule: Schedule, mean: float, std: float) -> Predict:
    """The exact E[x_0 | x_t] where the data are N(mean, std^2)."""

    def predict(x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        bar = schedule.alpha_bar[t][:, None, None]
        gain = bar.sqrt() * std**2 / (bar * std**2 + 1 - bar)
        clean = mean + gain * (x - bar.sqrt() * mean)
        return clean, (x - bar.sqrt() * clean) / (1 - bar).sqrt()

    return predict


def moments(schedule: Schedule, mean: float, std: float) -> tuple[float, float]:
    """Mean and variance that the linear recursion of the sampler ends with, from N(0, 1)."""
    m, v = 0.0, 1.0
    for t in range(schedule.steps, 0, -1):
        beta, alpha = schedule.beta[t].item(), schedule.alpha[t].item()
        bar, before = schedule.alpha_bar[t].item(), schedule.alpha_bar[t - 1].item()
        gain = bar**0.5 * std**2 / (bar * std**2 + 1 - bar)
        of_clean, of_x = before**0.5 * beta / (1 - bar), alpha**0.5 * (1 - before) / (1 - bar)
        factor = of_clean * gain + of_x
        m = factor * m + of_clean * mean * (1 - gain * bar**0.5)
        v = factor**2 * v + (beta if t > 1 else 0)
    return m, v


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.7, 1.0), (-1.5, 0.4), (0.3, 2.0)])
def test_the_exact_predictor_gives_the_moments_of_the_closed_form(mean: float, std: float) -> None:
    count = 120_000
    x = ancestral(gaussian(SCHEDULE, mean, std), start(count // 60, 10, 6), SCHEDULE, generator())
    m, v = moments(SCHEDULE, mean, std)
    assert x.mean().item() == pytest.approx(m, abs=5 * (v / count) ** 0.5)
    assert x.var().item() == pytest.approx(v, rel=5 * (2 / count) ** 0.5)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.7, 1.0), (0.7, 0.4), (-0.3, 2.0)])
def test_the_closed_form_is_the_data_s_own_distribution_when_steps_are_small(mean: float, std: float) -> None:
    m, v = moments(Schedule(ScheduleConfig(steps=4000, beta_start=1e-5, beta_end=0.004)), mean, std)
    assert m == pytest.approx(mean, abs=0.01) and v**0.5 == pytest.approx(std, rel=0.01)
    count = 30_000
    x = ancestral(gaussian(LONG, mean, std), start(count // 6, 1, 6), LONG, generator())
    assert x.mean().item() == pytest.approx(mean, abs=0.04)
    assert x.std().item() == pytest.approx(std, rel=0.05)


def test_with_unit_variance_the_paper_s_fifty_steps_are_already_exact() -> None:
    """sigma_t^2 = beta_t is the exact reverse step for N(mu, 1); the last step's noise, beta_1, is left out."""
    m, v = moments(SCHEDULE, 0.5, 1.0)
    assert v == pytest.approx(1 - 1e-4, rel=1e-6)
    assert m == pytest.approx(0.5 * (1 - SCHEDULE.alpha_bar[50].item()), rel=1e-6)  # x_T began without its mean


@pytest.mark.parametrize("noise_of", [lambda x, t: x.sin() + 0.01 * t, lambda x, t: 0.3 * x, lambda x, t: 0 * x])
def test_each_step_is_equation_3_of_the_paper(noise_of: Callable[[Tensor, int], Tensor]) -> None:
    """Whatever the predictor: x_{t-1} = (x_t - beta_t / sqrt(1 - abar_t) eps) / sqrt(alpha_t) + sqrt(beta_t) z."""

    def predict(x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        bar, eps = SCHEDULE.alpha_bar[t][:, None, None], noise_of(x, int(t[0]))
        return (x - (1 - bar).sqrt() * eps) / bar.sqrt(), eps

    seen: dict[int, Tensor] = {}
    noise = start(5, 3, 6)
    end = ancestral(predict, noise, SCHEDULE, generator(9), callback=lambda t, x: seen.update({t: x}))
    assert list(seen) == list(range(50, -1, -1))
    assert (seen[50] == noise).all() and (seen[0] == end).all()
    fresh = generator(9)
    for t in range(50, 0, -1):
        beta, alpha, bar = SCHEDULE.beta[t], SCHEDULE.alpha[t], SCHEDULE.alpha_bar[t]
        x = (seen[t] - beta / (1 - bar).sqrt() * noise_of(seen[t], t)) / alpha.sqrt()
        if t > 1:
            x = x + beta.sqrt() * torch.randn(x.shape, generator=fresh, dtype=x.dtype)
        torch.testing.assert_close(seen[t - 1], x, rtol=1e-9, atol=1e-9)


def test_the_last_step_adds_no_noise() -> None:
    """It ends with the last estimate of the clean sample, exactly."""
    target = start(4, 2, 6, seed=3)
    for seed in range(3):
        end = ancestral(lambda x, t: (target, x), start(4, 2, 6), SCHEDULE, generator(seed))
        torch.testing.assert_close(end, target, rtol=0, atol=1e-12)


def test_clipping_bounds_the_estimate() -> None:
    wild: Predict = lambda x, t: (100 * x, x)  # noqa: E731
    end = ancestral(wild, start(8, 2, 6), SCHEDULE, generator(), clip=2.5)
    assert end.abs().max().item() == pytest.approx(2.5)
    tame: Predict = lambda x, t: (x.clamp(-1, 1), x)  # noqa: E731
    free, clipped = (ancestral(tame, start(8, 2, 6), SCHEDULE, generator(), clip=c) for c in (None, 1.0))
    assert (free == clipped).all()


def test_same_generator_same_sample() -> None:
    predict = gaussian(SCHEDULE, 0, 1)
    a, b, c = (ancestral(predict, start(3, 2, 6), SCHEDULE, generator(seed)) for seed in (4, 4, 5))
    assert (a == b).all() and (a != c).any()
