"""The ink in the photo of a sheet: what is darker than the paper around it, in any light.

A shadow changes the light from place to place, but nowhere as narrowly as a stroke is wide: strokes are found against
the paper right beside them. What is filled in is wider; it is told from a shadow by its sharp border, and as it does
not run off the sheet.

Legend: h x w pixels of the photo, H x W of the sheet seen straight on.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.images import Picture
from stackgen.vision.ink.rules import strong, without_rules
from stackgen.vision.masks import components, extent, largest
from stackgen.vision.sheets import Sheet, least_channel
from stackgen.vision.straight import straightened
from stackgen.world import Mask

Floats = NDArray[np.float64]

WORK_SIZE = 1000
"""Longer edge of the sheet [pixel]."""

FAINTEST = 0.1
"""Ink takes away at least this share of the light."""

BESIDE = 0.045
"""Strokes are narrower than this, by the sheet's longer edge."""

_DARKER_THAN_SHADOW = 0.33  # share of the light of the paper beside it

_SLIT = 5  # what is lighter between the strokes of a hatch is narrower than this,

_STEP = 7  # a border is sharp where light changes within this [both pixels of the sheet at half its size]

_SHARP = 0.28  # by this logarithm

_INK_TELLS = 0.3  # what ink tells of what is beside it, by what paper does: inks have many colours

_ALIKE = 0.25  # share of its border from which on what is as light as paper beyond a stroke is paper, too

_LEAST_REGION = 40  # what is smaller is part of a border [pixel at half the size]

_COLOURED = 1.25  # largest by least channel of paper from which on it is coloured

_CUT = 12  # what is nearer to the photo's edge runs off it [pixel of the sheet]

_MARGIN = 0.012  # strip along the sheet's edge in which its own edge may show, by its longer edge


@dataclass(frozen=True)
class Page:
    """A sheet seen straight on.

    Args:
        ink: (H, W) what is drawn on it, without the lines of the paper.
        turn: (3, 3) homography from the photo to it.
        sheet: Where it lies in the photo, None where no sides of a sheet are seen.
        notes: What was removed, a sentence each.
        contrast: Share of the light that the ink takes away.
        beyond: (H, W) what of it is not in the photo.
    """

    ink: Mask
    turn: Floats
    sheet: Sheet | None
    notes: tuple[str, ...]
    contrast: float
    beyond: Mask


def read_page(photo: Picture, sheet: Sheet | None) -> Page:
    """Find the ink on a sheet (h, w, 3), or on the whole photo where there is none.

    Raises:
        StackgenError: If nothing is drawn.
    """
    if sheet is None or sheet.seen < 3:
        factor = WORK_SIZE / max(photo.shape[:2])
        how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
        straight = np.asarray(cv2.resize(photo, None, fx=factor, fy=factor, interpolation=how), np.uint8)
        turn = np.diag([factor, factor, 1.0])
    else:
        straight, turn = straightened(photo, sheet, WORK_SIZE)
    ink, darkness = find_ink(straight)
    seen = cv2.warpPerspective(np.ones(photo.shape[:2], np.uint8), turn, ink.shape[::-1])
    beyond = np.asarray(cv2.erode(seen, np.ones((2 * _CUT + 1,) * 2, np.uint8)) == 0)
    if sheet is not None:
        _clear_edge(ink, sheet.corners, turn)
    ink, ruled = without_rules(ink, darkness)
    ink = strong(ink & (seen > 0), darkness)
    if np.count_nonzero(ink) < 2e-4 * ink.size:
        raise StackgenError("nothing is drawn on the sheet; draw a structure with a dark pen, filled or in outline")
    notes = ("The lines of the paper were removed.",) if ruled else ()
    return Page(ink, turn, sheet, notes, float(np.median(darkness[ink])), beyond)


