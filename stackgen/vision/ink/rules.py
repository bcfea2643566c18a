"""The lines of ruled and squared paper, which are no part of a drawing.

Legend: H x W pixels.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.masks import components
from stackgen.world import Mask

LONG = 0.55
"""A line of ruled paper goes over at least this share of the sheet's width, or height."""

FEWEST = 4
"""Paper is ruled when it has at least so many of such lines in one direction."""

FAINTEST = 0.15
"""The darkest place of a drawing is at least so dark."""

SLOPE = 10.0
"""Lines of paper are level or upright to within this [deg]."""

_FAINT = 0.25  # share of a line's length that is seen of it where it is faint,
_MANY = 8  # and how many of these there are, at least
_HAIR = 0.005  # greatest width of a line of paper, by the sheet's longer edge


def without_rules(ink: Mask, darkness: NDArray[np.float32]) -> tuple[Mask, bool]:
    """Remove the lines of ruled or squared paper from the ink (H, W) on it.

    Args:
        ink: What is darker than the paper.
        darkness: (H, W) how much darker, 0..1; where a pen crosses a line it is darker than the line.

    Returns:
        The rest, and whether the paper is ruled.
    """
    cleaned, ruled = ink, False
    for upright in (False, True):
        turned, depth = (cleaned.T, darkness.T) if upright else (cleaned, darkness)
        lines = _rules(np.ascontiguousarray(turned), 1 if upright and ruled else FEWEST)
        if lines:
            ruled = True
            cleaned = _erased(np.ascontiguousarray(turned), np.ascontiguousarray(depth), lines)
            cleaned = cleaned.T if upright else cleaned
    cleaned = np.ascontiguousarray(cleaned)
    return (strong(cleaned, darkness) if ruled else cleaned), ruled


def strong(ink: Mask, darkness: NDArray[np.float32]) -> Mask:
    """Keep the parts of the ink that are as dark somewhere as a third of the darkest: the rest is dirt and texture."""
    if not ink.any():
        return ink
    dark = float(np.quantile(darkness[ink], 0.97))
    labels, areas = components(ink)
    darkest = np.bincount(labels[darkness > max(FAINTEST, 0.35 * dark)], minlength=len(areas))
    kept = (darkest > 0) & (areas > 12)
    return np.asarray(kept[labels])


