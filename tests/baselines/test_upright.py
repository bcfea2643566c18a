"""Running sums count the same pixels as the pictures do."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.baselines.heuristic import section
from stackgen.baselines.upright import cover, running_sums
from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Grid

GRIDS = [PAPER_GRID, Grid(width=6, height=3, pixels_per_cell=9.3, ground_margin=2)]


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("shape", range(4), ids=PAPER_CATALOGUE.names)
def test_a_span_is_the_block_s_silhouette(shape: int, grid: Grid) -> None:
    rng = np.random.default_rng(shape)
    x, z = rng.uniform(-4, 4, 40), 1.37
    weights = rng.integers(-5, 6, (64, 64))
    covered = cover(PAPER_CATALOGUE[shape], x, z, grid)
    sums = covered.sum(running_sums(weights))
    for i, place in enumerate(x):
        picture = silhouette(Stack(np.array([shape]), np.array([[place, 0, z, 0, 0, 0]])), grid)
        mine = np.zeros_like(picture)
        for row, start, stop in zip(covered.rows, covered.start[i], covered.stop[i], strict=True):
            mine[row, start:stop] = True
        assert np.array_equal(mine, picture)
        assert sums[i] == weights[picture].sum()


def test_beside_are_the_pixels_next_to_the_rows_covered() -> None:
    cube = PAPER_CATALOGUE[0]
    covered = cover(cube, [0.0, 2.0, 40.0], 0.5, PAPER_GRID)  # in the middle, at the edge, outside
    left, right = covered.beside(3, 64)
    everywhere = running_sums(np.ones((64, 64)))
    assert covered.sum(everywhere).tolist() == [14 * 14, 14 * 11, 0]
    assert left.sum(everywhere).tolist() == [14 * 3, 14 * 3, 0]
    assert right.sum(everywhere).tolist() == [14 * 3, 0, 0]
    assert right.take([0]).sum(everywhere).tolist() == [14 * 3]


def test_blocks_are_as_wide_at_half_height_as_they_look() -> None:
    assert [section(shape) for shape in PAPER_CATALOGUE] == [1, 2, 3, 0.5]
