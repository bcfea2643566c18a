"""The one reader of pictures: a drawing, the photo of a sketch or a depth frame becomes a figure.

Legend: H x W pixels of the picture, h x w of the figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.vision import drawings
from stackgen.vision.depth import find_structure, is_depth, read_frame
from stackgen.vision.drawings import Picture, read_silhouette
from stackgen.vision.masks import bounding_box
from stackgen.vision.sketches import read_sketch
from stackgen.world import Grid, Mask

PictureKind = Literal["drawing", "photo", "depth"]

FIGURE = 512
"""Longer edge of a figure [pixel], about."""


@dataclass(frozen=True)
class Reading:
    """What was read in a picture.

    Args:
        figure: (h, w) what was drawn or seen, upright, cut out to its box, of square pixels; the longer edge has about
            `FIGURE` of them.
        kind: What the picture was taken for.
        confidence: How sure the reader is, 0..1.
        overlay: (H, W, 3) uint8, the picture with the outline of what was read.
        notes: What was left out or is doubtful, a sentence each.
        cell: Edge of a cell in pixels of `figure` where it is known, else None.
        exact: (image_size, image_size) the silhouette itself where the picture already is one of the grid's, else None.
    """

    figure: Mask
    kind: PictureKind
    confidence: float
    overlay: Picture
    notes: tuple[str, ...] = ()
    cell: float | None = None
    exact: Mask | None = None


def read_picture(
    source: str | Path | ArrayLike, grid: Grid, as_: PictureKind | None = None, which: int | None = None
) -> Reading:
    """Read what a picture shows.

    Args:
        source: An image file, a depth frame (.npy or 16-bit PNG), an array as `read_silhouette` takes it, or a PIL
            image.
        grid: Grid of the silhouettes; a picture that already is one of them is taken as it is.
        as_: What to take the picture for; None to tell.
        which: Number of the drawing, from the left, where there are several.

    Raises:
        StackgenError: If the picture cannot be read, or nothing is seen in it.
    """
    if as_ is not None and as_ not in get_args(PictureKind):
        raise StackgenError(f"a picture is a drawing, a photo or a depth frame, got {as_!r}")
    if isinstance(source, str | Path) and as_ != "drawing" and (as_ == "depth" or is_depth(source)):
        found = find_structure(read_frame(source), grid)
        return _reading(found.front, "depth", grid)
    sketch = None
    if as_ != "drawing" and isinstance(source, str | Path):
        try:
            sketch = read_sketch(source, grid)
        except StackgenError:
            if as_ == "photo":
                raise
    if sketch is not None and (as_ == "photo" or iou(sketch.drawn, read_silhouette(source, grid)) < 0.7):
        return _reading(sketch.ink, "photo", grid)
    difference, scale = drawings._difference(source)
    taken = read_silhouette(source, grid)
    exact = taken if np.array_equal(difference > 0, taken) else None
    return _reading(drawings._structure(difference, scale), "drawing", grid, exact)


def _reading(mask: Mask, kind: PictureKind, grid: Grid, exact: Mask | None = None) -> Reading:
    cut = mask[bounding_box(mask)]
    scale = FIGURE / max(cut.shape)
    size = (max(1, round(cut.shape[1] * scale)), max(1, round(cut.shape[0] * scale)))
    figure = cv2.resize(cut.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
    overlay = np.repeat(np.where(mask, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return Reading(figure[bounding_box(figure)], kind, 1.0, overlay, exact=exact)


def place(figure: Mask, grid: Grid, cells_high: float) -> Mask:
    """Scale a figure to so many cells, set it on the ground line and centre it; what is off the canvas is cut off.

    A pixel is set when at least half of it is covered.

    Args:
        figure: (h, w), cut out to its box.
        grid: Scale and place of the result.
        cells_high: Height of the figure [cell].

    Returns:
        (image_size, image_size) silhouette.

    >>> int(place(np.ones((40, 10), bool), Grid(), 2).sum())
    196
    """
    height, width = figure.shape
    scale = grid.pixels_per_cell * cells_high / height  # [target pixel per pixel]
    columns = (np.arange(grid.image_size + 1) - grid.image_size / 2) / scale + width / 2
    rows = (np.arange(grid.image_size + 1) - (grid.image_size - grid.ground_margin)) / scale + height
    covered = _overlap(rows, height) @ figure.astype(np.float64) @ _overlap(columns, width).T
    return np.asarray(covered >= 0.5 - 1e-9)


def filling(figure: Mask, grid: Grid) -> float:
    """Return the height [cell] at which a figure is as high as the grid, or as wide where it would become wider."""
    height, width = figure.shape
    return min(float(grid.height), grid.width * height / width)


def _overlap(edges: NDArray[np.float64], length: int) -> NDArray[np.float64]:
    """Return the share (n, length) of each interval between `edges` (n + 1) that each of `length` unit cells covers."""
    low, high = edges[:-1, None], edges[1:, None]
    cells = np.arange(length)
    return np.clip(np.minimum(high, cells + 1) - np.maximum(low, cells), 0, None) / (high - low)
