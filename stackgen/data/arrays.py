"""Stacks as a few arrays, and the batches that are gathered from them: what training reads.

Legend: M stacks, N blocks at most, S shapes, H x W pixels, B stacks in a batch.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from stackgen.data.shards import Sample
from stackgen.errors import StackgenError
from stackgen.world import PAPER_WORLD, World

PADDING = 255
"""Shape index of the slots after a stack's last block."""

FIELDS = ("shapes", "poses", "silhouettes", "template")
"""Names of the arrays, here and in the compact file."""

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class StackArrays:
    """M stacks, padded to N blocks.

    Args:
        shapes: (M, N) uint8 indices into the catalogue, 255 after the last block.
        poses: (M, N, 6) float32 [cell, rad], zero after the last block.
        silhouettes: (M, H * W / 8) uint8, front silhouettes packed row by row, H = W.
        template: (M,) int64, the template each stack was deconstructed from.
        num_shapes: S, the number of shapes in the catalogue.

    Raises:
        StackgenError: If the arrays do not fit each other.
    """

    shapes: NDArray[np.uint8]
    poses: NDArray[np.float32]
    silhouettes: NDArray[np.uint8]
    template: NDArray[np.int64]
    num_shapes: int

    def __post_init__(self) -> None:
        kinds = {"shapes": np.uint8, "poses": np.float32, "silhouettes": np.uint8, "template": np.int64}
        for name, kind in kinds.items():
            if getattr(self, name).dtype != kind:
                raise StackgenError(f"dataset: {name} must be {np.dtype(kind)}, got {getattr(self, name).dtype}")
        m, n = self.shapes.shape if self.shapes.ndim == 2 else (-1, -1)
        fits = self.poses.shape == (m, n, 6) and self.silhouettes.ndim == 2 and self.template.shape == (m,)
        if not fits or len(self.silhouettes) != m or math.isqrt(8 * self.silhouettes.shape[1]) % 8:
            sizes = [getattr(self, name).shape for name in kinds]
            raise StackgenError(f"dataset: arrays must be (M, N), (M, N, 6), (M, H*W/8), (M,), got {sizes}")
        real = self.shapes != PADDING
        if (self.shapes[real] >= self.num_shapes).any() or (np.diff(real.astype(np.int8), axis=1) > 0).any():
            raise StackgenError(f"dataset: shape indices must be 0..{self.num_shapes - 1}, then {PADDING} to the end")
        if not np.isfinite(self.poses).all():
            raise StackgenError("dataset: poses must be finite numbers")

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def image_size(self) -> int:
        """H = W [pixel]."""
        return math.isqrt(8 * self.silhouettes.shape[1])

    @cached_property
    def lengths(self) -> NDArray[np.int64]:
        """(M,) number of blocks k of each stack."""
        return np.count_nonzero(self.shapes != PADDING, axis=1).astype(np.int64)

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """(M, S) block list of each stack."""
        return np.stack([np.count_nonzero(self.shapes == s, axis=1) for s in range(self.num_shapes)], axis=1)

    def images(self, indices: ArrayLike | slice = slice(None)) -> NDArray[np.bool_]:
        """Unpack the front silhouettes (B, H, W) of some stacks."""
        packed = self.silhouettes[indices if isinstance(indices, slice) else np.asarray(indices)]
        return np.unpackbits(packed, axis=1).view(bool).reshape(-1, self.image_size, self.image_size)

    def select(self, indices: ArrayLike | slice) -> StackArrays:
        """Select the stacks at `indices`, in that order."""
        i = indices if isinstance(indices, slice) else np.asarray(indices)
        return StackArrays(self.shapes[i], self.poses[i], self.silhouettes[i], self.template[i], self.num_shapes)

    def pose_statistics(self, mirror: bool = False) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compute mean (6,) and standard deviation (6,) of the poses of all blocks [cell, rad].

        Args:
            mirror: Whether to count their mirror images as well.
        """
        real = self.poses[self.shapes != PADDING].astype(np.float64)
        if mirror:
            real = np.concatenate([real, real * _MIRROR.numpy()])
        return real.mean(axis=0).astype(np.float32), real.std(axis=0).astype(np.float32)

    @cached_property
    def tensors(self) -> StackTensors:
        """The same stacks as tensors that share their memory."""
        return StackTensors.of(self)

    def batch(self, indices: ArrayLike) -> Batch:
        """Gather the stacks at `indices` (B,) into a batch, padded to N; see :meth:`StackTensors.batch`."""
        return self.tensors.batch(torch.as_tensor(np.asarray(indices, dtype=np.int64)))

    @staticmethod
    def concatenate(parts: Sequence[StackArrays]) -> StackArrays:
        """Put several together, at least one, in the order given."""
        if len(parts) == 1:
            return parts[0]
        fields = {name: np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS}
        return StackArrays(**fields, num_shapes=parts[0].num_shapes)

    @staticmethod
    def from_samples(samples: Iterable[Sample], world: World) -> StackArrays:
        """Put samples of a world together, in the order given.

        Raises:
            StackgenError: If there is no sample, or one that has too many blocks.
        """
        shapes, poses, silhouettes, template = [], [], [], []
        for sample in samples:
            free = world.max_blocks - len(sample.shapes)
            if free < 0:
                raise StackgenError(f"dataset: sample {sample.key} has more than {world.max_blocks} blocks")
            shapes.append(np.pad(sample.shapes.astype(np.uint8), (0, free), constant_values=PADDING))
            poses.append(np.pad(sample.poses.astype(np.float32), ((0, free), (0, 0))))
            silhouettes.append(np.packbits(sample.silhouette))
            template.append(int(sample.meta["template"]))
        if not shapes:
            raise StackgenError("dataset: the shards hold no sample")
        columns = np.stack(shapes), np.stack(poses), np.stack(silhouettes), np.array(template, np.int64)
        return StackArrays(*columns, num_shapes=len(world.catalogue))


class Buffers:
    """Memory for float pictures on the CPU, used again once no batch holds it.

    64 MB a batch of 4096: new memory from the system costs more than filling it.

    Args:
        most: Number of buffers kept; beyond that batches get fresh memory.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._kept: deque[NDArray[np.float32]] = deque()

    def take(self, size: int) -> Tensor:
        """Give (size,) float32 of any content."""
        for _ in range(len(self._kept)):
            buffer = self._kept.popleft()
            free = sys.getrefcount(buffer) == 2  # by this name and as the argument; a tensor's storage is a third
            if free and len(buffer) < size:
                continue  # too small by now: let it go
            self._kept.append(buffer)
            if free:
                return torch.from_numpy(buffer[:size])
        # numpy asks for huge pages: half the time of torch's fresh memory
        buffer = np.empty(size, np.float32)
        if len(self._kept) < self._most:
            self._kept.append(buffer)
        return torch.from_numpy(buffer[:size])


