"""What several tests share: a model that needs no weights, and command lines that answer as data."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

from stackgen.api import Model
from stackgen.commands.cli import main
from stackgen.evaluation.metrics import SCENE_METRICS
from stackgen.stack import Stack, shapes_of
from stackgen.world import PAPER_WORLD, Mask

settings.register_profile("patient", deadline=None)  # on a busy machine the slowest example says nothing
settings.load_profile("patient")


OF_BULLET = ("tests/robot", "tests/commands/test_build.py")
"""Tests of the simulated arm, which lives in PyBullet."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests of the arm where PyBullet is missing."""
    if find_spec("pybullet"):
        return
    for item in items:
        if item.nodeid.startswith(OF_BULLET):
            item.add_marker(pytest.mark.skip(reason="needs PyBullet, which has wheels for CPython 3.11"))


class Answer(NamedTuple):
    """What a command line answered."""

    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The one line on stderr; a test that asks for it fails if there are more, or none."""
        lines = self.err.splitlines()
        assert len(lines) == 1, f"one line expected on stderr, got:\n{self.err}"
        return lines[0]


Cli = Callable[..., Answer]

CHILD = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
"""Environment of a command line in a process of its own, wherever that runs."""


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    """Run a command line in this process."""

    def run(*arguments: object) -> Answer:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in err, err
        return Answer(code, out, err)

    return run


def workers_of(session: int) -> list[int]:
    """Worker processes that live in a session."""
    answer = subprocess.run(["ps", "-ww", "-s", str(session), "-o", "pid=,args="], capture_output=True, text=True)
    return [int(line.split()[0]) for line in answer.stdout.splitlines() if "spawn_main" in line]


def allow_interrupts() -> None:
    """For a child that is to be interrupted: a test run in the background would pass on that Ctrl-C is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class TowerSampler:
    """Puts the blocks on top of each other, each a little to one side as the seed says."""

    world = PAPER_WORLD
    settings: Mapping[str, Any] = MappingProxyType({})
    card: Mapping[str, Any] = MappingProxyType({})

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        """Towers, whatever the silhouettes."""
        rng = np.random.default_rng(seed)
        return [[self._tower(list_, rng) for _ in range(num_samples)] for list_ in counts]

    @staticmethod
    def _tower(counts: NDArray[np.int64], rng: np.random.Generator) -> Stack:
        shapes = shapes_of(counts)
        poses = np.zeros((len(shapes), 6))
        poses[:, 0] = rng.uniform(-0.05, 0.05, len(shapes))
        poses[:, 2] = np.arange(len(shapes)) + 0.5
        return Stack(shapes, poses)


class ThreeCubes:
    """Predicts three cubes, whatever the silhouette."""

    world = PAPER_WORLD
    card: Mapping[str, Any] = MappingProxyType({})

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """(B, top, S) block lists."""
        return np.tile(np.array([3, 0, 0, 0]), (len(silhouettes), top, 1))


@pytest.fixture
def towers(monkeypatch: pytest.MonkeyPatch) -> Model:
    """A model that needs no weights; `stackgen sample` uses it while the test runs."""
    model = Model(TowerSampler(), ThreeCubes())
    monkeypatch.setattr("stackgen.api.load", lambda *names: model)
    monkeypatch.setattr("stackgen.api.pictures._network", lambda: model)
    return model


class TinyWeights(NamedTuple):
    """Untrained weights of both networks."""

    sampler: Path
    predictor: Path

    @property
    def options(self) -> list[str]:
        """As the command line takes them."""
        return ["--weights", str(self.sampler), "--block_list_weights", str(self.predictor)]


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> TinyWeights:
    """Files of networks that nobody trained, small enough to be fast."""
    import torch

    from stackgen.models.block_list.module import BlockListCNN
    from stackgen.models.block_list.network import CNNConfig
    from stackgen.models.diffusion.module import DDPM
    from stackgen.models.transformer import TransformerConfig
    from stackgen.models.weights import write_weights

    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    ddpm = DDPM(TransformerConfig(width=32, layers=1, heads=2, feedforward=64))
    cnn = BlockListCNN(CNNConfig(channels=8, layers=1, stem_stride=4, pool=8, hidden=16))
    for name, module in (("ddpm", ddpm), ("cnn", cnn)):
        module.build(PAPER_WORLD)
        write_weights(folder / f"{name}.safetensors", module.model.state_dict(), module.card())
    return TinyWeights(folder / "ddpm.safetensors", folder / "cnn.safetensors")


def draw_tower(path: Path, width: int = 40, height: int = 120) -> Path:
    """Write a picture of a tower, dark on light."""
    from PIL import Image

    picture = np.full((160, 120), 255, dtype=np.uint8)
    picture[150 - height : 150, 60 - width // 2 : 60 + width // 2] = 0
    Image.fromarray(picture).save(path)
    return path


@pytest.fixture
def tower_image(tmp_path: Path) -> Path:
    """A picture of a tower."""
    return draw_tower(tmp_path / "tower.png")


def stacks_json(*stacks: list[tuple[str, float, float]]) -> dict[str, Any]:
    """The plain form of stacks of (shape, x, z)."""
    blocks = [[{"shape": name, "position": [x, 0, z]} for name, x, z in stack] for stack in stacks]
    return {"format": "stackgen.stacks/1", "stacks": [{"blocks": b} for b in blocks]}


@pytest.fixture
def stands(tmp_path: Path) -> Path:
    """A file of one stack that stands."""
    path = tmp_path / "stands.json"
    path.write_text(json.dumps(stacks_json([("cube", 0, 0.5), ("triangle", 0, 1.5)])))
    return path


@pytest.fixture(scope="session")
def towers_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of towers of one to three cubes: 48 to train on, 12 to validate, 12 to test."""
    return write_towers(tmp_path_factory.mktemp("dataset"), {"train": 48, "validation": 12, "test": 12})


def write_towers(folder: Path, sizes: dict[str, int]) -> Path:
    """Write a dataset of towers of one to three cubes, a shard for each split."""
    from stackgen.data.manifest import Manifest
    from stackgen.data.shards import Sample, write_shard
    from stackgen.geometry import silhouette
    from stackgen.sim.physics import Physics
    from stackgen.world import PAPER_GRID

    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    entries = []
    for number, (split, size) in enumerate(sizes.items()):
        samples = []
        for i in range(size):
            stack = TowerSampler._tower(np.array([1 + i % 3, 0, 0, 0]), rng)
            poses = stack.poses.astype(np.float32)
            meta = {"template": 100 * number + i, "layout": "", "removed": []}
            picture = silhouette(stack.with_poses(poses), PAPER_GRID)
            samples.append(Sample(f"{number}{i:04d}", stack.shapes.astype(np.uint8), poses, picture, meta))
        entries.append(write_shard(folder / f"{split}-{number:06d}.tar", samples))
    physics = Physics().to_json()
    Manifest("towers", 0, PAPER_WORLD, physics, {}, tuple(entries)).save(folder)
    return folder


@pytest.fixture
def no_new_metrics(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A metric that a test adds is measured in this test alone."""
    before = dict(SCENE_METRICS)
    monkeypatch.delitem(sys.modules, "examples.extending.metric", raising=False)  # it adds one when it is loaded
    yield
    SCENE_METRICS.clear()
    SCENE_METRICS.update(before)
