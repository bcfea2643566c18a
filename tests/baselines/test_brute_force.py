"""The vectorised search is the search of the paper's words, and finds what there is to find."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stackgen.baselines.brute_force import BruteForce
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Scene, scenes_of
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID
from tests.baselines.naive import naive_search


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Ten of the frozen test scenes."""
    arrays = Dataset.open(TESTSET).split("test")
    return scenes_of(arrays.select(np.arange(0, 500, 50)), PAPER_CATALOGUE)


@pytest.mark.parametrize(
    "settings", [{}, {"penalty": 0.5, "step": 1 / 14}, {"penalty": 0.0, "starts": 7, "steps": 6}], ids=str
)
def test_the_same_placements_as_the_naive_loop(settings: dict[str, Any], scenes: list[Scene]) -> None:
    small = {"starts": 10, "steps": 10}  # the loop is slow; the whole search is compared below
    method = BruteForce(**{**small, **settings})
    for number, scene in enumerate(scenes[:2]):
        wrong = np.roll(scene.counts, 1)  # a list that does not make the silhouette
        for counts in (scene.counts, wrong):
            ours, naive = (
                search(method, scene.silhouette, counts, np.random.default_rng(number))
                for search in (BruteForce.search, naive_search)
            )
            assert ours.shapes.tolist() == naive.shapes.tolist()
            assert np.array_equal(ours.poses, naive.poses)


@pytest.mark.slow
def test_the_same_placements_as_the_naive_loop_with_all_candidates(scenes: list[Scene]) -> None:
    method = BruteForce()
    for number, scene in enumerate(scenes):
        ours = method.search(scene.silhouette, scene.counts, np.random.default_rng(number))
        naive = naive_search(method, scene.silhouette, scene.counts, np.random.default_rng(number))
        assert np.array_equal(ours.poses, naive.poses)


def test_the_same_placements_on_pictures_without_any_structure() -> None:
    rng = np.random.default_rng(0)
    noise = rng.random((64, 64)) < 0.4
    method = BruteForce(starts=6, steps=6)
    counts = np.array([2, 1, 1, 2])
    for picture in (noise, np.zeros((64, 64), bool), np.ones((64, 64), bool)):
        ours = method.search(picture, counts, np.random.default_rng(1))
        naive = naive_search(method, picture, counts, np.random.default_rng(1))
        assert np.array_equal(ours.poses, naive.poses)


def test_candidates_are_the_paper_s() -> None:
    x, level = BruteForce().candidates(np.random.default_rng(0))
    assert len(x) == len(level) == 400
    starts = np.array([x[20 * i : 20 * (i + 1)].mean() for i in range(20)])
    assert np.abs(starts).max() <= 1.5  # [-3, 3] in half cells
    many = np.concatenate([BruteForce().candidates(np.random.default_rng(i))[1] for i in range(50)])
    assert set(many) == {0, 1, 2, 3}  # z in {1, 3, 5, 7} half cells
    assert np.abs(np.bincount(many) / len(many) - 0.25).max() < 0.05
    line = np.sort(x[:20] - starts[0])
    one_side = 0.15 * np.arange(1, 11)
    assert np.allclose(line, np.concatenate([-one_side[::-1], one_side]))  # along x, both ways


def test_a_lone_block_is_found() -> None:
    rng = np.random.default_rng(3)
    method = BruteForce(sigma=0)
    for shape in range(4):
        x, level = rng.uniform(-0.5, 0.5), int(rng.integers(0, 4))
        target = silhouette(Stack(np.array([shape]), np.array([[x, 0, level + 0.5, 0, 0, 0]])), PAPER_GRID)
        (found,) = method.search(target, np.eye(4, dtype=np.int64)[shape], rng).poses
        assert found[2] == level + 0.5
        assert abs(found[0] - x) < 0.1


def test_blocks_keep_clear_of_each_other() -> None:
    target = np.zeros((64, 64), bool)
    target[46:60, 18:46] = True  # two cells wide
    for seed in range(5):
        found = BruteForce(sigma=0).search(target, np.array([2, 0, 0, 0]), np.random.default_rng(seed))
        assert abs(found.poses[0, 0] - found.poses[1, 0]) > 0.85
        assert iou(silhouette(found, PAPER_GRID), target) > 0.85
    target[:, 32:] = False  # room for one only
    shifts = []
    for penalty in (0.0, 2.0):
        found = BruteForce(sigma=0, penalty=penalty).search(target, np.array([2, 0, 0, 0]), np.random.default_rng(0))
        shifts.append(np.abs(found.poses[0] - found.poses[1]).max())
    assert shifts[0] < 0.1 and shifts[1] > 0.9


def test_settings_that_mean_nothing_are_refused() -> None:
    for wrong in ({"sigma": 1.1}, {"starts": 0}, {"steps": 3}, {"step": 0.0}, {"penalty": -1.0}):
        with pytest.raises(StackgenError, match="brute force"):
            BruteForce(**wrong)
