"""A metric that is monitored and that nobody logs is named before the first step, not after an epoch."""

from __future__ import annotations

import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

from stackgen._lightning import pl
from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import SCENE_METRICS

_LATER = ("train/samples_per_second", "sample/stacks_per_second", *(f"sample/{name}" for name in SCENE_METRICS))
"""Metrics that are logged at the end of an epoch, if at all."""


class CheckMonitors(pl.Callback):
    """Refuse to early-stop by a metric, or keep the best by one, that is not known by the first step.

    What others than stackgen and Lightning log, and when, cannot be known: with a model or a callback of theirs, or
    without Lightning's validation before training, nothing is refused here.
    """

    def __init__(self) -> None:
        self._known = set[str]()

    def on_sanity_check_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Learn the metrics of a validation."""
        self._known = set(trainer.callback_metrics)

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Learn those of a training step, and compare, while there is nothing yet to be kept.

        Raises:
            StackgenError: The line names the metrics that there are.
        """
        known, self._known = self._known, set()
        callbacks = trainer.callbacks  # type: ignore[attr-defined]
        modules = {type(part).__module__.partition(".")[0] for part in (pl_module, *callbacks)}
        if not known or not modules <= {"stackgen", "lightning"}:
            return
        known = {*known, *trainer.callback_metrics, *_LATER}
        for callback in callbacks:
            if not isinstance(callback, EarlyStopping | ModelCheckpoint) or not getattr(callback, "strict", True):
                continue
            if callback.monitor is not None and callback.monitor not in known:
                name, there = type(callback).__name__, ", ".join(sorted(known))
                raise StackgenError(f"{name}: no metric is called {callback.monitor!r}; there are {there}")