_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
# 8 pixels of each byte: a look-up is three times as fast as shifting bits.
_PIXELS = torch.from_numpy(_BITS.astype(np.float32))
_REVERSED = torch.from_numpy(np.packbits(_BITS[:, ::-1], axis=1)[:, 0])  # the bits of each byte from behind
_MIRROR = torch.tensor([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True)
class StackTensors:
    """A split as tensors on one device, from which batches are gathered without a loop.

    Args:
        shapes: (M, N) int8, -1 after the last block.
        poses: (M, N, 6) float32.
        silhouettes: (M, H, W / 8) uint8.
        counts: (M, S) int64.
        template: (M,) int64.
        buffers: For the pictures of its batches.
    """

    shapes: Tensor
    poses: Tensor
    silhouettes: Tensor
    counts: Tensor
    template: Tensor
    buffers: Buffers = field(default_factory=Buffers, repr=False, compare=False)

    @staticmethod
    def of(arrays: StackArrays, buffers: Buffers | None = None) -> StackTensors:
        """Make tensors that share the arrays' memory."""
        parts = {
            "shapes": arrays.shapes.view(np.int8),
            "poses": arrays.poses,
            "silhouettes": arrays.silhouettes.reshape(len(arrays), arrays.image_size, arrays.image_size // 8),
            "counts": arrays.counts,
            "template": arrays.template,
        }
        tensors = {name: torch.from_numpy(np.require(part, requirements=["C", "W"])) for name, part in parts.items()}
        return StackTensors(**tensors, buffers=buffers or Buffers())

    def to(self, device: torch.device | str) -> StackTensors:
        """Move the tensors to another device."""
        names = ("shapes", "poses", "silhouettes", "counts", "template")
        return StackTensors(**{name: getattr(self, name).to(device) for name in names}, buffers=self.buffers)

    def batch(self, indices: Tensor, mirrored: Tensor | None = None, max_blocks: int | None = None) -> Batch:
        """Gather a batch.

        Args:
            indices: (B,) int64.
            mirrored: (B,) bool, which stacks to reflect at x = 0.
            max_blocks: Trim the padding to this many slots.

        Returns:
            `shapes` (B, N) int64 with -1 for padding, `poses` (B, N, 6) float32 [cell, rad], `mask`
            (B, N) bool, `silhouette` (B, H, W) float32, `counts` (B, S) int64, `template` (B,) int64.
        """
        indices = indices.to(self.shapes.device)
        shapes = self.shapes.index_select(0, indices)[:, :max_blocks].long()
        poses = self.poses.index_select(0, indices)[:, :max_blocks]
        packed = self.silhouettes.index_select(0, indices)
        if mirrored is not None:
            mirrored = mirrored.to(indices.device)
            signs = torch.where(mirrored[:, None], _MIRROR.to(indices.device), 1.0)
            poses = poses * signs[:, None, :]
            chosen = mirrored.nonzero().squeeze(1)
            backwards = packed.index_select(0, chosen).flip(-1)
            packed.index_copy_(0, chosen, _look_up(_REVERSED, backwards))
        return {
            "shapes": shapes,
            "poses": poses,
            "mask": shapes >= 0,
            "silhouette": self._unpack(packed),
            "counts": self.counts.index_select(0, indices),
            "template": self.template.index_select(0, indices),
        }

    def _unpack(self, packed: Tensor) -> Tensor:
        """Unpack (B, H, W / 8) bytes to (B, H, W) float32."""
        if packed.device.type == "cpu":
            out = self.buffers.take(8 * packed.numel()).view(-1, 8)
        else:
            out = torch.empty((packed.numel(), 8), device=packed.device)
        torch.index_select(_PIXELS.to(packed.device), 0, packed.reshape(-1).int(), out=out)
        return out.view(*packed.shape[:2], -1)


def _look_up(table: Tensor, bytes_: Tensor) -> Tensor:
    """Look each byte up in a table of 256 entries."""
    return table.to(bytes_.device).index_select(0, bytes_.reshape(-1).int()).view(bytes_.shape)


def to_batch(samples: Sequence[Sample], world: World = PAPER_WORLD) -> Batch:
    """Collate decoded samples into one batch: `wds.WebDataset(urls).map(decode).batched(64, collation_fn=to_batch)`.

    Args:
        samples: B of them, as :func:`stackgen.data.shards.decode` gives them.
        world: World of the dataset; `functools.partial(to_batch, world=dataset.world)` for another than the paper's.

    Returns:
        The same batch as from :class:`stackgen.data.datamodule.StackDataModule`; see :meth:`StackTensors.batch`.

    Raises:
        StackgenError: If a sample does not fit the world.
    """
    arrays = StackArrays.from_samples(samples, world)
    return arrays.batch(np.arange(len(arrays)))
