"""Random designs on the grid (paper, "Generating Data"); the settled one is a dataset's template."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stackgen.errors import StackgenError
from stackgen.stack import Stack
from stackgen.world import Shape, World

_EPSILON = 1e-6  # [cell]


@dataclass(frozen=True)
class DesignSettings:
    """How designs are drawn.

    Args:
        minimum_fill: Number of occupied cells from which on a row is finished.
        displacement: Largest shift of a block along x, drawn uniformly [cell].
        top_row_only: Shapes that may stand in the top row alone, since nothing rests on them.
    """

    minimum_fill: int = 3
    displacement: float = 0.1
    top_row_only: tuple[str, ...] = ("triangle",)

    def check(self, world: World) -> None:
        """See that designs can be drawn with these settings, and that their blocks can stand.

        Raises:
            StackgenError: If a row cannot be filled, or a shape cannot stand or bear where it may be put.
        """
        catalogue, grid = world.catalogue, world.grid
        unknown = set(self.top_row_only) - {*catalogue.names, *DesignSettings().top_row_only}
        if unknown:
            raise StackgenError(f"template: top_row_only names {', '.join(sorted(unknown))}: not in the catalogue")
        lower = [shape for shape in catalogue if shape.name not in self.top_row_only]
        if not lower:
            raise StackgenError("template: a shape must be left that may stand below the top row; see top_row_only")
        if self.displacement < 0 or not 1 <= self.minimum_fill <= grid.width:
            raise StackgenError(
                f"template: displacement must be at least 0 and minimum_fill lie in 1..{grid.width}, the grid's width"
            )
        for shape in catalogue:
            self._check_shape(shape, lower, world)

    def _check_shape(self, shape: Shape, lower: Sequence[Shape], world: World) -> None:
        grid = world.grid
        name = f"template: shape {shape.name!r}"
        stands, bears = shape.level
        if not stands:
            raise StackgenError(f"{name} has no level edge at its bottom to stand on")
        if not bears and shape in lower:
            raise StackgenError(f"{name} has no level edge at its top to bear others; name it in top_row_only")
        if cells_wide(shape) > grid.width or shape.size[2] > grid.height + _EPSILON:
            raise StackgenError(f"{name} is larger than the {grid.width} x {grid.height} grid")
        row = [other for other in lower if _same_height(other, shape)] or [shape]
        most = grid.width - min(cells_wide(other) for other in row) + 1
        if self.minimum_fill > most:
            raise StackgenError(
                f"{name} may leave its row with less than {self.minimum_fill} of {grid.width} cells filled;"
                f" set minimum_fill to {most} or add a narrower shape of its height"
            )


def cells_wide(shape: Shape) -> int:
    """Count the cells of a row that a shape takes up."""
    return math.ceil(shape.size[0] - _EPSILON)


def _same_height(a: Shape, b: Shape) -> bool:
    return abs(a.size[2] - b.size[2]) < _EPSILON


@dataclass(frozen=True)
class Design:
    """A design: rows from the bottom up, each a tuple of (shape index, left edge in cells)."""

    rows: tuple[tuple[tuple[int, int], ...], ...]

    @property
    def key(self) -> str:
        """The design as text, without the displacement: equal designs have equal keys."""
        return "/".join(",".join(f"{shape}@{left}" for shape, left in row) for row in self.rows)

    @staticmethod
    def from_key(key: str) -> Design:
        """Invert :attr:`key`."""
        rows = (row.split(",") for row in key.split("/"))
        return Design(tuple(tuple((int(s), int(x)) for s, x in (b.split("@") for b in row)) for row in rows))

    def mirrored(self, world: World) -> Design:
        """Reflect the design left to right."""
        return Design(
            tuple(
                tuple((s, world.grid.width - left - cells_wide(world.catalogue[s])) for s, left in reversed(row))
                for row in self.rows
            )
        )


def draw_design(rng: np.random.Generator, world: World, settings: DesignSettings | None = None) -> Design:
    """Fill the grid row by row with random blocks, never wider than the grid, until a row holds the
    minimum; the cells left free go, each on its own, to random gaps between and beside the blocks.

    The blocks of a row are of one height, that of its first; rows follow until none fits below the
    grid's upper edge.
    """
    settings, catalogue, grid = settings or DesignSettings(), world.catalogue, world.grid
    widths = [cells_wide(shape) for shape in catalogue]
    heights = [shape.size[2] for shape in catalogue]
    rows: list[tuple[tuple[int, int], ...]] = []
    room = grid.height + _EPSILON
    while room >= min(heights):
        choices = [
            i
            for i, shape in enumerate(catalogue)
            if heights[i] <= room and (shape.name not in settings.top_row_only or room - heights[i] < min(heights))
        ]
        if not choices:
            break
        row: list[int] = []
        while sum(widths[s] for s in row) < settings.minimum_fill:
            fitting = [s for s in choices if sum(widths[t] for t in row) + widths[s] <= grid.width]
            row.append(int(rng.choice(fitting)))
            choices = [s for s in choices if _same_height(catalogue[s], catalogue[row[0]])]
        room -= heights[row[0]]
        free = grid.width - sum(widths[s] for s in row)
        gaps = np.bincount(rng.integers(0, len(row) + 1, size=free), minlength=len(row) + 1)
        left, placed = 0, []
        for shape, gap in zip(row, gaps, strict=False):
            left += int(gap)
            placed.append((shape, left))
            left += widths[shape]
        rows.append(tuple(placed))
    return Design(tuple(rows))


def realize(design: Design, rng: np.random.Generator, world: World, settings: DesignSettings | None = None) -> Stack:
    """Put a design's blocks at their SE(3) poses, each displaced along x; neighbours that the
    displacement pushed into each other are moved apart, half the overlap each, as contact would."""
    settings, catalogue, grid = settings or DesignSettings(), world.catalogue, world.grid
    shapes, poses = [], []
    bottom = 0.0
    for row in design.rows:
        widths = np.array([catalogue[s].size[0] for s, _ in row])
        cells = np.array([cells_wide(catalogue[s]) for s, _ in row])
        lefts = np.array([left for _, left in row]) - grid.width / 2
        x = lefts + cells / 2 + rng.uniform(-settings.displacement, settings.displacement, len(row))
        x = _separate(x, widths)
        for (shape, _), center in zip(row, x, strict=True):
            shapes.append(shape)
            poses.append([center, 0, bottom + catalogue[shape].size[2] / 2, 0, 0, 0])
        bottom += max(catalogue[s].size[2] for s, _ in row)
    return Stack(np.array(shapes), np.array(poses), catalogue)


def _separate(x: np.ndarray, widths: np.ndarray, rounds: int = 50) -> np.ndarray:
    """Move centres until no two neighbours of a row overlap."""
    x = x.copy()
    need = (widths[1:] + widths[:-1]) / 2
    for _ in range(rounds):
        overlap = np.maximum(need - np.diff(x), 0)
        if not overlap.any():
            break
        x[:-1] -= overlap / 2
        x[1:] += overlap / 2
    return x
