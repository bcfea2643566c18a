"""Fine-tuning on verdicts: away from the layouts that fall, without forgetting the data.

Direct preference optimisation for diffusion models (Wallace et al. 2024, Eq. 14): for a pair of stacks
of one silhouette, the network shall get better at denoising the one that stands, and worse at the one
that falls, than a frozen copy of itself. The ordinary loss on the dataset is kept beside it.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from stackgen.data.preferences import Preferences
from stackgen.models.diffusion.module import DDPM
from stackgen.models.diffusion.network import PoseDiffusion

_REFERENCE = "reference"
_OTHER = 2**32
"""Sets the random stream of the pairs apart from that of the data."""


class VerdictTuning(DDPM):
    """A DDPM that learns from pairs too; it begins from trained weights, by `stackgen.training.StartFrom`.

    Its checkpoints are those of a DDPM.

    Args:
        preferences: File of pairs that `stackgen prefer` wrote.
        beta: Sharpness of the preference; a large one keeps the network near where it began.
        weight: Weight of the pairs' loss beside the data's.
        pairs: Number of pairs in each step, with two noise draws each.
        ddpm: Arguments of DDPM.
    """

    def __init__(
        self, preferences: str, *, beta: float = 100.0, weight: float = 1.0, pairs: int = 32, **ddpm: Any
    ) -> None:
        super().__init__(**ddpm)
        self.path = preferences
        self.preferences: Preferences
        self.beta, self.weight, self.pairs = beta, weight, pairs
        self._frozen: list[PoseDiffusion] = []  # in a list: no part of the module, so in no optimiser and no average
        self._loaded: dict[str, Tensor] | None = None

    def setup(self, stage: str) -> None:
        """Read the pairs too."""
        super().setup(stage)
        if stage == "fit":
            self.preferences = Preferences.load(self.path)

    def on_fit_start(self) -> None:
        """Keep a copy of the network as it is at the beginning, or was before a resume."""
        self._frozen = [copy.deepcopy(self.model).requires_grad_(False).eval()]
        if self._loaded is not None:
            self._frozen[0].load_state_dict(self._loaded)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the copy beside the weights."""
        super().on_save_checkpoint(checkpoint)
        if self._frozen:
            checkpoint[_REFERENCE] = self._frozen[0].state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the copy back."""
        super().on_load_checkpoint(checkpoint)
        self._loaded = checkpoint.get(_REFERENCE)

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        """Add the loss of the pairs to that of the data."""
        data = super().training_step(batch, index)
        generator = self.generator_of_step(_OTHER + index, self.device)
        loss, right = self._preference_loss(generator)
        self.log("train/preference_loss", loss, prog_bar=True)
        self.log("train/preferred", right)
        return data + self.weight * loss

    def _preference_loss(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        better, worse = (arrays.tensors.to(self.device) for arrays in (self.preferences.better, self.preferences.worse))
        chosen = torch.randint(len(self.preferences), (self.pairs,), generator=generator, device=self.device)
        mirrored = torch.rand(self.pairs, generator=generator, device=self.device) < 0.5
        blocks = int(self.preferences.better.lengths[chosen.cpu().numpy()].max())
        batches = [side.batch(chosen, mirrored, blocks) for side in (better, worse)]
        state = generator.get_state()
        gains = []
        for pair in batches:  # the same noise and steps for both, and for both networks
            generator.set_state(state)
            now, _ = self.model.loss(pair, 2, generator)
            generator.set_state(state)
            with torch.no_grad():
                before, _ = self._frozen[0].loss(pair, 2, generator)
            gains.append(before - now)
        margin = self.beta * (gains[0] - gains[1])
        return -F.logsigmoid(margin).mean(), (margin > 0).float().mean()
