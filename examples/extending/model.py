"""A model of your own: an MLP from silhouette and block list to poses, trained, watched and measured like ours."""

import torch
from torch import Tensor

from stackgen._lightning import pl
from stackgen.models.diffusion.denoiser import mlp, raster_order
from stackgen.models.module import WorldMixin


class SilhouetteMLP(WorldMixin, pl.LightningModule):
    """WorldMixin learns grid, shapes and N from the data, and calls `build` when it knows them."""

    kind = "silhouette-mlp"

    def __init__(self, width: int = 256, learning_rate: float = 1e-3) -> None:
        super().__init__()
        self.config, self.learning_rate = {"width": width}, learning_rate

    def build(self) -> None:
        if not hasattr(self, "model"):
            inputs = self.grid.image_size**2 + len(self.catalogue)
            self.model = mlp(inputs, self.config["width"], self.max_blocks * 6)

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

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.parameters(), lr=self.learning_rate)

    def sampler(self) -> object:  # by which SampleQuality watches the training
        from examples.extending.sampler import MLPSampler

        return MLPSampler(self)
