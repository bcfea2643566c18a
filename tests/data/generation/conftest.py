"""The small dataset, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from stackgen.data.generation.generate import ShardTask, generate
from stackgen.data.generation.workshop import MadeShard
from tests.data.generation.making import SMALL, Here, Stored


@pytest.fixture(scope="session")
def shards() -> dict[int, MadeShard]:
    """More shards of the small dataset than it needs."""
    task = ShardTask.of(SMALL)
    made: dict[int, MadeShard] = {}
    while sum(shard.samples for shard in made.values()) < SMALL.stacks:
        made[len(made)] = task(len(made))
    return {**made, **{number: task(number) for number in range(len(made), len(made) + 3)}}


@pytest.fixture(scope="session")
def small(shards: dict[int, MadeShard], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset, made undisturbed in one process; not to be written to."""
    folder = tmp_path_factory.mktemp("generate") / "small"
    generate(SMALL, folder, executor=Stored(shards))
    return folder


@pytest.fixture(scope="session")
def here() -> Here:
    """An executor without processes."""
    return Here()
