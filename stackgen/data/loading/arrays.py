"""A split of a dataset as a few arrays: what training reads, and the compact file that travels.

Needs numpy and torch alone: no shard reader beyond our own, no simulator.

Legend: M stacks, N blocks at most, S shapes, H x W pixels, B stacks in a batch.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from stackgen.data.loading.buffers import Buffers
from stackgen.data.loading.decoding import PADDING, Decoded, Frame
from stackgen.data.loading.losses import Losses, decode_sound
from stackgen.data.shards import SPLITS, Sample
from stackgen.data.sources import Shard, is_folder, is_remote, load_manifest, read_bytes, shards_of
from stackgen.errors import StackgenError
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE

LONG = 500_000
"""Samples from which on reading them shows its progress: some ten seconds."""

FIELDS = ("shapes", "poses", "silhouettes", "template")
"""Of the arrays, and of the compact file."""

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class StackArrays:
    """M stacks, padded to N blocks.

    Args:
        shapes: (M, N) uint8 indices into the catalogue, 255 after the last block.
        poses: (M, N, 6) float32 [cell, rad], zero after the last block.
        silhouettes: (M, H * W / 8) uint8, front silhouettes packed row by row, H = W.
        template: (M,) int64, the template each stack was deconstructed from.
        num_shapes: S, the size of the catalogue.

    Raises:
        StackgenError: If the arrays do not fit each other.
    """

    shapes: NDArray[np.uint8]
    poses: NDArray[np.float32]
    silhouettes: NDArray[np.uint8]
    template: NDArray[np.int64]
    num_shapes: int = len(PAPER_CATALOGUE)

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
        """(B, H, W) front silhouettes of some stacks."""
        packed = self.silhouettes[indices if isinstance(indices, slice) else np.asarray(indices)]
        return np.unpackbits(packed, axis=1).view(bool).reshape(-1, self.image_size, self.image_size)

    def select(self, indices: ArrayLike | slice) -> StackArrays:
        """The stacks at `indices`, in that order."""
        i = indices if isinstance(indices, slice) else np.asarray(indices)
        return StackArrays(self.shapes[i], self.poses[i], self.silhouettes[i], self.template[i], self.num_shapes)

    def pose_statistics(self, mirror: bool = False) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean (6,) and standard deviation (6,) of the poses of all blocks [cell, rad].

        Args:
            mirror: Of the stacks together with their mirror images.
        """
        real = self.poses[self.shapes != PADDING].astype(np.float64)
        if mirror:
            real = np.concatenate([real, real * _MIRROR.numpy()])
        return real.mean(axis=0).astype(np.float32), real.std(axis=0).astype(np.float32)

    @cached_property
    def tensors(self) -> StackTensors:
        """The same as tensors, sharing memory."""
        return StackTensors.of(self)

    def batch(self, indices: ArrayLike) -> Batch:
        """The batch of the stacks at `indices` (B,), padded to N; see :meth:`StackTensors.batch`."""
        return self.tensors.batch(torch.as_tensor(np.asarray(indices, dtype=np.int64)))

    @staticmethod
    def of(decoded: Decoded, frame: Frame) -> StackArrays:
        """The samples of a shard."""
        parts = (decoded.shapes, decoded.poses, decoded.silhouettes, decoded.template)
        return StackArrays(*parts, frame.num_shapes)

    @staticmethod
    def concatenate(parts: Sequence[StackArrays]) -> StackArrays:
        """Several as one, in the order given; at least one."""
        if len(parts) == 1:
            return parts[0]
        fields = {name: np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS}
        return StackArrays(**fields, num_shapes=parts[0].num_shapes)

    @staticmethod
    def from_samples(
        samples: Iterable[Sample], max_blocks: int = MAX_BLOCKS, num_shapes: int = len(PAPER_CATALOGUE)
    ) -> StackArrays:
        """From samples, in the order given.

        Raises:
            StackgenError: If there is no sample, or one that has too many blocks.
        """
        shapes, poses, silhouettes, template = [], [], [], []
        for sample in samples:
            free = max_blocks - len(sample.shapes)
            if free < 0:
                raise StackgenError(f"dataset: sample {sample.key} has more than {max_blocks} blocks")
            shapes.append(np.pad(sample.shapes.astype(np.uint8), (0, free), constant_values=PADDING))
            poses.append(np.pad(sample.poses.astype(np.float32), ((0, free), (0, 0))))
            silhouettes.append(np.packbits(sample.silhouette))
            template.append(int(sample.meta["template"]))
        if not shapes:
            raise StackgenError("dataset: the shards hold no sample")
        return StackArrays(
            np.stack(shapes), np.stack(poses), np.stack(silhouettes), np.array(template, np.int64), num_shapes
        )


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
        """Tensors that share the arrays' memory."""
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
        """The same on another device."""
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
        """(B, H, W / 8) bytes to (B, H, W) float32."""
        if packed.device.type == "cpu":
            out = self.buffers.take(8 * packed.numel()).view(-1, 8)
        else:
            out = torch.empty((packed.numel(), 8), device=packed.device)
        torch.index_select(_PIXELS.to(packed.device), 0, packed.reshape(-1).int(), out=out)
        return out.view(*packed.shape[:2], -1)


