"""Random placement is legal, and nothing but random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from stackgen.baselines.random_placement import RandomPlacement
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_WORLD, Catalogue, Grid, Shape

PICTURE = np.zeros((64, 64), dtype=bool)


def extents(stack: Stack) -> list[tuple[float, float, float]]:
    widths = [stack.catalogue[int(s)].size[0] for s in stack.shapes]
    return [(x - w / 2, x + w / 2, z) for (x, z), w in zip(stack.poses[:, [0, 2]], widths, strict=True)]


@settings(max_examples=80, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=4, max_size=4).filter(lambda c: 1 <= sum(c) <= 10), st.integers(0, 2**32))
def test_places_are_legal(counts: list[int], seed: int) -> None:
    stack = RandomPlacement().place(PICTURE, np.array(counts), np.random.default_rng(seed))
    assert stack.counts.tolist() == counts
    blocks = extents(stack)
    for i, (left, right, z) in enumerate(blocks):
        assert -2 - 1e-9 <= left and right <= 2 + 1e-9
        for other_left, other_right, other_z in blocks[:i]:
            assert z != other_z or right <= other_left + 1e-9 or other_right <= left + 1e-9
        under = [(a, b) for a, b, below in blocks if below == z - 1]
        assert z == 0.5 or any(a < right and left < b for a, b in under)


def test_a_place_is_drawn_uniformly_from_all_legal_ones() -> None:
    rng = np.random.default_rng(0)
    one = np.array([RandomPlacement().place(PICTURE, np.array([1, 0, 0, 0]), rng).poses[0] for _ in range(400)])
    assert (one[:, 2] == 0.5).all()
    assert kstest(one[:, 0], "uniform", args=(-1.5, 3)).pvalue > 0.01
    # A second cube: beside the first, where there is room, or on it; as often as the lengths say.
    layers = [[(-0.5, 0.5)], [], [], []]
    method = RandomPlacement()
    assert method.legal(1, 0, layers) == [(-1.5, -1.0), (1.0, 1.5)] and method.legal(1, 1, layers) == [(-1.0, 1.0)]
    assert method.legal(1, 2, layers) == []
    levels = [method._draw(1, layers, rng)[1] for _ in range(600)]
    assert np.mean(levels) == pytest.approx(2 / 3, abs=0.06)


def test_above_the_grid_only_where_there_is_no_room_below() -> None:
    low = RandomPlacement(replace(PAPER_WORLD, grid=Grid(height=1)))
    levels = [
        low.place(PICTURE, np.array([0, 0, 3, 0]), np.random.default_rng(seed)).poses[:, 2].tolist()
        for seed in range(5)
    ]
    assert levels == [[0.5, 1.5, 2.5]] * 5  # a long rectangle leaves no room for another


def test_a_block_as_wide_as_the_grid_has_one_place_in_a_layer() -> None:
    catalogue = Catalogue((Shape.box("plank", 4), *PAPER_CATALOGUE.shapes))
    planks = RandomPlacement(replace(PAPER_WORLD, catalogue=catalogue))
    stack = planks.place(PICTURE, np.array([3, 0, 0, 0, 0]), np.random.default_rng(0))
    assert stack.poses[:, 0].tolist() == [0, 0, 0] and stack.poses[:, 2].tolist() == [0.5, 1.5, 2.5]
