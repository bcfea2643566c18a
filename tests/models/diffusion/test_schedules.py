"""Noise schedules against the paper's numbers and the algebra of Gaussian steps."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from stackgen.models.diffusion.schedules import Schedule, ScheduleConfig

CONFIGS = [ScheduleConfig(), ScheduleConfig(kind="cosine"), ScheduleConfig(steps=7), ScheduleConfig(steps=1)]


def test_the_paper_s_schedule() -> None:
    schedule = Schedule(ScheduleConfig())
    assert schedule.steps == 50
    assert schedule.beta[1].item() == pytest.approx(1e-4) and schedule.beta[50].item() == pytest.approx(0.189)
    steps = schedule.beta[1:].diff()
    assert steps == pytest.approx(steps[0].expand(49), rel=1e-9)  # linear
    signal = math.prod(1 - (1e-4 + (0.189 - 1e-4) * i / 49) for i in range(50)) ** 0.5
    assert schedule.alpha_bar[50].sqrt().item() == pytest.approx(signal) == pytest.approx(0.0796, abs=5e-5)


@pytest.mark.parametrize("config", CONFIGS)
def test_alpha_bar_is_the_product_of_the_alphas(config: ScheduleConfig) -> None:
    schedule, product = Schedule(config), 1.0
    assert len(schedule.beta) == config.steps + 1 and schedule.alpha_bar[0] == 1
    for t in range(1, config.steps + 1):
        product *= 1 - schedule.beta[t].item()
        assert schedule.alpha_bar[t].item() == pytest.approx(product)
        assert 0 < schedule.beta[t] < 1 and schedule.alpha_bar[t] < schedule.alpha_bar[t - 1]


def test_the_cosine_schedule_is_a_cosine() -> None:
    schedule = Schedule(ScheduleConfig(steps=100, kind="cosine"))
    curve = [math.cos((t / 100 + 0.008) / 1.008 * math.pi / 2) ** 2 for t in range(101)]
    for t in (1, 17, 50, 99):
        assert schedule.alpha_bar[t].item() == pytest.approx(curve[t] / curve[0])


@pytest.mark.parametrize("config", CONFIGS)
def test_one_jump_is_as_many_single_steps(config: ScheduleConfig) -> None:
    """x_t = sqrt(alpha_t) x_{t-1} + sqrt(beta_t) z, composed: mean and variance of the jump to t (paper, Eq. 1)."""
    schedule, scale, variance = Schedule(config), 1.0, 0.0
    t = torch.arange(config.steps + 1)
    signal, noise = (part[:, 0, 0] for part in schedule.signal_and_noise(t))
    for step in range(1, config.steps + 1):
        alpha, beta = schedule.alpha[step].item(), schedule.beta[step].item()
        scale, variance = math.sqrt(alpha) * scale, alpha * variance + beta
        assert signal[step].item() == pytest.approx(scale, rel=1e-5)
        assert noise[step].item() ** 2 == pytest.approx(variance, rel=1e-4)
    assert signal**2 + noise**2 == pytest.approx(torch.ones(config.steps + 1))
    assert (signal[0].item(), noise[0].item()) == (1, 0)


def test_diffusing_mixes_each_row_at_its_own_step() -> None:
    schedule = Schedule(ScheduleConfig())
    clean, noise = torch.randn(3, 4, 6), torch.randn(3, 4, 6)
    t = torch.tensor([0, 20, 50])
    mixed = schedule.diffuse(clean, noise, t)
    assert mixed.shape == clean.shape and mixed.dtype == torch.float32
    for row, step in enumerate(t.tolist()):
        bar = schedule.alpha_bar[step].item()
        assert mixed[row] == pytest.approx(math.sqrt(bar) * clean[row] + math.sqrt(1 - bar) * noise[row], abs=1e-6)


@pytest.mark.parametrize("spacing", [1.0, 1.3, 3.0])
@pytest.mark.parametrize("config", CONFIGS)
def test_a_subset_falls_from_the_last_step_and_has_none_twice(config: ScheduleConfig, spacing: float) -> None:
    schedule = Schedule(config)
    for number in range(1, config.steps + 1):
        steps = schedule.subset(number, spacing)
        assert len(steps) == number and steps[0] == config.steps and steps[-1] >= 1
        assert all(a > b for a, b in pairwise(steps))
    assert schedule.subset(config.steps, spacing) == list(range(config.steps, 0, -1))


def test_spacing_moves_steps_towards_the_clean_end() -> None:
    schedule = Schedule(ScheduleConfig())
    even, closer = schedule.subset(8), schedule.subset(8, 2.0)
    assert set(np.diff(even)) <= {-6, -7} and all(a >= b for a, b in zip(even, closer, strict=True))


def test_half_the_log_of_the_signal_to_noise_ratio() -> None:
    schedule = Schedule(ScheduleConfig())
    signal, noise = (part[:, 0, 0] for part in schedule.signal_and_noise(torch.arange(51)))
    grown = (signal[12] / noise[12]).log() - (signal[40] / noise[40]).log()
    assert schedule.half_log_snr(12, 40) == pytest.approx(grown.item(), rel=1e-4)
