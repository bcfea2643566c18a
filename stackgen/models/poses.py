"""Poses as networks see them: normalised, padded, and the blocks of one shape in order.

Legend: B scenes, N blocks at most, H x W pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional as F

POSE = 6
"""Numbers of a pose: x, y, z [cell] and a rotation vector [rad]."""

_ROW_STEP = 0.25  # [cell] blocks of one shape whose centres differ by more lie in different rows


class PoseNetwork(nn.Module):
    """A network that draws poses, normalised by what the poses of its training data are like.

    A subclass implements `trims` and `sample`.

    Args:
        least_std: Lower bound of the standard deviation that a dimension is divided by [cell, rad].
    """

    mean: Tensor
    std: Tensor

    def __init__(self, least_std: float) -> None:
        super().__init__()
        self.least_std = least_std
        self.register_buffer("mean", torch.zeros(POSE))
        self.register_buffer("std", torch.ones(POSE))

    def fit_normalization(self, mean: ArrayLike, std: ArrayLike) -> None:
        """Take over the mean and the standard deviation (6,) of the training poses [cell, rad]."""
        self.mean.copy_(torch.as_tensor(np.asarray(mean)))
        self.std.copy_(torch.as_tensor(np.asarray(std)).clamp(min=max(self.least_std, 1e-6)))

    @property
    def trims(self) -> bool:
        """Whether padding may be left out, which is wrong where the network was trained to see it."""
        raise NotImplementedError

    def sample(self, silhouettes: Tensor, shapes: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
        """Draw poses (B, N, 6) [cell, rad].

        Args:
            silhouettes: (B / n, H, W) in {0, 1}, each serving n consecutive rows.
            shapes: (B, N) indices, negative at padding.
            mask: (B, N) True at blocks.
            generator: Source of all randomness.
        """
        raise NotImplementedError


def ranks(shapes: Tensor) -> Tensor:
    """Count how many blocks of its own shape stand before each block: (B, N) to (B, N).

    >>> ranks(torch.tensor([[0, 0, 2, 0]])).tolist()
    [[0, 1, 0, 2]]
    """
    same = shapes[:, :, None] == shapes[:, None, :]
    return same.tril(-1).sum(-1)


def raster_order(poses: Tensor, shapes: Tensor) -> Tensor:
    """(B, N) order that sorts blocks by shape, then from the bottom up, then left to right; padding last.

    Args:
        poses: (B, N, 6) [cell, rad].
        shapes: (B, N), negative at padding.
    """
    x, z = poses[..., 0], poses[..., 2]
    kind = torch.where(shapes < 0, shapes.max() + 1, shapes)
    upwards = (kind * 1e3 + z).argsort(-1)
    steps = kind.gather(-1, upwards).diff(dim=-1) + (z.gather(-1, upwards).diff(dim=-1) > _ROW_STEP)
    row = F.pad((steps > 0).cumsum(-1), (1, 0))
    return upwards.gather(-1, (row * 1e2 + x.gather(-1, upwards)).argsort(-1))
