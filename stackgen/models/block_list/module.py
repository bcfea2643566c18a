"""Training the block-list CNN: a thin Lightning shell around BlockListNetwork."""

from __future__ import annotations

from torch import Tensor

from stackgen.models.block_list.network import BlockListNetwork, CNNConfig
from stackgen.models.block_list.predictor import CNNPredictor
from stackgen.models.module import StackgenModule
from stackgen.models.optimization import OptimizerConfig


class BlockListCNN(StackgenModule):
    """The block-list CNN in training: it makes the true list's probability large (paper, Eq. 5).

    Args:
        cnn: Architecture of the CNN.
        optimizer: Learning rate and its course over the training.
    """

    kind = "blocklist"  # one word, as in the cards of weights
    network = BlockListNetwork
    model: BlockListNetwork

    def __init__(
        self,
        cnn: CNNConfig = CNNConfig(),  # noqa: B008 - frozen
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__(optimizer, cnn=cnn)

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """Compute the cross-entropy (paper, Eq. 5)."""
        features = self.model.features(batch["silhouette"])
        loss = self._loss(features, batch["counts"])
        self.log("train/loss", loss, prog_bar=True)
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        """Log cross-entropy, exact match and top 3 on held-out stacks."""
        features, truth = self.model.features(batch["silhouette"]), batch["counts"]
        loss, hits = self._loss(features, truth), self._hits(features, truth)
        size = len(hits)
        self.log_mean("validation/loss", loss, size, prog_bar=True)
        self.log_mean("validation/exact", hits[:, 0].float().mean(), size, prog_bar=True)
        self.log_mean("validation/top3", hits.any(-1).float().mean(), size)

    def _loss(self, features: Tensor, truth: Tensor) -> Tensor:
        """Compute the mean cross-entropy of the true lists (B, S)."""
        return -self.model.out.log_probabilities(features, truth[:, None]).mean()

    def _hits(self, features: Tensor, truth: Tensor) -> Tensor:
        """Say whether each of the three best lists is the true one (B, 3)."""
        return (self.model.out.best(features, 3) == truth[:, None]).all(-1)

    def predictor(self) -> CNNPredictor:
        """Make a BlockListPredictor of the network, sharing its weights."""
        return self.wrapped(CNNPredictor)
