"""The world that a stack lives in: its shapes, the grid and the scale of its pictures, and the number of blocks."""

from stackgen.world.grid import MAX_BLOCKS, PAPER_GRID, PAPER_WORLD, ROOM, VIEWS, Grid, Mask, View, World
from stackgen.world.shapes import MOST_SHAPES, PAPER_CATALOGUE, Catalogue, Floats, Shape

__all__ = [
    "MAX_BLOCKS",
    "MOST_SHAPES",
    "PAPER_CATALOGUE",
    "PAPER_GRID",
    "PAPER_WORLD",
    "ROOM",
    "VIEWS",
    "Catalogue",
    "Floats",
    "Grid",
    "Mask",
    "Shape",
    "View",
    "World",
]
