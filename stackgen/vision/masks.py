"""Masks and their connected parts, by OpenCV.

Legend: H x W pixels, n parts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stackgen.world import Mask


def bounding_box(mask: Mask) -> tuple[slice, slice]:
    """Return rows and columns of the smallest box around what is set; empty where nothing is."""
    import cv2

    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def components(mask: Mask, connectivity: int = 8) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Label the connected parts of a mask.

    Returns:
        (H, W) number of the part at each pixel, 0 where nothing is set, and (n + 1,) area of each part [pixel], that
        of number 0 as 0.
    """
    import cv2

    _, labels, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=connectivity)
    areas = parts[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return np.asarray(labels, np.int32), np.asarray(areas, np.int32)


def without_specks(mask: Mask, share: float) -> Mask:
    """Remove the parts that are smaller than this share of the largest part."""
    labels, areas = components(mask)
    return np.asarray((areas >= max(share * areas.max(), 1))[labels])


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


def smoothed(mask: Mask, size: int) -> Mask:
    """Apply a median filter of `size` x `size` pixels (odd)."""
    import cv2

    return np.asarray(cv2.medianBlur(mask.astype(np.uint8), size) > 0)
