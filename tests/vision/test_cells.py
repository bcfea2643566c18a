"""Silhouettes of whole cells are told from others, and become block lists."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.vision.cells import EMPTY, FULL, TRIANGLE, block_list_of, in_cells, occupancy, picture_of
from stackgen.vision.masks import fitted
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID


def test_cells_and_their_picture_are_inverse() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        cells = rng.choice([EMPTY, FULL], (4, 4))
        top = np.argmax(np.vstack([cells, np.zeros((1, 4), int)]) == EMPTY, axis=0)
        cells[np.minimum(top, 3)[0], 0] = FULL
        cells[3, 1] = TRIANGLE
        assert np.array_equal(occupancy(picture_of(cells, PAPER_GRID), PAPER_GRID), cells)


def test_blocks_that_stick_out_of_the_grid_make_no_triangles() -> None:
    long, cells = PAPER_CATALOGUE.index("long_rectangle"), np.array([[1, 1, 1, 0], [0, 1, 1, 1]] * 2)
    xs = [-0.65, 0.6, -0.5, 0.6]
    poses = np.array([[x, 0, row + 0.5, 0, 0, 0] for row, x in enumerate(xs)])
    as_read = fitted(silhouette(Stack(np.full(4, long), poses), PAPER_GRID), PAPER_GRID)
    whole, found, _ = in_cells(as_read, 0.85, PAPER_GRID)
    assert found is not None and found.tolist() == cells.tolist()
    assert np.array_equal(whole, picture_of(cells, PAPER_GRID))


@pytest.mark.parametrize(
    ("row", "counts"),
    [([1, 1, 1, 1], [1, 0, 1, 0]), ([1, 1, 0, 1], [1, 1, 0, 0]), ([0, 2, 1, 2], [1, 0, 0, 2]), ([0, 0, 0, 0], None)],
)
def test_the_heuristic_takes_the_longest_blocks_that_fit(row: list[int], counts: list[int] | None) -> None:
    found = block_list_of(np.array([row]))
    assert (None if found is None else found.tolist()) == counts
