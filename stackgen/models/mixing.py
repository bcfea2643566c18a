"""Weights mixed from others of one architecture: their mean, or what a tuning changed taken further.

Networks that were tuned from common ancestors lie in one valley of the loss, so their mean is often better than each
(Wortsman et al. 2022, "Model soups"), what one tuning changed can be added to another (Ilharco et al. 2023, "Editing
models with task arithmetic"), and a step beyond tuned weights goes on as their tuning went (Zheng et al. 2024,
"Model extrapolation expedites alignment").
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from stackgen.errors import StackgenError
from stackgen.models.weights import read_weights

_WORLD = ("kind", "catalogue", "grid", "max_blocks")
_FREE = ("dropout", "variance", "guidance", "antithetic", "temperature", "mend")
"""What the configurations may differ in: it changes how weights are trained or sampled, not what they mean."""


def mix_weights(
    sources: Sequence[str | Path], shares: Sequence[float] | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Add up weights of one architecture and world, each times its share.

    Args:
        sources: Weights, at least two: names, `.safetensors` or `.ckpt` files, or run folders.
        shares: A share for each, which may be negative; all together are 1. Equal ones by default.

    Returns:
        The tensors; and the card of the first, without its name, training and metrics, and with the sources.

    Raises:
        StackgenError: If weights cannot be read or do not fit each other, or the shares are not as they must be.
    """
    shares = [1 / len(sources)] * len(sources) if shares is None else shares
    if len(sources) < 2 or len(shares) != len(sources):
        raise StackgenError("mixing needs at least two weights, and as many shares where shares are given")
    if not abs(sum(shares) - 1) < 1e-6:
        raise StackgenError(f"the shares of all weights must be 1 together, not {sum(shares):g}")
    parts = [read_weights(source) for source in sources]
    tensors, card = parts[0]
    for source, (others, its_card) in zip(sources[1:], parts[1:], strict=True):
        same = all(its_card.get(name) == card.get(name) for name in _WORLD) and _agree(its_card, card, "config")
        if not same or {k: v.shape for k, v in others.items()} != {k: v.shape for k, v in tensors.items()}:
            raise StackgenError(f"{source} is not of the same architecture and world as {sources[0]}")
    mixed = {name: _sum([part[name] for part, _ in parts], shares) for name in tensors}
    facts = {name: value for name, value in card.items() if name not in ("name", "trained", "metrics", "sha256")}
    named = [
        {"name": its.get("name", Path(source).name), "share": share, "sha256": its.get("sha256")}
        for source, share, (_, its) in zip(sources, shares, parts, strict=True)
    ]
    return mixed, {**facts, "mixed": named}


def _agree(one: Any, other: Any, *names: str) -> bool:
    """Compare two configurations where both say something; an older one may lack what has been added since."""
    if isinstance(one, dict) and isinstance(other, dict):
        shared = names or (one.keys() & other.keys()) - set(_FREE)
        return all(_agree(one.get(name), other.get(name)) for name in shared)
    return bool(one == other)


def _sum(tensors: Sequence[Tensor], shares: Sequence[float]) -> Tensor:
    """Add up tensors of numbers, each times its share; of anything else the first is taken."""
    if not tensors[0].is_floating_point():
        return tensors[0]
    return torch.stack([share * tensor.float() for share, tensor in zip(shares, tensors, strict=True)]).sum(dim=0)
