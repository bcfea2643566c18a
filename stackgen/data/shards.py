"""Shards: stacks in WebDataset tars, a manifest beside them.

A dataset is a folder with `dataset.json` and `<split>-<number>.tar`. A sample is four members that
share a key and that numpy reads: `.shapes.npy` uint8 (k,), `.poses.npy` float32 (k, 6),
`.silhouette.npy` uint8 (H, W/8) (the front silhouette, `np.packbits` along the rows) and
`.meta.json`. Nothing in a shard depends on when or where it was written: equal stacks, equal bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import tarfile
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.stack import Stack
from stackgen.world import Catalogue, Grid, Mask

FORMAT = "stackgen.dataset/1"
Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
PROGRESS, PARTS = "progress", "parts"
"""Folders within a dataset that is not complete yet: the record of whole shards, and what is drawn from."""
_GOLDEN = 0.6180339887498949
_SHARD_NAME = re.compile(rf"(?:{'|'.join(SPLITS)})-(\d+)\.tar")


def split_of(number: int, validation: float, test: float, offset: float = 0.0) -> Split:
    """The split of the `number`-th part of a dataset; shares are met evenly along the way (multiples of the
    golden ratio).

    Args:
        number: From 0 on.
        validation, test: Shares of these splits; what is left is for training.
        offset: In [0, 1): another one, another choice.

    >>> [split_of(number, 0.1, 0.2) for number in range(6)]
    ['validation', 'train', 'test', 'train', 'train', 'validation']
    """
    place = (number * _GOLDEN + offset) % 1
    if place < validation:
        return "validation"
    return "test" if place < validation + test else "train"


@dataclass(frozen=True)
class Sample:
    """One stack of a dataset.

    Args:
        key: Unique in its dataset: template number and the blocks removed from it.
        shapes: (k,) indices into the catalogue.
        poses: (k, 6) [cell, rad], float32.
        silhouette: (H, W) front silhouette.
        meta: `template` (number), `layout` (its design as text), `removed` (block numbers).
    """

    key: str
    shapes: NDArray[np.uint8]
    poses: NDArray[np.float32]
    silhouette: Mask
    meta: dict[str, Any]

    def stack(self, catalogue: Catalogue) -> Stack:
        """The sample as a stack of a catalogue."""
        return Stack(self.shapes.astype(np.int64), self.poses.astype(np.float64), catalogue)


@dataclass(frozen=True)
class Manifest:
    """What `dataset.json` says of a dataset.

    Args:
        name: Of the configuration that made it.
        seed: Of the generator.
        catalogue, grid: The world of its stacks.
        max_blocks: N, the longest block list stored.
        physics: `Physics.to_json()` of the simulator that made it.
        settings: The generator's other settings.
        shards: For each file its name, SHA-256 and number of samples.
    """

    name: str
    seed: int
    catalogue: Catalogue
    grid: Grid
    max_blocks: int
    physics: dict[str, Any]
    settings: dict[str, Any]
    shards: tuple[dict[str, Any], ...] = field(default=())

    def count(self, split: Split) -> int:
        """Number of samples of a split."""
        return sum(shard["samples"] for shard in self.shards if shard["split"] == split)

    def paths(self, folder: Path, split: Split) -> list[Path]:
        """The shards of a split, in order."""
        return [folder / shard["file"] for shard in self.shards if shard["split"] == split]

    def samples(self, folder: Path, split: Split) -> Iterator[Sample]:
        """The samples of a split, in order, from shards whose checksums are right.

        Raises:
            StackgenError: If a shard is missing or is not the one that was written.
        """
        for shard in self.shards:
            if shard["split"] == split:
                yield from read_shard(folder / shard["file"], shard["sha256"])

    def to_json(self) -> dict[str, Any]:
        """Plain form, as stored."""
        return {
            "format": FORMAT,
            "name": self.name,
            "seed": self.seed,
            "catalogue": self.catalogue.to_json(),
            "grid": vars(self.grid),
            "max_blocks": self.max_blocks,
            "physics": self.physics,
            "settings": self.settings,
            "counts": {split: self.count(split) for split in SPLITS},
            "shards": list(self.shards),
        }

    @property
    def sha256(self) -> str:
        """Hash of the whole manifest, and so of the dataset: it names every shard's own."""
        return manifest_sha256(self.to_json())

    def save(self, folder: Path) -> None:
        """Write `dataset.json`, whole or not at all."""
        write_atomically(folder / "dataset.json", (json.dumps(self.to_json(), indent=1) + "\n").encode())

    @staticmethod
    def load(folder: str | Path) -> Manifest:
        """Read a dataset's manifest.

        Raises:
            StackgenError: If there is none, or it is not one of ours.
        """
        path = Path(folder) / "dataset.json"
        try:
            return Manifest.parse(path.read_bytes(), path)
        except FileNotFoundError as error:
            raise StackgenError(
                f"no dataset at {folder}: there is no dataset.json in it; make one with `stackgen generate`"
            ) from error
        except OSError as error:
            raise StackgenError(f"{path} cannot be read: {error.strerror or error}") from error

    @staticmethod
    def parse(content: bytes, path: str | Path) -> Manifest:
        """A manifest from the bytes of its file; `path` is what errors call it.

        Raises:
            StackgenError: If it is not one of ours.
        """
        try:
            data = json.loads(content)
        except ValueError as error:
            raise StackgenError(f"{path} is not readable as JSON: {error}") from error
        return Manifest.from_json(data, path)

    @staticmethod
    def from_json(data: Any, path: str | Path = "manifest") -> Manifest:
        """Inverse of :meth:`to_json`; `path` is what errors call it.

        Raises:
            StackgenError: If it is not the plain form of one of ours.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise StackgenError(f"{path} is not a {FORMAT} manifest")
        try:
            return Manifest(
                data["name"],
                data["seed"],
                Catalogue.from_json(data["catalogue"]),
                Grid(**data["grid"]),
                data["max_blocks"],
                data["physics"],
                data["settings"],
                tuple(data["shards"]),
            )
        except (KeyError, TypeError) as error:
            raise StackgenError(f"{path} is damaged: {error!r}") from error


def manifest_sha256(manifest: Mapping[str, Any]) -> str:
    """Hash of a manifest in its plain form."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def encode_shard(samples: Iterable[Sample]) -> bytes:
    """The tar of some samples: equal stacks, equal bytes."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for sample in samples:
            for suffix, content in _members(sample):
                info = tarfile.TarInfo(f"{sample.key}.{suffix}")
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def shard_entry(name: str, content: bytes, samples: int) -> dict[str, Any]:
    """What a manifest says of a shard.

    >>> shard_entry("train-000003.tar", b"", 0)["split"]
    'train'
    """
    sha256 = hashlib.sha256(content).hexdigest()
    return {"file": name, "split": name.rpartition("-")[0], "samples": samples, "sha256": sha256}


def shard_number(name: str) -> int:
    """Number of a shard by its file name.

    Raises:
        StackgenError: If that is not how shards are called.

    >>> shard_number("train-000003.tar")
    3
    """
    match = _SHARD_NAME.fullmatch(name)
    if match is None:
        raise StackgenError(f"{name!r} is not the name of a shard: they are called SPLIT-NUMBER.tar")
    return int(match[1])


def write_shard(path: Path, samples: Iterable[Sample]) -> dict[str, Any]:
    """Write one tar; returns its manifest entry (file, split, samples, sha256)."""
    those = list(samples)
    content = encode_shard(those)
    write_atomically(path, content)
    return shard_entry(path.name, content, len(those))


def is_whole(path: Path, sha256: str) -> bool:
    """Whether a shard is there and has the checksum that the manifest names; its samples are not decoded."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == sha256
    except FileNotFoundError:
        return False


