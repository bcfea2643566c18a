"""Which of all that is drawn is the structure: a name, a sun, a ground line are not, and two drawings are asked for.

Legend: H x W pixels.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from stackgen.errors import StackgenError
from stackgen.vision.ink.ground import without_ground
from stackgen.vision.ink.outlines import Filled, fill, loose
from stackgen.vision.masks import bounding_box, extent, is_round, largest, near_parts, rim, without_specks
from stackgen.world import Mask

FINE = 420
"""Ink is filled at a scale at which the largest part is no larger than this [pixel]."""

RIVAL = 0.2
"""A part of the picture is a drawing of its own from this share of the largest one's area on."""

TOGETHER = 0.07
"""What is nearer than this, by the size of the largest part, is one drawing."""

_DIRT = 0.004  # parts under this share of the largest one are dirt,
_MOST_DIRT = 0.08  # where all of it is no more than this share of the ink
_SURE = 0.82  # a drawing without any of its ground line counts from this share of the sureness with it on,
_ALIKE = 0.02  # and where no more of its strokes enclose nothing than with it, but for this share
_EDGE = 0.02  # what is nearer to the sheet's edge runs off it, by its longer edge
_APART = 0.03  # what is further from its largest part is beside it, half of that where it is solid, by its size
_SMALL = 0.15  # or smaller than this share of it,
_LEVEL = 0.06  # feet of one structure are level to within this, by its size
_FOOT = 0.08  # what is this much above its lowest point stands on the ground, by its size


