"""Datasets: one way to open them, whatever form they have and wherever they lie."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from stackgen.data.manifest import SPLITS, Manifest, Split
from stackgen.data.shards import Sample
from stackgen.data.sources import Shard, is_folder, is_remote, locate, read_bytes
from stackgen.errors import StackgenError
from stackgen.world import World

if TYPE_CHECKING:
    from stackgen.data.arrays import StackArrays

TESTSET = Path(__file__).parents[1] / "assets" / "testset-v1"
"""The frozen test scenes that every method is measured on."""


@dataclass(frozen=True)
class Dataset:
    """A dataset: a folder of shards or one compact `.npz` file, here, behind a URL or behind a command.

    Args:
        path: Where it lies: a local path, a URL (`https:`, `s3:`, ...) or `pipe:COMMAND`.
        manifest: What it says of itself.
        is_compact: Whether it, or a part of it, is one `.npz` file.
        parts: The datasets that it joins, if it does; see :meth:`join`.

    >>> Dataset.open(TESTSET).manifest.count("test")
    500
    """

    path: str
    manifest: Manifest
    is_compact: bool = False
    parts: tuple[Dataset, ...] = field(default=(), repr=False)
    _splits: dict[str, StackArrays] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    def open(path: str | Path) -> Dataset:
        """Open a dataset: read its manifest (a compact file is read whole).

        Raises:
            StackgenError: If there is none, or it is not one of this package.
        """
        where = str(path)
        if is_folder(where):
            return Dataset(where, Manifest.parse(*_manifest_file(where)))
        if not is_remote(where) and not Path(where).exists():
            raise StackgenError(
                f"no dataset at {where}: `stackgen generate` makes a folder, `stackgen dataset export` a .npz of it"
            )
        from stackgen.data.compact import load_npz

        splits, manifest = load_npz(where)
        return Dataset(where, manifest, True, _splits=splits)

    @staticmethod
    def join(datasets: Sequence[Dataset]) -> Dataset:
        """Take several datasets of one world for one: each split is theirs, one after the other.

        What its manifest says of the making is the first one's, but for the silhouettes: they are drawings if any are.

        Raises:
            StackgenError: If their worlds differ.
        """
        first = datasets[0]
        if len(datasets) == 1:
            return first
        for other in datasets[1:]:
            if other.world != first.world:
                raise StackgenError(
                    f"datasets {first.path} and {other.path} are of different worlds: join those of one"
                )
        drawings = {"silhouette": "drawing"} if any(dataset.manifest.of_drawings for dataset in datasets) else {}
        manifest = replace(
            first.manifest,
            name=" + ".join(dataset.manifest.name for dataset in datasets),
            settings=first.manifest.settings | drawings,
            shards=tuple(shard for dataset in datasets for shard in dataset.manifest.shards),
        )
        path = ", ".join(dataset.path for dataset in datasets)
        return Dataset(path, manifest, any(dataset.is_compact for dataset in datasets), tuple(datasets))

    @property
    def world(self) -> World:
        """Shapes, grid and longest block list of its stacks."""
        return self.manifest.world

    @property
    def splits(self) -> tuple[Split, ...]:
        """Names of the splits it has."""
        if self.parts:
            return tuple(split for split in SPLITS if any(split in part.splits for part in self.parts))
        if self.is_compact:
            return tuple(split for split in SPLITS if split in self._splits)
        return tuple(split for split in SPLITS if any(entry["split"] == split for entry in self.manifest.shards))

    def shards(self, split: str) -> list[Shard]:
        """List the shards of a split, in order.

        Raises:
            StackgenError: If it has no shards of that split.
        """
        if self.parts and split in self.splits:
            return [shard for part in self.parts if split in part.splits for shard in part.shards(split)]
        found = [Shard(self.path, entry) for entry in self.manifest.shards if entry["split"] == split]
        if not found or self.is_compact:
            fault = "is one compact file, not shards" if self.is_compact else f"has no {split} split"
            raise StackgenError(f"dataset {self.path} {fault}")
        return found

    def split(self, name: str) -> StackArrays:
        """Give a split as arrays in memory; read once, then kept.

        Raises:
            StackgenError: If it has no such split, or a shard is damaged (the message names it).
        """
        if name not in self._splits and self.parts and name in self.splits:
            from stackgen.data.arrays import StackArrays

            self._splits[name] = StackArrays.concatenate(
                [part.split(name) for part in self.parts if name in part.splits]
            )
        if name not in self._splits:
            if self.is_compact or self.parts:
                raise StackgenError(f"dataset {self.path} has no {name} split")
            from stackgen.data.decoding import SkipLog, decode_shards

            log = SkipLog()
            self._splits[name] = decode_shards(self.shards(name), self.world, log)
            log.report(f"the {name} split of {self.path}")
        return self._splits[name]

    def samples(self, split: str) -> Iterator[Sample]:
        """Read the samples of a split, in order, with their metadata; broken ones are named and skipped.

        Raises:
            StackgenError: If a shard is missing or is not the one that was written.
        """
        from stackgen.data.decoding import SkipLog, read_samples

        log = SkipLog()
        for shard in self.shards(split):
            yield from read_samples(shard, self.world, log)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a local folder of shards.

    Raises:
        StackgenError: If there is no dataset, or it is one compact file.
    """
    dataset = Dataset.open(folder)
    if dataset.is_compact:
        raise StackgenError(f"dataset {folder} is one compact file, not a folder of shards")
    return dataset.manifest


def _manifest_file(root: str) -> tuple[bytes, str]:
    """Bytes of `dataset.json` and what errors call it."""
    where = locate(root, "dataset.json")
    if not is_remote(root) and not Path(where).exists():
        raise StackgenError(f"no dataset at {root}: there is no dataset.json in it; make one with `stackgen generate`")
    return read_bytes(where), where
