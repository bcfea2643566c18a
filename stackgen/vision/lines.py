"""Lines that are no part of a drawing, and lines that it lacks.

The former are those of ruled and squared paper, and the ground that a structure stands on; the latter close gaps,
hatches and what has no base line.

Legend: H x W pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.masks import bounding_box, closed, components, extent, largest, opened
from stackgen.world import Mask

Floats = NDArray[np.float64]

LONG = 0.55
"""A line of ruled paper goes over at least this share of the sheet's width, or height."""

FEWEST = 4
"""Paper is ruled when it has at least so many of such lines in one direction."""

FAINTEST = 0.15
"""The darkest place of a drawing is at least so dark."""

SLOPE = 6.0
"""Lines of paper are level or upright to within this [deg]."""

HATCH = 0.02
"""Half of what lies between the strokes of a hatch, at most, by the size of the drawing."""

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
        taken = np.zeros(len(x), dtype=bool)
        while share.max(initial=0) > 0.5:
            peak = int(share.argmax())
            found.append((float(peak - width), slope))
            share[max(0, peak - 2 * hair) : peak + 2 * hair + 1] = 0
            taken |= np.abs(rows - peak) <= hair
        y, x = y[~taken], x[~taken]
    return found if len(found) >= fewest else []


def _slopes(y: NDArray[np.int64], x: NDArray[np.int64], width: int) -> list[float]:
    """Return slopes around that in which most of the pixels of level pieces of lines lie in line, best first."""
    if len(y) < 50:
        return []
    step = max(1, len(y) // 8000)
    y, x = y[::step], x[::step]

    def peaky(degrees: float) -> float:
        rows = np.round(y - x * np.tan(np.radians(degrees))).astype(int) + width
        return float((np.bincount(rows).astype(np.float64) ** 2).sum())

    best = max(np.arange(-SLOPE, SLOPE + 0.01, 0.25), key=peaky)
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


def without_ground(ink: Mask) -> list[Mask]:
    """Remove a ground line: thin, nearly level, under the drawing, and longer than it.

    Returns:
        Nothing where there is none; else the ink (H, W) without it, and without only what is beside the drawing, as
        what stands on the line may have no line of its own there.
    """
    body, foot = _off_ground(ink)
    if foot is None:
        return []
    body, again = _off_ground(body)  # beyond a drawing that is filled in the line is found anew
    foot = again or foot
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
        if long and below and body.sum() > 0.3 * ink.sum():
            return body, foot
    return ink, None


def _only(mask: Mask, box: tuple[slice, slice]) -> Mask:
    """Keep what lies in a box."""
    kept = np.zeros_like(mask)
    kept[box] = mask[box]
    return kept


def _erased_along(ink: Mask, path: NDArray[np.int64], width: float) -> Mask:
    """Erase a line of some width along its row in each column (W,), and what is below it; what stands on it stays."""
    body = ink.copy()
    reach = max(2, round(0.75 * width))
    alone = np.zeros(len(path), dtype=bool)
    for column in np.flatnonzero(path >= 0):
        top, bottom = max(0, path[column] - reach), min(len(ink), path[column] + reach + 1)
        run = np.flatnonzero(ink[max(0, top - reach) : bottom + reach, column])
        alone[column] = np.ptp(run) <= 1.35 * width if run.size else True
        if alone[column]:
            body[top:bottom, column] = False
    free = np.flatnonzero(alone)
    for column in np.flatnonzero((path >= 0) & ~alone) if free.size else ():
        body[round(float(np.interp(column, free, path[free]))) :, column] = False
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


def without_whiskers(mask: Mask, size: int) -> Mask:
    """Remove what is thin as a hair from something solid: lines of the paper that touch it."""
    core = opened(mask, 0.01 * size)
    near = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 3) <= 0.01 * size
    return np.asarray(near & mask) if core.any() else mask


def hatched(ink: Mask, size: int) -> Mask:
    """Close hatches: strokes so dense that what they cover is solid; other ink stays as it is."""
    dense = closed(ink, HATCH * size)
    solid = opened(dense, 0.05 * size)
    hatched = np.count_nonzero(solid) > 0.5 * np.count_nonzero(dense) and np.count_nonzero(
        ink
    ) > 0.4 * np.count_nonzero(dense)
    return dense if hatched else ink


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
