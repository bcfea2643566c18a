"""What `dataset.json` says of a dataset: its world, how it was made, and the checksum of every shard."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.io.schemas import require_valid
from stackgen.io.text import decode_text, parse_json, read_json
from stackgen.world import World

FORMAT = "stackgen.dataset/1"
Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
ShardEntry = dict[str, Any]
"""What a manifest says of a shard: `file`, `split`, `samples` and `sha256`."""

_SCHEMA = Path(__file__).with_name("dataset.schema.json")
_GOLDEN = 0.6180339887498949
_SHARD_NAME = re.compile(rf"(?:{'|'.join(SPLITS)})-([0-9]{{1,12}})\.tar")


def split_of(number: int, validation: float, test: float, offset: float = 0.0) -> Split:
    """Choose the split of the `number`-th part of a dataset; shares are met evenly along the way.

    Args:
        number: Number of the part, from 0 on; its multiple of the golden ratio decides.
        validation, test: Shares of these splits; the rest is for training.
        offset: Number in [0, 1); another one gives another choice.

    >>> [split_of(number, 0.1, 0.2) for number in range(6)]
    ['validation', 'train', 'test', 'train', 'train', 'validation']
    """
    place = (number * _GOLDEN + offset) % 1
    if place < validation:
        return "validation"
    return "test" if place < validation + test else "train"


@dataclass(frozen=True)
class Manifest:
    """What `dataset.json` says of a dataset.

    Args:
        name: Name of the configuration that made it.
        seed: Seed of the generator.
        world: Shapes, grid and longest block list of its stacks.
        physics: `Physics.to_json()` of the simulator that made it.
        settings: The generator's other settings.
        shards: Name, split, number of samples and SHA-256 of each file.
    """

    name: str
    seed: int
    world: World
    physics: dict[str, Any]
    settings: dict[str, Any]
    shards: tuple[ShardEntry, ...] = ()

    @property
    def of_drawings(self) -> bool:
        """Whether its silhouettes are drawings that the stacks answer, and not pictures of the stacks."""
        return self.settings.get("silhouette") == "drawing"

    def count(self, split: Split) -> int:
        """Count the samples of a split."""
        return sum(shard["samples"] for shard in self.shards if shard["split"] == split)

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples of each split."""
        return {split: self.count(split) for split in SPLITS}

    def to_json(self) -> dict[str, Any]:
        """Give the plain form, as stored."""
        return {
            "format": FORMAT,
            "name": self.name,
            "seed": self.seed,
            **self.world.to_json(),
            "physics": self.physics,
            "settings": self.settings,
            "counts": self.counts,
            "shards": list(self.shards),
        }

    @property
    def sha256(self) -> str:
        """Hash of the whole manifest, and so of the dataset: it contains every shard's own."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()

    def save(self, folder: Path) -> None:
        """Write `dataset.json` into a folder, whole or not at all."""
        write_json(folder / "dataset.json", self.to_json())

    @staticmethod
    def parse(content: bytes, path: str | Path) -> Manifest:
        """Read a manifest from the bytes of its file; errors call it `path`.

        Raises:
            StackgenError: If it is not a manifest of this format.
        """
        return Manifest.from_json(parse_json(decode_text(content, path), path), path)

    @staticmethod
    def from_json(data: Any, path: str | Path = "manifest") -> Manifest:
        """Invert :meth:`to_json`; errors call it `path`.

        Raises:
            StackgenError: If it is not the plain form of a manifest of this format.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise StackgenError(f"{path} is not a {FORMAT} manifest")
        try:
            require_valid(data, _SCHEMA)
            world = World.from_json(data)
        except StackgenError as error:
            raise StackgenError(f"{path} is damaged: {error}") from error
        return Manifest(data["name"], data["seed"], world, data["physics"], data["settings"], tuple(data["shards"]))


def shard_entry(name: str, content: bytes, samples: int) -> ShardEntry:
    """Describe a shard for the manifest.

    >>> shard_entry("train-000003.tar", b"", 0)["split"]
    'train'
    """
    sha256 = hashlib.sha256(content).hexdigest()
    return {"file": name, "split": name.rpartition("-")[0], "samples": samples, "sha256": sha256}


def read_shard_entry(path: Path) -> ShardEntry:
    """Read the description of one shard from a file of its own.

    Raises:
        StackgenError: If it is none, or names what is not the plain name of a shard.
    """
    entry = read_json(path)
    require_valid(entry, _SCHEMA, "shard")
    shard_number(entry["file"])
    return entry


def shard_number(name: str) -> int:
    """Read the number of a shard from its file name.

    Raises:
        StackgenError: If shards are not called so.

    >>> shard_number("train-000003.tar")
    3
    """
    match = _SHARD_NAME.fullmatch(name)
    if match is None:
        raise StackgenError(f"{name!r} is not the name of a shard: they are called SPLIT-NUMBER.tar")
    return int(match[1])


def is_shard_name(name: str) -> bool:
    """Tell whether the generator calls its shards so."""
    return _SHARD_NAME.fullmatch(name) is not None
