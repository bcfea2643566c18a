"""The line of the ground that a structure stands on, which is no block.

Legend: H x W pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.masks import bounding_box, extent, largest
from stackgen.world import Mask

_NEAR = 0.06  # the line's two ends are level to within this, by the size of all the ink
_EXPLAINED = 0.75  # least share of the ink that is the ground line or stands on it,
_BELOW = 0.06  # and greatest share of what lies below


def without_ground(ink: Mask) -> list[Mask]:
    """Remove a ground line: thin, nearly level, under the drawing, and longer than it.

    Returns:
        Nothing where there is none; else the ink (H, W) without it, and without only what is beside the drawing, as
        what stands on the line may have no line of its own there.
    """
    body, foot = _off_ground(ink)
    if foot is None:
        return []
    more, again = _off_ground(body)  # beyond a drawing that is filled in the line is found anew
    if again is not None and bounding_box(body & ~more)[0].start > foot[0].stop - _NEAR * extent(ink):
        body, foot = more, again
    under = body.copy()
    under[:, foot[1]] = ink[:, foot[1]]
    return [body, under]


def _off_ground(ink: Mask) -> tuple[Mask, tuple[slice, slice] | None]:
    """Remove the ground line that begins at one free end; return the rest and its box, None where there is none."""
    size = extent(ink)
    lowest, thick, alone = _lowest_runs(ink, round(0.2 * size))
    thin = alone & (thick <= max(3, 0.045 * size))
    for free in _stretches(thin, round(0.03 * size)):
        if np.count_nonzero(free) < 0.025 * size:
            continue
        path, width = _followed(ink, lowest, thick, free)
        body = _erased_along(ink, path, width)
        if not body.any():
            continue
        foot = bounding_box(largest(body, round(0.03 * size)))
        body = _only(body, foot)  # what else the line touches, such as the margin of ruled paper, is no part of it
        long = np.count_nonzero(path >= 0) > 1.04 * (foot[1].stop - foot[1].start)
        below = foot[0].stop - 1 <= np.median(path[path >= 0]) + 0.06 * size
        if long and below and body.sum() > 0.3 * ink.sum() and _is_all(ink, body, path, width):
            return body, foot
    return ink, None


def _is_all(ink: Mask, body: Mask, path: NDArray[np.int64], width: float) -> bool:
    """Tell whether a body and the line along a path (W,) are nearly all of the ink: no blocks lie below the ground."""
    off = np.arange(len(ink))[:, None] - path
    along = ink & (path >= 0)
    stands = np.count_nonzero(body | (along & (np.abs(off) <= 2 * width)))
    below = np.count_nonzero(along & (off > 2 * width))
    whole = np.count_nonzero(ink)
    return bool(stands > _EXPLAINED * whole and below < _BELOW * whole)


def _only(mask: Mask, box: tuple[slice, slice]) -> Mask:
    """Keep what lies in a box."""
    kept = np.zeros_like(mask)
    kept[box] = mask[box]
    return kept


def _erased_along(ink: Mask, path: NDArray[np.int64], width: float) -> Mask:
    """Erase a line of some width along its row in each column (W,), and what is below it; what stands on it stays."""
    body = ink.copy()
    reach = max(2, round(0.75 * width))
    off = np.arange(len(ink))[:, None] - path
    band = ink & (np.abs(off) <= 2 * reach) & (path >= 0)
    high, low = band.argmax(axis=0), len(ink) - 1 - band[::-1].argmax(axis=0)
    thick = np.where(band.any(axis=0), np.minimum(low - high, 255), 0).astype(np.uint8)
    smooth = cv2.medianBlur(thick[None], 4 * reach + 1)[0]  # a pen leaves holes in both lines, and strays
    alone = (smooth <= 1.35 * width) & (path >= 0)
    body[alone & (np.abs(off) <= reach)] = False
    free = np.flatnonzero(alone)
    if free.size:
        middle = np.round(np.interp(np.arange(len(path)), free, path[free]))
        body[(path >= 0) & ~alone & (np.arange(len(ink))[:, None] >= middle)] = False
    return body


def _lowest_runs(ink: Mask, room: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return of each column the middle row and length of its lowest run of ink, and whether nothing is near above."""
    height = len(ink)
    filled = ink.any(axis=0)
    bottom = height - 1 - ink[::-1].argmax(axis=0)
    rows = np.arange(height)[:, None]
    blank_above = ~ink & (rows < bottom)
    top = np.where(blank_above, rows, -1).max(axis=0) + 1
    near = (ink & (rows < top) & (rows >= top - room)).any(axis=0)
    return np.where(filled, (top + bottom) // 2, -1), np.where(filled, bottom - top + 1, 0), filled & ~near


def _stretches(thin: NDArray[np.bool_], gap: int) -> list[NDArray[np.bool_]]:
    """Return the stretches (W,) of columns that are set, over gaps, the longest first."""
    joined = cv2.morphologyEx(thin.astype(np.uint8)[None], cv2.MORPH_CLOSE, np.ones((1, 2 * gap + 1), np.uint8))
    _, labels = cv2.connectedComponents(joined)
    parts = [(labels[0] == number) & thin for number in range(1, int(labels.max()) + 1)]
    return sorted(parts, key=np.count_nonzero, reverse=True)[:3]


def _followed(
    ink: Mask, lowest: NDArray[np.int64], thick: NDArray[np.int64], free: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], float]:
    """Follow a line from where it is free to both sides; return its row in each column (W,), -1 without, and width."""
    width = float(np.median(thick[free]))
    path = np.where(free, lowest, -1)
    places = np.flatnonzero(free)
    for start, step in ((int(places.min()), -1), (int(places.max()), 1)):
        row, missing, trail = float(lowest[start]), 0, [float(lowest[start])] * 15
        column = start + step
        while 0 <= column < ink.shape[1] and missing < 12:
            low = max(0, round(row - width - 2))
            window = np.flatnonzero(ink[low : round(row + width + 3), column]) + low
            if len(window) == 0:
                missing += 1
            else:
                missing = 0
                if len(window) <= 1.7 * width + 1:
                    trail = [*trail[1:], float(window.mean())]
                    row = 0.6 * row + 0.4 * float(np.mean(trail[-6:]))
                path[column] = round(row)
            column += step
    known = np.flatnonzero(path >= 0)
    between = np.arange(known[0], known[-1] + 1)
    path[between] = np.round(np.interp(between, known, path[known]))
    return path, width
