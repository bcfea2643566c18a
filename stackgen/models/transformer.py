"""The parts of a Transformer over block tokens that sees the silhouette (paper, "Model Architecture").

There are two ways of seeing it. `joint` is the paper's: block and silhouette tokens share one encoder. `cross` is
ours: a short encoder reads the silhouette once, the block tokens attend to the memory it leaves, and a
condition (the denoiser's time) scales and shifts every layer (adaLN, Peebles & Xie 2023). The memory serves all
steps of a solver and several noise draws of a training step, and padding is never computed.

Legend: B scenes, N block tokens, C silhouette tokens, d width, H heads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stackgen.errors import StackgenError
from stackgen.models.poses import POSE
from stackgen.world import Grid

WAVES = 16
"""Number of wavelengths in which a place is written along each axis."""

SHORTEST, LONGEST = 0.5, 64.0
"""Those wavelengths' bounds [cell]."""


@dataclass(frozen=True)
class TransformerConfig:
    """Architecture of the Transformer; the defaults are the paper's.

    Args:
        width: Width d of the tokens.
        layers: Number of layers of the encoder (joint) or over the block tokens (cross).
        heads: Number of heads of each attention.
        feedforward: Width of the two-layer networks between attentions.
        conditioning: Way in which block tokens see the silhouette: `joint`, in one encoder with its tokens (paper), or
            `cross`, by attention to a memory that is read once.
        memory_layers: Number of encoder layers over the silhouette alone; `cross` only.
        mask_padding: Whether padding tokens are kept out of attention; the paper leaves them in, as zero vectors.
        patch: Edge of a silhouette patch [pixel].
        stride: Distance between silhouette patches [pixel]; below `patch` they overlap.
        dropout: Share of dropped activations in the encoder layers of `joint`.
        ordered: Whether the blocks of one shape are numbered, from the bottom up and left to right, and that
            number is embedded. The paper leaves equal blocks to their noise; then each must find out among all
            permutations which one it is.
        self_conditioning: Whether the denoiser is shown its own last estimate of the clean poses too (Chen, Zhang
            & Hinton 2023), so that it keeps to a layout once chosen.
        places: Whether silhouette patches and noisy blocks are told where they are, across and up [cell], by the same
            sines and cosines, so that a block finds what is near it on a grid of any size. The paper numbers the
            patches row by row, and the blocks have their normalised poses alone.

    Raises:
        StackgenError: If there can be no such network.
    """

    width: int = 512
    layers: int = 6
    heads: int = 8
    feedforward: int = 2048
    conditioning: Literal["joint", "cross"] = "joint"
    memory_layers: int = 2
    mask_padding: bool = False
    patch: int = 16
    stride: int = 16
    dropout: float = 0.0
    ordered: bool = False
    self_conditioning: bool = False
    places: bool = False

    def __post_init__(self) -> None:
        for name in ("width", "heads", "feedforward", "patch", "stride"):
            if not 1 <= getattr(self, name) <= 65_536:
                raise StackgenError(f"{name} must lie in 1..65536, got {getattr(self, name)}")
        if self.width % 2 or self.width % self.heads:
            raise StackgenError(f"width must be even and a multiple of heads ({self.heads}), got {self.width}")
        if not 0 <= self.layers <= 1000 or not 0 <= self.memory_layers <= 1000 or not 0 <= self.dropout < 1:
            raise StackgenError("layers and memory_layers must lie in 0..1000, and dropout in [0, 1)")

    @property
    def trims(self) -> bool:
        """Whether padding may be left out: not where the network is trained to see it."""
        return self.conditioning == "cross" or self.mask_padding


def block_layers(config: TransformerConfig, number: int) -> nn.ModuleList:
    """Make the layers that block tokens pass through."""
    kind = EncoderLayer if config.conditioning == "joint" else CrossLayer
    return nn.ModuleList(kind(config) for _ in range(number))


