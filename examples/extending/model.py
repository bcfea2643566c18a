"""A model of your own: an MLP from silhouette and block list to poses, trained, watched and measured like ours."""

import torch
from torch import Tensor, nn

from stackgen.models.module import StackgenModule
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.poses import raster_order
from stackgen.models.transformer import mlp
from stackgen.world import World


class SilhouetteMLP(StackgenModule):
    """An MLP. StackgenModule learns the world from the data, and calls `make` when it knows it."""

    kind = "silhouette-mlp"

    def __init__(self, width: int = 256, learning_rate: float = 1e-3) -> None:
        super().__init__(OptimizerConfig(learning_rate=learning_rate), width=width)

    def make(self, world: World) -> nn.Module:
        return mlp(world.grid.image_size**2 + len(world.catalogue), self.config["width"], world.max_blocks * 6)

    def forward(self, silhouettes: Tensor, counts: Tensor) -> Tensor:
        return self.model(torch.cat([silhouettes.flatten(1), counts.float()], dim=1)).unflatten(1, (-1, 6))

    def loss(self, batch: dict[str, Tensor]) -> Tensor:
        order = raster_order(batch["poses"], batch["shapes"])  # by shape, then upwards, then left to right
        poses, mask = batch["poses"].gather(1, order[..., None].expand(-1, -1, 6)), batch["mask"].gather(1, order)
        error = self(batch["silhouette"], batch["counts"])[:, : poses.shape[1]] - poses
        return (error.abs().mean(-1) * mask).sum() / mask.sum()

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        self.log("train/loss", loss := self.loss(batch), prog_bar=True)
        return loss

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        self.log_mean("validation/loss", self.loss(batch), len(batch["mask"]))

    def sampler(self) -> object:  # by which SampleQuality watches the training
        from examples.extending.sampler import MLPSampler

        return MLPSampler(self)
