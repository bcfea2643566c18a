"""The ink of a drawing on an even ground: what differs from the background, whatever its colours.

The background is what lies along the picture's edge, less a border that was drawn there. Where the structure fills the
edge, too, as in a tight crop, the paler of both is the background.

Legend: H x W pixels, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.images import CONTRAST, SMALLEST, Image8, of_two_tones
from stackgen.vision.masks import bounding_box, components
from stackgen.world import Grid, Mask

Levels = NDArray[np.uint8]
Differences = NDArray[np.float32]

WORK_SIZE = 768
"""Longer edge [pixel] every picture is brought to, so that edges are found to a fraction of a pixel."""

_SPECK = 0.005  # parts, and holes, under this share of the largest part are dirt
_EDGE_BAND = 0.02  # width of the strip along the edge that shows the background [of the shorter edge]
_BORDER = 0.03  # greatest width of a line along the picture's edge [of that edge]
_EVEN, _ALL_EVEN = 0.7, 0.95  # share of the edge of one colour from which on the ground is, and there is no shadow
_SHADOW = 0.03  # least share of a picture that is a shadow,
_IN_SHADOW = 0.15  # and by which ink is darker than it, by how much darker it is than the paper itself


@dataclass(frozen=True)
class Drawn:
    """What differs from the background.

    Args:
        ink: (H, W) at about `WORK_SIZE`.
        darkness: (H, W) how much it differs, 0..1.
        scale: Pixels of `ink` for one of the picture as it was read.
        place: (left, top) of `ink` in the picture as it was read [pixel].
        notes: What is doubtful, a sentence each.
        like_paper: Whether it is lighter than the background, and has the grain of a photo.
    """

    ink: Mask
    darkness: NDArray[np.float32]
    scale: float
    place: tuple[int, int]
    notes: tuple[str, ...]
    like_paper: bool

    def drawn_on(self, figure: Mask) -> bool:
        """Tell whether what was found (H, W) is itself drawn on, as a sheet of paper is."""
        import cv2

        level = (255 * (1 - self.darkness)).astype(np.uint8)
        if not self.like_paper:
            return False
        inner = cv2.erode(figure.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
        if np.count_nonzero(inner) < 0.1 * inner.size:
            return False
        lighter = cv2.morphologyEx(level, cv2.MORPH_OPEN, np.ones((21, 21), np.uint8))
        strokes = inner & (level.astype(np.int16) - lighter > 0.35 * float(self.darkness[inner].max()) * 255)
        share = np.count_nonzero(strokes) / np.count_nonzero(inner)
        return bool(0.002 < share < 0.3)


def find_drawn(image: Image8, look: Look) -> Drawn:
    """Find what is drawn in a picture that was looked at.

    Raises:
        StackgenError: If nothing is, or everything.
    """
    background, notes = _background(look.levels)
    scale = WORK_SIZE / max(look.levels.shape)
    levels = _resized(look.levels, scale)
    difference = np.abs(levels - background).max(axis=2)
    if np.count_nonzero(difference > CONTRAST) < 0.001 * difference.size:
        raise StackgenError("is all one colour, so nothing or everything is in it; draw a structure on a background")
    ink = _clean(_without_rim(difference > _threshold(difference[::2, ::2])))
    if ink.mean() > 0.98:
        raise StackgenError("the structure fills the whole frame; leave some background around it")
    if not ink.any():
        raise StackgenError("nothing but specks is in it; draw a structure on a background")
    extent = max(ink[bounding_box(ink)].shape) / scale * image.factor
    if extent < SMALLEST:
        rows, columns = ink[bounding_box(ink)].shape
        raise StackgenError(
            f"the structure in it is only {columns / scale * image.factor:.0f} x {rows / scale * image.factor:.0f}"
            f" pixels; at least {SMALLEST} are needed, draw or scan it larger"
        )
    tone = levels[..., -1]
    like_paper = not look.flat and float(np.median(tone[ink])) > float(np.median(tone[~ink]))
    return Drawn(ink, (difference / 255).astype(np.float32), scale, look.place, notes, like_paper)


def _levels(image: Image8) -> tuple[Levels, tuple[int, int]]:
    """Return colours (H, W, 3) or opacity (H, W, 1), whichever shows the structure, and their place in the picture.

    Where part of a picture is transparent, that part or the rest is the structure, unless the rest is a rectangle
    with something in it.
    """
    colours = image.colours
    if image.alpha is None:
        return colours, (0, 0)
    opaque = image.alpha >= 128
    if opaque.mean() > 0.9995 or not opaque.any():
        return colours, (0, 0)
    rows, columns = bounding_box(opaque)
    inside = colours[rows, columns]
    if opaque[rows, columns].mean() > 0.97 and min(inside.shape[:2]) >= SMALLEST:
        seen = inside[opaque[rows, columns]]
        if (np.quantile(seen, 0.995, axis=0) - np.quantile(seen, 0.005, axis=0)).max() > CONTRAST:
            inside = np.where(opaque[rows, columns, None], inside, np.median(seen, axis=0)).astype(np.uint8)
            return inside, (columns.start, rows.start)
    return image.alpha[..., None], (0, 0)


def _framed(levels: Levels, place: tuple[int, int]) -> tuple[Levels, tuple[int, int]]:
    """Cut off lines along the picture's edges: thin, of one colour from end to end, unlike the ground within."""
    depth = max(2, round(_BORDER * min(levels.shape[:2])))
    inner = levels[depth:-depth, depth:-depth]
    if min(inner.shape[:2]) < 4:
        return levels, place
    ring = [inner[0], inner[-1], inner[:, 0], inner[:, -1]]
    ground = np.median(np.concatenate(ring), axis=0)
    top, bottom, left, right = 0, levels.shape[0], 0, levels.shape[1]
    for _ in range(2):  # a border's corners show once a neighbouring side is gone
        part = levels[top:bottom, left:right]
        widths = [_border(np.rot90(part, turns), ground) for turns in range(4)]  # of the top, right, bottom and left
        if not any(widths):
            break
        top, right, bottom, left = top + widths[0], right - widths[1], bottom - widths[2], left + widths[3]
    rest = levels[top:bottom, left:right]
    if rest.shape == levels.shape:
        return levels, place
    if np.ptp(np.quantile(rest, (0.005, 0.995))) < CONTRAST and rest.mean() < levels[0].mean() - CONTRAST:
        return levels, place  # no border, but a dark structure with little paper around it
    return rest, (place[0] + left, place[1] + top)


