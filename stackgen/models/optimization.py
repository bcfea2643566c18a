"""AdamW with a warm-up and a cosine: one recipe for everything that learns here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from stackgen._lightning import pl
from stackgen.errors import StackgenError


@dataclass(frozen=True)
class OptimizerConfig:
    """Settings of AdamW. The paper gives none of these; they are ours.

    Args:
        learning_rate: Peak of the learning rate.
        warmup: Number of steps in which the learning rate rises to its peak.
        final: Share of the peak that is left at the end of training.
        weight_decay: Decoupled weight decay, on matrices only.
        beta2: Decay of the second moment.

    Raises:
        StackgenError: If a number is out of its range.
    """

    learning_rate: float = 1e-3
    warmup: int = 200
    final: float = 0.01
    weight_decay: float = 0.01
    beta2: float = 0.99

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            most = 1.0 if name in ("final", "beta2") else math.inf
            if not 0 <= value <= most or math.isinf(value):
                raise StackgenError(f"optimizer.{name} must lie in 0..{most:g}, got {value:g}")


def configure_optimizer(module: pl.LightningModule, config: OptimizerConfig) -> dict[str, Any]:
    """Make AdamW for a module's parameters; the cosine spans the trainer's estimated steps.

    Raises:
        StackgenError: If nobody can say how many steps there are.
    """
    parameters = [p for p in module.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in parameters if p.ndim >= 2], "weight_decay": config.weight_decay},
        {"params": [p for p in parameters if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, config.beta2))
    steps = module.trainer.estimated_stepping_batches
    if math.isinf(steps):
        raise StackgenError("trainer: the learning rate falls to the last step: give max_steps or max_epochs too")
    total = max(1, int(steps))
    course = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: learning_rate_share(step, total, config))
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": course, "interval": "step"}}


def learning_rate_share(step: int, total: int, config: OptimizerConfig) -> float:
    """Compute the share of the peak learning rate at a step.

    >>> config = OptimizerConfig(warmup=10, final=0.1)
    >>> [round(learning_rate_share(s, 110, config), 3) for s in (0, 9, 10, 60, 110)]
    [0.1, 1.0, 1.0, 0.55, 0.1]
    """
    if step < config.warmup:
        return (step + 1) / config.warmup
    progress = min(1.0, (step - config.warmup) / max(1, total - config.warmup))
    return config.final + (1 - config.final) * 0.5 * (1 + math.cos(math.pi * progress))
