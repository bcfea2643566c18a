"""Fine-tuning on tried lists: they are what they say, and the network comes to prefer those that are worth most."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.data.preferences import TriedLists, try_lists
from stackgen.errors import StackgenError
from stackgen.models.block_list.network import BlockListNetwork, CNNConfig
from stackgen.models.block_list.predictor import CNNPredictor
from stackgen.models.block_list.tuning import ListTuning
from stackgen.models.optimization import OptimizerConfig
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.methods import load_predictor
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD, Mask
from tests.conftest import Cli, TinyWeights
from tests.models.conftest import trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

SMALL = CNNConfig(channels=8, layers=1, stem_stride=4, pool=8, hidden=32)


class KnowsItsScenes:
    """Builds the stack of a scene from its own list, and a row of blocks high in the air from any other."""

    world = PAPER_WORLD
    settings: Mapping[str, Any] = {}
    card: Mapping[str, Any] = {}

    def __init__(self, stacks: StackArrays) -> None:
        self.rows = {stacks.images([i]).tobytes(): i for i in range(len(stacks))}
        self.stacks = stacks

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """(B, num_samples) stacks."""
        return [[self._sample(*scene)] * num_samples for scene in zip(silhouettes, counts, strict=True)]

    def _sample(self, mask: Mask, counts: NDArray[np.int64]) -> Stack:
        row = self.rows[mask[None].tobytes()]
        k = self.stacks.lengths[row]
        if (counts == self.stacks.counts[row]).all():
            return Stack(
                self.stacks.shapes[row, :k].astype(int), self.stacks.poses[row, :k].astype(float), PAPER_CATALOGUE
            )
        shapes = np.repeat(np.arange(4), counts)
        return Stack(shapes, np.tile([0, 0, 50.0, 0, 0, 0], (len(shapes), 1)), PAPER_CATALOGUE)


class NotInTheAir(StabilityChecker):
    """Stable is what begins near the ground."""

    physics = Physics()

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        stable = bool(stack.poses[:, 2].min() < 2)
        return Verdict(stable, np.full(len(stack), not stable), np.zeros(len(stack)), stack)


@pytest.fixture(scope="module")
def tried(arrays: StackArrays) -> TriedLists:
    pl.seed_everything(0, verbose=False)
    predictor = CNNPredictor(BlockListNetwork(SMALL, PAPER_WORLD), PAPER_WORLD)
    return try_lists(KnowsItsScenes(arrays), predictor, NotInTheAir(), arrays, number=4, num_samples=2)


def test_the_likeliest_lists_are_tried_and_a_scene_s_own(arrays: StackArrays, tried: TriedLists) -> None:
    assert tried.lists.shape == (len(arrays), 5, 4)
    own = (tried.lists == tried.scenes.counts[:, None]).all(-1)
    assert own.any(axis=1).all()
    assert (tried.worth[own] > 0.97).all() and (tried.worth[~own] == 0).all()
    assert all(len(np.unique(lists, axis=0)) == 5 for lists in tried.lists)
    assert sorted(map(bytes, tried.scenes.silhouettes)) == sorted(map(bytes, arrays.silhouettes))


def test_where_the_own_list_is_likely_the_next_one_is_tried_too(arrays: StackArrays) -> None:
    class Foresees:
        world = PAPER_WORLD
        card: Mapping[str, Any] = {}

        def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> Any:
            """(B, top, S): one, two, three... cubes."""
            cubes = np.arange(1, top + 1)[:, None] * np.array([1, 0, 0, 0])
            return np.tile(cubes, (len(silhouettes), 1, 1))

    tower = arrays.select([0])
    shapes = np.full_like(tower.shapes, 255)
    shapes[0, :2] = 0
    towers = StackArrays(shapes, tower.poses, tower.silhouettes, tower.template, 4)
    lists = try_lists(KnowsItsScenes(towers), Foresees(), NotInTheAir(), towers, number=3).lists
    assert lists[0, :, 0].tolist() == [1, 2, 3, 4]
    predictor = CNNPredictor(BlockListNetwork(SMALL, PAPER_WORLD), PAPER_WORLD)
    with pytest.raises(StackgenError, match="too few to try 2000"):
        try_lists(KnowsItsScenes(towers), predictor, NotInTheAir(), towers, number=1999)


def test_they_come_back_from_a_file(tried: TriedLists, tmp_path: Path) -> None:
    tried.save(tmp_path / "tried.npz")
    again = TriedLists.load(tmp_path / "tried.npz")
    assert np.array_equal(again.lists, tried.lists) and np.array_equal(again.worth, tried.worth)
    assert np.array_equal(again.scenes.silhouettes, tried.scenes.silhouettes)
    assert [path.name for path in tmp_path.iterdir()] == ["tried.npz"]


@pytest.mark.parametrize("damage", ["empty", "compact", "one list", "not finite", "floating"])
def test_a_foreign_file_is_named_in_one_line(damage: str, tried: TriedLists, compact: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    tried.save(path)
    content = dict(np.load(path))
    match damage:
        case "empty":
            path.write_bytes(b"")
        case "compact":
            path = compact
        case "one list":
            np.savez(path, **content | {"lists": content["lists"][:, :1], "worth": content["worth"][:, :1]})
        case "not finite":
            np.savez(path, **content | {"worth": content["worth"] * np.float32("nan")})
        case "floating":
            np.savez(path, **content | {"lists": content["lists"] * 0.5})
    with pytest.raises(StackgenError, match=r"^[^\n]*tried lists[^\n]*$"):
        TriedLists.load(path)
    with pytest.raises(StackgenError, match=r"^no tried lists at .*: make them with `stackgen prefer --lists 8`$"):
        TriedLists.load(tmp_path / "nothing.npz")


def module_for(path: Path, **options: Any) -> ListTuning:
    pl.seed_everything(0, verbose=False)
    optimizer = OptimizerConfig(learning_rate=3e-3, warmup=1)
    return ListTuning(str(path), cnn=SMALL, optimizer=optimizer, **{"scenes": 32, **options})


def data_of(compact: Path) -> StackDataModule:
    return StackDataModule(compact, batch_size=8, mirror=True)


def test_the_network_comes_to_prefer_what_is_worth_most(tried: TriedLists, compact: Path, tmp_path: Path) -> None:
    tried.save(tmp_path / "tried.npz")
    worths: list[float] = []

    class Watch(pl.Callback):
        def on_train_batch_end(self, trainer: pl.Trainer, *rest: Any) -> None:
            worths.append(float(trainer.callback_metrics["train/worth"]))

    trainer = trainer_for(tmp_path, max_steps=60, callbacks=[Watch()])
    trainer.fit(module_for(tmp_path / "tried.npz"), data_of(compact))
    assert worths[0] < 0.25  # one list of five, and it knows none yet
    assert np.mean(worths[-10:]) > 0.8


def test_its_checkpoints_are_those_of_a_block_list_network(tried: TriedLists, compact: Path, tmp_path: Path) -> None:
    tried.save(tmp_path / "tried.npz")
    trainer = trainer_for(tmp_path, max_steps=1)
    trainer.fit(module_for(tmp_path / "tried.npz"), data_of(compact))
    trainer.save_checkpoint(tmp_path / "x.ckpt")
    assert isinstance(load_predictor(tmp_path / "x.ckpt"), CNNPredictor)


@pytest.mark.parametrize("checker", ["simulator", "statics"])
def test_prefer_tries_the_lists_of_a_network(
    checker: str, cli: Cli, tiny: TinyWeights, towers_dataset: Path, tmp_path: Path
) -> None:
    command = ["prefer", "--data", towers_dataset, "--weights", tiny.sampler, "--block_list_weights", tiny.predictor]
    asked = [*command, "--scenes", 3, "--lists", 2, "--num_samples", 1, "--workers", 1, "--sampler.steps", 2]
    answer = cli(*asked, "--checker", checker, "--out", tmp_path / "tried.npz")
    assert answer.code == 0, answer.err
    tried = TriedLists.load(tmp_path / "tried.npz")
    assert tried.lists.shape == (3, 3, 4)
    assert cli(*asked, "--lists", -1, "--out", tmp_path / "no.npz").line.endswith("--seed and --lists at least 0")
