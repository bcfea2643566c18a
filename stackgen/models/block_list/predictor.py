"""The block-list CNN as a BlockListPredictor.

Legend: B silhouettes, M lists, S shapes, H x W pixels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from stackgen.errors import StackgenError
from stackgen.models.block_list.network import BlockListNetwork, CNNConfig
from stackgen.world import Mask, World


class CNNPredictor:
    """A BlockListPredictor: the network with its world.

    Args:
        network: Trained network.
        world: World it was trained in.
        card: What is known about the weights.
    """

    def __init__(self, network: BlockListNetwork, world: World, card: dict[str, Any] | None = None) -> None:
        self.network = network.eval()
        self.world = world
        self.card: dict[str, Any] = card or {}

    @torch.inference_mode()
    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """See BlockListPredictor."""
        if top < 1:
            raise StackgenError(f"block list: at least one is predicted, not {top}")
        most = None if limit is None else self._lists(limit, 1)
        return np.concatenate([self.network.best(part, top, most).cpu().numpy() for part in self._parts(silhouettes)])

    @torch.inference_mode()
    def log_probabilities(self, silhouettes: Mask, lists: ArrayLike) -> NDArray[np.float64]:
        """Compute the log-probability (B, M) [nat] of each of M block lists (M, S), for each silhouette.

        Raises:
            StackgenError: If a list has no block, or more than N.
        """
        counts = self._lists(lists, 2)
        parts = [self.network(part, counts.expand(len(part), -1, -1)) for part in self._parts(silhouettes)]
        return torch.cat(parts).double().cpu().numpy()

    def _parts(self, silhouettes: Mask) -> list[Tensor]:
        """Split the silhouettes (B, H, W) into batches, as the network takes them."""
        device = self.network.hidden.weight.device
        parts = np.array_split(silhouettes, max(1, math.ceil(len(silhouettes) / 256)))
        return [torch.from_numpy(np.ascontiguousarray(part, dtype=np.float32)).to(device) for part in parts]

    def _lists(self, counts: ArrayLike, dimensions: int) -> Tensor:
        """Put counts (..., S) where the network is."""
        array = np.asarray(counts, dtype=np.int64)
        if array.ndim != dimensions or array.shape[-1] != len(self.world.catalogue):
            names = ", ".join(self.world.catalogue.names)
            raise StackgenError(f"block list: one count for each of {names}, got an array {array.shape}")
        return torch.from_numpy(array).to(self.network.hidden.weight.device)


def make_block_list(config: dict[str, Any], world: World) -> tuple[nn.Module, Any]:
    """Make the block-list network of a card; see stackgen.models.weights.Maker."""
    return BlockListNetwork(CNNConfig(**config["cnn"]), world), CNNPredictor