def _rules(ink: Mask, fewest: int) -> list[tuple[float, float]]:
    """Find the level lines that go from side to side: (row at the left edge, slope), none where they are fewer."""
    height, width = ink.shape
    hair = max(3, round(_HAIR * max(ink.shape)) * 2 + 1)
    column = np.ones((2 * hair + 1, 1), np.uint8)
    thick = cv2.morphologyEx(ink.astype(np.uint8), cv2.MORPH_OPEN, column)  # what is high is no line
    thin = cv2.subtract(ink.astype(np.uint8), thick)
    level = cv2.morphologyEx(thin, cv2.MORPH_OPEN, np.ones((1, max(7, width // 80)), np.uint8)) > 0
    level[1:] &= ~level[:-1]  # a line counts once in each column
    y, x = np.nonzero(level)
    found: list[tuple[float, float]] = []
    for slope in _slopes(y, x, width):
        rows = np.round(y - x * slope).astype(int) + width
        ends = [(x < 0.3 * width), (x >= 0.7 * width), np.full(len(x), True)]
        counts = [np.convolve(np.bincount(rows[e], minlength=height + 2 * width), np.ones(5), "same") for e in ends]
        share = np.minimum(np.minimum(counts[0], counts[1]) / 0.3, counts[2] * 0.5 / LONG) / width
        peaks = _peaks(share, 2 * hair, 0.5)
        if len(peaks) < FEWEST and len(faint := _peaks(share, 2 * hair, _FAINT)) >= _MANY:
            peaks = faint
        if len(peaks) >= FEWEST:
            peaks = np.append(peaks, _between(peaks, np.maximum(counts[0], counts[1]) / 0.3 / width, hair))
        found += [(float(peak - width), slope) for peak in peaks]
        taken = (np.abs(rows[:, None] - peaks) <= hair).any(axis=1)
        y, x = y[~taken], x[~taken]
    return found if len(found) >= fewest else []


def _peaks(share: NDArray[np.float64], apart: int, least: float) -> NDArray[np.int64]:
    """Return the rows at which a share (n,) is most, and over the least, no two of them nearer than `apart` [pixel]."""
    share, found = share.copy(), []
    while share.max(initial=0) > least:
        found.append(int(share.argmax()))
        share[max(0, found[-1] - apart) : found[-1] + apart + 1] = 0
    return np.array(found, np.int64)


def _between(peaks: NDArray[np.int64], share: NDArray[np.float64], near: int) -> list[int]:
    """Return the rows of further lines, which a drawing or a shadow hides in part: where the others' distance has them.

    Args:
        peaks: (k,) rows of the lines that are known.
        share: (n,) along which share of the side where it is seen best there is a line in each row.
        near: How far they may lie from where they should be [pixel].
    """
    rows = np.sort(peaks)
    steps = np.diff(rows)
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    first = rows[0] - step * np.arange(1, rows[0] // step)
    last = rows[-1] + step * np.arange(1, (len(share) - rows[-1]) // step)
    where = [first, last]
    for low, high in pairwise(rows):
        parts = max(1, round((high - low) / step))
        where.append(low + (high - low) / parts * np.arange(1, parts))
    found = []
    for row in np.round(np.concatenate(where)).astype(int):
        top = max(0, row - near)
        best = top + int(share[top : row + near + 1].argmax())
        if share[best] > 0.5:
            found.append(best)
    return found


def _slopes(y: NDArray[np.int64], x: NDArray[np.int64], width: int) -> list[float]:
    """Return slopes around that in which most of the pixels of level pieces of lines lie in line, best first."""
    if len(y) < 50:
        return []
    step = max(1, len(y) // 8000)
    y, x = y[::step], x[::step]

    def peaky(degrees: float) -> float:
        rows = np.round(y - x * np.tan(np.radians(degrees))).astype(int) + width
        return float((np.bincount(rows).astype(np.float64) ** 2).sum())

    rough = max(np.arange(-SLOPE, SLOPE + 0.01, 0.5), key=peaky)
    best = max((rough - 0.25, rough, rough + 0.25), key=peaky)
    near = sorted(np.arange(-1.5, 1.51, 0.25), key=abs)
    return [float(np.tan(np.radians(best + turn))) for turn in near]


def _erased(ink: Mask, darkness: NDArray[np.float32], lines: list[tuple[float, float]]) -> Mask:
    """Erase lines where the ink on them is no thicker and no darker than they are."""
    height, width = ink.shape
    reach = max(4, round(1.2 * _HAIR * max(ink.shape)))
    columns = np.arange(width)
    cleaned = ink.copy()
    for start, slope in lines:
        offsets = np.arange(-reach, reach + 1)
        rows = np.round(start + slope * columns).astype(int) + _bent(ink, start, slope, reach)
        band = np.clip(rows + offsets[:, None], 0, height - 1)
        here = ink[band, columns]
        depth = darkness[band, columns]
        counts = here.sum(axis=0)
        seen = counts > 0
        usual, dark = (np.quantile(of[seen], 0.3) if seen.any() else 0 for of in (counts, depth.max(axis=0)))
        line = (counts <= usual + 2) & (depth.max(axis=0) <= 1.6 * dark + 0.02)
        line = cv2.morphologyEx(line.astype(np.uint8)[None], cv2.MORPH_OPEN, np.ones((1, 5), np.uint8))[0] > 0
        cleaned[band[:, line], columns[line]] = False
    return cleaned


def _bent(ink: Mask, start: float, slope: float, reach: int) -> NDArray[np.int64]:
    """Return by how many rows (W,) a line lies beside a straight one: paper is bent, and lenses bend."""
    height, width = ink.shape
    columns = np.arange(width)
    offsets = np.arange(-2 * reach, 2 * reach + 1)
    band = np.clip(np.round(start + slope * columns).astype(int) + offsets[:, None], 0, height - 1)
    here = ink[band, columns].astype(np.float64)
    here[:, here.sum(axis=0) > 2 * reach] = 0  # something upright crosses
    smooth = cv2.blur(here, (max(31, width // 8) | 1, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(offsets[smooth.argmax(axis=0)], dtype=np.int64)
