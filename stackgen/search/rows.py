"""The best ways to pack blocks side by side over one level of a silhouette, by dynamic programming.

A **level** is a height at which blocks may stand; a **row** is what stands there from left to right. Blocks lie at
whole pixels. A row gains a point for each pixel of the silhouette that its blocks cover, and loses `WASTE` for each
pixel that they cover beside it: where that is the IoU of the whole, the best sum is the best IoU (Dinkelbach 1967).

Legend: B rows packed at once, S shapes, W columns of pixels, L levels, K sequences of shapes that are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import row_intervals
from stackgen.world import Catalogue, Grid, Mask, Shape, World

Floats = NDArray[np.float64]
Gains = NDArray[np.float32]
Ints = NDArray[np.int64]

WASTE = 0.9
"""Loss for a pixel that is covered beside the silhouette, in pixels of the silhouette."""

BLOCK = 1.0
"""Loss for each block, in pixels: of two rows that fit alike the one of fewer blocks is better."""

NEVER = np.float32(-1e9)
"""Gain of what is impossible."""

_FINEST = 20
"""The smallest part of a cell that heights may be multiples of."""


class Placed(NamedTuple):
    """A block in a row: its shape, the left end of its columns [pixel], and its level."""

    shape: int
    left: float
    level: int


class Row(NamedTuple):
    """A packed row: what it gains [pixel], and its (shape, left end [pixel]) from left to right."""

    gain: float
    blocks: tuple[tuple[int, int], ...]

    @property
    def shapes(self) -> tuple[int, ...]:
        """Shape of each block."""
        return tuple(shape for shape, _ in self.blocks)


@dataclass(frozen=True)
class Piece:
    """A shape as the search sees it.

    Args:
        width: Number of columns that it takes [pixel].
        height: Number of levels from its foot to its head.
        foot, head: Ends of the edge that it stands on and of the one that bears, from its left end [cell]; None
            where there is no such edge.
        middle: Its centre of mass, from its left end and its foot [cell].
        weight: Its volume [cell^3].
    """

    width: int
    height: int
    foot: tuple[float, float] | None
    head: tuple[float, float] | None
    middle: tuple[float, float]
    weight: float

    @staticmethod
    def of(shape: Shape, grid: Grid, step: float) -> Piece:
        """Make the piece of a shape; its box is centred in the columns that it takes."""
        pixels = max(1, int(np.ceil(shape.size[0] * grid.pixels_per_cell - 1e-6)))
        middle, half = pixels / grid.pixels_per_cell / 2, shape.size[2] / 2
        x, _, z = shape.center_of_mass
        return Piece(
            pixels,
            round(shape.size[2] / step),
            _edge(shape, -half, middle),
            _edge(shape, half, middle),
            (middle + float(x), half + float(z)),
            shape.volume,
        )


def _edge(shape: Shape, z: float, middle: float) -> tuple[float, float] | None:
    """Give the ends of a shape's level edge at a height."""
    ends = [x for x, corner_z in shape.outline if abs(corner_z - z) < 1e-6]
    return (min(ends) + middle, max(ends) + middle) if len(ends) > 1 else None


def step_of(catalogue: Catalogue) -> float:
    """Find the distance between two levels [cell]: the largest that all heights are multiples of.

    Raises:
        StackgenError: If there is none of at least a twentieth of a cell.

    >>> from stackgen.world import PAPER_CATALOGUE
    >>> step_of(PAPER_CATALOGUE), step_of(Catalogue((Shape.box("brick", 2, 1.5), Shape.box("plank", 2, 0.5))))
    (1.0, 0.5)
    """
    heights = np.array([shape.size[2] for shape in catalogue])
    for parts in range(1, _FINEST + 1):
        step = float(heights.min()) / parts
        multiples = heights / step
        if step > 1 / _FINEST - 1e-9 and np.abs(multiples - np.round(multiples)).max() < 1e-6:
            return step
    raise StackgenError(
        "search stacks shapes whose heights are multiples of a common part of at least"
        f" 1/{_FINEST} cell; these are {', '.join(f'{height:g}' for height in sorted(set(heights)))}"
    )


