"""Ink becomes what it stands for: outlines are filled, openings stay open, lines that enclose nothing go.

The blank parts between strokes are faces. A face is part of the structure unless it is a window of something solid, a
face within another face, or a doorway: surrounded by another face but at its bottom. Half of the width of a stroke
lies outside of what it outlines, and is left out.

Legend: H x W pixels, F faces; face 0 is what lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.ink.gaps import bridged, hatched, with_base, without_whiskers
from stackgen.vision.masks import bounding_box, components, extent, opened
from stackgen.world import Mask

Ints = NDArray[np.int64]

GAPS = (0.0, 0.008, 0.016, 0.03, 0.05)
"""Half the widths of gaps in outlines that are tried to be closed, by the size of the drawing."""

STROKE = 0.13
"""A stroke is at most so wide, by the size of the drawing; what is wider is solid."""

LEAST_FACE = 0.012
"""Faces under this share of the drawing's box are flecks, and filled."""

THIN_FACE = 0.035
"""Faces narrower than this, by the size of the drawing, are what a pen left between two strokes, and filled."""

_SOLID = 1.3
"""Ink that holds a disc of so many widths of the stroke as its radius is filled in: two strokes side by side do not."""

LOOSE = 0.3
"""Share of the strokes that may enclose nothing before an outline counts as open."""

_MOST = 0.6  # share of what is enclosed at most that is enough

_NONE = 0.015  # share of them that is none: the sides of one block of many, between two others, are more,

_NEARLY = 0.94  # as is that block's share of what is enclosed


@dataclass(frozen=True, eq=False)
class Filled:
    """What the ink of one drawing stands for.

    Args:
        mask: (H, W) the structure.
        stroke: Width of the strokes of its outlines [pixel]; 0 where it is solid.
        notes: What was mended or left open, a sentence each.
        sureness: How sure that is, 0..1.
    """

    mask: Mask
    stroke: float
    notes: tuple[str, ...]
    sureness: float


@dataclass(frozen=True)
class _Faces:
    """Faces between strokes.

    Args:
        ink: (H, W) with its gaps closed.
        labels: (H, W) number of the face at each blank pixel, of the nearest one at each pixel of ink.
        areas: (F,) [pixel]; that of face 0 is 0.
        touching: (F, F) length of the border between faces across the ink [pixel].
        windows: (F,) whether a face is a hole of something solid.
    """

    ink: Mask
    labels: Ints
    areas: Ints
    touching: Ints
    windows: NDArray[np.bool_]


def fill(ink: Mask) -> Filled:
    """Fill what the ink (H, W) of a drawing outlines.

    Raises:
        StackgenError: If an outline is open.
    """
    rows, columns = bounding_box(ink)
    size = extent(ink)
    margin = round(0.12 * size) + 2
    work = np.pad(ink[rows, columns], margin)
    found = _mended(work, size)
    whole = np.zeros_like(ink)
    whole[rows, columns] = found.mask[margin:-margin, margin:-margin]
    return Filled(whole, found.stroke, found.notes, found.sureness)


def _mended(ink: Mask, size: int) -> Filled:
    """Fill ink, closing the least gaps that enclose most; draw a base line where it alone is missing."""
    ink = hatched(ink, size)
    best = _least_gap(ink, size)
    if best.loose <= LOOSE:
        return _told(best, "", 1.0)
    based = with_base(ink, size, max(best.stroke, 2.0))
    if based is not None:
        again = _least_gap(based, size)
        if again.loose <= LOOSE:
            return _told(again, "The drawing has no base line, and one was drawn.", 0.8)
    raise StackgenError("the outline of the drawing is open; close its gaps, or fill it in")


@dataclass(frozen=True)
class _Trial:
    """Ink filled with gaps of some width closed; `enclosed` is the area [pixel] that its outlines enclose."""

    mask: Mask
    stroke: float
    loose: float
    gap: float
    enclosed: int
    doorways: int


