"""A training whose numbers are no longer finite is ended, before anything of it is kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from stackgen._lightning import pl
from stackgen.errors import StackgenError
from stackgen.training.callbacks import RAW_WEIGHTS


class DivergedError(StackgenError):
    """The training led nowhere; checkpoints from before are as they were."""


class StopIfDiverged(pl.Callback):
    """End a training as soon as its loss or its weights are NaN or infinite, and keep no state of that kind.

    The loss is looked at whenever the trainer logs, the weights before each validation and each checkpoint.
    """

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Look at the loss now and then: a look waits for the device."""
        every = max(1, trainer.log_every_n_steps)  # type: ignore[attr-defined]
        loss = outputs.get("loss") if isinstance(outputs, Mapping) else outputs
        if trainer.global_step % every == 0 and isinstance(loss, Tensor) and not bool(torch.isfinite(loss).all()):
            raise _diverged(trainer, f"the loss is {float(loss.mean()):g}")

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Measure nothing that is none."""
        _check_weights(trainer, dict(pl_module.named_parameters()))

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Do not say that all went well if nothing was measured and kept."""
        _check_weights(trainer, dict(pl_module.named_parameters()))

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Keep no state that nobody can use."""
        names = [name for name, _ in pl_module.named_parameters()]
        for part in (checkpoint["state_dict"], checkpoint.get(RAW_WEIGHTS, {})):
            _check_weights(trainer, {name: part[name] for name in names if name in part})


def _check_weights(trainer: pl.Trainer, weights: Mapping[str, Tensor]) -> None:
    finite = [torch.isfinite(tensor).all() for tensor in weights.values()]
    if trainer.state.fn == "fit" and finite and not bool(torch.stack(finite).all()):
        raise _diverged(trainer, "the weights are not finite")


def _diverged(trainer: pl.Trainer, what: str) -> DivergedError:
    cure = "begin again with a smaller learning rate"
    return DivergedError(f"the training diverged: {what} at step {trainer.global_step}; {cure}")
