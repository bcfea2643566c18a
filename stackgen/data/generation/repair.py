"""Shards that were lost or damaged, made again from the manifest's settings, to the same bytes or not at all."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stackgen.data.card import write_card
from stackgen.data.dataset import read_manifest
from stackgen.data.generation.executors import Executor, make_executor
from stackgen.data.generation.generate import ShardTask, draw, make_shards
from stackgen.data.generation.settings import REVISIONS, GenerateSettings
from stackgen.data.generation.workshop import PARTS, MadeShard, Workshop, disk_may_be_full
from stackgen.data.manifest import Manifest, ShardEntry, shard_entry, shard_number
from stackgen.data.shards import encode_shard, is_whole, iterate_shard
from stackgen.errors import StackgenError
from stackgen.io.files import held, write_atomically
from stackgen.sim.physics import Physics, engine_version


@dataclass(frozen=True)
class Repaired:
    """What a repair did.

    Args:
        identical: Shards that are again as they were written.
        other: Shards that were made again with other bytes, as requested.
    """

    identical: tuple[str, ...] = ()
    other: tuple[str, ...] = ()


def repair(
    folder: Path,
    executor: Executor | None = None,
    other_bytes: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Repaired:
    """Make the shards again that are missing or damaged; all others are left alone.

    Args:
        folder: Folder of the dataset.
        executor: Runs their making; by default on processes of this machine.
        other_bytes: Accept shards that are not what was written, as another version of the simulator makes
            them; the manifest then gets their checksums.
        progress: Called with the number of shards that were made again, and of those that must be.

    Raises:
        StackgenError: If there is no dataset, its settings are not known, or what is made is not what was
            written; nothing but identical shards has then been put back.
    """
    manifest = read_manifest(folder)
    lost = {
        shard_number(entry["file"]): entry
        for entry in manifest.shards
        if not is_whole(folder / entry["file"], entry["sha256"])
    }
    if not lost:
        return Repaired()
    settings = _settings(manifest, other_bytes)
    identical: list[MadeShard] = []
    other: list[MadeShard] = []
    with disk_may_be_full(folder), held(folder):
        made = _made(folder, manifest, settings, list(lost), executor or make_executor("local"))
        for done, (number, shard) in enumerate(made, 1):
            entry = lost[number]
            shard = replace(_cut(shard, entry["samples"]), name=entry["file"])
            same = shard_entry(shard.name, shard.content, shard.samples)["sha256"] == entry["sha256"]
            if same or other_bytes:
                write_atomically(folder / shard.name, shard.content)
            (identical if same else other).append(shard)
            if progress:
                progress(done, len(lost))
        if other and not other_bytes:
            raise StackgenError(
                f"{other[0].name} cannot be made again byte for byte ({_difference(manifest)}) and was left as it is; "
                "--other_bytes puts what is made here in its place, and its checksum into dataset.json"
            )
        if other:
            _record(folder, manifest, other)
    return Repaired(tuple(shard.name for shard in identical), tuple(shard.name for shard in other))


def _settings(manifest: Manifest, other_bytes: bool) -> GenerateSettings:
    """Give the generator's settings, if it can be expected to make the same bytes."""
    if "resplit" in manifest.settings:
        raise StackgenError(
            f"dataset {manifest.name!r} was made by `stackgen dataset split`: repair its source and split that again"
        )
    settings = GenerateSettings.from_manifest(manifest)
    if not other_bytes and _difference(manifest) != _SAME:
        raise StackgenError(
            f"the shards of {manifest.name!r} cannot be made again byte for byte ({_difference(manifest)}); nothing "
            "was changed; --other_bytes puts what is made here in their place, and its checksums into dataset.json"
        )
    return settings


_SAME = "other versions of numpy or another kind of machine"


def _difference(manifest: Manifest) -> str:
    """Say how this generator differs from the one that made a dataset."""
    engine, revision = manifest.physics.get("engine"), manifest.settings.get("revision", 1)
    if engine != (here := _engine(manifest)):
        return f"it was made with {engine}, here is {here}"
    if revision != (now := REVISIONS[GenerateSettings.from_manifest(manifest).recipe]):
        return f"it was made by revision {revision} of the generator, here is {now}"
    return _SAME


def _engine(manifest: Manifest) -> str:
    """Give name and version of the engine of a dataset as it is installed here."""
    return engine_version(Physics.settings_of(manifest.physics)["engine"])


def _made(
    folder: Path, manifest: Manifest, settings: GenerateSettings, numbers: list[int], executor: Executor
) -> Iterator[tuple[int, MadeShard]]:
    """Make the shards of some numbers again."""
    if not settings.draw:
        with contextlib.closing(executor.map(ShardTask.of(settings), numbers)) as made:
            yield from made
        return
    parts = folder / PARTS  # as in the generation: an interrupted repair continues from there
    parts.mkdir(exist_ok=True)
    entries = make_shards(settings, Workshop(parts), executor)
    yield numbers[0], draw(parts, entries, settings)
    shutil.rmtree(parts, ignore_errors=True)


def _cut(shard: MadeShard, samples: int) -> MadeShard:
    """Cut a shard to its first samples, as the last one of a dataset was."""
    if shard.samples <= samples:
        return shard
    kept = list(iterate_shard(shard.content))[:samples]
    return MadeShard(shard.name, encode_shard(kept), samples)


def _record(folder: Path, manifest: Manifest, others: list[MadeShard]) -> None:
    """Put what the new shards are into manifest and card."""
    revision = REVISIONS[GenerateSettings.from_manifest(manifest).recipe]
    new: dict[str, dict[str, Any]] = {
        shard.name: {
            **shard_entry(shard.name, shard.content, shard.samples),
            "made_with": f"{_engine(manifest)}, generator revision {revision}",
        }
        for shard in others
    }
    entries: tuple[ShardEntry, ...] = tuple(new.get(entry["file"], entry) for entry in manifest.shards)
    changed = replace(manifest, shards=entries)
    changed.save(folder)
    write_card(folder, changed)
