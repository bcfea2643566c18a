"""Samplers are shown structures at the scale and in the place of cells; their stacks stand where these were drawn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import pytest

from stackgen.data.dataset import TESTSET, Dataset
from stackgen.sampling.alignment import AlignedSampler, aligned, as_shown, cell_scale
from stackgen.search.sampler import SearchSampler
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Mask

FOOT = round(PAPER_GRID.image_size - PAPER_GRID.ground_margin)


@pytest.fixture(scope="module")
def scenes() -> Mask:
    """Silhouettes (40, 64, 64) of stacks that stand on cells."""
    return np.stack([sample.silhouette for sample in Dataset.open(TESTSET).samples("test")][:40])


def drawn_at(mask: Mask, scale: float) -> Mask:
    """A silhouette, scaled about the middle of the ground line."""
    still = np.array([PAPER_GRID.image_size / 2, FOOT]) - 0.5
    turn = np.column_stack([scale * np.eye(2), still * (1 - scale)])
    return np.asarray(cv2.warpAffine(mask.astype(np.float32), turn, mask.shape[::-1]) >= 0.5)


class Recorder:
    """A sampler that keeps what it was shown, and answers with a cube in the middle of the grid."""

    world = PAPER_WORLD
    card: Mapping[str, Any] = {}
    shown: Mask

    def sample_batch(self, silhouettes: Mask, counts: object, num_samples: int, seed: int) -> list[list[Stack]]:
        """See StackSampler."""
        self.shown = silhouettes
        return [[Stack(np.array([0]), np.array([[0, 0, 0.5, 0, 0, 0.0]]), PAPER_CATALOGUE)] for _ in silhouettes]


def test_what_stands_on_cells_keeps_its_scale(scenes: Mask) -> None:
    assert {cell_scale(mask, PAPER_GRID) for mask in scenes} == {1.0}


@pytest.mark.parametrize("scale", [0.83, 0.87, 0.9])
def test_what_was_drawn_too_small_is_shown_at_its_scale(scenes: Mask, scale: float) -> None:
    found = np.array([cell_scale(drawn_at(mask, scale), PAPER_GRID) for mask in scenes])
    assert (np.abs(found * scale - 1) < 0.03).mean() > 0.8
    shown = [aligned(drawn_at(mask, scale), PAPER_GRID)[0] for mask in scenes]
    alike = [max(overlap(np.roll(one, shift, 1), mask) for shift in range(-14, 15))
             for one, mask in zip(shown, scenes, strict=True)]  # fmt: skip
    assert np.median(alike) > 0.93


def overlap(one: Mask, two: Mask) -> float:
    """IoU of two masks."""
    return float(np.count_nonzero(one & two) / np.count_nonzero(one | two))


def test_what_does_not_fit_at_another_scale_keeps_its_own() -> None:
    tower = np.zeros((64, 64), dtype=bool)
    tower[FOOT - 56 : FOOT, 23:41] = True  # as high as the grid, and more than a cell wide
    assert cell_scale(tower, PAPER_GRID) <= 1
    assert cell_scale(np.zeros((64, 64), dtype=bool), PAPER_GRID) == 1
    beside = np.zeros((64, 64), dtype=bool)
    beside[FOOT - 25 : FOOT, :25] = True  # at nine tenths of its scale, and at the picture's edge
    assert cell_scale(beside, PAPER_GRID) <= 1 and cell_scale(np.roll(beside, 20, axis=1), PAPER_GRID) > 1


def test_what_is_higher_than_the_grid_is_not_made_smaller_for_that_alone() -> None:
    tall = np.zeros((64, 64), dtype=bool)
    tall[FOOT - 60 : FOOT, 18:46] = True  # two cells wide, and 4 pixels higher than the grid
    own = cell_scale(tall[:, ::-1], PAPER_GRID)
    assert own == cell_scale(tall, PAPER_GRID) == 1


def test_a_stack_stands_where_the_structure_was_drawn() -> None:
    recorder, mask = Recorder(), np.zeros((64, 64), dtype=bool)
    mask[FOOT - 13 : FOOT, 40:53] = True  # a cube at nine tenths of its scale
    [[stack]] = AlignedSampler(recorder).sample_batch(mask[None], np.zeros((1, 4), int), 1, 0)  # type: ignore[arg-type]
    columns = np.flatnonzero(recorder.shown[0].any(axis=0))
    assert len(columns) in (14, 15)
    moved = (columns[0] + columns[-1] - (40 + 52)) / 2 / 14
    assert stack.poses[0, 0] == pytest.approx(-moved, abs=0.04)


def test_the_search_is_shown_what_was_drawn(scenes: Mask) -> None:
    drawn = drawn_at(scenes[0], 0.87)
    shown, offset = as_shown(drawn, SearchSampler())
    assert (shown == drawn).all() and offset == 0
