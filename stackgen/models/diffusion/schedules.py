"""Noise schedules: how much of the signal is left after t steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass(frozen=True)
class ScheduleConfig:
    """Description of a noise schedule; the defaults are the paper's.

    Args:
        steps: Number of diffusion steps T.
        kind: Course of the noise: `linear` in beta (paper), or `cosine` (Nichol & Dhariwal 2021).
        beta_start: First beta of the linear schedule.
        beta_end: Last beta of the linear schedule.
    """

    steps: int = 50
    kind: Literal["linear", "cosine"] = "linear"
    beta_start: float = 1e-4
    beta_end: float = 0.189


class Schedule:
    """The numbers of a schedule, indexed by t = 1..T; index 0 is the clean end (alpha-bar 1).

    >>> round(Schedule(ScheduleConfig()).alpha_bar[50].sqrt().item(), 4)  # what is left of the signal at T
    0.0796
    """

    def __init__(self, config: ScheduleConfig) -> None:
        self.config = config
        t = torch.linspace(0, 1, config.steps + 1, dtype=torch.float64)
        if config.kind == "linear":
            beta = torch.linspace(config.beta_start, config.beta_end, config.steps, dtype=torch.float64)
        else:
            curve = torch.cos((t + 0.008) / 1.008 * torch.pi / 2) ** 2
            beta = (1 - curve[1:] / curve[:-1]).clamp(max=0.999)
        self.beta = torch.cat([torch.zeros(1, dtype=torch.float64), beta])
        self.alpha = 1 - self.beta
        self.alpha_bar = self.alpha.cumprod(0)
        self._signal = self.alpha_bar.sqrt().float()
        self._noise = (1 - self.alpha_bar).sqrt().float()

    @property
    def steps(self) -> int:
        """T."""
        return self.config.steps

    def signal_and_noise(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """sqrt(alpha-bar) and sqrt(1 - alpha-bar) at steps t (...), float32, shaped (..., 1, 1)."""
        index = t.cpu()
        return (
            self._signal[index].to(t.device)[..., None, None],
            self._noise[index].to(t.device)[..., None, None],
        )

    def half_log_snr(self, t: int, before: int) -> float:
        """Compute how much half the log of the signal-to-noise ratio grows from step `before` to step t >= 1."""
        ratios = [self.alpha_bar[step].item() / (1 - self.alpha_bar[step].item()) for step in (t, before)]
        return 0.5 * math.log(ratios[0] / ratios[1])

    def subset(self, number: int, spacing: float = 1.0) -> list[int]:
        """Choose steps from T, ..., 1, falling, with T: T (1 - i / number)^spacing, rounded, without duplicates.

        >>> Schedule(ScheduleConfig()).subset(5), Schedule(ScheduleConfig()).subset(5, 1.3)
        ([50, 40, 30, 20, 10], [50, 37, 26, 15, 6])
        """
        chosen: list[int] = []
        for i in range(number - 1, -1, -1):
            step = round(self.steps * (1 - i / number) ** spacing)
            chosen.append(max(step, chosen[-1] + 1 if chosen else 1))
        return chosen[::-1]

    def diffuse(self, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Run the forward process (paper, Eq. 1): clean and noise (B, N, D), t (B,)."""
        signal, sigma = self.signal_and_noise(t)
        return signal * clean + sigma * noise
