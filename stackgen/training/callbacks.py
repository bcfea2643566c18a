"""Callbacks that every module shares: averaged and compiled weights, and what is logged beside the losses."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchmetrics import MeanMetric

from stackgen._lightning import pl
from stackgen.data.arrays import Batch
from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import SCENE_METRICS
from stackgen.evaluation.protocol import Scene, batch_seed, check_scenes, scenes_of_batch
from stackgen.models.weights import read_weights
from stackgen.protocols import PhysicsNumbers, StabilityChecker, StackSampler, Verdict
from stackgen.stack import Stack
from stackgen.training.loggers import log_picture
from stackgen.training.plots import silhouette_sheet

Part = tuple[float, float]
"""A sum, and the weight that it is to be divided by."""

RAW_WEIGHTS = "raw_state_dict"
"""Key of the weights in training in a checkpoint; its `state_dict` holds the averaged ones."""


class StartFrom(pl.Callback):
    """Start training from other weights, to fine-tune them; list it before EMA.

    Args:
        weights: Weights of the same architecture: a name, a `.safetensors` file, a `.ckpt` or a run folder. Parts
            that they lack (such as an embedding that was added since) begin as they would without them.
    """

    def __init__(self, weights: str) -> None:
        self.weights = weights

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Load the weights, unless the fit resumes from a checkpoint of its own."""
        if trainer.ckpt_path:
            return
        tensors, _ = read_weights(self.weights)
        wrong = StackgenError(f"StartFrom: {self.weights} does not fit the model of the configuration")
        try:
            missing, foreign = pl_module.model.load_state_dict(tensors, strict=False)  # type: ignore[union-attr]
        except RuntimeError as error:
            raise wrong from error
        if foreign or len(missing) > len(tensors) // 2:
            raise wrong
        if missing:
            print(f"StartFrom: {self.weights} has no {', '.join(missing)}, which begins untrained")


class Compile(pl.Callback):
    """Compile parts of the network with torch.compile for the training steps, in place: weights keep their names.

    Validation and sampling see other sizes and modes, each a compilation of its own; they run as written.

    Args:
        parts: Names of the parts in the training module.
        backend: Backend of torch.compile; `inductor` asks for a C++ compiler on a CPU.
        mode: Mode of that backend, such as `reduce-overhead` or `max-autotune`.
        dynamic: Whether one compilation is for all sizes; null compiles for the first size, and for all at the second.
    """

    def __init__(
        self,
        parts: Sequence[str] = ("model.denoiser",),
        backend: str = "inductor",
        mode: str | None = None,
        dynamic: bool | None = None,
    ) -> None:
        self.parts = tuple(parts)
        self.options: dict[str, Any] = {"backend": backend, "mode": mode, "dynamic": dynamic}

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Mark the parts; each is compiled when it is first called."""
        known = dict(pl_module.named_modules())
        for part in self.parts:
            if part not in known:
                kin = [name for name in known if name and name.count(".") < 2]
                raise StackgenError(f"Compile: {type(pl_module).__name__} has no part {part!r}; try {', '.join(kin)}")
            known[part].compile(**self.options)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let validation run as written."""
        torch.compiler.set_stance("force_eager")

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let training run compiled."""
        torch.compiler.set_stance("default")

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Leave nothing behind for what runs next in this process."""
        torch.compiler.set_stance("default")