class Levels:
    """What each shape gains at each place of a silhouette.

    Args:
        silhouette: (H, W) target.
        world: Shapes and grid.

    Raises:
        StackgenError: If the heights of the shapes have no common part.
    """

    def __init__(self, silhouette: Mask, world: World) -> None:
        self.grid, self.catalogue = world.grid, world.catalogue
        self.step = step_of(world.catalogue)
        self.pieces = tuple(Piece.of(shape, world.grid, self.step) for shape in world.catalogue)
        self.columns = world.grid.image_size
        self.silhouette = np.asarray(silhouette, dtype=bool)

    @cached_property
    def number(self) -> int:
        """Number of levels L on which a block could cover something."""
        heights = self.grid.vertical("front")[self.silhouette.any(axis=1)]
        return max(1, int(np.ceil(float(heights.max(initial=0)) / self.step - 1e-6)))

    @cached_property
    def widths(self) -> Ints:
        """(S,) columns that each shape takes."""
        return np.array([piece.width for piece in self.pieces])

    @cached_property
    def gains(self) -> Gains:
        """(L, S, W + 1) gain of a block with its left end at each column; `NEVER` where it leaves the picture."""
        gains = np.full((self.number, len(self.pieces), self.columns + 1), NEVER, dtype=np.float32)
        worth = np.where(self.silhouette, 1.0, -WASTE)
        sums = np.zeros((len(worth), self.columns + 1))
        np.cumsum(worth, axis=1, out=sums[:, 1:])
        z = self.grid.vertical("front")
        for s, (shape, piece) in enumerate(zip(self.catalogue, self.pieces, strict=True)):
            places = np.arange(self.columns - piece.width + 1)
            if piece.foot is None or not len(places):
                continue
            for level in range(self.number):
                base = level * self.step + shape.size[2] / 2
                left, right = row_intervals(np.asarray(shape.outline) + [0, base], z)
                rows = np.flatnonzero(left <= right)
                first = np.ceil(left[rows] * self.grid.pixels_per_cell + piece.width / 2 - 0.5 - 1e-9).astype(int)
                last = np.floor(right[rows] * self.grid.pixels_per_cell + piece.width / 2 - 0.5 + 1e-9).astype(int) + 1
                if base + shape.size[2] / 2 > z[0] + 1 / self.grid.pixels_per_cell:
                    continue  # it sticks out of the picture
                covered = sums[rows, places[:, None] + last] - sums[rows, places[:, None] + first]
                gains[level, s, : len(places)] = covered.sum(axis=1) - BLOCK
        return gains

    def left_end(self, column: float) -> float:
        """Give the place of a column's left end in the world [cell]."""
        return (column - self.columns / 2) / self.grid.pixels_per_cell


def pack(gains: Gains, widths: Ints, keep: int, depth: int, left: Ints | None = None) -> list[list[Row]]:
    """Find the best rows of distinct sequences of shapes, each at its best places.

    A sequence's first shapes are bounded by the best that any shapes can add to their right, so that of all sequences
    of a length the `keep` best beginnings are enough to find the `keep` best rows, where `depth` and `left` allow all.

    Args:
        gains: (B, S, W + 1) gain of each shape with its left end at each column.
        widths: (S,) columns that each takes.
        keep: K, largest number of rows each.
        depth: Largest number of blocks of a row.
        left: (B, S) blocks that there are; None for any number.

    Returns:
        For each of the B the rows, the best first, the empty one (which gains nothing) among them.
    """
    number, shapes, edges = gains.shape
    after = _best_after(gains, widths)
    best = np.zeros((number, 1, edges), dtype=np.float32)
    used = np.zeros((number, 1, shapes), dtype=np.int64)
    stages: list[_Stage] = []
    for _ in range(depth):
        grown = np.full((number, best.shape[1], shapes, edges), NEVER, dtype=np.float32)
        for s, width in enumerate(widths):
            if width < edges:
                grown[:, :, s, width:] = best[:, :, : edges - width] + gains[:, s, None, : edges - width]
        np.maximum.accumulate(grown, axis=3, out=grown)
        bound = (grown + after[:, None, None]).max(axis=3)
        if left is not None:
            bound[used >= left[:, None]] = NEVER
        bound = bound.reshape(number, -1)
        order = np.argsort(-bound, axis=1, kind="stable")[:, :keep]
        if bound.max() < NEVER / 2:
            break
        rows = np.arange(number)[:, None]
        parent, shape = order // shapes, order % shapes
        best = grown.reshape(number, -1, edges)[rows, order]
        best[bound[rows, order] < NEVER / 2] = NEVER
        used = used[rows, parent] + np.eye(shapes, dtype=np.int64)[shape]
        stages.append(_Stage(best, parent, shape))
    return [_rows(stages, b, widths, keep) for b in range(number)]


class _Stage(NamedTuple):
    """Sequences of one length: (B, K, W + 1) best gain up to each column, what they continue, and their last shape."""

    best: Gains
    parent: Ints
    shape: Ints


def _best_after(gains: Gains, widths: Ints) -> Gains:
    """(B, W + 1) best gain of any blocks right of each column."""
    number, shapes, edges = gains.shape
    after = np.zeros((number, edges), dtype=np.float32)
    for column in range(edges - 2, -1, -1):
        fits = [s for s in range(shapes) if column + widths[s] < edges]
        choices = [after[:, column + 1], *(gains[:, s, column] + after[:, column + widths[s]] for s in fits)]
        after[:, column] = np.max(choices, axis=0)
    return after


def _rows(stages: Sequence[_Stage], b: int, widths: Ints, keep: int) -> list[Row]:
    """Read the best rows of one of the B off the stages."""
    found = [(0.0, -1, 0)]
    for length, stage in enumerate(stages):
        gains = stage.best[b, :, -1]
        found += [(float(gains[k]), length, k) for k in np.flatnonzero(gains > NEVER / 2).tolist()]
    found.sort(key=lambda item: -item[0])
    rows = []
    for gain, length, k in found[:keep]:
        blocks, end = [], stages[0].best.shape[2] - 1 if stages else 0
        for stage in reversed(stages[: length + 1]):
            row = stage.best[b, k]
            end = int(np.searchsorted(row, row[end]))  # the leftmost place of the same gain
            shape = int(stage.shape[b, k])
            end -= int(widths[shape])
            blocks.append((shape, end))
            k = int(stage.parent[b, k])
        rows.append(Row(gain, tuple(reversed(blocks))))
    return rows