def _told(trial: _Trial, note: str, sureness: float) -> Filled:
    notes = [note] if note else []
    if trial.gap > 0.02:
        notes.append("The outline has a gap, which was closed.")
    if trial.doorways:
        notes.append("What is outlined within the drawing was left open, as a window or doorway.")
    sure = sureness * (0.85 if trial.gap > 0.02 else 1.0) * (1 - trial.loose)
    return Filled(trial.mask, trial.stroke, tuple(notes), sure)


def _least_gap(ink: Mask, size: int) -> _Trial:
    """Close the smallest gaps by which nearly all is enclosed that is where the fewest strokes enclose nothing."""
    trials: list[_Trial] = []
    for gap in GAPS:
        trials.append(_trial(ink, size, gap))
        if trials[0].loose < _NONE:
            return trials[0]
        if trials[-1].loose < _NONE and trials[-1].enclosed >= _MOST * _hull_area(ink):
            break  # wider ones enclose hardly more
    enough = [trial for trial in trials if trial.enclosed >= _MOST * max(trial.enclosed for trial in trials)]
    least = min(trial.loose for trial in enough)
    best = next(trial for trial in enough if trial.loose <= least + _NONE)
    alike = [trial for trial in enough if trial.enclosed >= _NEARLY * best.enclosed and trial.loose <= least + 0.1]
    return alike[0]


def _hull_area(ink: Mask) -> float:
    """Return the area of the convex hull of ink (H, W) [pixel], more than which nothing can enclose."""
    hull = cv2.convexHull(cv2.findNonZero(ink.astype(np.uint8)))
    return cv2.contourArea(hull)


def _trial(ink: Mask, size: int, gap: float) -> _Trial:
    drawn = bridged(ink, gap * size) if gap else ink
    faces = _faces(drawn, size)
    box = faces.ink[bounding_box(faces.ink)].size
    doors, opening = _open_faces(faces, size)
    inside = np.ones(len(faces.areas), dtype=bool)
    inside[0] = False
    inside &= ~(faces.windows | opening)
    large = inside & (faces.areas > LEAST_FACE * box)
    # Flecks between hatches are filled, but say nothing of outlines.
    stroke = _stroke(faces, large)
    whole = inside[faces.labels] if stroke else without_whiskers(faces.ink | inside[faces.labels], size)
    if stroke:
        whole |= opened(drawn, _SOLID * stroke)
    enclosed = int(faces.areas[large].sum())
    return _Trial(whole, stroke, loose(faces.ink, whole, stroke), gap, enclosed, doors)


def loose(ink: Mask, whole: Mask, stroke: float) -> float:
    """Return the share of the strokes that bound nothing of the whole."""
    if not stroke:
        return 0.0 if opened(ink, 0.5 * STROKE * extent(ink)).sum() > 0.3 * ink.sum() else 1.0
    far = cv2.distanceTransform((~whole).astype(np.uint8), cv2.DIST_L2, 3)
    return float(np.count_nonzero(ink & (far > stroke)) / np.count_nonzero(ink))


