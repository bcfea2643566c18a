"""Layouts, and the block lists that can make a silhouette, against trying every arrangement."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.sampling.feasible import can_make
from stackgen.stack import Stack, layout
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Catalogue, Shape, World

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


def row(*blocks: tuple[int, float], level: int = 0) -> Stack:
    """Blocks of one layer: (shape, x of the centre)."""
    return Stack(np.array([s for s, _ in blocks]), np.array([[x, 0, level + 0.5, 0, 0, 0] for _, x in blocks]))


def pile(*rows: Stack) -> Stack:
    """Rows on top of each other."""
    shapes = np.concatenate([r.shapes for r in rows])
    poses = np.concatenate([r.poses + np.array([0, 0, level, 0, 0, 0]) for level, r in enumerate(rows)])
    return Stack(shapes, poses)


def test_a_layout_reads_layers_from_the_bottom_and_blocks_from_the_left() -> None:
    stack = pile(row((RECTANGLE, 1), (CUBE, -1.5)), row((LONG, 0.3)), row((CUBE, 0)), row((TRIANGLE, 1), (CUBE, -1)))
    assert layout(stack, PAPER_GRID) == ((CUBE, RECTANGLE), (LONG,), (CUBE,), (CUBE, TRIANGLE))
    rng = np.random.default_rng(0)
    order = rng.permutation(len(stack))
    assert layout(Stack(stack.shapes[order], stack.poses[order]), PAPER_GRID) == layout(
        stack, PAPER_GRID
    )  # the order of blocks is no layout
    near = stack.with_poses(stack.poses + rng.uniform(-0.2, 0.2, stack.poses.shape))
    assert layout(near, PAPER_GRID) == layout(stack, PAPER_GRID)  # small errors neither
    sunk, lifted = (stack.poses + np.array([0, 0, dz, 0, 0, 0]) for dz in (-9, 9))
    assert layout(stack.with_poses(sunk), PAPER_GRID)[1:] == ((), (), ())
    assert layout(stack.with_poses(lifted), PAPER_GRID)[:3] == ((), (), ())


def brute_force_can_make(image: np.ndarray, counts: list[int]) -> bool:
    """Fills the half-height rows of a picture made of whole cells with every arrangement of the list."""
    cells = image[[PAPER_GRID.image_size - 4 - 7 - 14 * level for level in range(4)]][:, 4 + 7 + 14 * np.arange(4)]

    def fill(level: int, x: int, left: tuple[int, ...]) -> bool:
        if level == 4:
            return not any(left)
        if x == 4:
            return fill(level + 1, 0, left)
        if not cells[level, x]:
            return fill(level, x + 1, left)
        for shape, width in ((CUBE, 1), (RECTANGLE, 2), (LONG, 3)):
            if left[shape] and cells[level, x : x + width].sum() == width:
                rest = tuple(n - (i == shape) for i, n in enumerate(left))
                if fill(level, x + width, rest):
                    return True
        return False

    return fill(0, 0, tuple(counts))


def test_can_make_agrees_with_trying_every_arrangement_on_whole_cells() -> None:
    rng = np.random.default_rng(4)
    answers = []
    for _ in range(300):
        cells = rng.random((4, 4)) < 0.5
        image = np.zeros((64, 64), bool)
        for level, x in zip(*np.nonzero(cells), strict=True):
            image[60 - 14 * (level + 1) : 60 - 14 * level, 4 + 14 * x : 18 + 14 * x] = True
        counts = [0, 0, 0, 0]
        left = int(cells.sum())
        while left > 0:  # the right area, so that some lists fit
            width = int(rng.integers(1, min(3, left) + 1))
            counts[width - 1] += 1
            left -= width
        if any(counts):
            answers.append(can_make(image, counts, PAPER_WORLD))
            assert answers[-1] == brute_force_can_make(image, counts), (cells, counts)
    assert 20 < sum(answers) < len(answers) - 20


def test_the_true_list_of_generated_stacks_can_make_their_silhouettes() -> None:
    rng = np.random.default_rng(5)
    stacks = []
    for _ in range(300):
        stack = realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)
        keep = rng.random(len(stack)) > 0.2  # as deconstruction leaves them
        if keep.any():
            stacks.append(Stack(stack.shapes[keep], stack.poses[keep]))
    noise = [
        s.with_poses(s.poses + rng.uniform(-1, 1, s.poses.shape) * [0.005, 0.02, 0.03, 0, 0.03, 0]) for s in stacks
    ]
    assert np.mean([can_make(silhouette(s, PAPER_GRID), s.counts, PAPER_WORLD) for s in noise]) >= 0.99
    wrong = [can_make(silhouette(s, PAPER_GRID), t.counts, PAPER_WORLD) for s, t in itertools.pairwise(stacks)]
    assert np.mean(wrong) < 0.25


def test_can_make_tells_lists_apart() -> None:
    four_wide = silhouette(row((RECTANGLE, -1), (RECTANGLE, 1)), PAPER_GRID)
    for counts, possible in (
        ([0, 2, 0, 0], True), ([1, 0, 1, 0], True), ([4, 0, 0, 0], True), ([2, 1, 0, 0], True),
        ([3, 0, 0, 0], False), ([0, 2, 0, 1], False), ([1, 2, 0, 0], False), ([0, 0, 0, 0], False),
    ):  # fmt: skip
        assert can_make(four_wide, counts, PAPER_WORLD) is possible, counts
    roof = silhouette(pile(row((LONG, 0)), row((TRIANGLE, -1), (CUBE, 0.1))), PAPER_GRID)
    assert can_make(roof, [1, 0, 1, 1], PAPER_WORLD)
    assert not can_make(roof, [2, 0, 1, 0], PAPER_WORLD) and not can_make(roof, [0, 0, 1, 2], PAPER_WORLD)
    assert not can_make(np.zeros((64, 64)), [1, 0, 0, 0], PAPER_WORLD)


def test_can_make_takes_any_shape_of_one_cell_and_refuses_others() -> None:
    wide = Catalogue((*PAPER_CATALOGUE, Shape.box("four", 4), Shape.box("flat", 1, height=0.5)))
    image = silhouette(Stack(np.array([4]), np.array([[0, 0, 0.5, 0, 0, 0]]), wide), PAPER_GRID)
    wide_world = World(wide, PAPER_GRID, 10)
    assert can_make(image, [0, 0, 0, 0, 1, 0], wide_world) and can_make(image, [0, 2, 0, 0, 0, 0], wide_world)
    with pytest.raises(StackgenError, match="flat"):
        can_make(image, [0, 0, 0, 0, 0, 1], wide_world)
