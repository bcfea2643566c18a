"""Training Tran-Reg: a thin Lightning shell around PoseRegression."""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor

from stackgen.baselines.modules import Parts, PoseBaseline
from stackgen.baselines.tran_reg import PoseRegression
from stackgen.baselines.transformer import RegressionConfig
from stackgen.models.diffusion.denoiser import DenoiserConfig
from stackgen.models.optimization import OptimizerConfig


class TranReg(PoseBaseline):
    """The paper's Transformer-Regression baseline; the defaults are the paper's where it gives them.

    Args:
        transformer: Architecture, the same as the denoiser's.
        regression: How estimated poses are compared with the true ones.
        optimizer: Learning rate and its course.
    """

    kind = "tran-reg"

    def __init__(
        self,
        transformer: DenoiserConfig = DenoiserConfig(),  # noqa: B008 - frozen
        regression: RegressionConfig = RegressionConfig(),  # noqa: B008
        optimizer: OptimizerConfig = OptimizerConfig(),  # noqa: B008
    ) -> None:
        super().__init__({"transformer": asdict(transformer), "regression": asdict(regression)}, optimizer)
        self._parts = (transformer, regression)
        self.model: PoseRegression

    def build(self) -> None:
        """Make the network once its world is known."""
        if not hasattr(self, "model"):
            self.model = PoseRegression(*self._parts, len(self.catalogue), self.grid.image_size, self.max_blocks)

    def _loss(self, batch: dict[str, Tensor], generator: torch.Generator | None = None) -> tuple[Tensor, Parts]:
        return self.model.loss(batch, generator).mean(), {}
