"""Masks and their connected parts, by OpenCV.

Legend: H x W pixels, n parts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.world import Grid, Mask


def bounding_box(mask: Mask) -> tuple[slice, slice]:
    """Return rows and columns of the smallest box around what is set; empty where nothing is."""
    import cv2

    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def extent(mask: Mask) -> int:
    """Return the longer edge of the smallest box around what is set [pixel]."""
    return max(mask[bounding_box(mask)].shape)


def components(mask: Mask, connectivity: int = 8) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Label the connected parts of a mask.

    Returns:
        (H, W) number of the part at each pixel, 0 where nothing is set, and (n + 1,) area of each part [pixel], that
        of number 0 as 0.
    """
    import cv2

    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)
    areas = np.bincount(labels.ravel())  # faster than OpenCV's statistics
    areas[0] = 0
    return np.asarray(labels, np.int32), np.asarray(areas, np.int32)


def without_specks(mask: Mask, share: float) -> Mask:
    """Remove the parts that are smaller than this share of the largest part."""
    labels, areas = components(mask)
    return np.asarray((areas >= max(share * areas.max(), 1))[labels])


def rim(shape: tuple[int, ...], width: int) -> Mask:
    """Return the strip of some width [pixel] along the edge of a picture (H, W)."""
    strip = np.ones(shape[:2], dtype=bool)
    strip[width:-width, width:-width] = False
    return strip


_ROUND = 0.9  # a square has 0.83


def is_round(mask: Mask) -> bool:
    """Tell a sun from a structure, seen straight on or askew: it is the ellipse that has its moments.

    >>> y, x = np.mgrid[:60, :90]
    >>> is_round((x - 45) ** 2 + 3 * (y - 30) ** 2 < 1200), is_round((x > 20) & (x < 60) & (y > 10) & (y < 50))
    (True, False)
    """
    import cv2

    points = np.argwhere(mask).astype(np.float64)
    scales, axes = np.linalg.eigh(np.cov(points.T))
    x, y = np.flip(points.mean(axis=0))
    lengths = 4 * np.sqrt(np.maximum(scales, 1))  # of the whole axes, by the second moments of an ellipse
    turn = float(np.degrees(np.arctan2(*axes[:, 0])))
    ellipse = cv2.ellipse(np.zeros(mask.shape, np.uint8), ((x, y), tuple(lengths), turn), 1, -1) > 0
    return bool(np.count_nonzero(mask & ellipse) > _ROUND * np.count_nonzero(mask | ellipse))