def memory_layers(config: TransformerConfig) -> nn.ModuleList:
    """Make the layers that silhouette tokens pass through alone: none in `joint`."""
    number = config.memory_layers if config.conditioning == "cross" else 0
    return nn.ModuleList(EncoderLayer(config, norm_first=True) for _ in range(number))


def final_norm(config: TransformerConfig) -> nn.Module:
    """Make what follows the block layers: a norm in `cross`, whose layers are pre-norm, nothing in `joint`."""
    return nn.LayerNorm(config.width) if config.conditioning == "cross" else nn.Identity()


def pose_head(config: TransformerConfig) -> nn.Linear:
    """Make the layer from tokens (B, N, d) to poses (B, N, 6); in `cross` it begins at zero."""
    head = nn.Linear(config.width, POSE)
    if config.conditioning == "cross":
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
    return head


def run_blocks(
    layers: nn.ModuleList,
    config: TransformerConfig,
    *,
    blocks: Tensor,
    mask: Tensor,
    memory: Tensor,
    condition: Tensor | None,
) -> Tensor:
    """Let block tokens see each other and the silhouette.

    Args:
        layers: Layers of `block_layers`.
        config: Their architecture.
        blocks: (B, N, d) tokens.
        mask: (B, N) True at blocks, False at padding.
        memory: (B, C, d) silhouette tokens, or (B / n, C, d), each serving n consecutive rows.
        condition: (B, d) vector that is added to the tokens (joint) or modulates every layer (cross); may be
            None in `joint` alone.

    Returns:
        (B, N, d) tokens.
    """
    if config.conditioning == "cross":
        seen = None if bool(mask.all()) else mask
        for layer in layers:
            blocks = layer(blocks, condition, seen, memory)
        return blocks
    if condition is not None:
        blocks = blocks + condition[:, None]
    memory = memory.repeat_interleave(len(blocks) // len(memory), 0)
    tokens = torch.cat([blocks * mask[..., None], memory], dim=1)  # (B, N + C, d), zero vectors as padding
    seen = F.pad(mask, (0, memory.shape[1]), value=True) if config.mask_padding else None
    for layer in layers:
        tokens = layer(tokens, seen)
    return tokens[:, : blocks.shape[1]]


class Patches(nn.Module):
    """Silhouette to tokens: each patch through a two-layer MLP, plus sinusoidal positions, or its place.

    Raises:
        StackgenError: If the patches do not tile the picture.
    """

    positions: Tensor

    def __init__(self, config: TransformerConfig, grid: Grid) -> None:
        super().__init__()
        patch, stride, width, image_size = config.patch, config.stride, config.width, grid.image_size
        if patch > image_size or (image_size - patch) % stride:
            raise StackgenError(
                f"denoiser: patches of {patch} pixels every {stride} do not tile {image_size} pixels;"
                " set patch and stride so that image_size - patch is a multiple of stride"
            )
        self.patch, self.stride = patch, stride
        self.mlp = mlp(patch * patch, width, width)
        middles = torch.arange((image_size - patch) // stride + 1) * float(stride) + patch / 2  # [pixel]
        self.place: nn.Module = nn.Identity()
        if config.places:
            x = (middles - image_size / 2) / grid.pixels_per_cell
            z = (image_size - grid.ground_margin - middles) / grid.pixels_per_cell
            positions = waves(torch.cartesian_prod(z, x).flip(-1))
            self.place = nn.Linear(positions.shape[-1], width)
        else:
            positions = sinusoids(torch.arange(len(middles) ** 2).float(), width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) to (B, C, d), row by row from the top left."""
        patches = silhouette.unfold(1, self.patch, self.stride).unfold(2, self.patch, self.stride)  # (B, r, c, p, p)
        return self.mlp(patches.flatten(3).flatten(1, 2)) + self.place(self.positions)


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward; post-norm as in Vaswani et al. 2017, or pre-norm."""

    def __init__(self, config: TransformerConfig, norm_first: bool = False) -> None:
        super().__init__()
        d = config.width
        self.norm_first = norm_first
        self.attention = Attention(d, config.heads)
        self.feedforward = mlp(d, config.feedforward, d)
        self.norm1, self.norm2 = nn.LayerNorm(d), nn.LayerNorm(d)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, seen: Tensor | None) -> Tensor:
        """(B, N, d) to (B, N, d); `seen` (B, N) says which tokens may be attended to."""
        if self.norm_first:
            x = x + self.dropout(self.attention(self.norm1(x), seen))
            return x + self.dropout(self.feedforward(self.norm2(x)))
        x = self.norm1(x + self.dropout(self.attention(x, seen)))
        return self.norm2(x + self.dropout(self.feedforward(x)))


class CrossLayer(nn.Module):
    """Self-attention, attention to the memory and feed-forward, each modulated by a condition (adaLN-zero)."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        d = config.width
        self.attention = Attention(d, config.heads)
        self.memory_attention = MemoryAttention(d, config.heads)
        self.feedforward = mlp(d, config.feedforward, d)
        self.norm = nn.LayerNorm(d, elementwise_affine=False)
        self.modulation = nn.Linear(d, 9 * d)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, x: Tensor, condition: Tensor, seen: Tensor | None, memory: Tensor) -> Tensor:
        """Blocks (B, N, d), condition (B, d), memory (B or a divisor of it, C, d) to (B, N, d)."""
        m = self.modulation(F.silu(condition))[:, None].chunk(9, dim=-1)  # 9 x (B, 1, d)
        x = x + m[2] * self.attention(self.norm(x) * (1 + m[0]) + m[1], seen)
        x = x + m[5] * self.memory_attention(self.norm(x) * (1 + m[3]) + m[4], memory)
        return x + m[8] * self.feedforward(self.norm(x) * (1 + m[6]) + m[7])


class Attention(nn.Module):
    """Multi-head self-attention, written out: at 10 to 30 tokens this is twice as fast on a CPU as the fused kernel."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, seen: Tensor | None) -> Tensor:
        """(B, N, d) to (B, N, d)."""
        q, k, v = (split_heads(part, self.heads) for part in self.qkv(x).chunk(3, dim=-1))
        return self.out(attend(q, k, v, None if seen is None else seen[:, None, None]))


class MemoryAttention(nn.Module):
    """Attention of block tokens to a memory that several of them may share."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """(B, N, d) and (B / n, C, d) to (B, N, d); the n rows of one memory are attended as one."""
        shared = x.reshape(len(memory), -1, x.shape[-1])
        k, v = (split_heads(part, self.heads) for part in self.kv(memory).chunk(2, dim=-1))
        return self.out(attend(split_heads(self.q(shared), self.heads), k, v, None)).reshape(x.shape)


def attend(q: Tensor, k: Tensor, v: Tensor, seen: Tensor | None) -> Tensor:
    """Scaled dot-product attention of (B, H, N, d/H), heads merged again: (B, N, d)."""
    scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
    if seen is not None:
        scores = scores.masked_fill(~seen, torch.finfo(scores.dtype).min)
    mixed = scores.softmax(-1) @ v
    return mixed.transpose(1, 2).flatten(2)


def split_heads(x: Tensor, heads: int) -> Tensor:
    """(B, N, d) to (B, H, N, d/H)."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Make two linear layers with a ReLU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def sinusoids(positions: Tensor, width: int) -> Tensor:
    """(M,) positions to (M, width) sines and cosines of geometrically spaced wavelengths (Vaswani et al. 2017)."""
    half = width // 2
    rates = torch.exp(-math.log(10_000) * torch.arange(half, device=positions.device) / half)
    angles = positions[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def waves(places: Tensor) -> Tensor:
    """(..., 2) places across and up [cell] to (..., 4 * WAVES) sines and cosines, from SHORTEST to LONGEST."""
    steps = torch.linspace(math.log(SHORTEST), math.log(LONGEST), WAVES, device=places.device)
    angles = (places[..., None] * (2 * math.pi / steps.exp())).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
