"""The folder of a dataset while it is made: which settings it has, which shards are whole, what is removed at the end.

Every file appears under its final name only when it is whole. A shard counts as made once its entry is
recorded beside it, in `progress/`; whatever a kill leaves without entry, or not as its entry says, is made
again, and so are the bytes of the whole.
"""

from __future__ import annotations

import contextlib
import errno
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stackgen.data.dataset import read_manifest
from stackgen.data.manifest import Manifest, ShardEntry, is_shard_name, read_shard_entry, shard_entry, shard_number
from stackgen.data.shards import encode_shard, is_whole, read_shard
from stackgen.errors import StackgenError
from stackgen.io.files import is_left_over, write_atomically
from stackgen.io.text import parse_json, read_text

PROGRESS, PARTS = "progress", "parts"
"""Folders within a dataset that is not complete yet: the record of whole shards, and what is drawn from."""


@dataclass(frozen=True)
class MadeShard:
    """A shard that is not on disk yet."""

    name: str
    content: bytes
    samples: int


@dataclass(frozen=True)
class Workshop:
    """The shards of a folder and the record of those that are whole.

    Args:
        folder: Folder of the shards.
    """

    folder: Path

    @property
    def progress(self) -> Path:
        """Where the record is kept."""
        return self.folder / PROGRESS

    def whole(self, say: Callable[[str], None], only: range | None = None) -> dict[int, ShardEntry]:
        """Find the entries of the shards that are as they were written, by number.

        Args:
            say: Called with a line about each that is not.
            only: Look at these numbers alone.
        """
        found = {}
        for record in sorted(self.progress.glob("*.json")):
            if only is not None and record.stem.isdigit() and int(record.stem) not in only:
                continue
            try:
                entry = read_shard_entry(record)
                if record.stem != f"{shard_number(entry['file']):06d}":
                    raise StackgenError("it is of another shard")
                if is_whole(self.folder / entry["file"], entry["sha256"]):
                    found[shard_number(entry["file"])] = entry
                else:
                    say(f"{self.folder / entry['file']} is missing or damaged: it is made again")
            except StackgenError:
                say(f"{record} is damaged: its shard is made again")
        return found

    def keep(self, number: int, shard: MadeShard) -> ShardEntry:
        """Write a shard, then its record."""
        entry = shard_entry(shard.name, shard.content, shard.samples)
        write_atomically(self.folder / shard.name, shard.content)
        self.progress.mkdir(exist_ok=True)
        write_atomically(self.progress / f"{number:06d}.json", json.dumps(entry).encode())
        return entry

    def trim(self, entry: ShardEntry, keep: int) -> ShardEntry:
        """Cut a shard to its first samples. Its record stays that of the whole, which a kill thus brings back."""
        if keep >= entry["samples"]:
            return entry
        path = self.folder / entry["file"]
        content = encode_shard(list(read_shard(path, entry["sha256"]))[:keep])
        write_atomically(path, content)
        return shard_entry(path.name, content, keep)


def claim(out: Path, plain: dict[str, Any], means_the_same: Callable[[Any], bool]) -> None:
    """Make the folder this dataset's own, or see that it already is.

    Args:
        out: The folder.
        plain: All settings, as JSON allows.
        means_the_same: Whether settings that an earlier version wrote down are these.

    Raises:
        StackgenError: If it holds something else.
    """
    mine = json.dumps(plain, sort_keys=True, indent=1)
    record = out / "generate.json"
    out.mkdir(parents=True, exist_ok=True)
    strange = any(out.glob("*.tar")) and not record.exists()  # in this order: another process may just claim it
    if strange:
        raise StackgenError(f"{out} holds shards, but no generate.json that says of what; choose another folder")
    if not record.exists():
        write_atomically(record, mine.encode())
        return
    theirs = read_text(record)
    if theirs != mine and not means_the_same(_json(theirs)):
        raise StackgenError(f"{out} holds a dataset made with other settings; choose another folder or delete it")


def _json(text: str) -> Any:
    try:
        return parse_json(text, "generate.json")
    except StackgenError:
        return None


def finished(out: Path, stacks: int) -> Manifest | None:
    """Give the manifest of a dataset that is complete, None if it is still to be made.

    Args:
        out: Folder of the dataset.
        stacks: Number of stacks that it holds when it is complete.

    Raises:
        StackgenError: If it was complete once, but its manifest is not whole, or a shard is missing or damaged.
    """
    if not (out / "dataset.json").exists():
        return None
    manifest = read_manifest(out)
    if (listed := sum(manifest.counts.values())) != stacks:
        raise StackgenError(
            f"{out / 'dataset.json'} lists {listed} of the {stacks} stacks: it is not as it was written, and nothing"
            " was changed; put it back, or move it away to have it made again"
        )
    lost = [entry["file"] for entry in manifest.shards if not is_whole(out / entry["file"], entry["sha256"])]
    if lost:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise StackgenError(
            f"{out / lost[0]}{more}: missing or damaged since the dataset was complete; "
            f"make it again with `stackgen dataset repair {out}`"
        )
    return manifest


def sweep(out: Path, manifest: Manifest) -> None:
    """Remove what is no part of a complete dataset: shards made ahead, records, and what killed writers left."""
    for folder in (out / PARTS, out / PROGRESS):
        shutil.rmtree(folder, ignore_errors=True)
    known = {entry["file"] for entry in manifest.shards}
    for path in out.iterdir():
        if (is_shard_name(path.name) and path.name not in known) or is_left_over(path.name):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def disk_may_be_full(out: Path) -> Iterator[None]:
    """Say in one line that the disk is full, and that nothing is lost."""
    try:
        yield
    except (OSError, StackgenError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(cause, OSError) or cause.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise StackgenError(
            f"disk full: {out} keeps the shards that are whole; free some space and run the same command again, "
            "it continues from there"
        ) from error
