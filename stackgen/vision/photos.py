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
from stackgen.vision.lines import strong, without_rules
from stackgen.vision.masks import components
from stackgen.vision.sheets import Sheet, least_channel, straightened
from stackgen.world import Mask

Floats = NDArray[np.float64]

WORK_SIZE = 1000
"""Longer edge of the sheet [pixel]."""

FAINTEST = 0.1
"""Ink takes away at least this share of the light."""

BESIDE = 0.045
"""Strokes are narrower than this, by the sheet's longer edge."""

_DARKER_THAN_SHADOW = 0.33  # share of the light of the paper

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
    """

    ink: Mask
    turn: Floats
    sheet: Sheet | None
    notes: tuple[str, ...]
    contrast: float


def read_page(photo: Picture, sheet: Sheet | None) -> Page:
    """Find the ink on a sheet (h, w, 3), or on the whole photo where there is none.

    Raises:
        StackgenError: If nothing is drawn.
    """
    if sheet is None:
        factor = WORK_SIZE / max(photo.shape[:2])
        how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
        straight = np.asarray(cv2.resize(photo, None, fx=factor, fy=factor, interpolation=how), np.uint8)
        turn = np.diag([factor, factor, 1.0])
    else:
        straight, turn = straightened(photo, sheet.corners, WORK_SIZE)
    ink, darkness = find_ink(straight)
    if sheet is not None:
        _clear_edge(ink)
    ink, ruled = without_rules(ink, darkness)
    ink = strong(ink, darkness)
    if np.count_nonzero(ink) < 2e-4 * ink.size:
        raise StackgenError("nothing is drawn on the sheet; draw a structure with a dark pen, filled or in outline")
    notes = ("The lines of the paper were removed.",) if ruled else ()
    return Page(ink, turn, sheet, notes, float(np.median(darkness[ink])))


def find_ink(sheet: Picture) -> tuple[Mask, NDArray[np.float32]]:
    """Find what is darker (H, W) than the paper of a sheet (H, W, 3), and by which share of the light.

    Of the channels the darkest counts: a crayon of any colour takes the light of one.
    """
    light = cv2.GaussianBlur(least_channel(sheet), (0, 0), 0.8)
    size = max(2, round(BESIDE * max(light.shape))) | 1
    paper = cv2.morphologyEx(cv2.medianBlur(light, 5), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    darkness = 1 - (light.astype(np.float32) + 4) / (paper.astype(np.float32) + 4)
    grain = 1.48 * float(np.median(np.abs(darkness[::3, ::3] - np.median(darkness[::3, ::3]))))
    strokes = darkness > max(FAINTEST, 4 * grain)
    around = cv2.dilate(darkness, np.ones((11, 11), np.uint8))
    strokes &= darkness > 0.35 * around
    solid, depth = _solids(np.asarray(paper))
    darkness = np.where(solid, np.maximum(darkness, depth), darkness)
    return strokes | solid, np.clip(darkness, 0, 1).astype(np.float32)


def _solids(paper: NDArray[np.uint8]) -> tuple[Mask, NDArray[np.float32]]:
    """Find what is filled in (H, W): large, dark, with a sharp border, and not running off the sheet."""
    flat = paper[::2, ::2]
    base = float(np.quantile(flat[::2, ::2], 0.9))
    found = np.zeros(flat.shape, dtype=bool)
    low = cv2.erode(flat, np.ones((7, 7), np.uint8)).astype(np.float32)
    high = cv2.dilate(flat, np.ones((7, 7), np.uint8)).astype(np.float32)
    step = low < 0.75 * high
    for share in np.arange(0.8, 0.15, -0.08):
        labels, areas = components(flat < share * base, connectivity=4)
        ends = (labels[:2], labels[-2:], labels[:, :2], labels[:, -2:])
        at_edge = np.bincount(np.concatenate([end.ravel() for end in ends]), minlength=len(areas))
        for number in np.flatnonzero((areas > 0.002 * flat.size) & (areas < 0.7 * flat.size)):
            part = labels == number
            inside = at_edge[number] <= 0.1 * np.sqrt(areas[number]) or share < _DARKER_THAN_SHADOW
            if inside and not found[part].all():
                border = part & (cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
                if step[border].mean() > 0.85:
                    found |= part
    full = cv2.resize(found.astype(np.uint8), paper.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    full &= paper < 0.85 * base
    return np.asarray(full), np.where(full, 1 - paper / base, 0).astype(np.float32)


def _clear_edge(ink: Mask) -> None:
    """Remove ink that lies along the sheet's edge, where the table or the paper's thickness shows."""
    margin = max(2, round(_MARGIN * max(ink.shape)))
    ink[:margin] = ink[-margin:] = False
    ink[:, :margin] = ink[:, -margin:] = False
