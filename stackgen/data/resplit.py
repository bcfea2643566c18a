"""Splitting a dataset again: the same stacks in other shares, and those that belong together in one split."""

from __future__ import annotations

import contextlib
import glob
import math
import secrets
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from stackgen.data.card import write_card
from stackgen.data.dataset import read_manifest
from stackgen.data.decoding import SkipLog, read_samples
from stackgen.data.generation.designs import Design
from stackgen.data.manifest import SPLITS, Manifest, Split, split_of
from stackgen.data.shards import Sample, write_shard
from stackgen.data.sources import Shard
from stackgen.errors import StackgenError
from stackgen.io.files import held
from stackgen.world import World

By = Literal["template", "layout"]


@dataclass(frozen=True)
class Resplit:
    """How to split.

    Args:
        validation, test: Shares of these splits, counted in groups; what is left is for training.
        by: What stays together: `template`, all stacks deconstructed from one template; `layout`, those of all
            templates that are the same design or its mirror image, so that no design is on two sides.
        seed: Seed of the choice of groups.

    Raises:
        StackgenError: If the shares make no sense.
    """

    validation: float
    test: float
    by: By = "template"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.validation < 0 or self.test < 0 or self.validation + self.test > 1:
            raise StackgenError("dataset split: validation and test are shares; their sum is at most 1")
        if self.by not in ("template", "layout"):
            raise StackgenError(f"dataset split: by is template or layout, not {self.by!r}")


def resplit(folder: Path, out: Path, how: Resplit, progress: Callable[[int], None] | None = None) -> Manifest:
    """Write a new dataset of the same stacks with other splits.

    Args:
        folder: Folder of the dataset, which is not changed.
        out: A folder that is not there yet; it appears when it is complete.
        how: The shares, and what stays together.
        progress: Called with the number of shards that were read.

    Raises:
        StackgenError: If there is no dataset, a shard is damaged, or `out` is there already.
    """
    manifest = read_manifest(folder)
    if out.exists():
        raise StackgenError(f"{out} is there already: choose another folder")
    for left in out.parent.glob(f".{glob.escape(out.name)}.*.unfinished"):  # by runs that were killed
        with contextlib.suppress(StackgenError, OSError), held(left):
            shutil.rmtree(left)
    workshop = out.with_name(f".{out.name}.{secrets.token_hex(4)}.unfinished")
    workshop.mkdir(parents=True)
    try:
        with held(workshop):
            result = _written(folder, workshop, manifest, how, progress or (lambda read: None))
            _put_in_place(workshop, out)
    except BaseException:
        shutil.rmtree(workshop, ignore_errors=True)
        raise
    return result


def _put_in_place(workshop: Path, out: Path) -> None:
    try:
        workshop.rename(out)
    except OSError as error:  # another command was faster
        raise StackgenError(f"{out} is there already: choose another folder") from error


def _written(
    folder: Path, workshop: Path, manifest: Manifest, how: Resplit, progress: Callable[[int], None]
) -> Manifest:
    """Write the whole new dataset, and give its manifest."""
    entries = _write(folder, workshop, manifest, how, progress)
    settings = {**manifest.settings, "resplit": {**vars(how), "source": manifest.sha256}}
    result = replace(manifest, settings=settings, shards=tuple(entries))
    write_card(workshop, result)
    result.save(workshop)
    return result


def _write(
    folder: Path, out: Path, manifest: Manifest, how: Resplit, progress: Callable[[int], None]
) -> list[dict[str, Any]]:
    """Deal the groups out as they are met; shards are as large as before, and one at a time is in memory."""
    size = max((entry["samples"] for entry in manifest.shards), default=1)
    offset = how.seed * math.sqrt(2) % 1
    sides: dict[Any, Split] = {}
    waiting: dict[Split, list[Sample]] = {split: [] for split in SPLITS}
    entries: list[dict[str, Any]] = []

    def flush(split: Split) -> None:
        entries.append(write_shard(out / f"{split}-{len(entries):06d}.tar", waiting[split]))
        waiting[split] = []

    for read, (_, samples) in enumerate(_shards(folder, manifest), 1):
        for sample in samples:
            group = _group(sample, how.by, manifest)
            if group not in sides:
                sides[group] = split_of(len(sides), how.validation, how.test, offset)
            waiting[sides[group]].append(sample)
        for split in SPLITS:
            if len(waiting[split]) >= size:
                flush(split)
        progress(read)
    for split in SPLITS:
        if waiting[split]:
            flush(split)
    return entries


def _shards(folder: Path, manifest: Manifest) -> Iterator[tuple[Split, list[Sample]]]:
    """Read the samples of each shard that are not broken, and the split that they are in."""
    log = SkipLog()
    for entry in manifest.shards:
        yield entry["split"], read_samples(Shard(str(folder), entry), manifest.world, log)
    log.report(str(folder))


def _group(sample: Sample, by: By, manifest: Manifest) -> Any:
    """Name the group of samples that a sample must stay with."""
    if by == "template":
        return sample.meta["template"]
    design = _canonical(sample.meta.get("layout"), manifest.world)
    if design is None:
        raise StackgenError(f"sample {sample.key} does not say its layout: this dataset can only be split by template")
    return design


@lru_cache(maxsize=100_000)
def _canonical(layout: str | None, world: World) -> str | None:
    """One text for a design and its mirror image; None if there is no design."""
    try:
        design = Design.from_key(layout or "")
        return min(design.key, design.mirrored(world).key)
    except (ValueError, IndexError):
        return None


def split_table(
    folder: Path, manifest: Manifest, progress: Callable[[int], None] | None = None
) -> dict[str, dict[str, int]]:
    """Count by split the number of stacks, of templates, of designs, and of designs that another split has, too.

    A design and its mirror image count as one.

    Raises:
        StackgenError: If a shard is damaged.
    """
    templates: dict[str, set[Any]] = {split: set() for split in SPLITS}
    designs: dict[str, set[Any]] = {split: set() for split in SPLITS}
    stacks = dict.fromkeys(SPLITS, 0)
    for read, (split, samples) in enumerate(_shards(folder, manifest), 1):
        stacks[split] += len(samples)
        for sample in samples:
            templates[split].add(sample.meta["template"])
            designs[split].add(_canonical(sample.meta.get("layout"), manifest.world))
        if progress:
            progress(read)
    for known in designs.values():
        known.discard(None)
    return {
        split: {
            "stacks": stacks[split],
            "templates": len(templates[split]),
            "designs": len(designs[split]),
            "designs in another split too": len(
                designs[split] & set().union(*(designs[other] for other in SPLITS if other != split))
            ),
        }
        for split in SPLITS
    }
