"""What every training module shares: world, network, randomness, optimiser, and the card in its checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from stackgen._lightning import pl
from stackgen.errors import StackgenError
from stackgen.models.optimization import OptimizerConfig, configure_optimizer
from stackgen.models.poses import PoseNetwork
from stackgen.models.sampler import NetworkSampler
from stackgen.models.weights import CHECKPOINT_KEY
from stackgen.world import World

T = TypeVar("T")


class StackgenModule(pl.LightningModule):
    """A LightningModule that learns its world from its data or a checkpoint, and builds its network then.

    A subclass sets `kind` and `network`, and implements `training_step` and `validation_step`. From `kind`, `config`
    and `world` its network can be built again; see stackgen.models.weights.

    Args:
        optimizer: Learning rate and its course over the training.
        parts: What describes the network: frozen dataclasses or plain values, in the order that `network` takes them.
    """

    kind: str
    network: Callable[..., nn.Module]
    world: World
    model: nn.Module

    def __init__(self, optimizer: OptimizerConfig = OptimizerConfig(), **parts: Any) -> None:  # noqa: B008 - frozen
        super().__init__()
        self._parts = parts
        self.config: dict[str, Any] = {n: asdict(p) if is_dataclass(p) else p for n, p in parts.items()}  # type: ignore[arg-type]
        self.optimizer_config = optimizer
        self.dataset: dict[str, Any] | None = None

    def make(self, world: World) -> nn.Module:
        """Make a new network for a world."""
        return type(self).network(*self._parts.values(), world)

    def prepare(self, data: Any) -> None:
        """Take from the training data (a StackDataModule) what a new network needs; nothing by default."""

    def build(self, world: World) -> None:
        """Take a world, and make the network for it if there is none yet."""
        self.world = world
        if not hasattr(self, "model"):
            self.model = self.make(world)

    def setup(self, stage: str) -> None:
        """Learn the world from the data and build the network; what a checkpoint holds is loaded later."""
        data = getattr(self.trainer, "datamodule", None)
        if data is None or (stage != "fit" and hasattr(self, "model")):
            return
        self.build(data.world)
        if stage == "fit":
            facts = data.manifest
            self.dataset = {name: getattr(facts, name) for name in ("name", "sha256", "counts", "physics")}
            self.prepare(data)

    def configure_optimizers(self) -> Any:
        """AdamW and the course of its learning rate."""
        return configure_optimizer(self, self.optimizer_config)

    def generator_of_step(self, index: int, device: torch.device) -> torch.Generator:
        """Make a generator that depends on seed, process, epoch and step alone.

        So a resumed fit draws what the uninterrupted one would have, and no two processes draw the same.
        """
        place = (torch.initial_seed() % 2**63, self.global_rank, self.current_epoch, index)
        seed = int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0] >> 1)
        return torch.Generator(device=device).manual_seed(seed)

    def log_mean(self, name: str, mean: Tensor, count: int, prog_bar: bool = False) -> None:
        """Log the mean over some samples; over batches and processes all samples count alike."""
        # As a float, because Lightning rounds down what it averages of whole numbers (its issue 21859).
        self.log(name, mean, prog_bar=prog_bar, batch_size=float(count), sync_dist=True)  # type: ignore[arg-type]

    def wrapped(self, wrap: Callable[[Any, World], T]) -> T:
        """Make a sampler or predictor around the network; both share the weights, and the network keeps its mode."""
        training = self.model.training
        wrapper = wrap(self.model, self.world)
        self.model.train(training)
        return wrapper

    def card(self) -> dict[str, Any]:
        """Say what is known about the weights; see stackgen.models.weights."""
        return {"kind": self.kind, "config": self.config, **self.world.to_json(), "dataset": self.dataset}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Put the card into the checkpoint."""
        checkpoint[CHECKPOINT_KEY] = self.card()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the world from the checkpoint and build the network for its weights.

        Raises:
            StackgenError: If it is not a checkpoint of this kind of model.
        """
        card = checkpoint.get(CHECKPOINT_KEY)
        if not isinstance(card, dict) or card.get("kind") != self.kind:
            raise StackgenError(f"the checkpoint is not one of a {type(self).__name__} of stackgen")
        self.dataset = card["dataset"]
        self.build(World.from_json(card))


class PoseModule(StackgenModule):
    """A StackgenModule around a PoseNetwork."""

    model: PoseNetwork

    def prepare(self, data: Any) -> None:
        """Take the normalisation of poses from the training data."""
        self.model.fit_normalization(*data.pose_statistics())

    def sampler(self) -> NetworkSampler:
        """Make a StackSampler of the model, sharing its weights."""
        return self.wrapped(NetworkSampler)