class EMA(pl.Callback):
    """Exponential moving average of the weights, used for everything but the training steps.

    After update t the average is a + (1 - d) (w - a) with d = min(decay, (1 + t) / (10 + t)) (the
    second term lets a young average forget its random beginning). Validation, test and prediction
    run with the average, checkpoints hold it as their `state_dict` (the weights in training beside
    it, to resume from), and when the fit ends it stays in the module. Checkpoints of weights alone
    (`save_weights_only`) reach no callback and hold the weights in training.

    Lightning's EMAWeightAveraging is not its base: it copies the module before the network is built, takes the
    average back out before callbacks listed later can sample with it, and mixes up the two in a checkpoint that
    is saved while validating.

    Args:
        decay: Share of the old average that an update keeps.
        warmup: Whether a young average keeps less.
    """

    def __init__(self, decay: float = 0.999, warmup: bool = True) -> None:
        if not 0 <= decay < 1:
            raise StackgenError(f"EMA: decay must lie in [0, 1), got {decay}")
        self.decay, self.warmup = decay, warmup
        self.updates = self._step = 0
        self._live: dict[str, Tensor] = {}  # the module's own tensors
        self._other: dict[str, Tensor] = {}  # the average; while swapped, the weights in training
        self._swapped = False
        self._raw: dict[str, Tensor] | None = None  # of the checkpoint that is being resumed

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin with the weights as they are: fresh, or averaged ones of a checkpoint."""
        self._live = {name: t for name, t in pl_module.state_dict().items() if t.is_floating_point()}
        self._other = {name: t.clone() for name, t in self._live.items()}
        self._swapped = False
        if self._raw is not None:
            pl_module.load_state_dict(self._raw, strict=False)  # counters are not among them
            self._raw = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Remember where the steps are."""
        self._step = trainer.global_step

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Update after each optimiser step, not after each batch that only accumulates gradients."""
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        keep = min(self.decay, (1 + self.updates) / (10 + self.updates)) if self.warmup else self.decay
        with torch.no_grad():
            torch._foreach_lerp_([*self._other.values()], [*self._live.values()], 1 - keep)
        self.updates += 1

    def _swap(self, averaged: bool) -> None:
        """Exchange the module's weights and the others, unless they are as asked for."""
        if averaged != self._swapped and self._live:
            live, other = [*self._live.values()], [*self._other.values()]
            with torch.no_grad():
                kept = [tensor.clone() for tensor in live]
                torch._foreach_copy_(live, other)
                torch._foreach_copy_(other, kept)
            self._swapped = averaged

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Validate with the average."""
        self._swap(averaged=True)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Train on."""
        if trainer.state.fn == "fit":
            self._swap(averaged=False)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the average in the module: what is tested, exported or used next."""
        self._swap(averaged=True)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save the average as the checkpoint's weights, those in training beside them."""
        if self._live:
            average, raw = (self._live, self._other) if self._swapped else (self._other, self._live)
            checkpoint["state_dict"] = {**checkpoint["state_dict"], **average}
            checkpoint[RAW_WEIGHTS] = dict(raw)

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Keep the weights in training for :meth:`on_fit_start`; the module loads the average itself."""
        self._raw = checkpoint.get(RAW_WEIGHTS)

    def state_dict(self) -> dict[str, Any]:
        """Give the number of updates that the average has seen."""
        return {"updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Invert :meth:`state_dict`."""
        self.updates = int(state_dict["updates"])


