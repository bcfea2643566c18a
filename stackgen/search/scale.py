"""How many cells high a drawing is: a drawing has no scale, so the search tries those that there are.

One cube is answered by a cube and a tower of six by six cubes: of all scales the one is taken at which the best stack
fits best, where each block must improve the fit a little.

Legend: h x w pixels of a figure, H x W pixels of a silhouette. Lengths in cells.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.search.problem import SearchSettings
from stackgen.search.rows import BLOCK, Levels, pack
from stackgen.search.solver import Answer, solve
from stackgen.vision.masks import place
from stackgen.world import Grid, Mask, World

MOST_CELLS = 8
"""Largest height and width of a drawing that the search looks for [cell]."""

MOST_BLOCKS = 40
"""Longest block list above the grid of the world that was asked for."""

WORTH = 0.004
"""IoU by which each block must improve the fit."""

SLACK = 0.02
"""How much less than the best so far a scale may promise and be tried all the same."""

_LEAST = 1e-3  # time that a search is given when all of it is spent [s]
_FINE = 112  # height of the pictures in which scales are compared [pixel]


@dataclass(frozen=True)
class Cells:
    """How many cells a drawing is high, and wide.

    Args:
        high: Height [cell]; None to find it.
        wide: Width [cell]; None to keep the drawing's proportions.
    """

    high: int | None = None
    wide: int | None = None

    @staticmethod
    def parse(text: str) -> Cells:
        """Read `auto`, a height such as 6, or width and height such as 6x5.

        Raises:
            StackgenError: If it is none of these, or more than `MOST_CELLS`.

        >>> Cells.parse("6x5"), Cells.parse("auto")
        (Cells(high=5, wide=6), Cells(high=None, wide=None))
        """
        found = re.fullmatch(r"(?:(\d{1,3})x)?(\d{1,3})", text.strip(), re.ASCII)
        if text.strip() == "auto":
            return Cells()
        if not found or not all(1 <= int(number) <= MOST_CELLS for number in found.groups() if number):
            raise StackgenError(
                f"cells {text!r}: give auto, a height such as 6, or width x height such as 6x5, up to {MOST_CELLS}"
            )
        return Cells(int(found[2]), int(found[1]) if found[1] else None)

    def stretched(self, figure: Mask) -> Mask:
        """Give a figure (h, w) the proportions of these cells, where height and width are known."""
        if self.wide is None or self.high is None:
            return figure
        size = (len(figure) * self.wide // self.high or 1, len(figure))
        return cv2.resize(figure.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


@dataclass(frozen=True)
class Scaled:
    """A drawing at a scale.

    Args:
        world: World whose grid it lies in: the one asked for, or one with a larger grid.
        target: (H, W) silhouette.
        cells: Height [cell].
        answers: Best stacks there, where they were looked for.
    """

    world: World
    target: Mask
    cells: float
    answers: tuple[Answer, ...] = ()


def scaled(figure: Mask, world: World, cells: float) -> Scaled:
    """Put a figure (h, w) into the world at a height [cell]; where its grid is too small, into a larger one."""
    wide = cells * figure.shape[1] / figure.shape[0]
    grid = world.grid
    if cells > grid.height + 0.1 or wide > grid.width + 0.1:
        need = max((wide + 1) * grid.pixels_per_cell, (cells + 0.5) * grid.pixels_per_cell + grid.ground_margin)
        grid = Grid(
            max(grid.width, math.ceil(wide - 0.1)),
            max(grid.height, math.ceil(cells - 0.1)),
            max(grid.image_size, 8 * math.ceil(need / 8)),
            grid.pixels_per_cell,
            grid.ground_margin,
        )
        world = World(world.catalogue, grid, max(world.max_blocks, MOST_BLOCKS))
    target = place(figure, grid, cells)
    if not target.any():
        raise StackgenError(
            f"the drawing is too thin to be seen at {cells:g} cells; draw it bolder, or give more cells"
        )
    return Scaled(world, target, cells)


LESS = 0.5
"""Share of the effort for each scale of that for the scale before, which promised more."""


def best_scale(
    figure: Mask,
    world: World,
    cells: Cells,
    number: int = 3,
    block_list: NDArray[np.int64] | None = None,
    inventory: NDArray[np.int64] | None = None,
    settings: SearchSettings = SearchSettings(),  # noqa: B008 - frozen
) -> Scaled:
    """Find the scale at which blocks make a figure best, and the best stacks there.

    Args:
        figure: (h, w) drawing, cut out to its box.
        world: Shapes, and the grid of the smallest silhouette.
        cells: Height, and width, where they are known.
        number: Largest number of stacks.
        block_list, inventory, settings: As for :func:`stackgen.search.solver.solve`.

    Raises:
        StackgenError: If the figure is too thin to be seen at any scale.
    """
    figure = cells.stretched(figure)
    began = time.perf_counter()

    def answers(at: Scaled, wanted: int, share: float = 1.0) -> tuple[Answer, ...]:
        left = replace(settings, effort=settings.effort * share)
        if settings.seconds is not None:
            left = replace(left, seconds=max(settings.seconds - (time.perf_counter() - began), _LEAST))
        return tuple(solve(at.target, at.world, wanted, block_list, inventory, left))

    tried: list[tuple[float, Scaled]] = []
    for promise, at in _by_promise(figure, world, [cells.high] if cells.high else _heights(figure, world)):
        late = settings.seconds is not None and time.perf_counter() - began > settings.seconds
        if tried and (late or promise < max(worth for worth, _ in tried) - SLACK):
            break
        best = answers(at, 1, LESS ** len(tried))
        worth = max((fine_iou(a, figure, at) - WORTH * len(a.stack) for a in best), default=-1.0)
        tried.append((worth, replace(at, answers=best)))
    chosen = max(tried, key=lambda one: one[0])[1]
    return replace(chosen, answers=answers(chosen, number) or chosen.answers) if number > 1 else chosen


def _by_promise(figure: Mask, world: World, heights: Sequence[float]) -> list[tuple[float, Scaled]]:
    """Put a figure into the world at each height; sort by the IoU of the best rows, stand or fall, less their blocks.

    Raises:
        StackgenError: If the figure is too thin to be seen at any of them.
    """
    promises = []
    refused: StackgenError | None = None
    for high in heights:
        try:
            at = scaled(figure, world, high)
        except StackgenError as error:
            refused = error
            continue
        levels = Levels(at.target, at.world)
        rows = [found[0] for found in pack(levels.gains, levels.widths, keep=1, depth=MOST_CELLS)]
        blocks = sum(len(row.blocks) for row in rows)
        fit = (sum(row.gain for row in rows) + BLOCK * blocks) / float(at.target.sum())
        promises.append((fit - WORTH * blocks, at))
    if not promises:
        raise refused or StackgenError("the drawing is wider than eight times its height; draw it higher")
    return sorted(promises, key=lambda one: -one[0])


def _heights(figure: Mask, world: World) -> Sequence[float]:
    """List the heights at which a figure is at most `MOST_CELLS` wide; a flat one has the largest that it can have."""
    wide = figure.shape[1] / figure.shape[0]
    heights = [float(high) for high in range(1, MOST_CELLS + 1) if high * wide <= MOST_CELLS + 0.5]
    return heights or [MOST_CELLS / wide]


def fine_iou(answer: Answer, figure: Mask, at: Scaled) -> float:
    """Compare an answer with a figure (h, w) in a picture that is as fine at any scale."""
    scale = _FINE / at.cells / at.world.grid.pixels_per_cell
    grid = Grid(
        at.world.grid.width,
        at.world.grid.height,
        8 * math.ceil(at.world.grid.image_size * scale / 8),
        at.world.grid.pixels_per_cell * scale,
        at.world.grid.ground_margin * scale,
    )
    return silhouette_iou(answer.stack, place(figure, grid, at.cells), grid)


def block_lists(answers: Sequence[Answer]) -> Iterator[tuple[int, ...]]:
    """Give the distinct block lists of some answers, in order."""
    yield from dict.fromkeys(tuple(answer.stack.counts.tolist()) for answer in answers)
