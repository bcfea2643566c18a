"""The frozen test set is what it was when it was frozen, and its stacks are what they claim."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.manifest import SPLITS, Manifest
from stackgen.data.shards import Sample
from stackgen.geometry import block_vertices, silhouette
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD

SHA256 = "c3adc506167a5404589a6acd1d3cdc03343a4c85f68971a12d470aede965fbc0"
"""Of its shard. It never changes: every figure ever published with its name would mean something else."""


@pytest.fixture(scope="module")
def manifest() -> Manifest:
    return Dataset.open(TESTSET).manifest


@pytest.fixture(scope="module")
def samples(manifest: Manifest) -> list[Sample]:
    return list(Dataset.open(TESTSET).samples("test"))


def test_it_is_the_frozen_one(manifest: Manifest) -> None:
    assert [shard["sha256"] for shard in manifest.shards] == [SHA256]
    assert hashlib.sha256((TESTSET / manifest.shards[0]["file"]).read_bytes()).hexdigest() == SHA256
    assert sorted(path.name for path in TESTSET.iterdir()) == ["dataset.json", "test-000000.tar"]


def test_it_has_500_scenes_and_is_for_tests_alone(manifest: Manifest, samples: list[Sample]) -> None:
    assert {split: manifest.count(split) for split in SPLITS} == {"train": 0, "validation": 0, "test": 500}
    assert len(samples) == 500 == len({sample.key for sample in samples})


def test_its_world_is_the_project_s(manifest: Manifest) -> None:
    assert manifest.world == PAPER_WORLD
    physics = dict(manifest.physics)
    assert physics.pop("engine") == "pybullet 3.2.7"
    assert Physics(**physics) == Physics()


def test_every_silhouette_is_that_of_its_stack(samples: list[Sample]) -> None:
    for sample in samples:
        assert (silhouette(sample.stack(PAPER_CATALOGUE), PAPER_GRID) == sample.silhouette).all()


def test_nothing_is_cut_off_and_everything_is_four_cells_high(samples: list[Sample]) -> None:
    for sample in samples:
        stack = sample.stack(PAPER_CATALOGUE)
        corners = np.concatenate(block_vertices(stack))
        assert corners[:, 2].max() == pytest.approx(4, abs=0.2)
        wide = silhouette(stack, PAPER_GRID, margin=16)
        assert np.count_nonzero(wide) == np.count_nonzero(sample.silhouette)


def test_no_scene_is_there_twice(samples: list[Sample]) -> None:
    assert len({(s.meta["layout"], *s.meta["removed"]) for s in samples}) > 490
    assert len({(s.shapes.tobytes(), s.poses.round(3).tobytes()) for s in samples}) == 500


def test_block_lists_are_varied(samples: list[Sample]) -> None:
    lengths = [len(sample.shapes) for sample in samples]
    assert min(lengths) >= 4 and max(lengths) == PAPER_WORLD.max_blocks
    assert {int(s) for sample in samples for s in sample.shapes} == {0, 1, 2, 3}


def test_its_stacks_stand(samples: list[Sample]) -> None:
    """Nearly all: the paper's recipe settles once. What `stackgen test` calls the ground truth is the exact share."""
    verdicts = SimulatorChecker().check_all(sample.stack(PAPER_CATALOGUE) for sample in samples[::10])
    assert np.mean([verdict.stable for verdict in verdicts]) >= 0.96
