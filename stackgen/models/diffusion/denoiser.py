"""The denoiser: a Transformer over block tokens that sees the silhouette (paper, "Model Architecture").

Two ways of seeing it. `joint` is the paper's: block and silhouette tokens in one encoder. `cross` is
ours: a short encoder reads the silhouette once, the block tokens attend to what it remembers, and
time scales and shifts every layer (adaLN, Peebles & Xie 2023). The memory serves all steps of the
sampler and several noise draws of a training step, and padding is never computed.

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
from stackgen.world import World

POSE = 6
_ROW_STEP = 0.25  # [cell] blocks of one shape whose centres differ by more lie in different rows


@dataclass(frozen=True)
class DenoiserConfig:
    """Architecture; the defaults are the paper's.

    Args:
        width: d.
        layers: Of the encoder (joint), or of the block tokens (cross).
        heads: Of each attention.
        feedforward: Width of the two-layer networks between attentions.
        conditioning: `joint` or `cross`, see the module.
        memory_layers: Encoder layers over the silhouette alone; `cross` only.
        mask_padding: Keep padding tokens out of attention; the paper leaves them in, as zero vectors.
        patch, stride: Silhouette patches [pixel]; a stride below the patch makes them overlap.
        dropout: In the encoder layers of `joint`.
        ordered: Number the blocks of one shape from the bottom up and left to right, and embed that
            number. The paper leaves equal blocks to their noise; then each must find out among all
            permutations which one it is.
        self_conditioning: Show the network its own last estimate of the clean poses too (Chen, Zhang
            & Hinton 2023), so that a layout once chosen is kept to.
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

    @property
    def trims(self) -> bool:
        """Whether padding may be left out: not where the network is trained to see it."""
        return self.conditioning == "cross" or self.mask_padding