class SampleQuality(pl.Callback):
    """Sample validation scenes with their true block lists, every few epochs and when only validating, and score them.

    The module's `sampler()` gives the StackSampler; metrics are logged as `sample/<name>`, a picture of some
    scenes as `sample/scenes`. Without a checker, which the command line sets, only what needs no physics is logged.

    Args:
        every_n_epochs: Epochs from one sampling to the next, of those that validate; 0 never samples.
        num_scenes: Number of scenes, the first of the validation split, over all processes.
        num_samples: Number of stacks per scene.
        seed: Seed of the sampler, the same each time, so that epochs compare.
        checker: Says which stacks stand; null logs only what needs no physics.
        num_pictures: Number of scenes in the picture; 0 draws none.
    """

    def __init__(
        self,
        every_n_epochs: int = 5,
        num_scenes: int = 64,
        num_samples: int = 1,
        seed: int = 0,
        checker: StabilityChecker | None = None,
        num_pictures: int = 8,
    ) -> None:
        if every_n_epochs < 0 or num_scenes < 1 or num_samples < 1 or num_pictures < 0:
            raise StackgenError(
                "SampleQuality: num_scenes and num_samples must be at least 1,"
                " every_n_epochs and num_pictures 0 or more"
            )
        self.every_n_epochs, self.num_scenes, self.num_samples = every_n_epochs, num_scenes, num_samples
        self.seed, self.checker, self.num_pictures = seed, checker, num_pictures
        self._batches: list[Batch] = []

    def _due(self, trainer: pl.Trainer) -> bool:
        fitting = trainer.state.fn == "fit"
        due = not fitting or (self.every_n_epochs > 0 and (trainer.current_epoch + 1) % self.every_n_epochs == 0)
        return due and not trainer.sanity_checking

    def on_validation_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin to collect scenes."""
        self._batches = []

    def on_validation_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Collect scenes until there are enough."""
        missing = -(-self.num_scenes // trainer.world_size) - sum(len(b["mask"]) for b in self._batches)
        if missing > 0 and self._due(trainer):
            self._batches.append({name: tensor[:missing] for name, tensor in batch.items()})

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Sample, check and log; the averaged weights are in the module now."""
        if not self._batches:
            return
        make_sampler: Any = pl_module.sampler  # of our modules; Lightning knows nothing of it
        sampler: StackSampler = make_sampler()
        scenes = [s for batch in self._batches for s in scenes_of_batch(batch, sampler.world.catalogue)]
        self._batches = []
        start = time.perf_counter()
        stacks = self._draw(sampler, scenes, trainer.global_rank)
        rate = len(scenes) * self.num_samples, time.perf_counter() - start
        parts = {**self._measure(sampler, scenes, stacks), "stacks_per_second": rate}
        means = {f"sample/{name}": _mean(part, pl_module.device) for name, part in parts.items()}
        pl_module.log_dict(means, sync_dist=True)  # the same on all processes already
        if self.num_pictures and trainer.is_global_zero:
            firsts, shown = scenes[: self.num_pictures], [samples[0] for samples in stacks[: self.num_pictures]]
            verdicts = self.checker.check_all(shown) if self.checker else [None] * len(shown)
            log_picture(trainer, "sample/scenes", silhouette_sheet(firsts, shown, verdicts, sampler.world.grid))

    def _draw(self, sampler: StackSampler, scenes: list[Scene], rank: int) -> list[list[Stack]]:
        """Sample stacks for some scenes, the same for the same weights."""
        silhouettes, counts = np.stack([s.silhouette for s in scenes]), np.stack([s.counts for s in scenes])
        return sampler.sample_batch(silhouettes, counts, self.num_samples, batch_seed(self.seed, 0, rank))

    def _measure(self, sampler: StackSampler, scenes: list[Scene], stacks: list[list[Stack]]) -> dict[str, Part]:
        """Compute the metrics of some scenes, each as a sum and the weight that it is to be divided by."""
        scores = [r.score for r in check_scenes(scenes, stacks, self.checker or _NoPhysics(), sampler.world)]
        names = SCENE_METRICS if self.checker else ("diversity", "front_iou_before_physics")
        parts = {name: np.sum([SCENE_METRICS[name](score) for score in scores], axis=0) for name in names}
        return {name: (float(total), float(weight)) for name, (total, weight) in parts.items()}


def _mean(part: Part, device: torch.device) -> Tensor:
    """Compute a metric, all processes' scenes counting alike; NaN where it does not exist."""
    total, weight = part
    mean = MeanMetric(nan_strategy="ignore").to(device)
    mean.update(total / weight if weight else math.nan, weight)
    return mean.compute()


class _NoPhysics(StabilityChecker):
    """Stands in for a checker where there is none, for metrics that ignore physics: nothing moves."""

    @property
    def physics(self) -> PhysicsNumbers:
        """There is none."""
        raise NotImplementedError

    def check(self, stack: Stack) -> Verdict:
        """See StabilityChecker."""
        return Verdict(True, np.zeros(len(stack), bool), np.zeros(len(stack)), stack)


class Throughput(pl.Callback):
    """Log `train/samples_per_second` over all processes, of training steps and their data alone.

    Args:
        every_n_steps: Number of batches averaged over.
    """

    def __init__(self, every_n_steps: int = 50) -> None:
        if every_n_steps < 1:
            raise StackgenError(f"Throughput: every_n_steps must be at least 1, got {every_n_steps}")
        self.every_n_steps = every_n_steps
        self._restart()

    def _restart(self) -> None:
        self._samples, self._batches, self._since = 0, 0, time.perf_counter()

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave out what happened between epochs."""
        self._restart()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave out the validation."""
        self._restart()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        """Count, and log when there is enough to average."""
        self._samples += len(batch["mask"])
        self._batches += 1
        if self._batches == self.every_n_steps:
            rate = self._samples * trainer.world_size / (time.perf_counter() - self._since)
            pl_module.log("train/samples_per_second", rate, batch_size=1)
            self._restart()


class StepMetrics(pl.Callback):
    """Log `train/learning_rate` and `train/gradient_norm`, the norm of all gradients together before they are clipped.

    Args:
        every_n_steps: Steps from one log to the next; by default as often as the trainer logs.
    """

    def __init__(self, every_n_steps: int | None = None) -> None:
        if every_n_steps is not None and every_n_steps < 1:
            raise StackgenError(f"StepMetrics: every_n_steps must be at least 1, got {every_n_steps}")
        self.every_n_steps = every_n_steps

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Look at the gradients, now that they are there."""
        every = self.every_n_steps or max(1, trainer.log_every_n_steps)  # type: ignore[attr-defined]
        if trainer.global_step % every:
            return
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients))) if gradients else torch.zeros(())
        metrics = {"train/learning_rate": float(optimizer.param_groups[0]["lr"]), "train/gradient_norm": norm}
        pl_module.log_dict(metrics, batch_size=1)
