"""Figures of a few convex parts, and the pencil that draws them. Lengths in cells, z from the ground up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import row_intervals
from stackgen.stack import Stack
from stackgen.world import Catalogue, Grid, Mask

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """What is drawn.

    Args:
        parts: Corners (V, 2) of each convex part, (x, z) [cell].
        holes: Corners of each convex hole, cut out of all parts.
    """

    parts: tuple[Floats, ...]
    holes: tuple[Floats, ...] = ()

    @property
    def box(self) -> tuple[Floats, Floats]:
        """The lowest and the highest x and z."""
        corners = np.concatenate(self.parts)
        return corners.min(axis=0), corners.max(axis=0)

    def mapped(self, matrix: Floats, shift: Floats | Sequence[float] = (0.0, 0.0)) -> Figure:
        """Map all corners by a (2, 2) matrix, then shift them."""
        of = [tuple(corners @ matrix.T + np.asarray(shift) for corners in some) for some in (self.parts, self.holes)]
        return Figure(of[0], of[1])

    def painted(self, grid: Grid) -> Mask:
        """Paint it (H, W): a pixel is set when its centre is in a part and above the ground, and in no hole."""
        rows, columns = grid.vertical("front"), grid.horizontal()
        picture = np.zeros((len(rows), len(columns)), dtype=bool)
        for some, ink in ((self.parts, True), (self.holes, False)):
            for corners in some:
                left, right = row_intervals(corners, rows)
                picture[(columns >= left[:, None]) & (columns <= right[:, None])] = ink
        picture[rows < 0] = False
        return picture


@dataclass(frozen=True)
class Pencil:
    """What a figure is drawn with.

    Args:
        rng: Source of all that is random.
        wide, high: Size to fill, more or less [cell].
        step: Distance of the lines that edges lie on [cell]; 0 for anywhere.
        catalogue: The blocks, for figures made of them.
    """

    rng: np.random.Generator
    wide: float
    high: float
    step: float
    catalogue: Catalogue

    def length(self, low: float, high: float) -> float:
        """Draw a length between two, on the ruler."""
        value = self.rng.uniform(low, max(low, high))
        return self.snapped(value, least=self.step or 0.25)

    def place(self, low: float, high: float) -> float:
        """Draw a place between two, on the ruler; the first where there is no room up to the second."""
        return self.snapped(self.rng.uniform(low, max(low, high)))

    def snapped(self, value: float, least: float = 0.0) -> float:
        """Move a length to the ruler's nearest line, at least to `least`."""
        return max(least, float(np.round(value / self.step) * self.step) if self.step else float(value))

    def chance(self, share: float) -> bool:
        """Throw a coin that falls on heads with this share."""
        return bool(self.rng.random() < share)


def rectangle(left: float, low: float, wide: float, high: float) -> Floats:
    """Give the corners of a box by its lower left corner and its size."""
    return np.array([[left, low], [left + wide, low], [left + wide, low + high], [left, low + high]])


def gable(left: float, low: float, wide: float, high: float, apex: float = 0.5) -> Floats:
    """Give the corners of a triangle whose apex is above this share of its foot."""
    return np.array([[left, low], [left + wide, low], [left + apex * wide, low + high]])


def oval(left: float, low: float, wide: float, high: float) -> Floats:
    """Give 20 corners of an ellipse in a box."""
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    return np.array([left + wide / 2, low + high / 2]) + np.stack(
        [wide / 2 * np.cos(angle), high / 2 * np.sin(angle)], axis=1
    )


def of_blocks(stack: Stack) -> Figure:
    """Draw upright blocks as they stand."""
    return Figure(
        tuple(
            np.asarray(stack.catalogue[shape].outline) + pose[[0, 2]]
            for shape, pose in zip(stack.shapes.tolist(), stack.poses, strict=True)
        )
    )
