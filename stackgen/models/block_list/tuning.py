"""Fine-tuning the block-list network on what a sampler makes of its lists.

Many lists make a drawing, and a dataset shows each good one alike; a sampler is better at some of them. So beside the
ordinary loss on the dataset, the expected worth of a list among those that were tried is made large (minimum risk
training, Shen et al. 2016).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from stackgen.data.preferences import TriedLists
from stackgen.models.block_list.module import BlockListCNN

_OTHER = 2**32
"""Sets the random stream of the tried lists apart from that of the data."""


class ListTuning(BlockListCNN):
    """A BlockListCNN that learns from tried lists too, from trained weights on (`stackgen.training.StartFrom`).

    Its checkpoints are those of a BlockListCNN.

    Args:
        tried: File of tried lists that `stackgen prefer --lists` wrote.
        weight: Weight of their worth beside the data's loss.
        scenes: Number of their scenes in each step.
        block_list: Arguments of BlockListCNN.
    """

    def __init__(self, tried: str, *, weight: float = 10.0, scenes: int = 128, **block_list: Any) -> None:
        super().__init__(**block_list)
        self.path = tried
        self.tried: TriedLists
        self.weight, self.scenes = weight, scenes

    def setup(self, stage: str) -> None:
        """Read the tried lists too."""
        super().setup(stage)
        if stage == "fit":
            self.tried = TriedLists.load(self.path)

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """Make the expected worth of the tried lists large, beside the probability of the data's."""
        data = super().training_step(batch, index)
        worth = self._expected_worth(self.generator_of_step(_OTHER + index, self.device))
        self.log("train/worth", worth, prog_bar=True)
        return data - self.weight * worth

    def _expected_worth(self, generator: torch.Generator) -> Tensor:
        """Compute the mean worth of a list drawn from the network's distribution, among those tried for its scene."""
        chosen = torch.randint(len(self.tried), (self.scenes,), generator=generator, device=self.device)
        mirrored = torch.rand(self.scenes, generator=generator, device=self.device) < 0.5
        scenes = self.tried.scenes.tensors.to(self.device).batch(chosen, mirrored)
        rows = chosen.cpu().numpy()
        lists, worth = (torch.from_numpy(a[rows]).to(self.device) for a in (self.tried.lists, self.tried.worth))
        likely = self.model.out.log_probabilities(self.model.features(scenes["silhouette"]), lists)
        return (likely.softmax(-1) * worth).sum(-1).mean()