class Denoiser(nn.Module):
    """Noisy poses, time, shapes and a silhouette in; an estimate per block out.

    Args:
        config: See DenoiserConfig.
        world: Size of the shape codebook, edge of the silhouette [pixel], and N.
    """

    def __init__(self, config: DenoiserConfig, world: World) -> None:
        super().__init__()
        self.config = config
        d = config.width
        self.pose_embedding = mlp(POSE, d, d)
        self.shape_embedding = nn.Embedding(len(world.catalogue), d)
        if config.ordered:
            self.rank_embedding = nn.Embedding(world.max_blocks, d)
        if config.self_conditioning:
            self.estimate_embedding = nn.Linear(POSE, d, bias=False)
            nn.init.zeros_(self.estimate_embedding.weight)
        self.time_embedding = mlp(d, d, d)
        self.patches = Patches(config.patch, config.stride, world.grid.image_size, d)
        if config.conditioning == "joint":
            self.memory_encoder = nn.ModuleList()
            self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(config.layers))
        else:
            self.memory_encoder = nn.ModuleList(
                EncoderLayer(config, norm_first=True) for _ in range(config.memory_layers)
            )
            self.layers = nn.ModuleList(CrossLayer(config) for _ in range(config.layers))
            self.final_norm = nn.LayerNorm(d)
        self.head = nn.Linear(d, POSE)
        if config.conditioning == "cross":
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)

    def encode(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) silhouettes in {0, 1} to silhouette tokens (B, C, d), the same for every t."""
        tokens = self.patches(silhouette)
        for layer in self.memory_encoder:
            tokens = layer(tokens, None)
        return tokens

    def forward(
        self, poses: Tensor, t: Tensor, shapes: Tensor, mask: Tensor, memory: Tensor, estimate: Tensor | None = None
    ) -> Tensor:
        """Estimate (B, N, 6) for normalised noisy poses (B, N, 6).

        Args:
            poses: Normalised; what stands at padding does not matter.
            t: (B,) diffusion step, 1..T.
            shapes: (B, N) indices, negative at padding; if `ordered`, those of one shape in their order.
            mask: (B, N) True at blocks.
            memory: (B, C, d) of `encode`; or (B / n, C, d), serving n consecutive rows each.
            estimate: (B, N, 6) last estimate of the clean poses, normalised; None if there is none yet,
                or the network takes none.
        """
        time = self.time_embedding(sinusoids(t.float(), self.config.width))  # (B, d)
        tokens = self.pose_embedding(poses) + self.shape_embedding(shapes.clamp(min=0))
        if self.config.ordered:
            tokens = tokens + self.rank_embedding(ranks(shapes))
        if estimate is not None and self.config.self_conditioning:
            tokens = tokens + self.estimate_embedding(estimate)
        if self.config.conditioning == "joint":
            tokens = self._joint(tokens + time[:, None], mask, memory)
        else:
            tokens = self._cross(tokens, time, mask, memory)
        return self.head(tokens)

    def _joint(self, blocks: Tensor, mask: Tensor, memory: Tensor) -> Tensor:
        memory = memory.repeat_interleave(len(blocks) // len(memory), 0)
        tokens = torch.cat([blocks * mask[..., None], memory], dim=1)  # (B, N + C, d), zero vectors as padding
        seen = F.pad(mask, (0, memory.shape[1]), value=True) if self.config.mask_padding else None
        for layer in self.layers:
            tokens = layer(tokens, seen)
        return tokens[:, : blocks.shape[1]]

    def _cross(self, blocks: Tensor, time: Tensor, mask: Tensor, memory: Tensor) -> Tensor:
        seen = None if bool(mask.all()) else mask
        for layer in self.layers:
            blocks = layer(blocks, time, seen, memory)
        return self.final_norm(blocks)


class Patches(nn.Module):
    """Silhouette to tokens: each patch through a two-layer MLP, plus sinusoidal positions."""

    def __init__(self, patch: int, stride: int, image_size: int, width: int) -> None:
        super().__init__()
        if patch > image_size or (image_size - patch) % stride:
            raise StackgenError(
                f"denoiser: patches of {patch} pixels every {stride} do not tile {image_size} pixels;"
                " set patch and stride so that image_size - patch is a multiple of stride"
            )
        self.patch, self.stride = patch, stride
        count = ((image_size - patch) // stride + 1) ** 2
        self.mlp = mlp(patch * patch, width, width)
        self.register_buffer("positions", sinusoids(torch.arange(count).float(), width), persistent=False)

    def forward(self, silhouette: Tensor) -> Tensor:
        """(B, H, W) to (B, C, d), row by row from the top left."""
        patches = silhouette.unfold(1, self.patch, self.stride).unfold(2, self.patch, self.stride)  # (B, r, c, p, p)
        return self.mlp(patches.flatten(3).flatten(1, 2)) + self.positions


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward; post-norm as in Vaswani et al. 2017, or pre-norm."""

    def __init__(self, config: DenoiserConfig, norm_first: bool = False) -> None:
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
    """Self-attention, attention to the memory and feed-forward, each modulated by time (adaLN-zero)."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__()
        d = config.width
        self.attention = Attention(d, config.heads)
        self.memory_attention = MemoryAttention(d, config.heads)
        self.feedforward = mlp(d, config.feedforward, d)
        self.norm = nn.LayerNorm(d, elementwise_affine=False)
        self.modulation = nn.Linear(d, 9 * d)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, x: Tensor, time: Tensor, seen: Tensor | None, memory: Tensor) -> Tensor:
        """Blocks (B, N, d), time (B, d), memory (B or a divisor of it, C, d) to (B, N, d)."""
        m = self.modulation(F.silu(time))[:, None].chunk(9, dim=-1)  # 9 x (B, 1, d)
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


def ranks(shapes: Tensor) -> Tensor:
    """How many blocks of its own shape stand before each block: (B, N) to (B, N).

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


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a ReLU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def sinusoids(positions: Tensor, width: int) -> Tensor:
    """(M,) positions to (M, width) sines and cosines of geometrically spaced wavelengths (Vaswani et al. 2017)."""
    half = width // 2
    rates = torch.exp(-math.log(10_000) * torch.arange(half, device=positions.device) / half)
    angles = positions[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
