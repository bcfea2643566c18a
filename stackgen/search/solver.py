"""The best stacks for any silhouette, by search: rows of blocks, combined in two ways and judged by statics.

**Best first** where all shapes have one height, and the **beam** where that search finds too little or heights differ.
Both share the rows (:mod:`stackgen.search.rows`) and what holds them (:mod:`stackgen.search.balance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.search.balance import Balance
from stackgen.search.beam import beam
from stackgen.search.best_first import best_first
from stackgen.search.problem import Beginning, Ints, Limits, Problem, SearchSettings
from stackgen.search.rows import Levels, Placed
from stackgen.stack import Layout, Stack, check_block_list, layout
from stackgen.world import Mask, World


@dataclass(frozen=True)
class Answer:
    """A stack that stands, as far as statics can tell.

    Args:
        stack: Its blocks, upright, none inside another and none above its support.
        iou: Front IoU with the target.
        margin: Largest tilt to either side that it survives [rad].
        layout: Shapes of each layer from left to right.
    """

    stack: Stack
    iou: float
    margin: float
    layout: Layout


def solve(
    target: Mask,
    world: World,
    number: int = 3,
    block_list: Ints | None = None,
    inventory: Ints | None = None,
    settings: SearchSettings = SearchSettings(),  # noqa: B008 - frozen
) -> list[Answer]:
    """Find stacks that stand and look like a silhouette, of distinct layouts, the best first.

    Args:
        target: (H, W) front silhouette.
        world: Shapes, grid, and the largest number of blocks.
        number: Largest number of answers.
        block_list: (S,) blocks, all of which are to be used; by default the search chooses them.
        inventory: (S,) blocks that there are, of which it chooses.
        settings: How long and for what it looks.

    Returns:
        Answers of distinct layouts whose IoU is within `settings.near` of the best; none if nothing stands.

    Raises:
        StackgenError: If the silhouette is empty or of another size than the grid's, the block list is impossible, or
            the heights of the shapes have no common part.
    """
    mask = np.asarray(target, dtype=bool)
    if mask.shape != (world.grid.image_size,) * 2:
        raise StackgenError(f"search: the silhouette must be {world.grid.image_size} pixels square, got {mask.shape}")
    if not mask.any():
        raise StackgenError("search: nothing is set in the silhouette; draw a structure")
    problem = Problem(Levels(mask, world), world, _limits(world, block_list, inventory), settings, number)
    one_height = all(piece.height == 1 for piece in problem.levels.pieces)
    ends, exhausted = best_first(problem) if one_height else ([], False)
    if len(ends) < number and not exhausted:
        ends += beam(problem)
    return _answers(ends, problem)


def _limits(world: World, block_list: Ints | None, inventory: Ints | None) -> Limits:
    if block_list is not None:
        check_block_list(block_list, world.max_blocks)
        return Limits(np.asarray(block_list), int(np.sum(block_list)), all_of_them=True)
    if inventory is not None:
        return Limits(np.minimum(inventory, world.max_blocks), world.max_blocks)
    return Limits(np.full(len(world.catalogue), world.max_blocks), world.max_blocks)


def _answers(ends: Sequence[Beginning], problem: Problem) -> list[Answer]:
    """Make stacks of what was found: distinct layouts near the best, the best first."""
    levels, grid, settings = problem.levels, problem.world.grid, problem.settings
    found: dict[Layout, tuple[float, Beginning, Stack]] = {}
    for end in ends:
        stack = _stack(end.blocks, problem)
        kind = layout(stack, grid)
        alike = silhouette_iou(stack, levels.silhouette, grid)
        if kind not in found or found[kind][0] < alike:
            found[kind] = (alike, end, stack)
    best = max((alike for alike, _, _ in found.values()), default=0.0)
    near = [(a, k, e, s) for k, (a, e, s) in found.items() if a >= best - settings.near - 1e-9]
    answers = [
        Answer(stack, alike, float(np.arctan(Balance(end.blocks, levels).slope())), kind)
        for alike, kind, end, stack in near
    ]
    if settings.prefer == "margin":
        answers.sort(key=lambda answer: (-round(answer.margin, 3), -answer.iou))
    else:
        answers.sort(key=lambda answer: (-round(answer.iou, 3), -answer.margin))
    return answers[: problem.number]


def _stack(blocks: Sequence[Placed], problem: Problem) -> Stack:
    """Make the stack of some blocks, each in the middle of its columns."""
    levels, catalogue = problem.levels, problem.world.catalogue
    ppc = problem.world.grid.pixels_per_cell
    poses = np.zeros((len(blocks), 6))
    for i, (shape, a, level) in enumerate(blocks):
        poses[i, 0] = levels.left_end(a) + levels.pieces[shape].width / ppc / 2
        poses[i, 2] = level * levels.step + catalogue[shape].size[2] / 2
    return Stack(np.array([block.shape for block in blocks], dtype=np.int64), poses, catalogue)
