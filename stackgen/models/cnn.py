"""Training the block-list CNN: a thin Lightning shell around BlockListNetwork."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from torch import Tensor
from torch.nn import functional as F

from stackgen._lightning import pl
from stackgen.models.blocklist import BlockListNetwork, CNNConfig, CNNPredictor
from stackgen.models.optimization import OptimizerConfig, configure_optimizer
from stackgen.models.world import WorldMixin


class BlockListCNN(WorldMixin, pl.LightningModule):
    """Predicts the block list from the silhouette, by cross-entropy over all lists (paper, Eq. 5).

    Args:
        cnn: Architecture.
        optimizer: Learning rate and its course.
    """

    kind = "blocklist"

    def __init__(
        self,
        cnn: CNNConfig = CNNConfig(),  # noqa: B008 - frozen
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__()
        self.config: dict[str, Any] = {"cnn": asdict(cnn)}
        self.optimizer_config = optimizer
        self._cnn = cnn
        self.model: BlockListNetwork

    def build(self) -> None:
        """Make the network once its world is known."""
        if not hasattr(self, "model"):
            self.model = BlockListNetwork(self._cnn, len(self.catalogue), self.max_blocks)

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """One step of the cross-entropy."""
        loss, _ = self._loss(batch)
        self.log("train/loss", loss, prog_bar=True)
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Cross-entropy, exact match and top 3 on held-out stacks."""
        loss, hits = self._loss(batch)
        size = len(hits)
        self.log("validation/loss", loss, prog_bar=True, batch_size=size, sync_dist=True)
        self.log("validation/exact", hits[:, 0].float().mean(), prog_bar=True, batch_size=size, sync_dist=True)
        self.log("validation/top3", hits.any(-1).float().mean(), batch_size=size, sync_dist=True)

    def _loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean cross-entropy, and whether each of the three best classes is the true one (B, 3)."""
        logits = self.model(batch["silhouette"])
        truth = self.model.classes(batch["counts"])
        return F.cross_entropy(logits, truth), logits.topk(3).indices == truth[:, None]

    def configure_optimizers(self) -> Any:
        """AdamW and its learning-rate course."""
        return configure_optimizer(self, self.optimizer_config)

    def predictor(self) -> CNNPredictor:
        """The network as a BlockListPredictor, sharing its weights."""
        was_training = self.model.training
        predictor = CNNPredictor(self.model, self.catalogue, self.grid, self.max_blocks)
        self.model.train(was_training)
        return predictor
