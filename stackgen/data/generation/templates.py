"""Templates: random designs on the grid (paper, "Generating Data")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stackgen.geometry import PAPER_GRID, Grid
from stackgen.stack import PAPER_CATALOGUE, Catalogue, Stack


@dataclass(frozen=True)
class TemplateSettings:
    """How designs are drawn.

    Args:
        minimum_fill: A row is finished once at least this many cells are occupied.
        displacement: Each block's x is shifted uniformly within this [cell].
        top_row_only: Shapes that may stand in the top row alone (nothing rests on them).
    """

    minimum_fill: int = 3
    displacement: float = 0.1
    top_row_only: tuple[str, ...] = ("triangle",)


@dataclass(frozen=True)
class Template:
    """A design: rows from the bottom up, each a tuple of (shape index, left edge in cells)."""

    rows: tuple[tuple[tuple[int, int], ...], ...]

    @property
    def key(self) -> str:
        """The layout as text, without the displacement: equal designs have equal keys."""
        return "/".join(",".join(f"{shape}@{left}" for shape, left in row) for row in self.rows)

    @staticmethod
    def from_key(key: str) -> Template:
        """Inverse of :attr:`key`."""
        rows = (row.split(",") for row in key.split("/"))
        return Template(tuple(tuple((int(s), int(x)) for s, x in (b.split("@") for b in row)) for row in rows))

    def mirrored(self, catalogue: Catalogue, grid: Grid) -> Template:
        """The design reflected left to right."""
        return Template(
            tuple(
                tuple((s, grid.width - left - round(catalogue[s].size[0])) for s, left in reversed(row))
                for row in self.rows
            )
        )


def draw_template(
    rng: np.random.Generator,
    settings: TemplateSettings | None = None,
    catalogue: Catalogue = PAPER_CATALOGUE,
    grid: Grid = PAPER_GRID,
) -> Template:
    """Fill the grid row by row with random blocks, never wider than the grid, until a row holds the
    minimum; the cells left free go, each on its own, to random gaps between and beside the blocks."""
    settings = settings or TemplateSettings()
    widths = [round(shape.size[0]) for shape in catalogue]
    anywhere = [i for i, shape in enumerate(catalogue) if shape.name not in settings.top_row_only]
    rows = []
    for level in range(grid.height):
        choices = range(len(catalogue)) if level == grid.height - 1 else anywhere
        row: list[int] = []
        while sum(widths[s] for s in row) < settings.minimum_fill:
            fitting = [s for s in choices if sum(widths[t] for t in row) + widths[s] <= grid.width]
            row.append(int(rng.choice(fitting)))
        free = grid.width - sum(widths[s] for s in row)
        gaps = np.bincount(rng.integers(0, len(row) + 1, size=free), minlength=len(row) + 1)
        left, placed = 0, []
        for shape, gap in zip(row, gaps, strict=False):
            left += int(gap)
            placed.append((shape, left))
            left += widths[shape]
        rows.append(tuple(placed))
    return Template(tuple(rows))


def realize(
    template: Template,
    rng: np.random.Generator,
    settings: TemplateSettings | None = None,
    catalogue: Catalogue = PAPER_CATALOGUE,
    grid: Grid = PAPER_GRID,
) -> Stack:
    """The template's blocks at their SE(3) poses, each displaced along x; neighbours that the
    displacement pushed into each other are moved apart, half the overlap each, as contact would."""
    settings = settings or TemplateSettings()
    shapes, poses = [], []
    bottom = 0.0
    for row in template.rows:
        widths = np.array([catalogue[s].size[0] for s, _ in row])
        lefts = np.array([left for _, left in row]) - grid.width / 2
        x = lefts + widths / 2 + rng.uniform(-settings.displacement, settings.displacement, len(row))
        x = _separate(x, widths)
        for (shape, _), center in zip(row, x, strict=True):
            shapes.append(shape)
            poses.append([center, 0, bottom + catalogue[shape].size[2] / 2, 0, 0, 0])
        bottom += max(catalogue[s].size[2] for s, _ in row)
    return Stack(np.array(shapes), np.array(poses), catalogue)


def _separate(x: np.ndarray, widths: np.ndarray, rounds: int = 50) -> np.ndarray:
    """Centres moved until no two neighbours of a row overlap."""
    x = x.copy()
    need = (widths[1:] + widths[:-1]) / 2
    for _ in range(rounds):
        overlap = np.maximum(need - np.diff(x), 0)
        if not overlap.any():
            break
        x[:-1] -= overlap / 2
        x[1:] += overlap / 2
    return x
