"""All ways to build a silhouette from a block list, and how diverse valid samples can be at most.

A design puts blocks into the cells of the grid, as templates do: whole cells, all at y = 0, shapes that
may stand in the top row alone nowhere else. It matches a silhouette if it fills exactly the cells that the
silhouette fills. Inside a run of filled cells blocks then lie side by side, so the shapes of each row from
left to right say where each lies: the designs that match are as many layouts
(:func:`stackgen.sampling.feasible.layout`), and finitely many. Whether one stands is asked of a StabilityChecker.

Legend: S shapes, H x W pixels, n samples a scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stackgen.data.generation.templates import Template, TemplateSettings, cells_wide, realize
from stackgen.geometry import silhouette_iou
from stackgen.protocols import StabilityChecker, check_all
from stackgen.sampling.feasible import RUN_TOLERANCE, VALID_IOU, Layout, cross_section, row_runs
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid

PLACEMENTS = 32
"""Displaced placements of a design that are tried, after the exact one, before it is said to fall."""

Row = tuple[tuple[int, int], ...]
"""Blocks of a row as (shape index, left edge [cell]), as in a Template."""

Counts = tuple[int, ...]


class Span(NamedTuple):
    """Cells of a row, counted from the grid's left edge, that are to be filled side by side.

    Args:
        start, end: [cell].
        shape: The one shape it is, where it tapers; None for boxes.
    """

    start: int
    end: int
    shape: int | None = None


def spans_of(
    silhouette: ArrayLike, catalogue: Catalogue = PAPER_CATALOGUE, grid: Grid = PAPER_GRID
) -> tuple[tuple[Span, ...], ...]:
    """The cells that a silhouette (H, W) fills: for each row, from the ground up, its spans from left to right.

    Read at half height of each row, as in `metrics.can_make`: a run of pixels as wide as a tapering shape is
    there is that shape (the nearest, if there are several); the ends of any other are rounded to whole cells.
    So displacement and settling do no harm, and a few pixels' gap between two blocks is none.

    Raises:
        StackgenError: If a shape is not one cell high.
    """
    sections = [cross_section(shape) for shape in catalogue]
    rows = []
    for runs in row_runs(np.asarray(silhouette, dtype=bool), grid):
        spans: list[Span] = []
        for left, right in runs:
            tapering = [(abs(w - (right - left)), i) for i, (w, narrower) in enumerate(sections) if narrower]
            error, shape = min(tapering, default=(np.inf, -1))
            if error <= RUN_TOLERANCE:
                start = round((left + right - catalogue[shape].size[0]) / 2 + grid.width / 2)
                spans.append(Span(start, start + cells_wide(catalogue[shape]), shape))
                continue
            start, end = (round(edge + grid.width / 2) for edge in (left, right))
            if spans and spans[-1].shape is None and spans[-1].end >= start:
                start = spans.pop().start
            spans.append(Span(start, end))
        rows.append(tuple(spans))
    return tuple(rows)


def designs(
    silhouette: ArrayLike,
    counts: ArrayLike,
    catalogue: Catalogue = PAPER_CATALOGUE,
    grid: Grid = PAPER_GRID,
    settings: TemplateSettings | None = None,
) -> Iterator[Template]:
    """Every design that matches a silhouette and uses up a block list, each once; no block of it hangs in the air.

    An exact cover of the silhouette's cells, searched row by row from the ground. A branch ends where a
    shape is used up or a block would have nothing but empty cells below it; what can be built on a row
    depends on the blocks left alone, so that is searched once.

    Args:
        silhouette: (H, W).
        counts: (S,) block list; all of it is used.
        catalogue: Of shapes one cell high and whole cells wide.
        grid: Of the silhouette.
        settings: Which shapes may stand in the top row alone: the highest row that the silhouette fills.

    Raises:
        StackgenError: If a shape is not one cell high.

    >>> from stackgen.geometry import silhouette
    >>> from stackgen.stack import Stack
    >>> wide = Stack([1, 0], [[0, 0, 0.5, 0, 0, 0], [1.5, 0, 0.5, 0, 0, 0]])  # a rectangle, a cube to its right
    >>> for template in designs(silhouette(wide), [1, 1, 0, 0]):
    ...     print(template.rows[0])
    ((0, 1), (1, 2))
    ((1, 1), (0, 3))
    """
    spans = list(spans_of(silhouette, catalogue, grid))
    while spans and not spans[-1]:  # rows above the structure
        spans.pop()
    widths = [cells_wide(shape) for shape in catalogue]
    top_row_only = (settings or TemplateSettings()).top_row_only
    below_top = [i for i, shape in enumerate(catalogue) if shape.name not in top_row_only]
    boxes = [i for i, shape in enumerate(catalogue) if not cross_section(shape)[1]]

    @cache
    def from_row(row: int, left: Counts) -> tuple[tuple[Row, ...], ...]:
        """All ways to fill a row and those above it with the blocks that are left."""
        if row == len(spans):
            return () if any(left) else ((),)
        ground = None if row == 0 else frozenset(c for s in spans[row - 1] for c in range(s.start, s.end))
        legal = range(len(catalogue)) if row == len(spans) - 1 else below_top
        choices = [(span, [i for i in legal if (i in boxes if span.shape is None else i == span.shape)])
                   for span in spans[row]]  # fmt: skip
        return tuple(
            (filling, *above)
            for filling, rest in _fillings(choices, left, widths, ground)
            for above in from_row(row + 1, rest)
        )

    yield from map(Template, from_row(0, tuple(int(count) for count in np.asarray(counts))))


def _fillings(
    spans: Sequence[tuple[Span, Sequence[int]]], left: Counts, widths: Sequence[int], ground: frozenset[int] | None
) -> Iterator[tuple[Row, Counts]]:
    """All ways to fill the spans of a row, and the blocks that are then left.

    Args:
        spans: What is to be filled, each with the shapes that may.
        left: (S,) blocks that there are.
        widths: (S,) [cell].
        ground: Filled cells of the row below; None where that is the ground itself.
    """
    if not spans:
        yield (), left
        return
    (span, shapes), *others = spans
    for shape in shapes:
        end = span.start + widths[shape]
        hangs = ground is not None and ground.isdisjoint(range(span.start - 1, end + 1))
        if not left[shape] or end > span.end or hangs:
            continue
        rest = tuple(count - (i == shape) for i, count in enumerate(left))
        following = [(span._replace(start=end), shapes), *others] if end < span.end else others
        for filling, remaining in _fillings(following, rest, widths, ground):
            yield ((shape, span.start), *filling), remaining


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
    counts: ArrayLike,
    checker: StabilityChecker,
    catalogue: Catalogue = PAPER_CATALOGUE,
    grid: Grid = PAPER_GRID,
    placements: int = PLACEMENTS,
    seed: int = 0,
) -> Answers:
    """The layouts that match, and those that are valid: that stand and have front IoU of at least 0.8.

    A design is put down exactly on its cells and, as long as that falls, displaced at random as templates
    are: a block whose centre of mass lies right above the edge of its support stands with luck, and so it
    does in the dataset. One placement that stands is enough.

    Args:
        silhouette: (H, W).
        counts: (S,) block list.
        checker: Judges the placements.
        catalogue, grid: The world.
        placements: Displaced placements to try.
        seed: Of the displacements.
    """
    target = np.asarray(silhouette, dtype=bool)
    found = list(designs(target, counts, catalogue, grid))
    rng = np.random.default_rng(seed)
    valid: set[int] = set()
    for attempt in range(1 + placements):
        settings = TemplateSettings(displacement=TemplateSettings.displacement if attempt else 0.0)
        open_ = [i for i in range(len(found)) if i not in valid]
        stacks = [realize(found[i], rng, settings, catalogue, grid) for i in open_]
        for i, verdict in zip(open_, check_all(checker, stacks), strict=True):
            if verdict.stable and silhouette_iou(verdict.settled, target, grid=grid) >= VALID_IOU:
                valid.add(i)
    layouts = [layout_of(template, grid) for template in found]
    return Answers(tuple(layouts), tuple(layouts[i] for i in sorted(valid)))


def layout_of(template: Template, grid: Grid = PAPER_GRID) -> Layout:
    """A design's layout, as `metrics.layout` gives it for its stack."""
    rows = [tuple(shape for shape, _ in row) for row in template.rows]
    return (*rows, *[()] * (grid.height - len(rows)))


def expected_diversity(number: int, samples: int = 3) -> float:
    """Share of distinct layouts to be expected among samples drawn uniformly from a number of valid ones.

    The ceiling of valid diversity: of all ways to draw layouts independently of each other, the uniform one
    gives most. A draw hits one layout at least once with probability 1 - (1 - 1/V)^n.

    >>> [round(expected_diversity(number), 3) for number in (0, 1, 2, 3, 1000)]
    [0.0, 0.333, 0.583, 0.704, 0.999]
    """
    if not number:
        return 0.0
    return number * (1 - (1 - 1 / number) ** samples) / samples
