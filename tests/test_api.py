"""The library answers as the command line does, from files and arrays alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import stackgen
from stackgen.api import Model
from stackgen.geometry import PAPER_GRID, Mask, mirror, silhouette
from stackgen.stack import Stack, StackgenError
from stackgen.stacks_file import read_stacks
from tests.conftest import Cli, TinyWeights


def same(a: list[Stack], b: list[Stack]) -> bool:
    return all(
        np.array_equal(x.shapes, y.shapes) and np.array_equal(x.poses, y.poses) for x, y in zip(a, b, strict=True)
    )


@pytest.fixture
def model(tiny: TinyWeights) -> Model:
    return stackgen.load(tiny.sampler, tiny.predictor)


def test_names_of_the_package_exist_and_unknown_ones_do_not() -> None:
    assert {"load", "sample", "Model"} <= set(dir(stackgen))
    assert all(getattr(stackgen, name) for name in stackgen.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = stackgen.nothing


def test_same_seed_same_stacks(model: Model, tower_image: Path) -> None:
    first, again = (model.sample(tower_image, num_samples=2, seed=4) for _ in range(2))
    assert same(first, again)
    assert not same(first, model.sample(tower_image, num_samples=2, seed=5))


def test_file_path_and_array_are_one(model: Model, tower_image: Path) -> None:
    from_path = model.sample(tower_image)
    assert same(from_path, model.sample(str(tower_image)))
    assert same(from_path, model.sample(np.asarray(Image.open(tower_image))))
    assert same(from_path, model.sample(model.read(tower_image)))


def test_block_lists_of_every_form_are_one(model: Model, tower_image: Path) -> None:
    stacks = model.sample(tower_image, blocks="cube=2,triangle=1")
    assert [stack.names for stack in stacks] == [["cube", "cube", "triangle"]] * 3
    assert same(stacks, model.sample(tower_image, blocks={"cube": 2, "triangle": 1}))
    assert same(stacks, model.sample(tower_image, blocks=np.array([2, 0, 0, 1])))
    for wrong in ({"cube": -1, "triangle": 2}, {"cone": 1}, np.array([1, 2]), np.array([11, 0, 0, 0])):
        with pytest.raises(StackgenError):
            model.sample(tower_image, blocks=wrong)


def test_the_command_line_answers_as_the_library(
    cli: Cli, model: Model, tiny: TinyWeights, tower_image: Path, tmp_path: Path
) -> None:
    answer = cli("sample", tower_image, "--seed", 7, "--out", tmp_path / "out", *tiny.options)
    assert answer.code == 0, answer.err
    written = read_stacks(tmp_path / "out" / "stacks.json")
    result = model.sample_checked(tower_image, seed=7)
    assert same(written.stacks, result.stacks) and same(written.stacks, model.sample(tower_image, seed=7))
    assert written.weights == result.weights and written.weights is not None
    assert [e.front_iou for e in written.entries] == [e.front_iou for e in result.entries]


def test_what_falls_has_no_iou_and_what_stands_has_its_silhouettes(towers: Model) -> None:
    tower = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
    floating = tower.with_poses(tower.poses + [0, 0, 2, 0, 0, 0])
    target = silhouette(tower)
    judge = stackgen.api.judge
    assert judge(towers.checker, tower, target).front_iou == pytest.approx(1, abs=0.02)
    assert judge(towers.checker, floating, target).front_iou == 0
    assert judge(towers.checker, tower).front_iou is None
    assert judge(towers.checker, mirror(tower), np.fliplr(target)).front_iou == pytest.approx(1, abs=0.02)


def test_progress_is_told_once_for_the_poses_and_once_a_verdict(towers: Model, tower_image: Path) -> None:
    steps: list[None] = []
    towers.sample_checked(tower_image, num_samples=4, on_step=lambda: steps.append(None))
    assert len(steps) == 5


def test_a_model_without_predictor_asks_for_a_block_list(towers: Model, tower_image: Path) -> None:
    alone = Model(towers.sampler)
    assert len(alone.sample(tower_image, blocks="cube=1")) == 3
    with pytest.raises(StackgenError, match="give one"):
        alone.sample(tower_image)


class Remembers:
    """A sampler that keeps what it was shown and answers with a cube in the middle of the lowest row it saw."""

    def __init__(self) -> None:
        self.seen: Mask | None = None

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        self.seen = silhouettes[0]
        columns = np.flatnonzero(self.seen[59])
        x = (columns.mean() + 0.5 - PAPER_GRID.image_size / 2) / PAPER_GRID.pixels_per_cell
        return [[Stack(np.array([0]), np.array([[x, 0, 0.5, 0, 0, 0]]))] * num_samples]


def test_the_sampler_sees_the_structure_on_the_cells_of_its_grid_and_the_answer_moves_back() -> None:
    tower = silhouette(Stack(np.array([0, 0, 0, 0]), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)])))
    sampler = Remembers()
    stacks = Model(sampler).sample(tower, num_samples=1, blocks="cube=4")
    assert sampler.seen is not None
    edges = np.flatnonzero(np.diff(sampler.seen[40].astype(int))) + 1 - PAPER_GRID.image_size / 2
    assert np.all(edges % PAPER_GRID.pixels_per_cell == 0)  # a tower of odd width stands half a cell beside the middle
    assert abs(stacks[0].poses[0, 0]) < 1e-9  # and yet the answer is where the drawing was
