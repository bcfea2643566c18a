"""Decoding of shards to arrays, a whole shard at once: some 25 times as fast as sample by sample.

The manifest says what a sample must be; one that is not so is left out and named, never silently. The checksum
of the whole shard must have been compared before: a sample that is altered and still one is not noticed here.

Legend: M stacks, N blocks at most, k blocks of one stack, H x W pixels.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.data.arrays import FIELDS, PADDING, StackArrays
from stackgen.data.shards import PackedSample, Sample, find_samples
from stackgen.data.sources import Shard, is_remote
from stackgen.errors import StackgenError, warn
from stackgen.world import World

NAMED = 10
"""Broken samples that are named one by one; of more there is only the number."""

LONG = 500_000
"""Samples from which on reading them shows its progress: some ten seconds."""

_POSE = 6


def bytes_per_sample(world: World) -> int:
    """Compute the memory of a stack in :class:`StackArrays`, its cached block list and length included [byte]."""
    pixels = world.grid.image_size**2
    return world.max_blocks * (1 + 4 * _POSE) + pixels // 8 + 8 * (len(world.catalogue) + 2)


@dataclass(frozen=True)
class Decoded:
    """The readable samples of one shard.

    Args:
        stacks: M of them.
        positions: (M,) int64, their places among all samples of the shard, ascending.
        keys: Their M names.
        broken: Key and fault of each broken sample, as text.
    """

    stacks: StackArrays
    positions: NDArray[np.int64]
    keys: tuple[str, ...]
    broken: tuple[str, ...] = ()


def decode_shard(content: bytes, world: World) -> Decoded:
    """Decode the samples of a tar; each is checked by itself, so that a broken one costs no other."""
    keys, rows, positions, broken = [], [], [], []
    for position, packed in enumerate(find_samples(content)):
        try:
            rows.append(_row(content, packed, world))
        except Exception as error:  # noqa: BLE001 - whatever strange bytes may lead to
            broken.append(f"{packed.key}: {_fault(error)}")
        else:
            keys.append(packed.key)
            positions.append(position)
    real, shapes, poses, silhouettes, template = _assemble(rows, world)
    beyond = ((shapes >= len(world.catalogue)) & real).any(1)
    sound = np.isfinite(poses).all((1, 2)) & ~beyond
    broken += [f"{keys[i]}: poses that are not finite, or shapes beyond the catalogue" for i in np.flatnonzero(~sound)]
    columns, where = (shapes, poses, silhouettes, template), np.array(positions, np.int64)
    if not sound.all():
        columns, where = tuple(column[sound] for column in columns), where[sound]
        keys = [keys[i] for i in np.flatnonzero(sound)]
    return Decoded(StackArrays(*columns, num_shapes=len(world.catalogue)), where, tuple(keys), tuple(broken))


_Row = tuple[bytes, bytes, bytes, int]
"""Bytes of shapes, poses and silhouette of a sample, and the number of its template."""


def _assemble(rows: list[_Row], world: World) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Say which slots hold blocks, and make the arrays of some rows."""
    shapes, poses, silhouettes, template = zip(*rows, strict=True) if rows else ((), (), (), ())
    m, n = len(rows), world.max_blocks
    real = np.arange(n) < np.array([len(part) for part in shapes], np.int64)[:, None]
    padded, placed = np.full((m, n), PADDING, np.uint8), np.zeros((m, n, _POSE), np.float32)
    padded[real] = np.frombuffer(b"".join(shapes), np.uint8)
    placed[real] = np.frombuffer(b"".join(poses), "<f4").reshape(-1, _POSE)
    packed = np.frombuffer(bytearray().join(silhouettes), np.uint8).reshape(m, world.grid.image_size**2 // 8)
    return real, padded, placed, packed, np.array(template, np.int64)


def _row(content: bytes, packed: PackedSample, world: World) -> _Row:
    """Read one sample.

    Raises:
        Exception: If a part is missing or not what the format says.
    """
    packed.check()
    members = packed.members
    shape, shapes = _npy(content[members["shapes.npy"]], np.dtype(np.uint8))
    if len(shape) != 1 or not 1 <= shape[0] <= world.max_blocks:
        raise ValueError(f"shapes of size {shape}, not of 1 to {world.max_blocks} blocks")
    size, poses = _npy(content[members["poses.npy"]], np.dtype("<f4"))
    if size != (*shape, _POSE):
        raise ValueError(f"poses of size {size} for {shape[0]} blocks")
    pixels, silhouette = _npy(content[members["silhouette.npy"]], np.dtype(np.uint8))
    if pixels != (world.grid.image_size, world.grid.image_size // 8):
        raise ValueError(f"a packed silhouette of size {pixels}, not of {world.grid.image_size} pixels square")
    meta = json.loads(content[members["meta.json"]])
    template, layout = meta["template"], meta.get("layout", "")
    if not isinstance(template, int) or not -(2**63) <= template < 2**63:
        raise ValueError(f"template {template!r:.40}")
    if not isinstance(layout, str):
        raise ValueError(f"layout {layout!r:.40}")
    return shapes, poses, silhouette, template


def _npy(content: bytes, kind: np.dtype) -> tuple[tuple[int, ...], bytes]:
    """Read shape and plain bytes of an array of numpy's format."""
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


def _fault(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"no {error.args[0]}"
    return " ".join(str(error).split()) or type(error).__name__


# What could not be read: named when it is first met, counted, and reported.


@dataclass(frozen=True)
class Skipped:
    """Samples that could not be read.

    Args:
        what: Line that names the shard or the sample, and says what is wrong.
        samples: How many there are.
    """

    what: str
    samples: int = 1


class SkipLog:
    """Counts skipped samples, each only once between two reports however often it is met.

    Args:
        where: Label in every line, if not empty; tells processes apart.
    """

    def __init__(self, where: str = "") -> None:
        self._label = f"data{' ' if where else ''}{where}"
        self._named: set[Skipped] = set()
        self._lately: set[Skipped] = set()

    def add(self, skipped: Iterable[Skipped]) -> None:
        """Count some; name those that were not met before."""
        for item in skipped:
            self._lately.add(item)
            if item not in self._named:
                self._named.add(item)
                if item.samples > 1 or len(self._named) <= NAMED:
                    warn(f"{self._label}: {item.what}")

    def report(self, within: str) -> None:
        """Say how many samples were skipped since the last report, if any were."""
        count = sum(item.samples for item in self._lately)
        if count:
            warn(f"{self._label}: samples skipped in {within}: {count}")
        self._lately.clear()


def read_decoded(shard: Shard, world: World) -> tuple[Decoded, list[Skipped]]:
    """Decode a shard; a broken sample is skipped, and the whole shard if its checksum is wrong."""
    try:
        content = shard.read()
    except StackgenError as error:
        skipped = Skipped(f"{error}; its {shard.samples} samples are skipped", shard.samples)
        return decode_shard(b"", world), [skipped]
    return _decode_sound(content, shard, world)


def read_samples(shard: Shard, world: World, log: SkipLog) -> list[Sample]:
    """Read the samples of a shard one by one, with their metadata: those that :func:`decode_shard` takes, no others.

    Raises:
        StackgenError: If the shard is missing or is not the one that was written.
    """
    content = shard.read()
    decoded, skipped = _decode_sound(content, shard, world)
    log.add(skipped)
    packed = find_samples(content)
    return [packed[position].decode(content) for position in decoded.positions]


def decode_shards(shards: Sequence[Shard], world: World, log: SkipLog) -> StackArrays:
    """Decode all samples of some shards into one set of arrays.

    Args:
        shards: The shards; their order is kept.
        world: World of the dataset.
        log: Counts and names the broken samples.

    Raises:
        StackgenError: If a shard is damaged, which is found before anything was begun; or if there is no sample.
    """
    total, count = sum(shard.samples for shard in shards), 0
    # Not in parts that are then put together: that would take twice the memory.
    columns: dict[str, NDArray[Any]] = {
        "shapes": np.empty((total, world.max_blocks), np.uint8),
        "poses": np.empty((total, world.max_blocks, _POSE), np.float32),
        "silhouettes": np.empty((total, world.grid.image_size**2 // 8), np.uint8),
        "template": np.empty(total, np.int64),
    }
    for shard in _tracked(shards):
        decoded, skipped = _decode_sound(shard.read(), shard, world)
        log.add(skipped)
        stop = count + len(decoded.stacks)
        if stop > total:
            raise StackgenError(f"shard {shard.path} holds more samples than dataset.json says")
        for name in FIELDS:
            columns[name][count:stop] = getattr(decoded.stacks, name)
        count = stop
    if not count:
        raise StackgenError("dataset: the shards hold no sample")
    return StackArrays(**{name: columns[name][:count] for name in FIELDS}, num_shapes=len(world.catalogue))


def _decode_sound(content: bytes, shard: Shard, world: World) -> tuple[Decoded, list[Skipped]]:
    """Decode the bytes of a shard whose checksum is right; says which samples in it are broken or absent."""
    decoded = decode_shard(content, world)
    skipped = [Skipped(f"skipped a broken sample of {shard.name}, {fault}") for fault in decoded.broken]
    absent = shard.samples - len(decoded.stacks) - len(skipped)
    if absent > 0:
        skipped.append(Skipped(f"{shard.name} lacks {absent} of the samples that dataset.json says it has", absent))
    return decoded, skipped


def _tracked(shards: Sequence[Shard]) -> Iterable[Shard]:
    """Show a progress bar if reading the shards takes a while."""
    if sum(shard.samples for shard in shards) < LONG and not is_remote(shards[0].path):
        return shards
    from rich.console import Console  # only where it is needed
    from rich.progress import track

    screen = Console(stderr=True)
    return track(shards, "reading shards", console=screen, transient=True, disable=not screen.is_terminal)
