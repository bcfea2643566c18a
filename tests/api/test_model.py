"""The library answers as the command line does, from files and arrays alike."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import stackgen
from stackgen.api import Model, check
from stackgen.api.model import _configured
from stackgen.errors import StackgenError
from stackgen.geometry import mirror, silhouette
from stackgen.io.stacks_file import read_stacks
from stackgen.models.diffusion.settings import SPACING, SamplerConfig
from stackgen.sampling.verified import Budget
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, PAPER_WORLD, Mask
from tests.conftest import Cli, TinyWeights


def same(a: list[Stack], b: list[Stack]) -> bool:
    return all(
        np.array_equal(x.shapes, y.shapes) and np.array_equal(x.poses, y.poses) for x, y in zip(a, b, strict=True)
    )


class KnowsThePapersWorld:
    """What a sampler and a predictor say of themselves."""

    world = PAPER_WORLD
    settings: Mapping[str, Any] = MappingProxyType({})
    card: Mapping[str, Any] = MappingProxyType({})


@pytest.fixture
def model(tiny: TinyWeights) -> Model:
    return stackgen.load(tiny.sampler, tiny.predictor)


def test_names_of_the_package_exist_and_unknown_ones_do_not() -> None:
    assert {"load", "sample", "Model"} <= set(dir(stackgen))
    assert all(getattr(stackgen, name) for name in stackgen.__all__)
    with pytest.raises(AttributeError, match="nothing"):
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


def test_with_the_size_of_a_cell_weights_are_asked_for_the_structure_at_its_scale(
    cli: Cli, tiny: TinyWeights, tmp_path: Path
) -> None:
    frame = Path(__file__).parents[2] / "examples" / "photos" / "stack-castle-depth.png"
    for size, cells in ((0.05, 4), (0.067, 3)):
        answer = cli("sample", frame, "--cell_size", size, "--num_samples", 1, "--out", tmp_path / "out", *tiny.options)
        assert answer.code == 0, answer.err
        target = read_stacks(tmp_path / "out" / "stacks.json").target
        assert target is not None and np.count_nonzero(target.any(axis=1)) == pytest.approx(14 * cells, abs=3)


def test_what_falls_has_no_iou_and_what_stands_has_its_silhouettes(towers: Model) -> None:
    tower = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
    floating = tower.with_poses(tower.poses + [0, 0, 2, 0, 0, 0])
    target = silhouette(tower, PAPER_GRID)
    assert check(towers.checker, tower, target, PAPER_GRID).front_iou == pytest.approx(1, abs=0.02)
    assert check(towers.checker, floating, target, PAPER_GRID).front_iou == 0
    assert check(towers.checker, tower, None, PAPER_GRID).front_iou is None
    assert check(towers.checker, mirror(tower), np.fliplr(target), PAPER_GRID).front_iou == pytest.approx(1, abs=0.02)


def test_progress_is_told_once_for_the_poses_and_once_a_verdict(towers: Model, tower_image: Path) -> None:
    steps: list[None] = []
    towers.sample_checked(tower_image, num_samples=4, on_step=lambda: steps.append(None))
    assert len(steps) == 5


def test_a_model_without_predictor_asks_for_a_block_list(towers: Model, tower_image: Path) -> None:
    alone = Model(towers.sampler)
    assert len(alone.sample(tower_image, blocks="cube=1")) == 3
    with pytest.raises(StackgenError, match="give one"):
        alone.sample(tower_image)


def test_a_sampler_without_a_world_is_refused() -> None:
    with pytest.raises(StackgenError, match="Worldless has no world"):
        Model(type("Worldless", (), {"settings": {}, "card": {}})())


class Remembers(KnowsThePapersWorld):
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
    tower = silhouette(
        Stack(np.array([0, 0, 0, 0]), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)])), PAPER_GRID
    )
    sampler = Remembers()
    stacks = Model(sampler).sample(tower, num_samples=1, blocks="cube=4")
    assert sampler.seen is not None
    edges = np.flatnonzero(np.diff(sampler.seen[40].astype(int))) + 1 - PAPER_GRID.image_size / 2
    assert np.all(edges % PAPER_GRID.pixels_per_cell == 0)  # a tower of odd width stands half a cell beside the middle
    assert abs(stacks[0].poses[0, 0]) < 1e-9  # and yet the answer is where the drawing was


def test_settings_of_the_sampler_reach_it_and_the_file(tiny: TinyWeights, tower_image: Path) -> None:
    few = stackgen.load(tiny.sampler, tiny.predictor, SamplerConfig("dpm", 4))
    result = few.sample_checked(tower_image, num_samples=2)
    assert result.sampler == {"kind": "dpm", "steps": 4, "spacing": SPACING, "eta": 0.0}
    assert same(result.stacks, few.sample(tower_image, num_samples=2))
    assert not same(result.stacks, stackgen.load(tiny.sampler, tiny.predictor).sample(tower_image, num_samples=2))


def test_settings_are_for_diffusion_models_alone() -> None:
    with pytest.raises(StackgenError, match="no diffusion model"):
        _configured(Remembers(), "heuristic", SamplerConfig("dpm"))
    assert isinstance(_configured(Remembers(), "heuristic", SamplerConfig()), Remembers)


class Towers(KnowsThePapersWorld):
    """Straight towers where the target is: they stand, but those of three blocks begin in the air."""

    def sample_batch(
        self, silhouettes: Mask, counts: NDArray[np.int64], num_samples: int, seed: int
    ) -> list[list[Stack]]:
        scenes = []
        for mask, list_ in zip(silhouettes, counts, strict=True):
            k = int(list_.sum())
            poses = np.zeros((k, 6))
            poses[:, 0] = (np.flatnonzero(mask.any(axis=0)).mean() - 31.5) / PAPER_GRID.pixels_per_cell
            poses[:, 2] = np.arange(k) + 0.5 + 3 * (k == 3)
            noise = np.random.default_rng(seed).uniform(-0.01, 0.01, num_samples)
            scenes.append([Stack(np.zeros(k, dtype=np.int64), poses + [x, 0, 0, 0, 0, 0]) for x in noise])
        return scenes


class TwoLists(KnowsThePapersWorld):
    """Predicts three cubes, then four."""

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        lists = np.array([[3, 0, 0, 0], [4, 0, 0, 0]])
        lists = lists if limit is None else lists[(lists <= limit).all(axis=1)]
        return np.tile(lists[:top], (len(silhouettes), 1, 1))


FOUR = silhouette(
    Stack(np.zeros(4, dtype=np.int64), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)])), PAPER_GRID
)


@pytest.fixture
def four() -> Model:
    return Model(Towers(), TwoLists())


def test_verified_stacks_come_with_verdicts_and_what_was_spent(four: Model) -> None:
    steps: list[None] = []
    result = four.sample_verified(FOUR, 2, seed=3, blocks="cube=4", on_step=lambda: steps.append(None))
    assert len(steps) == 3 and result.comment == "verified by simulator: 8 stacks drawn, 2 checked, 2 stable"
    assert result.sampler == {"verify": "simulator", "draws": 64}
    assert same(result.stacks, four.sample_verified(FOUR, 2, seed=3, blocks="cube=4").stacks)
    assert not same(result.stacks, four.sample_verified(FOUR, 2, seed=4, blocks="cube=4").stacks)
    for entry in result.entries:
        assert entry.verdict and entry.verdict.stable and not entry.comment
        assert entry.front_iou == check(four.checker, entry.stack, result.target, PAPER_GRID).front_iou
        assert entry.front_iou is not None and entry.front_iou > 0.95


def test_statics_may_judge_and_the_simulator_has_the_last_word(four: Model) -> None:
    result = four.sample_verified(FOUR, 1, blocks="cube=4", verify="statics", budget=Budget(8))
    verdict = result.entries[0].verdict
    assert verdict is not None and verdict.margin is None  # the simulator's verdict has none
    assert result.sampler == {"verify": "statics", "draws": 8}
    with pytest.raises(StackgenError, match="simulator or statics"):
        four.sample_verified(FOUR, verify="guess")  # type: ignore[arg-type]


def test_another_list_is_tried_unless_one_was_given(four: Model) -> None:
    found = four.sample_verified(FOUR, 1, budget=Budget(8))
    assert found.block_list is not None and found.block_list.tolist() == [4, 0, 0, 0]
    assert found.entries[0].verdict and found.entries[0].verdict.stable and "2 block lists" in found.comment
    given = four.sample_verified(FOUR, 1, blocks="cube=3", budget=Budget(8))
    assert given.block_list is not None and given.block_list.tolist() == [3, 0, 0, 0]
    assert given.entries[0].verdict and not given.entries[0].verdict.stable and given.entries[0].front_iou == 0
    assert given.entries[0].comment == "nothing stable was found for it"


def test_the_block_list_comes_from_the_inventory(four: Model) -> None:
    assert four.sample(FOUR, 1)[0].names == ["cube"] * 3
    assert four.sample(FOUR, 1, inventory="cube=7,rectangle=9")[0].names == ["cube"] * 4
    assert four.predict_blocks(FOUR, {"cube": 7}).tolist() == [4, 0, 0, 0]
    checked = four.sample_checked(FOUR, 1, inventory={"cube": 7})
    assert checked.inventory is not None and checked.inventory.tolist() == [7, 0, 0, 0]
    assert checked.block_list_source == "cnn" and checked.block_list is not None
    assert four.sample_verified(FOUR, 1, inventory="cube=4").entries[0].front_iou > 0.95  # type: ignore[operator]
    with pytest.raises(StackgenError, match="too small"):
        four.sample(FOUR, 1, inventory="cube=1")
    with pytest.raises(StackgenError, match="not both"):
        four.sample(FOUR, 1, blocks="cube=2", inventory="cube=2")


def test_the_command_line_verifies_and_answers_by_its_exit_code(
    cli: Cli, four: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stackgen.api.load", lambda *names: four)
    Image.fromarray(FOUR).save(tmp_path / "four.png")
    options = tmp_path / "four.png", "--num_samples", 2, "--out", tmp_path / "out"
    answer = cli("sample", "--blocks", "cube=4", "--verify", "--budget", "30s", *options)
    assert answer.code == 0 and "four.png: verified by simulator: 8 stacks drawn, 2 checked, 2 stable" in answer.out
    answer = cli("sample", "--blocks", "cube=3", "--verify", "simulator", "--budget", "8", *options)
    assert answer.code == 1 and "stack 1 falls: nothing stable was found for it" in answer.out
    assert read_stacks(tmp_path / "out" / "stacks.json").sampler == {"verify": "simulator", "draws": 8}
    assert cli("sample", "--one_shot", "--blocks", "cube=3", *options).code == 0  # unverified, it only reports


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--one_shot", "--budget", "1s"], "--verify"),
        (["--one_shot", "--cells", "6"], "--cells"),
        (["--one_shot", "--prefer", "margin"], "--prefer"),
        (["--cells", "9"], "cells"),
        (["--verify", "--budget", "soon"], "a time, such as 1s"),
        (["--one_shot", "--inventory", "cube=1"], "tower.png: the inventory cube=1 is too small"),
        (["--inventory", "cone=1"], "unknown shape 'cone'"),
        (["--inventory", "cube=9", "--blocks", "cube=3"], "not both"),
        (["--sampler.steps", "0"], "at least 1"),
        (["--verify", "guess"], "guess"),
    ],
)
def test_what_cannot_be_asked_is_one_line(
    options: list[str], message: str, cli: Cli, towers: Model, tower_image: Path, tmp_path: Path
) -> None:
    answer = cli("sample", tower_image, "--out", tmp_path / "out", *options)
    assert answer.code == 2 and message in answer.line
    assert not (tmp_path / "out").exists()
