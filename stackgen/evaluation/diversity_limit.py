"""The diversity limit: all ways to build a silhouette from a block list, and how diverse valid samples can be at most.

A design puts blocks into the cells of the grid: whole cells, all at y = 0, shapes that may stand in the top
row alone nowhere else. It matches a silhouette if it fills exactly the cells that the silhouette fills. Inside
a run of filled cells blocks then lie side by side, so the shapes of each row from left to right say where each
lies: the designs that match are as many layouts (:func:`stackgen.stack.layout`), and finitely many.
Whether one stands is said by a StabilityChecker.

Legend: S shapes, H x W pixels, n samples a scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stackgen.data.generation.designs import Design, DesignSettings, cells_wide, realize
from stackgen.geometry import silhouette_iou
from stackgen.protocols import StabilityChecker
from stackgen.sampling.feasible import RUN_TOLERANCE, VALID_IOU, cross_section, row_runs
from stackgen.stack import Layout
from stackgen.world import Grid, World

PLACEMENTS = 32
"""Displaced placements of a design that are tried, after the exact one, before it is said to fall."""

Layer = tuple[tuple[int, int], ...]
"""Blocks of a layer as (shape index, left edge [cell]), as in a Design."""

BlocksLeft = tuple[int, ...]
"""(S,) blocks that are left, of each shape."""


class CellRun(NamedTuple):
    """Cells of a row, counted from the grid's left edge, that are to be filled side by side.

    Args:
        start, end: [cell].
        shape: Index of the one shape it is, where it tapers; None for boxes.
    """

    start: int
    end: int
    shape: int | None = None


def cell_runs(silhouette: ArrayLike, world: World) -> tuple[tuple[CellRun, ...], ...]:
    """Find the cells that a silhouette (H, W) fills: for each row, from the ground up, its runs from left to right.

    They are read at half height of each row, as in `can_make`: a run of pixels as wide as a tapering shape is
    there is that shape (the nearest, if there are several); the ends of any other are rounded to whole cells.
    So displacement and settling do no harm, and a few pixels' gap between two blocks is none.

    Raises:
        StackgenError: If a shape is not one cell high.
    """
    catalogue, grid = world.catalogue, world.grid
    sections = [cross_section(shape) for shape in catalogue]
    rows = []
    for runs in row_runs(np.asarray(silhouette, dtype=bool), grid):
        found: list[CellRun] = []
        for left, right in runs:
            tapering = [(abs(w - (right - left)), i) for i, (w, narrower) in enumerate(sections) if narrower]
            error, shape = min(tapering, default=(np.inf, -1))
            if error <= RUN_TOLERANCE:
                start = round((left + right - catalogue[shape].size[0]) / 2 + grid.width / 2)
                found.append(CellRun(start, start + cells_wide(catalogue[shape]), shape))
                continue
            start, end = (round(edge + grid.width / 2) for edge in (left, right))
            if found and found[-1].shape is None and found[-1].end >= start:
                start = found.pop().start
            found.append(CellRun(start, end))
        rows.append(tuple(found))
    return tuple(rows)


def designs(
    silhouette: ArrayLike, block_list: ArrayLike, world: World, settings: DesignSettings | None = None
) -> Iterator[Design]:
    """Find every design that matches a silhouette and uses up a block list, each once; no block of it hangs in the air.

    An exact cover of the silhouette's cells, searched row by row from the ground. A branch ends where a
    shape is used up or a block would have nothing but empty cells below it; what can be built on a row
    depends on the blocks left alone, so that is searched once.

    Args:
        silhouette: (H, W).
        block_list: (S,); all of it is used.
        world: World of the silhouette, its shapes one cell high and whole cells wide.
        settings: Which shapes may stand in the top row alone: the highest row that the silhouette fills.

    Raises:
        StackgenError: If a shape is not one cell high.

    >>> from stackgen.geometry import silhouette
    >>> from stackgen.stack import Layout, Stack
    >>> from stackgen.world import PAPER_GRID, PAPER_WORLD
    >>> wide = Stack([1, 0], [[0, 0, 0.5, 0, 0, 0], [1.5, 0, 0.5, 0, 0, 0]])  # a rectangle, a cube to its right
    >>> for design in designs(silhouette(wide, PAPER_GRID), [1, 1, 0, 0], PAPER_WORLD):
    ...     print(design.rows[0])
    ((0, 1), (1, 2))
    ((1, 1), (0, 3))
    """
    catalogue = world.catalogue
    rows = list(cell_runs(silhouette, world))
    while rows and not rows[-1]:  # rows above the structure
        rows.pop()
    widths = [cells_wide(shape) for shape in catalogue]
    top_row_only = (settings or DesignSettings()).top_row_only
    below_top = [i for i, shape in enumerate(catalogue) if shape.name not in top_row_only]
    boxes = [i for i, shape in enumerate(catalogue) if not cross_section(shape)[1]]

    @cache
    def from_row(row: int, left: BlocksLeft) -> tuple[tuple[Layer, ...], ...]:
        """Find all ways to fill a row and those above it with the blocks that are left."""
        if row == len(rows):
            return () if any(left) else ((),)
        ground = None if row == 0 else frozenset(c for run in rows[row - 1] for c in range(run.start, run.end))
        legal = range(len(catalogue)) if row == len(rows) - 1 else below_top
        choices = [(run, [i for i in legal if (i in boxes if run.shape is None else i == run.shape)])
                   for run in rows[row]]  # fmt: skip
        return tuple(
            (filling, *above)
            for filling, rest in _fillings(choices, left, widths, ground)
            for above in from_row(row + 1, rest)
        )

    yield from map(Design, from_row(0, tuple(int(count) for count in np.asarray(block_list))))


def _fillings(
    runs: Sequence[tuple[CellRun, Sequence[int]]],
    left: BlocksLeft,
    widths: Sequence[int],
    ground: frozenset[int] | None,
) -> Iterator[tuple[Layer, BlocksLeft]]:
    """Find all ways to fill the runs of a row, and the blocks that are then left.

    Args:
        runs: What is to be filled, each with the shapes that may.
        left: (S,) blocks that there are.
        widths: (S,) [cell].
        ground: Filled cells of the row below; None where that is the ground itself.
    """
    if not runs:
        yield (), left
        return
    (run, shapes), *others = runs
    for shape in shapes:
        end = run.start + widths[shape]
        hangs = ground is not None and ground.isdisjoint(range(run.start - 1, end + 1))
        if not left[shape] or end > run.end or hangs:
            continue
        rest = tuple(count - (i == shape) for i, count in enumerate(left))
        following = [(run._replace(start=end), shapes), *others] if end < run.end else others
        for filling, remaining in _fillings(following, rest, widths, ground):
            yield ((shape, run.start), *filling), remaining


@dataclass(frozen=True)
class Answers:
    """The layouts of a block list that answer a silhouette.

    Args:
        matching: Those that fill its cells.
        valid: Those of them that stand.
    """

    matching: tuple[Layout, ...]
    valid: tuple[Layout, ...]


def answers(
    silhouette: ArrayLike,
    block_list: ArrayLike,
    checker: StabilityChecker,
    world: World,
    placements: int = PLACEMENTS,
    seed: int = 0,
) -> Answers:
    """Find the layouts that match, and those that are valid: that stand and have front IoU of at least 0.8.

    A design is put down exactly on its cells and, as long as that falls, displaced at random as those of a dataset
    are: a block whose centre of mass lies right above the edge of its support stands with luck, and so it
    does in the dataset. One placement that stands is enough.

    Args:
        silhouette: (H, W).
        block_list: (S,).
        checker: Says which placements stand.
        world: World of the silhouette.
        placements: Displaced placements to try.
        seed: Seed of the displacements.
    """
    target = np.asarray(silhouette, dtype=bool)
    found = list(designs(target, block_list, world))
    rng = np.random.default_rng(seed)
    valid: set[int] = set()
    for attempt in range(1 + placements):
        settings = DesignSettings(displacement=DesignSettings.displacement if attempt else 0.0)
        open_ = [i for i in range(len(found)) if i not in valid]
        stacks = [realize(found[i], rng, world, settings) for i in open_]
        for i, verdict in zip(open_, checker.check_all(stacks), strict=True):
            if verdict.stable and silhouette_iou(verdict.settled, target, world.grid) >= VALID_IOU:
                valid.add(i)
    layouts = [layout_of(design, world.grid) for design in found]
    return Answers(tuple(layouts), tuple(layouts[i] for i in sorted(valid)))


def layout_of(design: Design, grid: Grid) -> Layout:
    """Give a design's layout, as `stackgen.stack.layout` does for its stack."""
    rows = [tuple(shape for shape, _ in row) for row in design.rows]
    return (*rows, *[()] * (grid.height - len(rows)))


def expected_diversity(number: int, samples: int = 3) -> float:
    """Compute the share of distinct layouts to be expected among samples drawn uniformly from a number of valid ones.

    This is the diversity limit: of all ways to draw layouts independently of each other, the uniform one
    gives most. A draw hits one layout at least once with probability 1 - (1 - 1/V)^n.

    >>> [round(expected_diversity(number), 3) for number in (0, 1, 2, 3, 1000)]
    [0.0, 0.333, 0.583, 0.704, 0.999]
    """
    if not number:
        return 0.0
    return number * (1 - (1 - 1 / number) ** samples) / samples
