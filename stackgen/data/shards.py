"""Shards: stacks in WebDataset tars.

A dataset is a folder with `dataset.json` and `<split>-<number>.tar`. A sample is four members that
share a key and that numpy reads: `.shapes.npy` uint8 (k,), `.poses.npy` float32 (k, 6),
`.silhouette.npy` uint8 (H, W/8) (the front silhouette, `np.packbits` along the rows) and
`.meta.json`. Nothing in a shard depends on when or where it was written: equal stacks, equal bytes.

Shards that others wrote are read as the webdataset package reads them: neighbours that share a key are a sample,
and what belongs to no sample is ignored.
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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.data.manifest import ShardEntry, shard_entry
from stackgen.errors import StackgenError
from stackgen.io.arrays import read_npy
from stackgen.io.files import read_bytes, write_atomically
from stackgen.stack import Stack
from stackgen.world import Catalogue, Mask


@dataclass(frozen=True)
class Sample:
    """One stack of a dataset.

    Args:
        key: Name that is unique in its dataset: the template's number and the blocks removed from it.
        shapes: (k,) indices into the catalogue.
        poses: (k, 6) [cell, rad], float32.
        silhouette: (H, W) front silhouette.
        meta: `template` (number), `layout` (its design as text; the format's word), `removed` (block numbers).
    """

    key: str
    shapes: NDArray[np.uint8]
    poses: NDArray[np.float32]
    silhouette: Mask
    meta: dict[str, Any]

    def stack(self, catalogue: Catalogue) -> Stack:
        """Give the sample as a stack of a catalogue."""
        return Stack(self.shapes.astype(np.int64), self.poses.astype(np.float64), catalogue)


def decode(members: Mapping[str, Any]) -> Sample:
    """Decode one sample as webdataset hands it over: `wds.WebDataset(urls).map(decode)`.

    Args:
        members: Bytes of each member by its suffix (`shapes.npy`, ...), and the sample's `__key__`.

    Raises:
        KeyError: If a member is missing.
        ValueError: If a member is not what the format says.
    """
    key = str(members["__key__"])
    shapes, poses, packed = (read_npy(members[f"{name}.npy"]) for name in ("shapes", "poses", "silhouette"))
    meta, picture = json.loads(members["meta.json"]), np.unpackbits(packed, axis=1).astype(bool)
    if shapes.dtype != np.uint8 or shapes.ndim != 1 or poses.dtype != np.float32 or poses.shape != (len(shapes), 6):
        raise ValueError(f"sample {key}: shapes {shapes.shape} do not fit poses {poses.shape}")
    if not isinstance(meta, dict):
        raise ValueError(f"sample {key}: meta.json is not an object")
    return Sample(key, shapes, poses, picture, meta)


def encode_shard(samples: Iterable[Sample]) -> bytes:
    """Write the tar of some samples: equal stacks, equal bytes."""
    import webdataset  # loads torch, which those who only read manifests do without

    buffer = io.BytesIO()
    with webdataset.TarWriter(buffer, user="", group="", mode=0o644, mtime=0, encoder=False) as tar:
        for sample in samples:
            tar.write({"__key__": sample.key, **_members(sample)})
    return buffer.getvalue()


def write_shard(path: Path, samples: Iterable[Sample]) -> ShardEntry:
    """Write one tar; answer its entry in the manifest."""
    those = list(samples)
    content = encode_shard(those)
    write_atomically(path, content)
    return shard_entry(path.name, content, len(those))


def is_whole(path: Path, sha256: str) -> bool:
    """Tell whether a shard is there and has the checksum that the manifest names; samples are not decoded."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return False
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == sha256
    except FileNotFoundError:
        return False


def read_shard(path: str | Path, sha256: str | None = None) -> Iterator[Sample]:
    """Read the samples of one tar, in order.

    Args:
        path: The tar.
        sha256: Checksum that the manifest names; None trusts the file.

    Raises:
        StackgenError: If the file is missing, truncated or not a shard, or has another checksum.
    """
    try:
        content = read_bytes(path)
        if compressed := compression_of(content):
            raise ValueError(f"it is compressed with {compressed}, and a shard is a plain tar")
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise ValueError("its checksum is not the one in dataset.json (`stackgen dataset repair` makes it again)")
        yield from iterate_shard(content)
    except (OSError, tarfile.TarError, KeyError, ValueError, EOFError, tokenize.TokenError) as error:
        raise StackgenError(f"shard {path} is missing or damaged: {' '.join(str(error).split())}") from error


def iterate_shard(content: bytes) -> Iterator[Sample]:
    """Read the samples of a tar from its bytes.

    Raises:
        tarfile.TarError, KeyError, ValueError, EOFError, tokenize.TokenError: If the bytes are damaged.
    """
    files, end = _files(content)
    # Python's reader takes a damaged header, or no end at all, for the end of the archive.
    if len(content) < end + 2 * tarfile.BLOCKSIZE or any(content[end:]):
        raise ValueError("it ends too early")
    for packed in _grouped(files):
        yield packed.decode(content)


@dataclass(slots=True)
class PackedSample:
    """Where the members of one sample lie in a tar.

    Args:
        key: Name of the sample.
        members: Place of each member by its suffix; others than those of the format are not listed.
        twice: Suffixes that came again.
    """

    key: str
    members: dict[str, slice] = field(default_factory=dict)
    twice: list[str] = field(default_factory=list)

    def check(self) -> None:
        """Refuse a sample with members that are missing or contradict each other.

        Raises:
            ValueError: The message says which members.
        """
        if len(self.members) < len(MEMBERS) or self.twice:
            missing = [name for name in MEMBERS if name not in self.members]
            raise ValueError(f"no {', '.join(missing)}" if missing else f"{', '.join(self.twice)} twice")

    def decode(self, content: bytes) -> Sample:
        """Decode the sample from the bytes of its tar.

        Raises:
            ValueError: If a member is missing or not what the format says.
        """
        try:
            self.check()
        except ValueError as error:
            raise ValueError(f"sample {self.key}: {error}") from error
        return decode({"__key__": self.key, **{name: content[place] for name, place in self.members.items()}})


MEMBERS = ("meta.json", "poses.npy", "shapes.npy", "silhouette.npy")
"""Suffixes of a sample's members."""


def find_samples(content: bytes) -> list[PackedSample]:
    """Find the samples of a tar, broken ones included, as webdataset groups them."""
    return list(_grouped(_files(content)[0]))


_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ": "xz", b"\x28\xb5\x2f\xfd": "zstd"}


def compression_of(content: bytes) -> str | None:
    r"""Name the program that compressed some bytes; None for a plain tar.

    >>> compression_of(b"\x1f\x8b..."), compression_of(b"00000.meta.json")
    ('gzip', None)
    """
    return next((name for mark, name in _COMPRESSED.items() if content.startswith(mark)), None)


_MEMBERS = frozenset(MEMBERS)
_File = tuple[str, slice]
"""Name and place of a file in a tar."""

_NAME = re.compile(r"((?:.*/|)[^.]+)\.([^/]*)", re.DOTALL)  # key and suffix, as webdataset takes them apart
_FOREIGN = re.compile(r"__[^/]*__($|/)")  # what webdataset keeps for itself
_PLAIN = {ord("0"): True, 0: True, ord("5"): False}
"""Types of members that need no other reader than :func:`_plain_files`, and whether they are files."""


def _grouped(files: Iterable[_File]) -> Iterator[PackedSample]:
    """Put neighbours that share a key together; those without a member of the format are no samples."""
    current = PackedSample("")
    for name, place in files:
        key, suffix = _key_and_suffix(name)
        if key != current.key:
            if not key:
                continue
            if current.members:
                yield current
            current = PackedSample(key)
        if suffix in current.members:
            current.twice.append(suffix)
        elif suffix in _MEMBERS:
            current.members[suffix] = place
    if current.members:
        yield current


def _key_and_suffix(name: str) -> tuple[str, str]:
    """Take a file's name apart; the key is empty if the file is part of no sample."""
    if "/" not in name and not name.startswith("__"):
        key, dot, suffix = name.partition(".")
        return (key, suffix.lower()) if dot else ("", "")
    match = None if _FOREIGN.match(name) else _NAME.fullmatch(name)
    return (match[1], match[2].lower()) if match else ("", "")


def _files(content: bytes) -> tuple[list[_File], int]:
    """Find the files of a tar, and the place where its members end."""
    plain = _plain_files(content)
    if plain is not None:
        return plain
    found = []
    try:
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
            for member in tar:
                if member.isreg() and not member.issparse():
                    found.append((member.name, slice(member.offset_data, member.offset_data + member.size)))
            return found, tar.offset
    except (tarfile.TarError, ValueError, EOFError):
        return found, 0


def _plain_files(content: bytes) -> tuple[list[_File], int] | None:
    """Read headers that hold all there is to know, many times as fast as tarfile; None if one of them does not."""
    at, found = 0, []
    while at + tarfile.BLOCKSIZE <= len(content) and content[at]:
        kind, start = content[at + 156], at + tarfile.BLOCKSIZE
        if kind not in _PLAIN or content[at + 345]:  # the second half of a long name
            return None
        try:
            size = int(content[at + 124 : at + 136].strip(b" \0") or b"0", 8)
        except ValueError:
            return None
        if _PLAIN[kind]:
            name = content[at : at + 100].partition(b"\0")[0].decode("utf-8", "surrogateescape")
            found.append((name, slice(start, start + size)))
        at = start + -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
    return found, at


def _members(sample: Sample) -> dict[str, bytes]:
    """Give the bytes of each member by its suffix."""
    return {
        "meta.json": json.dumps(sample.meta, sort_keys=True).encode(),
        "poses.npy": _npy(sample.poses.astype("<f4")),
        "shapes.npy": _npy(sample.shapes.astype(np.uint8)),
        "silhouette.npy": _npy(np.packbits(sample.silhouette, axis=1)),
    }


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
