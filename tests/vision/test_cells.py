"""Silhouettes of whole cells are told from others, and become block lists."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.vision.cells import EMPTY, FALLING, FULL, RISING, block_list_of, in_cells, occupancy, picture_of
from stackgen.vision.masks import bounding_box, fitted
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID


def test_cells_and_their_picture_are_inverse() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        cells = np.repeat(rng.choice([EMPTY, FULL], (4, 4)), 2, axis=1)
        cells[2, 2:4] = FULL
        cells[3, 2:4] = RISING, FALLING
        assert np.array_equal(occupancy(picture_of(cells, PAPER_GRID), PAPER_GRID), cells)


def test_blocks_that_stick_out_of_the_grid_make_no_triangles() -> None:
    long, cells = PAPER_CATALOGUE.index("long_rectangle"), np.repeat([[1, 1, 1, 0], [0, 1, 1, 1]] * 2, 2, axis=1)
    xs = [-0.65, 0.6, -0.5, 0.6]
    poses = np.array([[x, 0, row + 0.5, 0, 0, 0] for row, x in enumerate(xs)])
    seen = silhouette(Stack(np.full(4, long), poses), PAPER_GRID, margin=10)
    whole, found, _ = in_cells(seen[bounding_box(seen)], PAPER_GRID)
    assert found is not None and found.tolist() == cells.tolist()
    assert np.array_equal(whole, picture_of(cells, PAPER_GRID))


@pytest.mark.parametrize(
    ("row", "counts"),
    [
        ([1, 1, 1, 1, 1, 1, 1, 1], [1, 0, 1, 0]),
        ([1, 1, 1, 1, 0, 0, 1, 1], [1, 1, 0, 0]),
        ([0, 2, 3, 1, 1, 2, 3, 0], [1, 0, 0, 2]),
        ([0, 0, 0, 0], None),
    ],
)
def test_the_heuristic_takes_the_longest_blocks_that_fit(row: list[int], counts: list[int] | None) -> None:
    found = block_list_of(np.array([row]))
    assert (None if found is None else found.tolist()) == counts


@pytest.mark.parametrize("steps", [3, 4])
def test_steps_keep_their_number(steps: int) -> None:
    figure = np.kron(np.tril(np.ones((steps, steps), dtype=bool)), np.ones((50, 50), dtype=bool))
    whole, cells, _ = in_cells(figure, PAPER_GRID)
    expected = np.tril(np.ones((steps, steps), dtype=int))[::-1].repeat(2, axis=1)
    assert cells is not None and np.array_equal(cells[:steps, : 2 * steps], expected)
    assert whole.any(axis=1).sum() == 14 * steps


def test_what_is_not_made_of_whole_cells_stays_as_seen() -> None:
    rows, columns = np.mgrid[-1:1:200j, -1:1:200j]
    disc = (rows**2 + columns**2 < 1)[1:-1, 1:-1]
    whole, cells, block_list = in_cells(disc, PAPER_GRID)
    assert np.array_equal(whole, fitted(disc, PAPER_GRID)) and cells is None and block_list is None


def test_a_pyramid_has_half_cells_and_is_symmetric() -> None:
    figure = np.zeros((300, 300), dtype=bool)
    for row in range(3):
        figure[100 * row : 100 * (row + 1), 100 - 50 * row : 200 + 50 * row] = True
    _, cells, block_list = in_cells(figure, PAPER_GRID)
    assert cells is not None and (cells != EMPTY).sum(axis=1).tolist() == [6, 4, 2, 0]
    assert all(np.array_equal(np.trim_zeros(row), np.trim_zeros(row)[::-1]) for row in cells)
    assert block_list is not None and block_list.tolist() == [1, 1, 1, 0]


def test_no_triangle_hangs_in_the_air() -> None:
    picture = picture_of(np.array([[0, 0, 1, 1], [2, 3, 1, 1]]), PAPER_GRID)
    assert occupancy(picture, PAPER_GRID)[1].max() == FULL
