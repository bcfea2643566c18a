"""A small dataset in every form it can have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stackgen.data.arrays import StackArrays
from stackgen.data.dataset import Dataset
from stackgen.data.generation.designs import draw_design, realize
from stackgen.data.manifest import Manifest
from stackgen.data.shards import Sample, write_shard
from stackgen.geometry import silhouette
from stackgen.world import PAPER_GRID, PAPER_WORLD

SHARDS = {"train-000000.tar": 41, "train-000001.tar": 30, "validation-000002.tar": 23, "test-000003.tar": 7}


@pytest.fixture(scope="session")
def samples() -> dict[str, list[Sample]]:
    """Designs as drawn, by the name of their shard; a template each."""
    rng = np.random.default_rng(0)
    made: dict[str, list[Sample]] = {}
    number = 0
    for name, count in SHARDS.items():
        made[name] = []
        while len(made[name]) < count:
            design = draw_design(rng, PAPER_WORLD)
            stack = realize(design, rng, PAPER_WORLD)
            if len(stack) > 10:
                continue
            meta = {"template": number, "layout": design.key, "removed": []}
            shapes, poses = stack.shapes.astype(np.uint8), stack.poses.astype(np.float32)
            made[name].append(Sample(f"{number:07d}", shapes, poses, silhouette(stack, PAPER_GRID), meta))
            number += 1
    return made


@pytest.fixture(scope="session")
def dataset(samples: dict[str, list[Sample]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset folder."""
    folder = tmp_path_factory.mktemp("dataset")
    shards = tuple(write_shard(folder / name, those) for name, those in samples.items())
    Manifest("small", 0, PAPER_WORLD, {"engine": "none"}, {}, shards).save(folder)
    return folder


@pytest.fixture(scope="session")
def splits(dataset: Path) -> dict[str, StackArrays]:
    """Its splits in memory."""
    found = Dataset.open(dataset)
    return {name: found.split(name) for name in found.splits}
