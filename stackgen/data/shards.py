"""Shards: stacks in WebDataset tars.

A dataset is a folder with `dataset.json` and `<split>-<number>.tar`. A sample is four members that
share a key and that numpy reads: `.shapes.npy` uint8 (k,), `.poses.npy` float32 (k, 6),
`.silhouette.npy` uint8 (H, W/8) (the front silhouette, `np.packbits` along the rows) and
`.meta.json`. Nothing in a shard depends on when or where it was written: equal stacks, equal bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.data.manifest import ShardEntry, shard_entry
from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
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
    shapes, poses, packed = (
        np.load(io.BytesIO(members[f"{name}.npy"]), allow_pickle=False) for name in ("shapes", "poses", "silhouette")
    )
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
        content = Path(path).read_bytes()
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
    members: dict[str, Any] = {}
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
        for member in tar:
            key, _, suffix = member.name.partition(".")
            file = tar.extractfile(member)
            if file is None:
                continue
            members[suffix] = file.read()
            if len(members) == 4:
                yield decode({"__key__": key, **members})
                members = {}
        # Python's reader takes a damaged header, or no end at all, for the end of the archive.
        if members or len(content) < tar.offset + 2 * tarfile.BLOCKSIZE or any(content[tar.offset :]):
            raise ValueError("it ends too early")


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
