"""The model of model.py as a StackSampler, which evaluation, report, drawings and the robot take."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from examples.extending.model import SilhouetteMLP
from stackgen.errors import StackgenError
from stackgen.stack import Stack, shapes_of
from stackgen.world import Mask


class MLPSampler:
    """A sampler has one method, `sample_batch`; this one is made of a module in training, or of a checkpoint."""

    settings: Mapping[str, Any] = {}

    def __init__(self, trained: SilhouetteMLP | str) -> None:
        self.module = load(trained) if isinstance(trained, str) else trained
        self.world, self.card = self.module.world, self.module.card()

    @torch.no_grad()
    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        poses = self.module(torch.from_numpy(silhouettes).float(), torch.from_numpy(counts)).double().numpy()
        catalogue = self.world.catalogue
        stacks = [Stack(shapes_of(c), p[: c.sum()], catalogue) for c, p in zip(counts, poses, strict=True)]
        return [[stack] * num_samples for stack in stacks]


def load(checkpoint: str) -> SilhouetteMLP:
    """Load the module of a checkpoint; only tensors and plain values are read from it."""
    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    if content.get("stackgen", {}).get("kind") != SilhouetteMLP.kind:
        raise StackgenError(f"{checkpoint} is no checkpoint of a SilhouetteMLP")
    module = SilhouetteMLP(**content["stackgen"]["config"])
    module.on_load_checkpoint(content)  # takes the world from it, and builds the network
    module.load_state_dict(content["state_dict"])
    return module
