"""The reverse process where its result is known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from stackgen.models.diffusion.schedules import Schedule, ScheduleConfig
from stackgen.models.diffusion.solvers import Predict, ancestral, multistep, standard_normal

SCHEDULE = Schedule(ScheduleConfig())
LONG = Schedule(ScheduleConfig(steps=400, beta_end=0.04))
STEPS = [50, 37, 26, 15, 6]
SOLVERS: dict[str, Callable[..., Tensor]] = {
    "ancestral beta": ancestral,
    "ancestral posterior": partial(ancestral, posterior_variance=True),
    "first order eta 0": multistep,
    "first order eta 0.5": partial(multistep, eta=0.5),
    "second order eta 0": partial(multistep, order=2),
    "second order eta 1": partial(multistep, order=2, eta=1.0),
}


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def start(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def watched(predict: Predict, seen: dict[int, Tensor]) -> Predict:
    """The predictor, keeping every x_t that it is shown."""

    def shown(x: Tensor, t: Tensor) -> Tensor:
        seen[int(t)] = x
        return predict(x, t)

    return shown


def gaussian(schedule: Schedule, mean: float, std: float) -> Predict:
    """The exact E[x_0 | x_t] where the data are N(mean, std^2)."""

    def predict(x: Tensor, t: Tensor) -> Tensor:
        bar = schedule.alpha_bar[t][:, None, None]
        gain = bar.sqrt() * std**2 / (bar * std**2 + 1 - bar)
        return mean + gain * (x - bar.sqrt() * mean)

    return predict


def moments(schedule: Schedule, mean: float, std: float) -> tuple[float, float]:
    """Mean and variance that the linear recursion of the solver ends with, from N(0, 1)."""
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

    def predict(x: Tensor, t: Tensor) -> Tensor:
        bar = SCHEDULE.alpha_bar[t][:, None, None]
        return (x - (1 - bar).sqrt() * noise_of(x, int(t))) / bar.sqrt()

    seen: dict[int, Tensor] = {}
    noise = start(5, 3, 6)
    end = ancestral(watched(predict, seen), noise, SCHEDULE, generator(9))
    assert list(seen) == list(range(50, 0, -1)) and (seen[50] == noise).all()
    seen[0] = end
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
        for solve in SOLVERS.values():
            end = solve(lambda x, t: target, start(4, 2, 6), SCHEDULE, generator(seed), STEPS)
            torch.testing.assert_close(end, target, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_same_generator_same_sample(name: str) -> None:
    predict = gaussian(SCHEDULE, 0, 1)
    a, b, c = (SOLVERS[name](predict, start(3, 2, 6), SCHEDULE, generator(seed), STEPS) for seed in (4, 4, 5))
    assert (a == b).all()
    if name.endswith("eta 0"):
        assert (a == c).all()  # no noise on the way
    else:
        assert (a != c).any()


def wavy(x: Tensor, t: Tensor) -> Tensor:
    """A predictor without any law."""
    return (x + 0.01 * t).sin()


@pytest.mark.parametrize("steps", [STEPS, None])
def test_eta_one_is_ancestral_sampling_with_the_posterior_s_variance(steps: list[int] | None) -> None:
    """DDIM at eta = 1, and first-order SDE-DPM-Solver++, are DDPM (Song et al. 2021, Section 4.1)."""
    a = ancestral(wavy, start(3, 4, 6), SCHEDULE, generator(2), steps, posterior_variance=True)
    b = multistep(wavy, start(3, 4, 6), SCHEDULE, generator(2), steps, order=1, eta=1.0)
    torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_two_steps_of_the_second_order_are_those_of_the_paper_s_algorithm() -> None:
    """DPM-Solver++ (2M), Lu et al. 2022, Algorithm 2, written out with lambda, h and r."""
    steps = [50, 30, 12, 4]
    seen: dict[int, Tensor] = {}
    noise = start(2, 3, 6)
    end = multistep(watched(wavy, seen), noise, SCHEDULE, generator(), steps, order=2)
    assert list(seen) == steps
    bar = SCHEDULE.alpha_bar
    lam = 0.5 * (bar / (1 - bar)).log()
    x, last = noise, None
    for i, (t, s) in enumerate(pairwise(steps)):
        clean, h = wavy(x, torch.tensor([t])), lam[s] - lam[t]
        data = clean
        if last is not None:
            r = (lam[t] - lam[steps[i - 1]]) / h
            data = (1 + 1 / (2 * r)) * clean - 1 / (2 * r) * last
        x = ((1 - bar[s]) / (1 - bar[t])).sqrt() * x - bar[s].sqrt() * ((-h).exp() - 1) * data
        last = clean
        torch.testing.assert_close(seen[s], x, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(end, wavy(x, torch.tensor([4])), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("mean", "std"), [(0.7, 0.4), (-0.3, 2.0)])
def test_the_second_order_is_nearer_to_the_flow_s_end_than_the_first(mean: float, std: float) -> None:
    """Of Gaussian data the flow from noise to data is known: it scales x about the mean."""
    predict, noise = gaussian(LONG, mean, std), start(50, 1, 6)
    bar = LONG.alpha_bar[LONG.steps]
    exact = mean + (noise - bar.sqrt() * mean) * std / (bar * std**2 + 1 - bar).sqrt()
    steps = LONG.subset(12, 2.0)
    first, second = (multistep(predict, noise, LONG, generator(), steps, order) for order in (1, 2))
    assert (second - exact).abs().mean() < 0.5 * (first - exact).abs().mean()
    fine = multistep(predict, noise, LONG, generator(), None, order=2)
    torch.testing.assert_close(fine, exact, rtol=0.01, atol=0.01)


@pytest.mark.parametrize("eta", [0.5, 1.0])
def test_a_few_steps_of_the_second_order_keep_the_moments_with_fresh_noise_too(eta: float) -> None:
    x = multistep(gaussian(LONG, 0.7, 0.6), start(5000, 1, 6), LONG, generator(), LONG.subset(40), 2, eta)
    assert x.mean().item() == pytest.approx(0.7, abs=0.03)
    assert x.std().item() == pytest.approx(0.6, rel=0.06)


def test_all_steps_are_those_of_the_schedule() -> None:
    whole = list(range(50, 0, -1))
    for solve in SOLVERS.values():
        a, b = (solve(wavy, start(2, 2, 6), SCHEDULE, generator(), steps) for steps in (None, whole))
        assert (a == b).all()


@pytest.mark.parametrize("apart", [2, 3, 8])
def test_antithetic_noise_is_standard_normal_and_correlated_as_little_as_can_be(apart: int) -> None:
    groups = standard_normal((apart * 40_000, 2), generator(), apart).unflatten(0, (-1, apart))
    wanted = torch.full((apart, apart), -1 / (apart - 1)).fill_diagonal_(1.0)
    for entry in range(2):
        torch.testing.assert_close(groups[..., entry].T.cov(), wanted, atol=0.02, rtol=0)
    assert groups.mean(dim=(0, 2)).abs().max() < 0.02
    assert groups.sum(dim=1).abs().max() < 1e-4
    fourth = (groups**4).mean().item()
    assert fourth == pytest.approx(3, rel=0.03)  # that of a Gaussian
    first, second = groups[:-1, 0], groups[1:, 0]
    assert (first * second).mean().abs() < 0.02  # groups know nothing of each other


def test_noise_without_groups_is_what_it_was() -> None:
    noise = standard_normal((4, 3, 6), generator(3))
    assert torch.equal(noise, torch.randn(4, 3, 6, generator=generator(3)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_antithetic_samples_of_gaussian_data_have_the_moments_and_lie_apart(solver: str) -> None:
    """The estimate is linear in x, so samples are as correlated as their noise."""
    noise = standard_normal((6000, 1, 6), generator(1), 3)
    x = SOLVERS[solver](gaussian(LONG, 0.7, 0.6), noise, LONG, generator(), apart=3)
    assert x.mean().item() == pytest.approx(0.7, abs=0.03)
    assert x.std().item() == pytest.approx(0.6, rel=0.1)
    groups = x.unflatten(0, (-1, 3)) - 0.7
    assert ((groups[:, 0] * groups[:, 1]).mean() / x.var()).item() == pytest.approx(-0.5, abs=0.05)


def test_temperature_acts_in_the_lower_half_of_the_steps_alone() -> None:
    noise, seen, cold = start(2, 2, 6), dict[int, Tensor](), dict[int, Tensor]()
    ancestral(watched(wavy, seen), noise, SCHEDULE, generator(4))
    ancestral(watched(wavy, cold), noise, SCHEDULE, generator(4), temperature=0.3)
    same = [t for t in seen if torch.equal(seen[t], cold[t])]
    assert same == list(range(50, 24, -1))  # the noise of the step from 25 to 24 is the first that is less


def test_low_temperature_brings_samples_nearer_to_the_mean() -> None:
    predict, noise = gaussian(SCHEDULE, 0.7, 0.05), start(2000, 1, 6)
    spread = [ancestral(predict, noise, SCHEDULE, generator(), None, True, 1, t).std().item() for t in (0.0, 0.5, 1.0)]
    assert spread == sorted(spread) and spread[0] < 0.9 * spread[2]