def read_shard(path: str | Path, sha256: str | None = None) -> Iterator[Sample]:
    """The samples of one tar, in order.

    Args:
        path: Of the tar.
        sha256: What its checksum must be, as the manifest has it; None trusts the file.

    Raises:
        StackgenError: If the file is missing, truncated or not a shard, or has another checksum.
    """
    try:
        content = Path(path).read_bytes()
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise ValueError("its checksum is not the one in dataset.json (`stackgen dataset repair` makes it again)")
        yield from iterate_shard(content)
    except (OSError, tarfile.TarError, KeyError, ValueError, EOFError, tokenize.TokenError) as error:
        raise StackgenError(f"shard {path} is missing or damaged: {' '.join(str(error).split())}") from error


def iterate_shard(content: bytes) -> Iterator[Sample]:
    """The samples of a tar, from its bytes.

    Raises:
        tarfile.TarError, KeyError, ValueError, EOFError, tokenize.TokenError: As damaged bytes may have it.
    """
    members: dict[str, bytes] = {}
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
        for member in tar:
            key, _, suffix = member.name.partition(".")
            file = tar.extractfile(member)
            if file is None:
                continue
            members[suffix] = file.read()
            if len(members) == 4:
                yield decode_sample(key, members)
                members = {}
        # Python's reader takes a damaged header, or no end at all, for the end of the archive.
        if members or len(content) < tar.offset + 2 * tarfile.BLOCKSIZE or any(content[tar.offset :]):
            raise ValueError("it ends too early")


def decode_sample(key: str, members: dict[str, bytes]) -> Sample:
    """A sample from the contents of its members, by suffix.

    Raises:
        KeyError: If a member is missing.
        ValueError: If one is not what the format says.
    """
    arrays = {
        name: np.load(io.BytesIO(members[f"{name}.npy"]), allow_pickle=False)
        for name in ("shapes", "poses", "silhouette")
    }
    shapes, poses, meta = arrays["shapes"], arrays["poses"], json.loads(members["meta.json"])
    picture = np.unpackbits(arrays["silhouette"], axis=1).astype(bool)
    if shapes.dtype != np.uint8 or shapes.ndim != 1 or poses.dtype != np.float32 or poses.shape != (len(shapes), 6):
        raise ValueError(f"sample {key}: shapes {shapes.shape} do not fit poses {poses.shape}")
    if not isinstance(meta, dict):
        raise ValueError(f"sample {key}: meta.json is not an object")
    return Sample(key, shapes, poses, picture, meta)


def _members(sample: Sample) -> Iterator[tuple[str, bytes]]:
    yield "meta.json", json.dumps(sample.meta, sort_keys=True).encode()
    yield "poses.npy", _npy(sample.poses.astype("<f4"))
    yield "shapes.npy", _npy(sample.shapes.astype(np.uint8))
    yield "silhouette.npy", _npy(np.packbits(sample.silhouette, axis=1))


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
