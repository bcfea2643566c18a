"""The dataset generator: designs in, shards out, on as many processes as there are.

A shard holds all stacks of a fixed range of templates, and each template has its own random stream,
so a shard's bytes depend on the settings and its number alone: not on the number of workers, nor on
whether the run was interrupted. A run that is started again makes the shards that are missing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.data.card import write_card
from stackgen.data.generation.executors import Executor, make_executor
from stackgen.data.generation.recipes import samples_of, testset_contents
from stackgen.data.generation.settings import REVISIONS, GenerateSettings
from stackgen.data.generation.workshop import PARTS, MadeShard, Workshop, claim, disk_may_be_full, finished, sweep
from stackgen.data.manifest import Manifest, ShardEntry, shard_entry
from stackgen.data.shards import encode_shard, read_shard
from stackgen.errors import StackgenError
from stackgen.io.files import held, write_atomically
from stackgen.sim.simulator import Simulator

_HOPELESS = 2000  # templates without a stack, after which none is expected


def generate(
    settings: GenerateSettings,
    out: Path,
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
    executor: Executor | None = None,
    say: Callable[[str], None] | None = None,
) -> Manifest:
    """Make a dataset, or finish one that was interrupted.

    Args:
        settings: What to make.
        out: Folder of the dataset.
        workers: Number of processes; by default one per core. The result does not depend on it.
        progress: Called with the number of stacks stored so far.
        executor: Runs the making of the shards; by default on processes of this machine.
        say: Called with a line about each shard that was damaged in an interruption and is made again.

    Raises:
        StackgenError: If the folder holds something else, a shard was damaged since the dataset was
            complete, the disk is full, or workers die again and again.
    """
    with disk_may_be_full(out), _claimed(settings, out):
        manifest = finished(out, settings.draw or settings.stacks)
        if manifest is None:
            workshop = workshop_of(settings, out)
            executor = executor or make_executor("local", workers)
            entries = make_shards(settings, workshop, executor, progress, say)
            if settings.draw:
                entries = [_store(out, draw(workshop.folder, entries, settings))]
            manifest = _manifest(settings, tuple(entries))
            write_card(out, manifest)
            manifest.save(out)
        sweep(out, manifest)
    return manifest


def generate_range(
    settings: GenerateSettings,
    out: Path,
    shards: range,
    executor: Executor | None = None,
    *,
    progress: Callable[[int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> int:
    """Make some shards of a dataset, for jobs that share its folder; :func:`generate` collects them.

    Args:
        settings: Settings of the whole dataset.
        out: Folder of the dataset.
        shards: Numbers of the shards.
        executor: Runs their making; by default on processes of this machine.
        progress: Called with the number of shards that are there so far.
        say: Called with a line about each shard that was damaged in an interruption and is made again.

    Returns:
        The number of stacks they hold; 0 if the dataset is complete already.
    """
    with disk_may_be_full(out), _claimed(settings, out, shared=True):
        if finished(out, settings.draw or settings.stacks) is not None:
            return 0
        workshop = workshop_of(settings, out)
        known = workshop.whole(say or _ignore, shards)
        missing = [number for number in shards if number not in known]
        made = (executor or make_executor("local")).map(ShardTask.of(settings), missing)
        with contextlib.closing(made):
            for number, shard in made:
                known[number] = workshop.keep(number, shard)
                (progress or _ignore)(len(known))
    return sum(entry["samples"] for entry in known.values())


@dataclass(frozen=True)
class ShardTask:
    """The task of a worker: make the shard of a number.

    Args:
        settings: Settings of the dataset.
        excluded: What to leave out of it.
    """

    settings: GenerateSettings
    excluded: frozenset[str]

    @staticmethod
    def of(settings: GenerateSettings) -> ShardTask:
        """Make the task of a dataset."""
        return ShardTask(settings, testset_contents(settings.world) if settings.exclude_testset else frozenset())

    def __call__(self, shard: int) -> MadeShard:
        """Make one shard."""
        settings = self.settings
        first = shard * settings.templates_per_shard
        with Simulator(settings.physics) as simulator:
            samples = [
                sample
                for number in range(first, first + settings.templates_per_shard)
                for sample in samples_of(settings, number, self.excluded, simulator)
            ]
        return MadeShard(f"{settings.split_of(shard)}-{shard:06d}.tar", encode_shard(samples), len(samples))


def make_shards(
    settings: GenerateSettings,
    workshop: Workshop,
    executor: Executor,
    progress: Callable[[int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> list[ShardEntry]:
    """Write as many shards as it takes, the last one cut to size; returns the entries of those not empty."""
    progress, say = progress or _ignore, say or _ignore
    known = workshop.whole(say)
    entries: list[ShardEntry] = []
    stored = 0
    made = executor.map(ShardTask.of(settings), (number for number in count() if number not in known))
    with contextlib.closing(made):
        for shard in count():
            while shard not in known:
                number, new = next(made)
                known[number] = workshop.keep(number, new)
            entry = known[shard]
            stored += entry["samples"]
            progress(min(stored, settings.stacks))
            if entry["samples"]:
                entries.append(entry)
            if stored >= settings.stacks:
                break
            if not stored and shard * settings.templates_per_shard > _HOPELESS:
                raise StackgenError(
                    f"generate: {_HOPELESS} templates gave no stack; relax max_blocks, accept, template or drawings"
                )
    entries[-1] = workshop.trim(entries[-1], entries[-1]["samples"] - (stored - settings.stacks))
    return entries


@contextlib.contextmanager
def _claimed(settings: GenerateSettings, out: Path, shared: bool = False) -> Iterator[None]:
    """Have the folder to oneself, or share it with others who make a range of the same shards."""
    out.mkdir(parents=True, exist_ok=True)
    with held(out, shared):
        claim(out, _manifest(settings, ()).to_json(), partial(_are, settings))
        yield


def workshop_of(settings: GenerateSettings, out: Path) -> Workshop:
    """Give the folder where the shards are made: a drawn shard must not overwrite what it is drawn from."""
    folder = out / PARTS if settings.draw else out
    folder.mkdir(exist_ok=True)
    return Workshop(folder)


def _are(settings: GenerateSettings, plain: Any) -> bool:
    """Tell whether a plain manifest without shards has these settings, where defaults stand for what it lacks."""
    try:
        manifest = Manifest.from_json(plain)
        revision = REVISIONS[settings.recipe]
        same = manifest.settings.get("revision", revision) == revision
        return same and manifest.physics == settings.physics.to_json() and settings.from_manifest(manifest) == settings
    except StackgenError:
        return False


def _manifest(settings: GenerateSettings, entries: tuple[ShardEntry, ...]) -> Manifest:
    return Manifest(
        settings.name,
        settings.seed,
        settings.world,
        settings.physics.to_json(),
        settings.to_json(),
        entries,
    )


def draw(folder: Path, entries: list[ShardEntry], settings: GenerateSettings) -> MadeShard:
    """Keep `settings.draw` stacks of all in a folder's shards, drawn uniformly, in one shard."""
    samples = [sample for entry in entries for sample in read_shard(folder / entry["file"], entry["sha256"])]
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(2**32,)))
    chosen = np.sort(rng.choice(len(samples), settings.draw, replace=False))
    return MadeShard(entries[0]["file"], encode_shard(samples[i] for i in chosen), len(chosen))


def _store(folder: Path, shard: MadeShard) -> ShardEntry:
    write_atomically(folder / shard.name, shard.content)
    return shard_entry(shard.name, shard.content, shard.samples)


def _ignore(_: object) -> None:
    """Stand in for a callback that was not given."""