def _stroke(faces: _Faces, outlined: NDArray[np.bool_]) -> float:
    """Return the width of the strokes around outlined faces [pixel], 0 where there are none."""
    if not outlined.any():
        return 0.0
    depth = cv2.distanceTransform(faces.ink.astype(np.uint8), cv2.DIST_L2, 5)
    ridge = (depth >= cv2.dilate(depth, np.ones((3, 3), np.uint8)) - 1e-3) & faces.ink
    near = cv2.dilate((outlined[faces.labels] & ~faces.ink).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    reach = cv2.dilate((near & faces.ink).astype(np.uint8), np.ones((3, 3), np.uint8), iterations=2) > 0
    values = depth[ridge & (reach | outlined[faces.labels])]
    return float(max(1.0, 2 * np.median(values))) if values.size else 1.0


def _faces(ink: Mask, size: int) -> _Faces:
    """Find the faces between strokes; those that are thin count as ink."""
    blank = (~ink).astype(np.uint8)
    labels, areas = components(~ink, connectivity=4)
    outside = labels[0, 0]
    width = cv2.distanceTransform(blank, cv2.DIST_L2, 3)
    kept = np.bincount(labels[2 * width > THIN_FACE * size], minlength=len(areas)) > 0
    kept[[0, outside]] = False, True
    ink = ~kept[labels]
    number = np.cumsum(kept)  # outside gets 0, the others follow
    number = np.where(kept, number, 0)
    number = np.where(number > number[outside], number - 1, number)
    number[outside] = 0
    face = np.where(ink, -1, number[labels]).astype(np.int64)
    count = int(kept.sum())
    _, nearest = cv2.distanceTransformWithLabels(ink.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_pixel = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
    of_pixel[nearest[~ink]] = face[~ink]
    full = of_pixel[nearest]
    sizes = np.bincount(face[~ink], minlength=count)
    sizes[0] = 0
    touching = np.zeros((count, count), dtype=np.int64)
    for one, two in ((full[1:], full[:-1]), (full[:, 1:], full[:, :-1])):
        differs = one != two
        pairs = np.bincount(one[differs] * count + two[differs], minlength=count * count)
        touching += pairs.reshape(count, count)
    return _Faces(ink, full, sizes, touching + touching.T, _solid_windows(ink, face, count, size))


def _solid_windows(ink: Mask, face: Ints, count: int, size: int) -> NDArray[np.bool_]:
    """Tell which faces (F,) are holes of something solid: most of their border is no stroke."""
    solid = opened(ink, STROKE * size / 2)
    near = cv2.dilate(solid.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    total, massive = np.zeros(count), np.zeros(count)
    for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        beside = np.roll(face, shift, axis)
        border = (face < 0) & (beside > 0)
        total += np.bincount(beside[border], minlength=count)
        massive += np.bincount(beside[border & near], minlength=count)
    return np.asarray(massive > 0.5 * np.maximum(total, 1))


def _open_faces(faces: _Faces, size: int) -> tuple[int, NDArray[np.bool_]]:
    """Find the faces (F,) that lie within another one: windows, and doorways that it surrounds but at their bottom."""
    count = len(faces.areas)
    found = np.zeros(count, dtype=bool)
    box = size * size
    for around in range(1, count):
        if faces.windows[around] or found[around]:
            continue
        reached = _reachable(faces.touching, around)
        within = ~reached
        within[[0, around]] = False
        if within.any() and faces.areas[around] > 0.3 * faces.areas[within].sum():
            found |= within
        for one in range(1, count):
            if one != around and not found[one] and faces.areas[one] > LEAST_FACE * box / 2:
                found[one] |= _is_doorway(faces, one, around)
    return int(np.count_nonzero(found)), found


def _reachable(touching: Ints, without: int) -> NDArray[np.bool_]:
    """Tell which faces (F,) are connected with the outside when one face is taken away."""
    joined = touching > 0
    joined[without] = joined[:, without] = False
    reached = np.zeros(len(joined), dtype=bool)
    reached[0] = True
    while True:
        more = reached | joined[reached].any(axis=0)
        if (more == reached).all():
            return reached
        reached = more


def _is_doorway(faces: _Faces, one: int, around: int) -> bool:
    """Tell whether a face is surrounded by another one, but at its bottom by the outside."""
    total = faces.touching[one].sum()
    by, out = faces.touching[one, around], faces.touching[one, 0]
    if by < 0.55 * total or by + out < 0.9 * total or out < 0.05 * total:
        return False
    if faces.areas[around] < 0.5 * faces.areas[one]:
        return False
    rows, columns = np.nonzero(faces.labels == one)
    top, bottom = int(rows.min()), int(rows.max())
    below = faces.labels[min(bottom + 1, len(faces.labels) - 1), columns[rows == bottom]]
    middle = columns[(rows > top + 0.3 * (bottom - top))]
    sides = faces.labels[(top + bottom) // 2, [max(int(middle.min()) - 1, 0), int(middle.max()) + 1]]
    return bool((below == 0).mean() > 0.5 and (sides == around).all())
