"""Lines that a drawing lacks: gaps in outlines, what lies between hatches, a base line; and hairs that it has too many.

Legend: H x W pixels.
"""

from __future__ import annotations

import cv2
import numpy as np

from stackgen.vision.masks import closed, components, opened
from stackgen.world import Mask

HAIR = 0.018
"""Half the width of what is no part of something solid, at most, by the size of the drawing."""

HATCH = 0.02
"""Half of what lies between the strokes of a hatch, at most, by the size of the drawing."""


def without_whiskers(mask: Mask, size: int) -> Mask:
    """Remove what is thin as a hair from something solid: lines of the paper that touch it, but no tip of its own."""
    reach = HAIR * size
    core = opened(mask, reach)
    if not core.any():
        return mask
    near = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 3) <= reach
    parts, areas = components(mask & ~near)
    return np.asarray(mask & (near | (areas < 0.5 * reach**2)[parts]))


def hatched(ink: Mask, size: int) -> Mask:
    """Close hatches: strokes so dense that what they cover is solid; other ink stays as it is."""
    dense = closed(ink, HATCH * size)
    solid = opened(dense, 0.05 * size)
    of_dense = np.array([np.count_nonzero(part) for part in (solid, ink)]) / np.count_nonzero(dense)
    return ink | solid if (of_dense > [0.5, 0.4]).all() else ink


def bridged(ink: Mask, reach: float) -> Mask:
    """Draw lines across gaps in outlines of up to twice a reach [pixel].

    What lies further from all ink than the reach tells inside from outside; where both meet there is a line.
    """
    blank, _ = components(~ink, connectivity=4)
    outside = blank == blank[0, 0]
    far = cv2.distanceTransform((~ink).astype(np.uint8), cv2.DIST_L2, 5) > reach
    seeds, _ = components(far & outside, connectivity=4)
    barrier = np.where(seeds > 0, 0, 1).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(barrier, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_pixel = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
    of_pixel[nearest[seeds > 0]] = seeds[seeds > 0]
    sides = of_pixel[nearest].astype(np.float32)
    low, high = cv2.erode(sides, np.ones((3, 3), np.uint8)), cv2.dilate(sides, np.ones((3, 3), np.uint8))
    return np.asarray(ink | ((low != high) & outside))


def with_base(ink: Mask, size: int, stroke: float) -> Mask | None:
    """Draw a line between the lowest ends of the strokes, None where they are too near to each other."""
    rows, columns = np.nonzero(ink)
    base = int(rows.max())
    feet = columns[rows > base - 0.08 * size]
    if np.ptp(feet) < 0.25 * np.ptp(columns):
        return None
    based = ink.astype(np.uint8)
    ends = []
    for end in (int(feet.min()), int(feet.max())):
        near = (np.abs(columns - end) <= stroke) & (rows > base - 0.08 * size)
        ends.append((end, int(rows[near].max())))
    cv2.line(based, ends[0], ends[1], 1, max(1, round(stroke)))
    return based > 0
