"""Designs: the paper's rules for rows, and what a design's text and mirror image say of it."""

from __future__ import annotations

import numpy as np
import pytest

from stackgen.data.generation.designs import Design, DesignSettings, draw_design, realize
from stackgen.geometry import silhouette
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Grid, World

WIDTHS = [1, 2, 3, 1]
TRIANGLE = 3
STILL = DesignSettings(displacement=0)


def draws(count: int, seed: int = 0) -> list[Design]:
    rng = np.random.default_rng(seed)
    return [draw_design(rng, PAPER_WORLD) for _ in range(count)]


def test_rows_are_filled_to_three_cells_and_never_wider_than_four() -> None:
    for template in draws(300):
        assert len(template.rows) == 4
        for row in template.rows:
            widths = [WIDTHS[s] for s, _ in row]
            assert 3 <= sum(widths) <= 4
            assert sum(widths[:-1]) < 3  # finished as soon as three cells were filled


def test_blocks_lie_on_the_grid_side_by_side() -> None:
    for template in draws(300):
        for row in template.rows:
            cells = [cell for s, left in row for cell in range(left, left + WIDTHS[s])]
            assert cells == sorted(set(cells)) and 0 <= cells[0] and cells[-1] < 4


def test_triangles_stand_in_the_top_row_alone_and_do() -> None:
    found = draws(300)
    assert not any(s == TRIANGLE for template in found for row in template.rows[:-1] for s, _ in row)
    assert any(s == TRIANGLE for template in found for s, _ in template.rows[-1])
    everywhere = DesignSettings(top_row_only=())
    rng = np.random.default_rng(0)
    assert any(s == TRIANGLE for _ in range(20) for s, _ in draw_design(rng, PAPER_WORLD, everywhere).rows[0])


def test_blocks_are_drawn_uniformly_among_those_that_fit() -> None:
    """The first block of a lower row is a cube, a rectangle or a long rectangle, a third each."""
    firsts = [row[0][0] for template in draws(1000) for row in template.rows[:-1]]
    shares = np.bincount(firsts, minlength=4) / len(firsts)
    assert shares == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0], abs=4 * np.sqrt(2 / 9 / len(firsts)))
    firsts = [template.rows[-1][0][0] for template in draws(1000)]
    assert np.bincount(firsts) / 1000 == pytest.approx(np.full(4, 1 / 4), abs=4 * np.sqrt(3 / 16 / 1000))


def test_free_cells_go_to_every_gap_alike() -> None:
    """A row of one long rectangle has one free cell and two gaps; one of three cubes has four."""
    rows = [row for template in draws(2000) for row in template.rows[:-1]]
    alone = [row[0][1] for row in rows if len(row) == 1]
    assert np.mean(alone) == pytest.approx(1 / 2, abs=4 * 0.5 / np.sqrt(len(alone)))
    cubes = [sum(range(4)) - sum(left for _, left in row) for row in rows if [s for s, _ in row] == [0, 0, 0]]
    assert len(cubes) > 50
    assert np.bincount(cubes) / len(cubes) == pytest.approx(np.full(4, 1 / 4), abs=4 * 0.45 / np.sqrt(len(cubes)))


def test_a_key_is_the_design_and_mirroring_twice_is_nothing() -> None:
    found = draws(300)
    keys = {template.key for template in found}
    assert len(keys) > 250
    for template in found:
        assert Design.from_key(template.key) == template
        mirrored = template.mirrored(PAPER_WORLD)
        assert mirrored.mirrored(PAPER_WORLD) == template
        assert Design.from_key(mirrored.key) == mirrored
    assert any(template != template.mirrored(PAPER_WORLD) for template in found)


def test_the_mirrored_design_has_the_mirrored_silhouette() -> None:
    rng = np.random.default_rng(0)
    for template in draws(20):
        mirrored = template.mirrored(PAPER_WORLD)
        here, there = (silhouette(realize(t, rng, PAPER_WORLD, STILL), PAPER_GRID) for t in (template, mirrored))
        assert (there == np.fliplr(here)).all()


def test_without_displacement_blocks_fill_their_cells() -> None:
    rng = np.random.default_rng(0)
    for template in draws(50):
        stack = realize(template, rng, PAPER_WORLD, STILL)
        wanted = [(s, left - 2 + WIDTHS[s] / 2, z + 0.5) for z, row in enumerate(template.rows) for s, left in row]
        assert [(int(s), *p[[0, 2]]) for s, p in zip(stack.shapes, stack.poses, strict=True)] == wanted
        assert not stack.poses[:, [1, 3, 4, 5]].any()


@pytest.mark.parametrize("displacement", [0.1, 0.3])
def test_displaced_blocks_stay_near_their_cells_and_out_of_each_other(displacement: float) -> None:
    rng = np.random.default_rng(0)
    settings = DesignSettings(displacement=displacement)
    farthest = 0.0
    for template in draws(200):
        here, there = realize(template, rng, PAPER_WORLD, STILL), realize(template, rng, PAPER_WORLD, settings)
        away = np.abs(there.poses - here.poses)
        assert away[:, 0].max() <= displacement + 1e-3 and not away[:, 1:].any()
        farthest = max(farthest, float(away[:, 0].max()))
        for z in np.unique(there.poses[:, 2]):
            row = there.poses[:, 2] == z
            x, w = there.poses[row, 0], np.array(WIDTHS)[there.shapes[row]]
            assert (np.diff(x) >= (w[1:] + w[:-1]) / 2 - 2e-3).all()
    assert farthest > 0.9 * displacement


def test_same_stream_same_design_and_other_grids_work_too() -> None:
    assert draws(5) == draws(5) != draws(5, seed=1)
    world = World(PAPER_CATALOGUE, Grid(width=6, height=2), 10)
    rng = np.random.default_rng(0)
    for _ in range(20):
        template = draw_design(rng, world, DesignSettings(minimum_fill=5))
        assert len(template.rows) == 2
        stack = realize(template, rng, world, STILL)
        assert np.abs(stack.poses[:, 0]).max() < 3 and stack.poses[:, 2].max() == 1.5
        assert all(5 <= sum(WIDTHS[s] for s, _ in row) <= 6 for row in template.rows)