def choose(
    ink: Mask, which: int | None = None, spread: bool = False, framed: bool = True, beyond: Mask | None = None
) -> Filled:
    """Find the drawing among all that the ink (H, W) shows, and fill it.

    A name, a sun, a ground line are left out.

    Args:
        ink: All that is drawn.
        which: Number of the drawing, from the left; None where there is one.
        spread: Whether what stands apart on the same ground is one structure, which may be cropped to its edges.
        framed: Whether what runs off is left out, where something else is drawn.
        beyond: (H, W) what of the sheet is not in the photo, into which drawings run off, too.

    Raises:
        StackgenError: If there are several drawings and none is asked for, fewer than asked for, or an outline is open.
    """
    clean = without_specks(ink, _DIRT)
    if np.count_nonzero(clean) > (1 - _MOST_DIRT) * np.count_nonzero(ink):  # else the drawing is made of specks
        ink = clean
    edge = rim(ink.shape, round(_EDGE * max(ink.shape)))
    if beyond is not None:
        edge |= beyond
    scale = FINE / max(extent(largest(ink, 0)), 1)
    if scale >= 1:
        return _chosen(ink, edge, which, spread, framed)
    size = (round(ink.shape[1] * scale), round(ink.shape[0] * scale))
    small = [cv2.resize(of.astype(np.float32), size, interpolation=cv2.INTER_AREA) for of in (ink, edge)]
    found = _chosen(small[0] > 0.3, small[1] > 0.5, which, spread, framed)
    mask = cv2.resize(found.mask.astype(np.float32), ink.shape[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5
    return replace(found, mask=np.asarray(mask), stroke=found.stroke / scale)


def _chosen(ink: Mask, edge: Mask, which: int | None, spread: bool, framed: bool) -> Filled:
    """Find the drawing in ink (H, W), as `choose` does, where what lies in `edge` (H, W) runs off."""
    groups = near_parts(ink, TOGETHER)
    found = [_one(group) for group in groups]
    seen, cut = list(zip(groups, found, strict=True)), []
    if framed:
        inner = [pair for pair in seen if not _at_edge(*pair, edge)]
        if not spread or _most(inner) > RIVAL * _most(seen):
            seen, cut = inner, [group for group, part in seen if _at_edge(group, part, edge)]
    drawings = _that_can_be_read(seen, cut=bool(cut))
    if not spread:
        drawings = [replace(one, mask=_without_name(one)) for one in drawings]
    most = max(np.count_nonzero(part.mask) for part in drawings)
    rivals = [part for part in drawings if np.count_nonzero(part.mask) >= RIVAL * most]
    rivals.sort(key=lambda part: bounding_box(part.mask)[1].start)
    if which is not None:
        if not 1 <= which <= len(rivals):
            raise StackgenError(f"which must lie in 1..{len(rivals)}, the number of drawings there are, got {which}")
        return rivals[which - 1]
    main = max(drawings, key=lambda part: np.count_nonzero(part.mask))
    beside = [part for part in drawings if part is not main and spread and _is_level(part.mask, main.mask)]
    rivals = [part for part in rivals if not (part is main or part in beside or is_round(part.mask))]
    if rivals:
        raise StackgenError(
            f"{len(rivals) + 1} drawings are in it; cover or crop all but one, or say which one counts, from the left"
            " (--which 1)"
        )
    left_out = len(found) - 1 - len(beside)
    notes = main.notes + (("What is drawn beside the structure was left out.",) if left_out else ())
    if any(_width(group) > _width(main.mask) for group in cut):
        notes = (*notes, "Something larger runs off, so which drawing counts is uncertain.")
    mask = np.any([part.mask for part in (main, *beside)], axis=0)
    return Filled(mask, main.stroke, notes, main.sureness * (0.95 if left_out else 1.0))


def _without_name(drawing: Filled) -> Mask:
    """Leave out what is small and not right beside the largest part (H, W): a name is drawn near the structure, too."""
    apart = round((_APART if drawing.stroke else _APART / 2) * extent(drawing.mask))
    kept = largest(drawing.mask, apart)
    rest = drawing.mask & ~kept
    while np.count_nonzero(rest) > _SMALL * np.count_nonzero(kept):
        one = largest(rest, apart)
        if np.count_nonzero(one) <= _SMALL * np.count_nonzero(kept):
            break
        kept, rest = kept | one, rest & ~one
    return kept


def _that_can_be_read(seen: list[tuple[Mask, Filled | StackgenError]], cut: bool) -> list[Filled]:
    """Return the drawings among groups of ink (H, W), where no larger one is open, or was cut off by the edge."""
    drawings = [part for _, part in seen if isinstance(part, Filled)]
    refused = {_width(group): part for group, part in seen if isinstance(part, StackgenError)}
    if cut and (not seen or (not refused and all(is_round(part.mask) for part in drawings))):
        raise StackgenError("the drawing runs off the sheet; leave some blank paper around it")
    if refused and (not drawings or max(refused) > max(_width(part.mask) for part in drawings)):
        raise refused[max(refused)]  # never a name beside an outline that is open
    return drawings


def _most(pairs: list[tuple[Mask, Filled | StackgenError]]) -> int:
    """Return the area of the largest drawing [pixel]."""
    return max((int(np.count_nonzero(part.mask)) for _, part in pairs if isinstance(part, Filled)), default=0)


def _at_edge(group: Mask, part: Filled | StackgenError, edge: Mask) -> bool:
    """Tell whether what was found in a group of ink (H, W) runs off the sheet, as drawings may and the table does."""
    mask = part.mask if isinstance(part, Filled) else group
    return bool(np.count_nonzero(mask & edge) > 2 * _EDGE * max(mask.shape))


def _width(mask: Mask) -> int:
    """Return the lesser edge of a mask's box, which is small for a line [pixel]."""
    return min(mask[bounding_box(mask)].shape)


def _one(group: Mask) -> Filled | StackgenError:
    """Fill one group of ink, without the ground line under it; the error if its outline is open."""
    inks = without_ground(group)
    bodies = [filled for filled in map(_filled, inks) if filled is not None]
    if bodies:
        surest = max(filled.sureness for filled in bodies)
        sure = [filled for filled in bodies if filled.sureness > _SURE * surest]
        left = [loose(inks[0], filled.mask, filled.stroke) for filled in sure]
        chosen = next(filled for filled, of in zip(sure, left, strict=True) if of <= min(left) + _ALIKE)
        notes = (*chosen.notes, "The ground line was left out.")
        if chosen is not bodies[0] and _is_between(inks[-1], chosen.mask):
            notes = (*notes, "Whether there is a gap between two blocks on the ground line is uncertain.")
        return replace(chosen, mask=_footed(chosen, group), notes=notes)
    try:
        return fill(group)
    except StackgenError as error:
        return error


def _footed(filled: Filled, ink: Mask) -> Mask:
    """Let what was filled (H, W) reach down to half a stroke below the upper edge of the line that it stands on."""
    if not filled.stroke:
        return filled.mask
    mask, half = filled.mask.copy(), round(filled.stroke / 2)
    rows = np.arange(len(mask))[:, None]
    bottom = np.where(mask.any(axis=0), len(mask) - 1 - mask[::-1].argmax(axis=0), -1)
    line = ink & (np.abs(rows - bottom) <= 2 * half)
    foot = np.flatnonzero((bottom > bottom.max() - _FOOT * extent(mask)) & line.any(axis=0))
    if foot.size:
        edge = line[:, foot].argmax(axis=0)
        lowest = max(0, int(edge.max()) - 255)
        edge = lowest + cv2.medianBlur(np.maximum(edge - lowest, 0).astype(np.uint8)[None], 8 * half + 1)[0].astype(int)
        mask[:, foot] &= rows < edge + half  # upright strokes do not end on it
        mask[:, foot] |= (rows > bottom[foot]) & (rows < edge + half)
    return mask


def _is_between(ink: Mask, mask: Mask) -> bool:
    """Tell whether there is a face between two others at the foot of what was filled (H, W), by its strokes."""
    foot = (ink & mask)[bounding_box(mask)[0].stop - 1 - round(_FOOT * extent(mask))]
    return bool(np.count_nonzero(np.diff(foot.astype(np.int8), prepend=0) > 0) > 3)


def _filled(ink: Mask) -> Filled | None:
    try:
        return fill(ink)
    except StackgenError:
        return None


def _is_level(part: Mask, main: Mask) -> bool:
    """Tell whether two parts (H, W) stand on one ground."""
    return abs(bounding_box(part)[0].stop - bounding_box(main)[0].stop) <= _LEVEL * extent(main)
