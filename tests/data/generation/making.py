"""A small dataset, and executors for tests: in this process, and from a store of shards."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.generation.workshop import MadeShard

T = TypeVar("T")

SMALL = GenerateSettings("small", 45, seed=5, templates_per_shard=2, validation=0.2, test=0.2)


class Here:
    """Makes everything in this process, one after the other."""

    def map(self, task: Callable[[int], T], numbers: Iterable[int]) -> Generator[tuple[int, T], None, None]:
        """See :class:`stackgen.data.generation.executors.Executor`."""
        for number in numbers:
            yield number, task(number)


@dataclass(frozen=True)
class Stored:
    """Hands over shards that were made before, several at a time and the last one first; no others."""

    shards: dict[int, MadeShard]
    together: int = 1

    def map(self, task: Callable[[int], T], numbers: Iterable[int]) -> Generator[tuple[int, T], None, None]:
        """See :class:`stackgen.data.generation.executors.Executor`."""
        waiting: list[int] = []
        for number in numbers:
            if number not in self.shards:
                break
            waiting.append(number)
            if len(waiting) == self.together:
                yield from ((n, self.shards[n]) for n in reversed(waiting))  # type: ignore[misc]
                waiting = []
        yield from ((n, self.shards[n]) for n in reversed(waiting))  # type: ignore[misc]


def contents(folder: Path) -> dict[str, str]:
    """Checksum of every file, by its path in the folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def copy(folder: Path, to: Path) -> Path:
    """A copy to do harm to."""
    shutil.copytree(folder, to)
    return to


def flip(path: Path, place: int) -> None:
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)