def _border(levels: Levels, ground: NDArray[np.floating]) -> int:
    """Return the width of a line along the upper edge [pixel], 0 where there is none or it is as the ground (C,)."""
    most = max(1, round(_BORDER * len(levels)))
    if len(levels) < 4 * most:
        return 0
    if np.abs(np.median(levels[0], axis=0) - ground).max() <= CONTRAST:
        return 0
    rows = levels[: 2 * most + 2]
    tones = np.median(rows, axis=1)
    even = (np.abs(rows - tones[:, None]).max(axis=2) < 2 * CONTRAST).mean(axis=1) > 0.9  # palettes are dithered
    unlike = np.abs(tones - ground).max(axis=1) > CONTRAST
    line = even & unlike
    if not line[0] or line.all():
        return 0
    width = int(np.argmin(line))
    soft = int((~even[width:]).argmin()) if not even[width] else 0
    return width + min(soft, 2) if width <= most else 0


def _resized(levels: Levels, scale: float) -> Differences:
    import cv2

    height, width = (max(1, round(n * scale)) for n in levels.shape[:2])
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(levels, (width, height), interpolation=how)
    return np.asarray(resized, np.float32).reshape(height, width, -1)


def _background(levels: Levels) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return the background's colour (C,) in `levels` (H, W, C), and what is doubtful of it.

    It is the median along the picture's edges; the lower one counts less, as structures often stand on it. The largest
    difference of any channel from it makes colours of equal brightness differ, and stays linear over a blurred edge, so
    that half of it is the edge's middle.
    """
    band = max(1, round(min(levels.shape[:2]) * _EDGE_BAND))
    edges = [levels[:band], levels[:, :band], levels[:, -band:], levels[-band:]]
    border = np.concatenate([edge.reshape(-1, levels.shape[2]) for edge in edges[:3]])
    background = np.median(border, axis=0)
    notes: tuple[str, ...] = ()
    around = np.concatenate([edge.reshape(-1, levels.shape[2]) for edge in edges])
    other = around[np.abs(around - background).max(axis=1) > 3 * CONTRAST]
    if levels.shape[2] == 3 and len(other) > 0.02 * len(around):
        tone = np.median(other, axis=0)
        if tone.min() > 165 and background.mean() < 150 and (np.abs(other - tone).max(axis=1) < CONTRAST).mean() > 0.6:
            background = tone
            notes = ("The picture is cut off along its edges; what is dark in it was taken for the structure.",)
    return background.astype(np.float32), notes


def _threshold(difference: Differences) -> float:
    """Find the level where the structure begins: Otsu's, lowered while a paler part of the structure lies under it.

    A white house with a dark roof on grey has two steps. A paler part is told from a blurred edge by
    its thickness, and from uneven lighting by a clear step and by not reaching the picture's edge.
    """
    import cv2

    threshold = _otsu(difference)
    thick = np.ones((2 * (max(difference.shape) // 60) + 1,) * 2, np.uint8)
    for _ in range(3):
        below = difference[difference <= threshold]
        lower = _otsu(below) if len(below) else 0.0
        paler = (difference > lower) & (difference <= threshold)
        in_between = np.abs(difference - lower) < 0.25 * lower
        count, labels = cv2.connectedComponents(cv2.erode(paler.view(np.uint8), thick), connectivity=4)
        at_edge = np.unique(np.concatenate([labels[0], labels[:, 0], labels[:, -1]]))
        inside = np.isin(labels, at_edge, invert=True)
        enough = max(2 * _SPECK * np.count_nonzero(difference > threshold), 1)
        if lower < CONTRAST / 2 or count < 2 or np.count_nonzero(inside) < enough:
            return threshold
        if np.count_nonzero(in_between) > 0.3 * np.count_nonzero(paler):
            return threshold
        threshold = lower
    return threshold


def _otsu(values: Differences) -> float:
    """Return the middle between the means of two groups of values [0..255], split by Otsu's method (1979)."""
    import cv2

    levels = np.clip(values, 0, 255).astype(np.uint8).ravel()
    split, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    is_low = levels <= split
    return float((levels[is_low].mean() + levels[~is_low].mean()) / 2) if 0 < is_low.sum() < is_low.size else 0.0


