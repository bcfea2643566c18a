"""The grid and the scale of a world's pictures, and the world itself: shapes, grid and number of blocks.

Units: cells (the edge of a cube) for lengths, pixels for pictures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import MALFORMED, StackgenError
from stackgen.world.shapes import PAPER_CATALOGUE, Catalogue, Floats

Mask = NDArray[np.bool_]
View = Literal["front", "side", "top"]
VIEWS: tuple[View, ...] = ("front", "side", "top")

MAX_BLOCKS = 10
"""N, the number of object tokens of the paper; the longest block list its models accept."""

_MOST = {"width": 1000, "height": 1000, "image_size": 4096, "pixels_per_cell": 4096}
_MOST_BLOCKS = 1000

ROOM = 0.2
"""Least space beside and above a full grid in its pictures [cell]: blocks are displaced, and settle."""


@dataclass(frozen=True)
class Grid:
    """The design grid and the scale of its pictures.

    The image is `image_size` pixels square. x = 0 (y = 0 in the side view) lies on the edge between
    its two middle columns, z = 0 on the edge `ground_margin` pixels above its lower border; the top
    view has y = 0 between its two middle rows. At 14 pixels a cell a structure may stick out 0.28
    cells on every side of the 4 x 4 grid before it is cut off: twice what displacement and settling
    were seen to do.

    Args:
        width: Width of the design grid [cell].
        height: Height of the design grid [cell].
        image_size: Edge of the silhouette [pixel].
        pixels_per_cell: Scale of the pictures [pixel/cell].
        ground_margin: Number of rows of pixels under the ground line.

    Raises:
        StackgenError: If a number is not positive (the margin: negative).
    """

    width: int = 4
    height: int = 4
    image_size: int = 64
    pixels_per_cell: float = 14.0
    ground_margin: float = 4.0

    def __post_init__(self) -> None:
        for name, whole in (("width", True), ("height", True), ("image_size", True), ("pixels_per_cell", False)):
            value = getattr(self, name)
            if not 0 < value < np.inf or (whole and value != round(value)):
                kind = "a whole number of at least 1" if whole else "positive and finite"
                raise StackgenError(f"grid: {name} must be {kind}, got {value}")
            if value > _MOST[name]:
                raise StackgenError(f"grid: {name} must be at most {_MOST[name]}, got {value}")
            if whole:
                object.__setattr__(self, name, int(value))  # 64.0 of a file is 64
        if not 0 <= self.ground_margin < self.image_size:
            raise StackgenError(f"grid: ground_margin must lie in 0..image_size, got {self.ground_margin}")

    def require_room(self) -> None:
        """See that whole stacks fit into the pictures, and the pictures into bytes.

        Raises:
            StackgenError: If a structure that fills the grid has less than `ROOM` cells beside or above it,
                or `image_size` is not a multiple of 8.
        """
        wide = (self.width + 2 * ROOM) * self.pixels_per_cell
        high = (self.height + ROOM) * self.pixels_per_cell + self.ground_margin
        need = 8 * math.ceil(max(wide, high) / 8)
        if self.image_size < max(wide, high):
            scale = min(
                self.image_size / (self.width + 2 * ROOM),
                (self.image_size - self.ground_margin) / (self.height + ROOM),
            )
            raise StackgenError(
                f"grid: at {self.pixels_per_cell:g} pixels a cell, {self.width} x {self.height} cells do not fit into"
                f" pictures of {self.image_size}; set image_size to {need} or pixels_per_cell to {math.floor(scale)}"
            )
        if self.image_size % 8:
            raise StackgenError(f"grid: image_size must be a multiple of 8, got {self.image_size}")

    @property
    def cell_edge(self) -> float:
        """x [cell] of a line between two columns of cells: 0, or 0.5 where the width is odd."""
        return self.width % 2 / 2

    def horizontal(self, margin: int = 0) -> Floats:
        """World coordinate of each column's centre [cell], with `margin` extra pixels on both sides."""
        columns = np.arange(-margin, self.image_size + margin, dtype=np.float64) + 0.5
        return (columns - self.image_size / 2) / self.pixels_per_cell

    def vertical(self, view: View, margin: int = 0) -> Floats:
        """World coordinate of each row's centre [cell], first row at the top of the picture."""
        rows = np.arange(-margin, self.image_size + margin, dtype=np.float64) + 0.5
        zero = self.image_size / 2 if view == "top" else self.image_size - self.ground_margin
        return (zero - rows) / self.pixels_per_cell


PAPER_GRID = Grid()


@dataclass(frozen=True)
class World:
    """What a method must know of its questions: the shapes, the grid of the pictures, the longest block list.

    Args:
        catalogue: The shapes.
        grid: The design grid and the scale of its pictures.
        max_blocks: Largest number of blocks of a stack.

    Raises:
        StackgenError: If `max_blocks` is not a whole number of at least 1.
    """

    catalogue: Catalogue
    grid: Grid
    max_blocks: int

    def __post_init__(self) -> None:
        if self.max_blocks != int(self.max_blocks) or not 1 <= self.max_blocks <= _MOST_BLOCKS:
            raise StackgenError(
                f"world: max_blocks must be a whole number from 1 to {_MOST_BLOCKS}, got {self.max_blocks}"
            )

    def to_json(self) -> dict[str, Any]:
        """Plain form, as manifests and cards carry it beside their other facts."""
        return {"catalogue": self.catalogue.to_json(), "grid": asdict(self.grid), "max_blocks": self.max_blocks}

    @staticmethod
    def from_json(facts: Mapping[str, Any]) -> World:
        """Inverse of :meth:`to_json`; other keys are ignored.

        Raises:
            StackgenError: If a part is missing or malformed.

        >>> World.from_json(PAPER_WORLD.to_json()) == PAPER_WORLD
        True
        """
        try:
            grid, max_blocks = Grid(**facts["grid"]), int(facts["max_blocks"])
            return World(Catalogue.from_json(facts["catalogue"]), grid, max_blocks)
        except MALFORMED as error:
            raise StackgenError(f"a world is a catalogue, a grid and max_blocks: {error!r}") from error


PAPER_WORLD = World(PAPER_CATALOGUE, PAPER_GRID, MAX_BLOCKS)
"""The paper's: four shapes, 4 x 4 cells, 64 x 64 pixels, ten blocks."""
