"""Greedy fills what it can fill, and the swap changes places without changing the silhouette."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.baselines.greedy_random import GreedyRandom, layer_runs
from stackgen.baselines.swap import swap, swaps
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette, silhouette_iou
from stackgen.stack import Stack, layout, parse_block_list
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, PAPER_GRID

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)
Row = list[tuple[int, float]]


def stack(*rows: Row) -> Stack:
    """Rows from the ground up, each of (shape, x)."""
    blocks = [(shape, x, level + 0.5) for level, row in enumerate(rows) for shape, x in row]
    return Stack(np.array([b[0] for b in blocks]), np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks]))


PYRAMID = stack([(LONG, 0)], [(RECTANGLE, 0)], [(CUBE, 0)], [(TRIANGLE, 0)])
BRIDGE = stack([(CUBE, -1.1), (CUBE, 1.07)], [(LONG, 0.03)], [(RECTANGLE, -0.5), (CUBE, 1.02)])
STAIRS = stack([(LONG, -0.5), (CUBE, 1.5)], [(RECTANGLE, -1), (CUBE, 0.5)], [(CUBE, -1.5), (CUBE, -0.5)])


@pytest.mark.parametrize("truth", [PYRAMID, BRIDGE, STAIRS], ids=["pyramid", "bridge", "stairs"])
def test_what_longest_first_can_make_is_made(truth: Stack) -> None:
    built, left = GreedyRandom().fill(silhouette(truth, PAPER_GRID), truth.counts)
    assert not left.any()
    assert layout(built, PAPER_GRID) == layout(truth, PAPER_GRID)
    assert silhouette_iou(built, silhouette(truth, PAPER_GRID), PAPER_GRID) > 0.93


def test_order_is_bottom_up_and_longest_run_first() -> None:
    truth = stack([(CUBE, -1.5), (RECTANGLE, 0.5)], [(RECTANGLE, 0.5)])
    built, _ = GreedyRandom().fill(silhouette(truth, PAPER_GRID), truth.counts)
    assert built.shapes.tolist() == [RECTANGLE, CUBE, RECTANGLE]
    assert built.poses[:, 2].tolist() == [0.5, 0.5, 1.5]


def test_the_longest_block_that_fits_stands_at_the_left_end() -> None:
    target = silhouette(stack([(RECTANGLE, -1), (RECTANGLE, 1)]), PAPER_GRID)
    built, left = GreedyRandom().fill(target, parse_block_list("long_rectangle=1,cube=2", PAPER_CATALOGUE, MAX_BLOCKS))
    assert built.names == ["long_rectangle", "cube"] and left.tolist() == [1, 0, 0, 0]
    assert np.allclose(built.poses[:, 0], [-0.5, 1.5], atol=0.04)


def test_what_fits_nowhere_lies_on_the_ground_beside() -> None:
    target = silhouette(stack([(CUBE, 0)]), PAPER_GRID)
    (built,) = GreedyRandom(sigma=0).sample_batch(target[None], np.array([[1, 2, 0, 0]]), 1, 0)[0]
    assert built.counts.tolist() == [1, 2, 0, 0]
    assert (built.poses[1:, 2] == 0.5).all()
    edges = [[x - 1, x + 1] for x in built.poses[1:, 0]]
    assert edges[0][0] >= PAPER_GRID.width / 2 and edges[1][0] > edges[0][1]


def test_a_run_is_measured_to_the_pixel() -> None:
    runs = layer_runs(
        silhouette(stack([(CUBE, -1.5), (RECTANGLE, 0.5)], [(TRIANGLE, 0.25)]), PAPER_GRID), 0, PAPER_GRID
    )
    assert np.allclose(runs, [(-2, -1), (-0.5, 1.5)], atol=0.04)
    (triangle,) = layer_runs(silhouette(stack([(CUBE, 0)], [(TRIANGLE, 0.25)]), PAPER_GRID), 1, PAPER_GRID)
    assert np.allclose(triangle, (0, 0.5), atol=0.08)
    assert layer_runs(np.zeros((64, 64), bool), 2, PAPER_GRID) == []


def test_nothing_to_see_is_no_error() -> None:
    (built,) = GreedyRandom().sample_batch(np.zeros((1, 64, 64), bool), np.array([[1, 1, 1, 1]]), 1, 0)[0]
    assert built.counts.tolist() == [1, 1, 1, 1]


def test_settings_that_mean_nothing_are_refused() -> None:
    for sigma, tolerance in ((-0.1, 0.24), (1.1, 0.24), (0.6, 0.5), (0.6, -0.1)):
        with pytest.raises(StackgenError, match="greedy"):
            GreedyRandom(sigma=sigma, tolerance=tolerance)


# The swap.

SWAPPABLE = stack([(RECTANGLE, -1), (RECTANGLE, 1)], [(CUBE, -0.5), (CUBE, 0.5)])


def test_the_swap_comes_with_probability_sigma() -> None:
    for sigma in (0.0, 0.6, 1.0):
        rng = np.random.default_rng(7)
        changed = [
            layout(swap(SWAPPABLE, sigma, rng), PAPER_GRID) != layout(SWAPPABLE, PAPER_GRID) for _ in range(1000)
        ]
        assert abs(np.mean(changed) - sigma) <= 0.05 * (0 < sigma < 1)


def test_every_possible_swap_comes_up_alike() -> None:
    rng = np.random.default_rng(1)
    found = [layout(swap(SWAPPABLE, 1.0, rng), PAPER_GRID)[0] for _ in range(400)]
    left = np.mean([row == (CUBE, CUBE, RECTANGLE) for row in found])
    assert set(found) == {(CUBE, CUBE, RECTANGLE), (RECTANGLE, CUBE, CUBE)}
    assert abs(left - 0.5) < 0.1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_a_swap_keeps_block_list_and_silhouette(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(3):
        shapes = [[RECTANGLE, RECTANGLE], [RECTANGLE, CUBE, CUBE], [CUBE] * 4, [LONG, CUBE]][rng.integers(4)]
        widths = np.array([s + 1 for s in rng.permutation(shapes)])
        middles = np.cumsum(widths) - widths / 2 - 2
        rows.append([(int(w) - 1, float(x)) for w, x in zip(widths, middles, strict=True)])
    before = stack(*rows)
    after = swap(before, 1.0, rng)
    assert np.array_equal(before.shapes, after.shapes)
    assert np.array_equal(silhouette(before, PAPER_GRID), silhouette(after, PAPER_GRID))
    possible = RECTANGLE in before.shapes and any((CUBE, CUBE) in pairwise(r) for r in layout(before, PAPER_GRID))
    assert np.array_equal(before.poses, after.poses) == (not possible)


def test_only_neighbours_in_a_layer_are_swapped() -> None:
    apart = stack([(CUBE, -1.5), (CUBE, 1.5)], [(RECTANGLE, 0)])
    above = stack([(CUBE, 0), (RECTANGLE, 1.5)], [(CUBE, 0)])
    assert swaps(apart) == [] and swaps(above) == []
    assert swaps(stack([(CUBE, -1.5), (CUBE, -0.3), (RECTANGLE, 1.3)])) == [(0, 1, 2)]