def _look_up(table: Tensor, bytes_: Tensor) -> Tensor:
    """What a table of 256 entries says of each byte."""
    return table.to(bytes_.device).index_select(0, bytes_.reshape(-1).int()).view(bytes_.shape)


def save_npz(path: str | Path, splits: Mapping[str, StackArrays], manifest: Mapping) -> None:
    """Write a whole dataset as one compressed file of plain arrays.

    Args:
        path: Ends in `.npz`.
        splits: Any of train, validation, test; a split's place in that list is its number in the file.
        manifest: The dataset's manifest, as JSON allows.

    Raises:
        StackgenError: If there is nothing to write, or it cannot be written.
    """
    path = Path(path)
    names = [name for name in SPLITS if name in splits]
    if not names or len(names) != len(splits) or path.suffix != ".npz":
        raise StackgenError(f"compact dataset: {path} must end in .npz and hold some of {', '.join(SPLITS)}")
    parts: dict[str, Any] = {
        field: np.concatenate([getattr(splits[name], field) for name in names]) for field in FIELDS
    }
    parts["split"] = np.repeat(
        np.array([SPLITS.index(name) for name in names], np.uint8), [len(splits[name]) for name in names]
    )
    parts["manifest"] = np.array(json.dumps(manifest))
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(temporary, allow_pickle=False, **parts)
        os.replace(temporary, path)
    except OSError as error:
        raise StackgenError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def load_npz(path: str | Path) -> tuple[dict[str, StackArrays], dict]:
    """Inverse of :func:`save_npz`: the splits it holds, and the manifest.

    Raises:
        StackgenError: If the file is missing, broken, or not such a file.
    """
    if not is_remote(path) and not Path(path).exists():
        raise StackgenError(
            f"no dataset at {path}: `stackgen generate` makes a folder, `stackgen dataset export` a .npz of it"
        )
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as file:
            fields = {name: file[name] for name in FIELDS}
            split, manifest = file["split"], json.loads(str(file["manifest"]))
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise StackgenError(f"{path} is not a compact stackgen dataset: {_one_line(error)}") from error
    if not isinstance(manifest, dict) or split.shape != fields["template"].shape:
        raise StackgenError(f"{path} is not a compact stackgen dataset: manifest or split do not fit")
    catalogue = manifest.get("catalogue")
    everything = StackArrays(**fields, num_shapes=len(catalogue) if catalogue else len(PAPER_CATALOGUE))
    return {str(name): everything.select(split == i) for i, name in enumerate(SPLITS) if (split == i).any()}, manifest


def load_dataset(path: str | Path, splits: Iterable[str] = SPLITS) -> tuple[dict[str, StackArrays], dict]:
    """The splits asked for, as far as they exist, and the manifest, of a dataset folder or a compact file.

    Args:
        path: Local, or as :mod:`stackgen.data.sources` says.
        splits: Their names.

    Raises:
        StackgenError: If it is neither, has none of the splits, or a shard is damaged (the message names it).
    """
    wanted = tuple(splits)
    if is_folder(path):
        manifest, losses = load_manifest(path), Losses()
        shards = {str(name): shards_of(manifest, path, name) for name in SPLITS if name in wanted}
        found = {name: _fill(those, Frame.of(manifest), losses) for name, those in shards.items() if those}
        losses.report(str(path))
        facts = manifest.to_json()
    else:
        everything, facts = load_npz(path)
        found = {name: arrays for name, arrays in everything.items() if name in wanted}
    if not found:
        raise StackgenError(f"dataset {path} has no {' or '.join(wanted)} split")
    return found, facts


def _fill(shards: Sequence[Shard], frame: Frame, losses: Losses) -> StackArrays:
    """All samples of some shards; damage to one is an error, since it is found before anything was begun."""
    total, count = sum(shard.samples for shard in shards), 0
    # Not in parts that are then put together: that would take twice the memory.
    fields: dict[str, NDArray[Any]] = {
        "shapes": np.empty((total, frame.max_blocks), np.uint8),
        "poses": np.empty((total, frame.max_blocks, 6), np.float32),
        "silhouettes": np.empty((total, frame.image_size**2 // 8), np.uint8),
        "template": np.empty(total, np.int64),
    }
    for shard in _tracked(shards):
        decoded, lost = decode_sound(shard.read(), shard, frame)
        losses.add(lost)
        stop = count + len(decoded.positions)
        if stop > total:
            raise StackgenError(f"shard {shard.path} holds more samples than dataset.json says")
        for name, column in fields.items():
            column[count:stop] = getattr(decoded, name)
        count = stop
    if not count:
        raise StackgenError("dataset: the shards hold no sample")
    return StackArrays(**{name: column[:count] for name, column in fields.items()}, num_shapes=frame.num_shapes)


def _tracked(shards: Sequence[Shard]) -> Iterable[Shard]:
    """The shards, with a progress bar if reading them takes a while."""
    if sum(shard.samples for shard in shards) < LONG and not is_remote(shards[0].path):
        return shards
    from rich.console import Console  # only where it is needed
    from rich.progress import track

    screen = Console(stderr=True)
    return track(shards, "reading shards", console=screen, transient=True, disable=not screen.is_terminal)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