def largest(mask: Mask, gap: int) -> Mask:
    """Keep the largest part of a mask; what is at most `gap` pixels apart is one part.

    >>> largest(np.array([[1, 1, 0, 0, 0, 1]], dtype=bool), 1).tolist()
    [[True, True, False, False, False, False]]
    """
    import cv2

    kernel = np.ones((2 * max(0, gap // 2) + 1,) * 2, np.uint8)
    _, labels = cv2.connectedComponents(cv2.dilate(mask.astype(np.uint8), kernel))
    areas = np.bincount(labels[mask], minlength=1)
    areas[0] = 0
    return np.asarray(mask & (labels == areas.argmax()))


_DASHES = 12  # parts of like size that are one outline, drawn in dashes or by a crayon,
_LIKE = 0.2  # least share of the area of the largest of them
_MOST_PARTS = 30  # of smaller ones nothing hangs, and noise has hundreds


def near_parts(ink: Mask, together: float) -> list[Mask]:
    """Return the parts of the ink (H, W) that are near to each other, without dirt.

    Args:
        ink: All that is drawn; what an outline encloses belongs to it.
        together: What is nearer than this, by the size of the largest part, is one part.
    """
    import cv2

    labels, areas = components(ink)
    boxes = [bounding_box(labels == number) for number in np.argsort(areas)[::-1][:5] if areas[number]]
    size = max(max(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in boxes)
    blank, _ = components(np.pad(~ink, 1, constant_values=True), connectivity=4)
    within = blank[1:-1, 1:-1] != blank[0, 0]
    far = cv2.distanceTransform((~(ink | within)).astype(np.uint8), cv2.DIST_L2, 3)
    reach = size / 3 if np.count_nonzero(areas > _LIKE * areas.max()) >= _DASHES else together * size / 2
    while True:
        groups, _ = components(far <= reach)
        groups = np.where(ink, groups, 0)
        largest_first = 1 + np.argsort(-np.bincount(groups.ravel())[1:], kind="stable")
        parts = [groups == number for number in sorted(largest_first[:_MOST_PARTS].tolist())]
        whole = max(extent(part) for part in parts)
        if whole <= 2 * size:
            return [part for part in parts if extent(part) > 0.1 * size]
        size, reach = whole, together * whole / 2  # it was an outline of many dashes


def smoothed(mask: Mask, size: int) -> Mask:
    """Apply a median filter of `size` x `size` pixels (odd)."""
    import cv2

    return np.asarray(cv2.medianBlur(mask.astype(np.uint8), size) > 0)


def closed(mask: Mask, radius: float) -> Mask:
    """Close gaps of up to twice a radius [pixel], by discs."""
    import cv2

    if radius < 0.5:
        return mask
    grown = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) <= radius
    return np.asarray((cv2.distanceTransform(grown.astype(np.uint8), cv2.DIST_L2, 5) > radius) | mask)


def opened(mask: Mask, radius: float) -> Mask:
    """Keep the parts of a mask that hold a disc of this radius [pixel]."""
    import cv2

    core = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) > radius
    if not core.any():
        return core
    return np.asarray(cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 5) <= radius) & mask


def place(figure: Mask, grid: Grid, cells_high: float) -> Mask:
    """Scale a figure to so many cells, set it on the ground line and centre it; what is off the canvas is cut off.

    A pixel is set when at least half of it is covered. OpenCV's INTER_AREA scales to whole pixels only, which moves
    edges.

    Args:
        figure: (h, w), cut out to its box.
        grid: Scale and place of the result.
        cells_high: Height of the figure [cell].

    Returns:
        (image_size, image_size) silhouette.

    Raises:
        StackgenError: If nothing of it is left at this scale.

    >>> int(place(np.ones((40, 20), bool), Grid(), 2).sum())
    392
    """
    height, width = figure.shape
    scale = grid.pixels_per_cell * cells_high / height  # [target pixel per pixel]
    columns = (np.arange(grid.image_size + 1) - grid.image_size / 2) / scale + width / 2
    rows = (np.arange(grid.image_size + 1) - (grid.image_size - grid.ground_margin)) / scale + height
    covered = _overlap(rows, height) @ figure.astype(np.float64) @ _overlap(columns, width).T
    placed = np.asarray(covered >= 0.5 - 1e-9)
    if not placed.any():
        raise StackgenError("the structure is too thin to be seen at the grid's scale; draw it bolder")
    return placed


def filling(figure: Mask, grid: Grid) -> float:
    """Return the height [cell] at which a figure (h, w) is as high as the grid, or as wide where it would be wider."""
    height, width = figure.shape
    return min(float(grid.height), grid.width * height / width)


def fitted(mask: Mask, grid: Grid) -> Mask:
    """Scale what is set in a mask (H, W) until it fills the grid, on the ground line and centred.

    Raises:
        StackgenError: If nothing is left of it at this scale.
    """
    figure = mask[bounding_box(mask)]
    return place(figure, grid, filling(figure, grid))


def _overlap(edges: NDArray[np.float64], length: int) -> NDArray[np.float64]:
    """Return the share (n, length) of each interval between `edges` (n + 1) that each of `length` unit cells covers."""
    low, high = edges[:-1, None], edges[1:, None]
    cells = np.arange(length)
    return np.clip(np.minimum(high, cells + 1) - np.maximum(low, cells), 0, None) / (high - low)
