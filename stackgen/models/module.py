"""What every training module shares: it learns its world from its data, and names it in its checkpoints."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from stackgen.data.shards import manifest_sha256
from stackgen.errors import StackgenError
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid

CHECKPOINT_KEY = "stackgen"
"""Where a Lightning checkpoint holds the card of its model."""


class WorldMixin:
    """Catalogue, grid and N, from the DataModule or from a checkpoint; the network is built when they are known.

    A module sets `kind` and `config` (plain data from which the network can be built again) and
    implements `build`.
    """

    kind: str
    config: dict[str, Any]
    catalogue: Catalogue = PAPER_CATALOGUE
    grid: Grid = PAPER_GRID
    max_blocks: int = MAX_BLOCKS
    dataset: dict[str, Any] | None = None

    def build(self) -> None:
        """Make the network, once."""
        raise NotImplementedError

    def setup(self, stage: str) -> None:
        """Called by Lightning before anything else: look at the data, build the network."""
        data = getattr(self.trainer, "datamodule", None)  # type: ignore[attr-defined]
        if data is not None and stage == "fit":
            manifest = data.manifest
            self.catalogue, self.grid, self.max_blocks = data.catalogue, data.grid, int(manifest["max_blocks"])
            self.dataset = {
                "name": manifest["name"],
                "sha256": manifest_sha256(manifest),
                "counts": manifest["counts"],
                "physics": manifest["physics"],
            }
        self.build()

    def log_mean(self, name: str, mean: Tensor, count: int, prog_bar: bool = False) -> None:
        """Log the mean over some samples; over batches and processes all samples count alike."""
        # As a float, because Lightning rounds down what it averages of whole numbers (its issue 21859).
        self.log(name, mean, prog_bar=prog_bar, batch_size=float(count), sync_dist=True)  # type: ignore[attr-defined]

    def card(self) -> dict[str, Any]:
        """What is known about the weights; see stackgen.models.weights."""
        return {
            "kind": self.kind,
            "config": self.config,
            "catalogue": self.catalogue.to_json(),
            "grid": vars(self.grid),
            "max_blocks": self.max_blocks,
            "dataset": self.dataset,
        }

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
        self.catalogue, self.grid = Catalogue.from_json(card["catalogue"]), Grid(**card["grid"])
        self.max_blocks, self.dataset = card["max_blocks"], card["dataset"]
        self.build()
