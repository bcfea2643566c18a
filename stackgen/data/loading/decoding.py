"""The bytes of a shard to arrays at once, some twenty times as fast as sample by sample.

What a sample must be is said by the manifest; one that is not so is left out and named. The checksum
of the whole shard must have been compared before: what is altered and still a sample is not noticed here.

Legend: M stacks, N blocks at most, k blocks of one stack, H x W pixels.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stackgen.data.shards import Manifest

PADDING = 255
"""Shape index of the slots after a stack's last block."""

_BLOCK = 512  # bytes; a tar is headers and contents, each filled up to whole blocks
_REGULAR = b"0\0"  # types of members that are files
_POSE = 6


@dataclass(frozen=True)
class Frame:
    """What every sample of a dataset keeps within.

    Args:
        max_blocks: N.
        num_shapes: Size of the catalogue.
        image_size: H = W [pixel].
    """

    max_blocks: int
    num_shapes: int
    image_size: int

    @staticmethod
    def of(manifest: Manifest) -> Frame:
        """As a manifest says it."""
        return Frame(manifest.max_blocks, len(manifest.catalogue), manifest.grid.image_size)

    @property
    def bytes_per_sample(self) -> int:
        """Memory that a stack takes in :class:`StackArrays`, its cached block list and length included [byte]."""
        return self.max_blocks * (1 + 4 * _POSE) + self.image_size**2 // 8 + 8 * (self.num_shapes + 2)


@dataclass(frozen=True)
class Decoded:
    """The samples of one shard, padded to N blocks: the fields of :class:`stackgen.data.loading.arrays.StackArrays`.

    Args:
        shapes: (M, N) uint8.
        poses: (M, N, 6) float32.
        silhouettes: (M, H * W / 8) uint8.
        template: (M,) int64.
        positions: (M,) int64, their places among all samples of the shard, ascending.
        broken: Of those that are not as they should be key and fault, as text.
    """

    shapes: NDArray[np.uint8]
    poses: NDArray[np.float32]
    silhouettes: NDArray[np.uint8]
    template: NDArray[np.int64]
    positions: NDArray[np.int64]
    broken: tuple[str, ...] = ()


def decode_shard(content: bytes, frame: Frame) -> Decoded:
    """The samples of a tar.

    Each sample is checked by itself, so that a broken one costs no other.
    """
    keys, rows, positions, broken = [], [], [], []
    for position, (key, members) in enumerate(_samples(content)):
        try:
            rows.append(_row(content, members, frame))
        except Exception as error:  # noqa: BLE001 - whatever strange bytes may lead to
            broken.append(f"{key}: {_fault(error)}")
        else:
            keys.append(key)
            positions.append(position)
    shapes, poses, silhouettes, template = _assemble(rows, frame)
    beyond = ((shapes >= frame.num_shapes) & (shapes != PADDING)).any(1)
    sound = np.isfinite(poses).all((1, 2)) & ~beyond
    broken += [f"{keys[i]}: poses that are not finite, or shapes beyond the catalogue" for i in np.flatnonzero(~sound)]
    where = np.array(positions, np.int64)
    if sound.all():  # nearly always: no need to copy
        return Decoded(shapes, poses, silhouettes, template, where, tuple(broken))
    return Decoded(shapes[sound], poses[sound], silhouettes[sound], template[sound], where[sound], tuple(broken))


_Row = tuple[bytes, bytes, bytes, int]
"""Bytes of shapes, poses and silhouette of a sample, and the number of its template."""


def _assemble(rows: list[_Row], frame: Frame) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """The arrays of some rows."""
    shapes, poses, silhouettes, template = zip(*rows, strict=True) if rows else ((), (), (), ())
    m, n = len(rows), frame.max_blocks
    real = np.arange(n) < np.array([len(part) for part in shapes], np.int64)[:, None]
    padded, placed = np.full((m, n), PADDING, np.uint8), np.zeros((m, n, _POSE), np.float32)
    padded[real] = np.frombuffer(b"".join(shapes), np.uint8)
    placed[real] = np.frombuffer(b"".join(poses), "<f4").reshape(-1, _POSE)
    packed = np.frombuffer(bytearray().join(silhouettes), np.uint8).reshape(m, frame.image_size**2 // 8)
    return padded, placed, packed, np.array(template, np.int64)


def _row(content: bytes, members: dict[bytes, slice], frame: Frame) -> _Row:
    """One sample.

    Raises:
        Exception: If a part is missing or not what the format says.
    """
    shape, shapes = _npy(content[members[b"shapes.npy"]], np.dtype(np.uint8))
    if len(shape) != 1 or not 1 <= shape[0] <= frame.max_blocks:
        raise ValueError(f"shapes of size {shape}, not of 1 to {frame.max_blocks} blocks")
    size, poses = _npy(content[members[b"poses.npy"]], np.dtype("<f4"))
    if size != (*shape, _POSE):
        raise ValueError(f"poses of size {size} for {shape[0]} blocks")
    pixels, silhouette = _npy(content[members[b"silhouette.npy"]], np.dtype(np.uint8))
    if pixels != (frame.image_size, frame.image_size // 8):
        raise ValueError(f"a packed silhouette of size {pixels}, not of {frame.image_size} pixels square")
    template = json.loads(content[members[b"meta.json"]])["template"]
    if not isinstance(template, int) or not -(2**63) <= template < 2**63:
        raise ValueError(f"template {template!r:.40}")
    return shapes, poses, silhouette, template


def _npy(content: bytes, kind: np.dtype) -> tuple[tuple[int, ...], bytes]:
    """Shape and plain bytes of an array of numpy's format."""
    start = 10 + int.from_bytes(content[8:10], "little")
    shape, found = _npy_header(content[:start])
    expected = kind.itemsize
    for length in shape:
        expected *= length
    if found != kind or len(content) - start != expected:
        raise ValueError(f"an array {found} {shape} in {len(content) - start} bytes, not one of {kind}")
    return shape, content[start:]


@lru_cache(maxsize=256)  # the same few again and again
def _npy_header(header: bytes) -> tuple[tuple[int, ...], np.dtype]:
    if header[:8] != b"\x93NUMPY\x01\x00":
        raise ValueError("an array that is not in numpy's format 1.0")
    shape, fortran, kind = np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))
    if fortran:
        raise ValueError("an array in Fortran order")
    return shape, kind


def _samples(content: bytes) -> Iterator[tuple[str, dict[bytes, slice]]]:
    """Key and members of each sample: neighbours that share the part of their name before the first dot."""
    key, members = b"", dict[bytes, slice]()
    for name, place in _members(content):
        here, _, suffix = name.partition(b".")
        if here != key and members:
            yield key.decode(errors="replace"), members
            members = {}
        key = here
        members[suffix] = place
    if members:
        yield key.decode(errors="replace"), members


def _members(content: bytes) -> Iterator[tuple[bytes, slice]]:
    """Name and place of each file in a tar, up to the first header that is none."""
    at = 0
    while at + _BLOCK <= len(content) and content[at]:
        try:
            size = int(content[at + 124 : at + 136].strip(b" \0") or b"0", 8)
        except ValueError:
            return
        start = at + _BLOCK
        if content[at + 156] in _REGULAR:
            yield content[at : at + 100].rstrip(b"\0"), slice(start, start + size)
        at = start + -(-size // _BLOCK) * _BLOCK


def _fault(error: Exception) -> str:
    if isinstance(error, KeyError):
        name = error.args[0]
        return f"no {name.decode() if isinstance(name, bytes) else name}"
    return " ".join(str(error).split()) or type(error).__name__