def is_drawn_on(photo: Picture, sheet: Sheet) -> bool:
    """Tell whether something is drawn on a sheet; what is light within a drawing of two tones is blank."""
    straight, turn = straightened(photo, sheet, WORK_SIZE // 3)
    ink, _ = find_ink(straight)
    _clear_edge(ink, sheet.corners, turn)
    return extent(largest(ink, 3)) > 0.1 * max(ink.shape)


def find_ink(sheet: Picture) -> tuple[Mask, NDArray[np.float32]]:
    """Find what is darker (H, W) than the paper of a sheet (H, W, 3), and by which share of the light.

    Of the channels the darkest counts, by the paper's own colour: a crayon of any colour takes the light of one.
    """
    tone = np.quantile(sheet[::8, ::8].reshape(-1, 3), 0.75, axis=0).clip(1)
    if tone.max() > _COLOURED * tone.min():
        sheet = np.clip(sheet * (tone.max() / tone).astype(np.float32), 0, 255).astype(np.uint8)
    light = cv2.GaussianBlur(least_channel(sheet), (0, 0), 0.8)
    size = max(2, round(BESIDE * max(light.shape))) | 1
    paper = cv2.morphologyEx(cv2.medianBlur(light, 5), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    darkness = 1 - (light.astype(np.float32) + 4) / (paper.astype(np.float32) + 4)
    grain = 1.48 * float(np.median(np.abs(darkness[::3, ::3] - np.median(darkness[::3, ::3]))))
    strokes = darkness > max(FAINTEST, 4 * grain)
    around = cv2.dilate(darkness, np.ones((11, 11), np.uint8))
    strokes &= darkness > 0.35 * around
    solid, depth = _solids(np.asarray(light))
    darkness = np.where(solid, np.maximum(darkness, depth), darkness)
    return strokes | solid, np.clip(darkness, 0, 1).astype(np.float32)


def _solids(light: NDArray[np.uint8]) -> tuple[Mask, NDArray[np.float32]]:
    """Find what is filled in or hatched (H, W): darker than the paper across a sharp border, and not running off it.

    Sharp borders divide the sheet into regions. Light that changes slowly divides nothing, so a shadow that falls over
    paper and ink makes no regions; one with a sharp border makes regions of paper that go on to the sheet's edge.

    Returns:
        The mask, and by which share of the light it is darker than the paper nearest to it.
    """
    half = cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    even = cv2.morphologyEx(cv2.medianBlur(half, 5), cv2.MORPH_OPEN, np.ones((_SLIT, _SLIT), np.uint8))
    levels = np.log(even.astype(np.float32) + 8)
    reach = np.ones((_STEP, _STEP), np.uint8)
    low = np.asarray(cv2.erode(levels, reach), np.float32)
    labels, areas = components(cv2.dilate(levels, reach) - low < _SHARP, connectivity=4)
    labels[(areas < _LEAST_REGION)[labels]] = 0
    if not labels.any():
        return np.zeros(light.shape, bool), np.zeros(light.shape, np.float32)
    nearest = _nearest(labels > 0)
    regions, here = labels.ravel()[nearest], levels.ravel()[nearest]
    steps, lengths, alike = _borders(regions, here, low, len(areas))
    ends = np.concatenate([end.ravel() for end in (regions[:2], regions[-2:], regions[:, :2], regions[:, -2:])])
    runs_off = np.bincount(ends, minlength=len(areas)) > 0.2 * np.sqrt(areas)
    lighter, around = (steps * lengths).sum(axis=1), np.maximum(lengths.sum(axis=1), 1)
    paper = runs_off & (lighter >= np.log(_DARKER_THAN_SHADOW) * around)
    paper[(areas * (lighter > -_SHARP * around)).argmax()] = True  # the largest may be the structure
    for _ in range(3):  # from what goes on to the edge, over the strokes of an outline, to what that stands around
        paper |= alike @ paper > _ALIKE
    ink = _darker(steps, lengths, paper)[regions]
    depth = np.where(ink, 1 - np.exp(here - here.ravel()[_nearest(~ink)]), 0)
    found = cv2.resize(np.stack([ink, depth], 2).astype(np.float32), light.shape[::-1])
    return np.asarray(found[..., 0] > 0.5), np.asarray(found[..., 1])


def _nearest(mask: Mask) -> NDArray[np.int64]:
    """Return the number of the pixel nearest to each one (H, W) of those that are set."""
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, np.int64)
    of_label[labels[mask]] = np.flatnonzero(mask)
    return np.asarray(of_label[labels])


def _borders(
    regions: NDArray[np.int32], levels: NDArray[np.float32], low: NDArray[np.float32], count: int
) -> tuple[Floats, Floats, Floats]:
    """Compare regions that touch; those with a stroke between them do not.

    Args:
        regions: (H, W) number of the region at each pixel.
        levels: (H, W) logarithm of the light in it beside its border.
        low: (H, W) least logarithm of the light around each pixel.
        count: Number of regions R.

    Returns:
        (R, R) by how much one is lighter than another across their border; (R, R) how long that is [pixel], 0 to one
        that has strokes around it nearly everywhere, as a face of an outline has; and (R, R) the share of its border
        where one is as light as another beyond a stroke, as paper in one shadow is.
    """
    steps, lengths, alike, around = *np.zeros((3, count * count)), np.zeros(count)
    for one, two in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        for here, there in ((one, two), (two, one)):
            stroke = low[here] < np.minimum(levels[here], levels[there]) - _SHARP / 2
            differs = regions[here] != regions[there]
            around += np.bincount(regions[here][differs], minlength=count)
            pairs = regions[here][differs].astype(np.int64) * count + regions[there][differs]
            step, beyond = (levels[here] - levels[there])[differs], stroke[differs]
            steps += np.bincount(pairs[~beyond], step[~beyond], count * count)
            lengths += np.bincount(pairs[~beyond], minlength=count * count)
            alike += np.bincount(pairs[beyond & (np.abs(step) < _SHARP / 2)], minlength=count * count)
    told = lengths.reshape(count, count)
    enough = told.sum(axis=1) >= around / 3
    share = alike.reshape(count, count) / np.maximum(around, 1)[:, None]
    return (steps / np.maximum(lengths, 1)).reshape(count, count), told * enough[:, None], share


def _darker(steps: Floats, lengths: Floats, paper: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which regions (R,) are ink: darker than the paper they touch, and no lighter than the ink.

    Args:
        steps: (R, R) by how much one is lighter than another.
        lengths: (R, R) length of their border [pixel].
        paper: (R,) which are paper for sure.
    """
    known, ink = paper.copy(), np.zeros(len(paper), bool)
    while (touching := np.where(known, 0, lengths @ known)).any():
        one = int(touching.argmax())
        told = np.where(known, lengths[one], 0) * np.where(ink, _INK_TELLS, 1)
        darker = steps[one] < np.where(ink, _SHARP / 2, -_SHARP / 2)
        ink[one], known[one] = told[darker].sum() > told.sum() / 2, True
    return ink


def _clear_edge(ink: Mask, corners: Floats, turn: Floats) -> None:
    """Remove ink beyond the sheet and along its edge, where the table or the paper's thickness shows."""
    margin = max(2, round(_MARGIN * max(ink.shape)))
    inside = np.zeros(ink.shape, np.uint8)
    there = cv2.perspectiveTransform(corners[None].astype(np.float64), turn)[0]
    cv2.fillPoly(inside, [np.round(there).astype(np.int32)], 1)
    cv2.polylines(inside, [np.round(there).astype(np.int32)], True, 0, 2 * margin + 1)
    ink &= inside > 0