def _without_rim(mask: Mask) -> Mask:
    """Remove thin lines along the mask's edges (H, W), which are not of one colour or not quite straight.

    The side of an outline that is cropped to it is none: without it, what it outlines is open.
    """
    kept = mask.copy()
    for turns in range(4):
        side = np.rot90(kept, turns)  # a view: what is removed from it is removed from the mask
        shares = side[: max(2, round(2 * _BORDER * len(side)))].mean(axis=1)
        if shares[0] > 0.85 and np.median(shares[len(shares) // 2 :]) < 0.5:
            side[: int(np.argmax(shares < 0.5)) + 1] = False
    return mask if 1.5 * _enclosed(kept) < _enclosed(mask) < 0.97 * mask.size else kept


def _enclosed(mask: Mask) -> int:
    """Return how many pixels are set (H, W) or enclosed by what is."""
    blank, _ = components(np.pad(~mask, 1, constant_values=True), connectivity=4)
    return int(np.count_nonzero(blank != blank[0, 0]))


def _clean(mask: Mask) -> Mask:
    """Remove parts and fill holes that are tiny beside the mask's largest part."""
    labels, areas = components(mask, connectivity=4)
    limit = _SPECK * areas.max(initial=0)
    kept = (areas >= max(limit, 1))[labels]
    holes, sizes = components(~kept, connectivity=4)
    return np.asarray(kept | (sizes < limit)[holes])


def fits(mask: Mask, grid: Grid) -> bool:
    """Tell whether a mask (image_size square) is placed and scaled as the grid's silhouettes are."""
    rows, columns = bounding_box(mask)
    inside = rows.start > 0 and columns.start > 0 and columns.stop < grid.image_size
    on_ground = rows.stop == round(grid.image_size - grid.ground_margin)
    half = grid.pixels_per_cell / 2
    height, width = rows.stop - rows.start, columns.stop - columns.start
    fills = abs(height - grid.height * 2 * half) <= half or abs(width - grid.width * 2 * half) <= half
    return inside and on_ground and fills


def grid_offset(silhouette: Mask, grid: Grid) -> int:
    """Find by how many pixels to shift a silhouette so that its upright edges fall on the grid's cell lines.

    Stacks of the generator stand on the cells of the grid, so samplers trained on them know edges there
    and nowhere else; a drawing is centred, which puts a structure of odd width half a cell beside. The
    shift is at most half a cell; the smallest of equally good ones is taken.

    >>> picture = np.zeros((64, 64), dtype=bool)
    >>> picture[4:60, 25:39] = True  # a tower, one cell wide, in the middle
    >>> abs(grid_offset(picture, Grid()))
    7
    """
    steps = np.diff(silhouette.astype(np.int8), axis=1, prepend=0, append=0)
    edges = np.abs(steps).sum(axis=0)  # number of rows with an edge left of each column
    places = np.arange(len(edges)) - grid.image_size / 2 - grid.cell_edge * grid.pixels_per_cell
    filled = np.flatnonzero(silhouette.any(axis=0))
    half = round(grid.pixels_per_cell / 2)
    best, best_score = 0, -np.inf
    for offset in sorted(range(-half, half + 1), key=abs):
        if filled.size and not (0 <= filled[0] + offset and filled[-1] + offset < grid.image_size):
            continue
        phase = (places + offset) / grid.pixels_per_cell
        distance = np.abs(phase - np.round(phase)) * grid.pixels_per_cell  # [pixel] to the next cell line
        score = float((edges * np.maximum(0, 2 - distance)).sum())
        if score > best_score + 1e-9:
            best, best_score = offset, score
    return best


def as_it_is(image: Image8, grid: Grid) -> Mask | None:
    """Return the silhouette (image_size square) where a picture already is one of this grid, else None.

    It is `image_size` pixels square, has two values only, its structure's lowest row on the ground line, nothing on the
    picture's edge, and is as high or as wide as the grid to within half a cell.
    """
    levels, _ = _levels(image)
    if image.factor != 1 or levels.shape[:2] != (grid.image_size,) * 2:
        return None
    difference = np.abs(levels - np.median(levels[:1].reshape(-1, levels.shape[2]), axis=0)).max(axis=2)
    if len(np.unique(difference)) != 2:
        return None
    mask = difference > 0
    return mask if fits(mask, grid) else None


@dataclass(frozen=True)
class Look:
    """What tells a drawing from a photo in a picture, less a border along its edges.

    Args:
        levels: (H, W, C) its colours, or opacity.
        place: (left, top) of these in the picture as it was read [pixel].
        flat: Whether neighbouring pixels are equal nearly everywhere, as drawing programs leave them and no camera.
        shaded: Whether what is dark has strokes in it and reaches the edge, as a shadow does.
        two_tone: Whether it has two tones, but for grain and soft edges.
        even: Whether the background is of one colour: most places along the picture's edge are alike.
        on_white: Whether most of the picture's edge is light and colourless.
    """

    levels: Levels
    place: tuple[int, int]
    flat: bool
    shaded: bool
    two_tone: bool
    even: bool
    on_white: bool

    @property
    def sheetless(self) -> bool:
        """Whether no sheet of paper can be in it: a picture that no camera took, or one of two tones on even white."""
        return (self.flat and (self.two_tone or self.even)) or (self.two_tone and self.even and self.on_white)

    @property
    def drawn(self) -> bool:
        """Whether it is a drawing where no sheet of paper is in it.

        Its ground is of one colour, or it has two tones only. What a camera saw has grain: on white, or in a shadow, it
        is the photo of paper, whatever lies in its corners.
        """
        return self.two_tone or (self.even and (self.flat or not (self.on_white or self.shaded)))


def look_at(image: Image8) -> Look:
    """Find what tells a drawing from a photo."""
    levels, place = _framed(*_levels(image))
    green = levels[..., levels.shape[2] // 2]
    same = (green[1:, 1:] == green[1:, :-1]) & (green[1:, 1:] == green[:-1, 1:])
    tone = np.median(np.concatenate((levels[0], levels[-1], levels[:, 0], levels[:, -1])), axis=0)
    step = max(1, max(levels.shape) // (WORK_SIZE // 2))
    some = np.ascontiguousarray(np.moveaxis(levels[::step, ::step], 2, 0))
    shaded, evenness = _is_shaded(some.min(axis=0)), _evenness(levels)
    return Look(
        levels,
        place,
        flat=not shaded and float(np.count_nonzero(same)) > 0.8 * same.size,  # however even a camera's noise was made
        shaded=shaded and evenness < _ALL_EVEN,
        two_tone=not shaded and any(of_two_tones(end.reduce(some)) for end in (np.maximum, np.minimum)),
        even=evenness > _EVEN,
        on_white=bool(tone.min() > 140 and np.ptp(tone) < 40),
    )


def _is_shaded(values: NDArray[np.uint8]) -> bool:
    """Tell whether there are strokes in what is dark of levels (H, W), as in the shadow that falls over a sketch."""
    import cv2

    values = np.asarray(cv2.medianBlur(values, 5), np.uint8)
    split, _ = cv2.threshold(values, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    dark = values <= split
    wide = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, np.ones((15, 15), np.uint8))
    inner = cv2.erode(wide, np.ones((9, 9), np.uint8)) > 0
    if inner.mean() < _SHADOW or dark.all():
        return False
    strokes = cv2.morphologyEx(values, cv2.MORPH_BLACKHAT, np.ones((11, 11), np.uint8))
    apart = float(np.median(values[~dark])) - float(np.median(values[dark]))
    return bool((strokes[inner] > _IN_SHADOW * apart).mean() > 0.005)


def _evenness(levels: Levels) -> float:
    """Return the share of the places along the edge of a picture (H, W, C) that are of one colour."""
    band = max(1, round(min(levels.shape[:2]) * 2 * _EDGE_BAND))
    places = [
        np.median(patch.reshape(-1, levels.shape[2]), axis=0)
        for edge in (levels[:band], levels[-band:], levels[:, :band].swapaxes(0, 1), levels[:, -band:].swapaxes(0, 1))
        for patch in np.array_split(edge, 8, axis=1)
    ]
    tones = np.array(places)
    alike = np.abs(tones[:, None] - tones[None]).max(axis=2) < 0.6 * CONTRAST
    return float(alike.mean(axis=1).max())
