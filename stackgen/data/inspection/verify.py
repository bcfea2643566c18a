"""Verifying a dataset: every shard against its checksum, and every stack readable."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from stackgen.data.dataset import read_manifest
from stackgen.data.decoding import Decoded, decode_shard
from stackgen.data.generation.workshop import PARTS, PROGRESS
from stackgen.data.manifest import Manifest, ShardEntry
from stackgen.data.shards import compression_of
from stackgen.io.files import read_bytes
from stackgen.io.text import read_json

Fault = Literal["missing", "truncated", "altered", "unreadable", "wrong", "foreign"]
_END = 1024  # zero bytes at least at the end of a tar
_RECORD = 10240  # a tar is padded to a multiple of it [byte]


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a dataset.

    Args:
        file: Name of the file.
        fault: `missing`; `truncated`, cut off; `altered`, bytes changed; `unreadable`, a sample is not what the
            format says; `wrong`, the manifest contradicts itself or the shards; `foreign`, no part of the dataset.
        detail: More about it, in words.
    """

    file: str
    fault: Fault
    detail: str = ""

    @property
    def breaks_bytes(self) -> bool:
        """Whether a shard is not as it was written, so that a repair can help."""
        return self.fault in ("missing", "truncated", "altered")


def verify(folder: Path, progress: Callable[[int], None] | None = None) -> list[Problem]:
    """Compare every shard with its checksum and read every sample.

    Args:
        folder: Folder of the dataset.
        progress: Called with the number of shards that have been looked at.

    Returns:
        All that is wrong; empty if nothing is.

    Raises:
        StackgenError: If there is no dataset.
    """
    manifest = read_manifest(folder)
    problems = _of_manifest(folder, manifest)
    seen = _Seen({}, {})
    for number, entry in enumerate(manifest.shards, 1):
        problems += _of_shard(folder, manifest, entry, seen)
        if progress:
            progress(number)
    return problems + _foreign(folder, manifest)


@dataclass(frozen=True)
class _Seen:
    """Shards of the keys and splits of the templates met so far: a key is unique, a template in one split only."""

    keys: dict[str, str]
    splits: dict[int, str]


def _of_manifest(folder: Path, manifest: Manifest) -> list[Problem]:
    problems = []
    counts = read_json(folder / "dataset.json").get("counts")
    if counts != manifest.counts:
        problems.append(Problem("dataset.json", "wrong", "its counts are not the sums of its shards'"))
    files = [entry["file"] for entry in manifest.shards]
    twice = {file for file in files if files.count(file) > 1}
    return problems + [Problem(file, "wrong", "dataset.json names it twice") for file in sorted(twice)]


def _of_shard(folder: Path, manifest: Manifest, entry: ShardEntry, seen: _Seen) -> list[Problem]:
    name = entry["file"]
    try:
        content = read_bytes(folder / name)
    except FileNotFoundError:
        return [Problem(name, "missing", f"{entry['samples']} stacks")]
    except OSError as error:
        return [Problem(name, "unreadable", error.strerror or str(error))]
    if compressed := compression_of(content):
        return [Problem(name, "altered", f"it is compressed with {compressed}, and a shard is a plain tar")]
    decoded = decode_shard(content, manifest.world)
    readable = len(decoded.positions)
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        truncated = len(content) % _RECORD != 0 or any(content[-_END:])
        still = f"{readable} of {entry['samples']} stacks can still be read, whether they are right or not"
        return [Problem(name, "truncated" if truncated else "altered", still)]
    problems = [Problem(name, "unreadable", f"sample {text}") for text in decoded.broken]
    if readable + len(decoded.broken) != entry["samples"]:
        problems.append(Problem(name, "wrong", f"{readable} stacks, but dataset.json says {entry['samples']}"))
    return problems + _repeated(name, entry["split"], decoded, seen)


def _repeated(name: str, split: str, decoded: Decoded, seen: _Seen) -> list[Problem]:
    problems = []
    for key in decoded.keys:
        if key in seen.keys:
            problems.append(Problem(name, "wrong", f"key {key} is in {seen.keys[key]} too"))
        seen.keys[key] = name
    for template in np.unique(decoded.stacks.template).tolist():
        if seen.splits.setdefault(template, split) != split:
            detail = f"template {template} is on two sides, {split} and {seen.splits[template]}"
            problems.append(Problem(name, "wrong", detail))
    return problems


def _foreign(folder: Path, manifest: Manifest) -> list[Problem]:
    known = {entry["file"] for entry in manifest.shards}
    problems = [
        Problem(path.name, "foreign", "a shard that dataset.json does not name")
        for path in sorted(folder.glob("*.tar"))
        if path.name not in known
    ]
    leftovers = [*sorted(folder.glob(".*.tmp")), *(p for p in (folder / PROGRESS, folder / PARTS) if p.exists())]
    return problems + [Problem(path.name, "foreign", "left behind by a run that was killed") for path in leftovers]
