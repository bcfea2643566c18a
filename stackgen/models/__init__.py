"""The paper's networks: the diffusion model of poses and the classifier of block lists, and how they are trained."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from stackgen.models.block_list.module import BlockListCNN
    from stackgen.models.diffusion.module import DDPM
    from stackgen.models.diffusion.preference import VerdictTuning

__all__ = ["DDPM", "BlockListCNN", "VerdictTuning"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "block_list.module": ["BlockListCNN"],
        "diffusion.module": ["DDPM"],
        "diffusion.preference": ["VerdictTuning"],
    },
)
