"""The sheet of paper in a photo: where it lies, and how it looks straight on.

Paper is told from a table by its whiteness, by its colour, which a shadow does not change, and by its edge, which is
sharper than a shadow's. Each way proposes quadrangles; the one counts whose sides are the clearest steps from light to
dark, taken on the spot, so that a shadow across a side does no harm. A side may lie beyond the photo's edge.

Legend: h x w pixels of the photo; corners (4, 2) as x, y from the upper left clockwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.images import Picture
from stackgen.world import Mask

Floats = NDArray[np.float64]

FOCAL = 0.75
"""Focal length of a usual camera by the photo's longer edge: a telephone's, a webcam's or a RealSense's is near it."""

FOCALS = (0.6, 1.6)
"""Least and largest focal length that is believed, by the photo's longer edge."""

SHEETS = (0.707, 0.773)
"""Proportions of sheets of A4 and of Letter."""

_BETWEEN = 0.755  # nearer to Letter, as most sheets are of A4

LEAST_SHEET = 0.05
"""A sheet is at least this share of the photo."""

SUPPORT = 0.6
"""Least share of each side of a sheet along which it is lighter inside than outside."""

_AT_EDGE = 4.0  # what is nearer to the photo's edge is cut off by it [pixel at which the sheet is looked for]

_SEARCH = 400  # longer edge at which the sheet is looked for [pixel]


@dataclass(frozen=True)
class Sheet:
    """A sheet of paper in a photo.

    Args:
        corners: (4, 2) corners [pixel], which may lie outside of the photo.
        sureness: How clear its sides are, 0..1.
        whole: Whether all four sides are seen; else its length is unknown.
    """

    corners: Floats
    sureness: float
    whole: bool = True

    @property
    def slanted(self) -> bool:
        """Whether it is seen at such a slant that its proportions are hard to tell."""
        lengths = np.linalg.norm(self.corners - np.roll(self.corners, -1, axis=0), axis=1)
        return bool(min(lengths[i] / lengths[i - 2] for i in range(4)) < 0.7)


def find_sheet(photo: Picture) -> Sheet | None:
    """Find the sheet of paper in a photo (h, w, 3); None where no sides of one are seen."""
    factor = _SEARCH / max(photo.shape[:2])
    small = np.asarray(cv2.resize(photo, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)
    small = np.asarray(cv2.medianBlur(small, 5), np.uint8)
    light, tint = least_channel(small).astype(np.float32), _tint(small)
    best: tuple[float, Floats, float] | None = None
    for region in _regions(small):
        corners = _quadrangle(region)
        if corners is None:
            continue
        corners = _refined(small, corners, reach=8)
        if _is_frame(corners, region.shape):
            continue
        sureness, seen = _support(light, tint, corners)
        shape = np.array(small.shape[1::-1])
        area = cv2.contourArea(np.clip(corners, 0, shape).astype(np.float32)) / shape.prod()
        score = sureness * area**0.25 * 0.9 ** (4 - seen)
        if sureness >= SUPPORT and (best is None or score > best[0] + 1e-3):
            best = score, corners, sureness
    if best is None:
        return None
    corners = _refined(photo, best[1] / factor, reach=max(2.0, 3 / factor))
    cut = _cut_side(best[1], small.shape)
    return Sheet(corners, best[2]) if cut is None else Sheet(_completed(corners, cut, photo.shape), best[2], False)


def _cut_side(corners: Floats, shape: tuple[int, ...]) -> int | None:
    """Return the number of the side that is an edge of the photo rather than of the sheet, None where there is none."""
    far = np.array(shape[1::-1]) - 1
    for number in range(4):
        side = corners[[number, (number + 1) % 4]]
        if (side.max(axis=0) <= _AT_EDGE).any() or ((far - side).max(axis=0) <= _AT_EDGE).any():
            return number
    return None


def _completed(corners: Floats, cut: int, shape: tuple[int, ...]) -> Floats:
    """Put a side (number `cut`) that the photo's edge cuts off square to its neighbours, as it is on the sheet.

    The neighbours are parallel and the opposite side is square to them, which tells the direction of the fourth side
    where the focal length is known. It passes through the further corner that is seen.
    """
    focal, middle = FOCAL * max(shape[:2]), np.array(shape[1::-1]) / 2
    points = np.column_stack([(np.roll(corners, -cut, axis=0) - middle) / focal, np.ones(4)])
    here, next_, opposite, last = points  # the side that is cut goes from `here` to `next_`
    along = np.cross(np.cross(next_, opposite), np.cross(here, last))  # direction of the neighbours
    across = np.cross(np.cross(opposite, last), along)
    moved = []
    for corner in (here, next_):
        side = np.cross(corner, across)
        moved.append([np.cross(side, np.cross(*neighbour)) for neighbour in ((here, last), (next_, opposite))])
    ends = np.array(moved)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (ends[..., :2] / ends[..., 2:]) * focal + middle
    found = np.roll(corners, -cut, axis=0)
    outer = max(ends, key=lambda pair: float(((pair - found[[3, 2]]) * (found[:2] - found[[3, 2]])).sum()))
    if not np.isfinite(outer).all():
        return corners
    found[:2] = outer
    return np.roll(found, cut, axis=0)


def _refined(photo: Picture, corners: Floats, reach: float) -> Floats:
    """Move the sides of a quadrangle to where the photo steps down most within some pixels of them."""
    light = cv2.GaussianBlur(least_channel(photo), (0, 0), 1.0).astype(np.float32) + 8
    middle = corners.mean(axis=0)
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
        outward = np.array([along[1], -along[0]])
        outward *= np.sign((start - middle) @ outward)
        shifts = np.arange(-reach, reach + 0.5)
        points = start + (end - start) * np.linspace(0.04, 0.96, 80)[:, None]
        there = (points[:, None] + shifts[:, None] * outward).astype(np.float32)
        seen = cv2.remap(light, there[..., 0], there[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        step = np.log(seen[:, :-2] / seen[:, 2:])
        clear = step.max(axis=1) > 0.06
        if np.count_nonzero(clear) < 25:
            lines.append(np.array([start, end]))
            continue
        found = points[clear] + shifts[1 + step.argmax(axis=1)[clear], None] * outward
        x, y, u, v = cv2.fitLine(found.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()[[2, 3, 0, 1]]
        lines.append(np.array([[x, y], [x + u, y + v]], np.float64))
    moved = np.array([_crossing(one, two) for one, two in zip(np.roll(lines, 1, axis=0), lines, strict=True)])
    return moved if np.isfinite(moved).all() and np.abs(moved - corners).max() < 6 * reach else corners


def least_channel(picture: Picture) -> NDArray[np.uint8]:
    """Return the least channel (h, w) of a colour picture: that in which ink of any colour is dark, and wood, too."""
    return np.asarray(cv2.min(cv2.min(picture[..., 0], picture[..., 1]), picture[..., 2]), np.uint8)


def _is_frame(corners: Floats, shape: tuple[int, ...]) -> bool:
    """Tell whether a quadrangle is a border along the picture's edges rather than a sheet."""
    width, height = shape[1], shape[0]
    ends = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    return bool(np.abs(corners - ends).max() < 0.05 * max(shape))


def _tint(small: Picture) -> NDArray[np.float32]:
    """Return how colourless each pixel is, 255 for grey: least by largest channel, which a shadow hardly changes."""
    most = cv2.max(cv2.max(small[..., 0], small[..., 1]), small[..., 2]).astype(np.float32)
    return np.asarray(255 * (least_channel(small).astype(np.float32) + 8) / (most + 8), np.float32)


def _regions(small: Picture) -> Iterator[Mask]:
    """Propose regions (h, w) that may be the sheet."""
    light, tint = least_channel(small), _tint(small).astype(np.uint8)
    for levels, shares in ((light, np.arange(1.1, 0.3, -0.08)), (tint, np.array([1.0, 0.95, 0.9]))):
        level, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        for share in shares:
            if share * level < 250:
                yield levels > share * level
    yield from _flooded(small)
    yield from _between_edges(small)


def _flooded(small: Picture) -> Iterator[Mask]:
    """Propose what is reached from the lightest place without a sharp step: shadows end softly, paper does not."""
    soft = cv2.GaussianBlur(small, (0, 0), 1.0)
    paper = cv2.morphologyEx(soft, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    level = cv2.blur(least_channel(np.asarray(paper, np.uint8)), (15, 15))
    row, column = np.unravel_index(int(level.argmax()), level.shape)
    for step in (3, 5, 8):
        mask = np.zeros((small.shape[0] + 2, small.shape[1] + 2), np.uint8)
        cv2.floodFill(
            paper.copy(), mask, (int(column), int(row)), 0, (step,) * 3, (step,) * 3, 8 | cv2.FLOODFILL_MASK_ONLY
        )
        yield mask[1:-1, 1:-1] > 0


def _between_edges(small: Picture) -> Iterator[Mask]:
    """Propose what lies between edges, alone and by twos: a hard shadow divides a sheet."""
    light = np.log(least_channel(small).astype(np.float32) + 12)
    soft = cv2.GaussianBlur(cv2.morphologyEx(light, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)), (0, 0), 1.2)
    steep = np.hypot(cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1))
    for level in (0.12, 0.25):
        _, labels, parts, _ = cv2.connectedComponentsWithStats((steep < level).astype(np.uint8), connectivity=4)
        order = [
            i for i in np.argsort(-parts[:, cv2.CC_STAT_AREA]) if i and parts[i, cv2.CC_STAT_AREA] > 0.02 * light.size
        ]
        masks = [labels == i for i in order[:5]]
        yield from masks
        for first in range(len(masks)):
            for second in range(first):
                joined = (masks[first] | masks[second]).astype(np.uint8)
                yield cv2.morphologyEx(joined, cv2.MORPH_CLOSE, np.ones((11, 11), np.uint8)) > 0


def _quadrangle(region: Mask) -> Floats | None:
    """Return the corners (4, 2) of the largest part of a region where its hull has four sides.

    Sides that the photo's edge cuts off count last: three sides and the photo's edge are a sheet, too.
    """
    whole = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    contours, _ = cv2.findContours(whole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    contour = max(contours, key=lambda one: float(cv2.contourArea(one)))
    hull = cv2.convexHull(contour)
    area = float(cv2.contourArea(hull))
    if not LEAST_SHEET * region.size <= area <= 0.985 * region.size or cv2.contourArea(contour) < 0.8 * area:
        return None
    around = cv2.approxPolyDP(hull, 0.006 * cv2.arcLength(hull, True), True)[:, 0].astype(np.float64)
    if not 4 <= len(around) <= 10:
        return None
    lines = _four_sides(around, region.shape)
    if lines is None:
        return None
    corners = np.array([_crossing(one, two) for one, two in zip(np.roll(lines, 1, axis=0), lines, strict=True)])
    limits = 0.6 * np.array(region.shape[::-1])
    if (
        not np.isfinite(corners).all()
        or (corners < -limits).any()
        or (corners > 1.6 * np.array(region.shape[::-1])).any()
    ):
        return None
    flat = corners.astype(np.float32)
    inside = np.zeros(region.shape, np.uint8)
    cv2.fillPoly(inside, [np.round(corners).astype(np.int32)], 1)
    filled = np.zeros(region.shape, np.uint8)
    cv2.fillPoly(filled, [hull], 1)
    same = int(np.count_nonzero(inside & filled)) / max(1, int(np.count_nonzero(inside | filled)))
    return _clockwise(corners) if cv2.isContourConvex(flat) and same > 0.9 else None


def _four_sides(around: Floats, shape: tuple[int, ...]) -> Floats | None:
    """Choose four sides (4, 2, 2) of a polygon in order, those off the photo's edge first, then the longest."""
    sides = np.stack([around, np.roll(around, -1, axis=0)], axis=1)
    lengths = np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1)
    far = np.array(shape[1::-1]) - 1
    cut = (sides.max(axis=1) <= 2).any(axis=1) | ((far - sides).max(axis=1) <= 2).any(axis=1)
    minor = cut | (lengths < 0.12 * max(shape))
    order = np.lexsort((-lengths, minor))
    chosen = np.sort(order[:4])
    if np.count_nonzero(~cut[chosen]) < 3:
        return None
    return sides[chosen]


def _crossing(one: Floats, two: Floats) -> Floats:
    """Return where two lines (2, 2) cross; nan where they are parallel."""
    (p, q), (r, s) = one, two
    a, b = q - p, s - r
    across = a[0] * b[1] - a[1] * b[0]
    if abs(across) < 1e-6:
        return np.full(2, np.nan)
    return np.asarray(p + ((r - p)[0] * b[1] - (r - p)[1] * b[0]) / across * a)


def _support(light: NDArray[np.float32], tint: NDArray[np.float32], corners: Floats) -> tuple[float, int]:
    """Return the share of a quadrangle's sides that step down, that of the least side, and how many sides are seen."""
    height, width = light.shape
    middle = corners.mean(axis=0)
    least, seen = 1.0, 0
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
        inward = np.array([-along[1], along[0]])
        inward *= np.sign((middle - start) @ inward)
        points = start + (end - start) * np.linspace(0.04, 0.96, 60)[:, None]
        inside, outside, beyond = (np.round(points + shift * inward).astype(int) for shift in (5, -5, -14))
        known = ((inside >= 0) & (outside >= 0) & (inside < [width, height]) & (outside < [width, height])).all(axis=1)
        if np.count_nonzero(known) < 15:
            continue
        (x, y), (u, v) = inside[known].T, outside[known].T
        darker = (light[v, u] + 8) / (light[y, x] + 8)
        duller = tint[v, u] - tint[y, x]
        far, away = np.clip(beyond[known], 0, [width - 1, height - 1]).T  # beyond a mere line it is light again
        paper = (light[away, far] > 0.95 * light[y, x]) & (tint[away, far] > tint[y, x] - 9)
        least = min(least, float((((darker < 0.88) | (duller < -18)) & ~paper).mean()))
        seen += 1
    return (least if seen >= 2 else 0.0), seen


def _clockwise(corners: Floats) -> Floats:
    """Order corners (4, 2) from the upper left clockwise, as they are seen in the photo."""
    middle = corners.mean(axis=0)
    angles = np.arctan2(*(corners - middle).T[::-1])
    corners = corners[np.argsort(angles)]  # y points down: growing angles run clockwise
    return np.roll(corners, -int(corners.sum(axis=1).argmin()), axis=0)


def _usual(ratio: float) -> float:
    """Return the proportions of the sheets that people have where they are near: those of A4 and of Letter."""
    short = min(ratio, 1 / ratio)
    near = SHEETS[0] if short < _BETWEEN else SHEETS[1]
    if abs(near - short) > 0.1 * near:
        return ratio
    return near if ratio < 1 else 1 / near


def straightened(photo: Picture, sheet: Sheet, size: int) -> tuple[Picture, Floats]:
    """Show the sheet straight on.

    Returns:
        (h', w', 3) the sheet, `size` pixels for its longer edge, and the (3, 3) homography from photo to sheet.
    """
    corners = sheet.corners
    ratio = sheet_ratio(corners - np.array(photo.shape[1::-1]) / 2, max(photo.shape))
    ratio = _usual(ratio) if sheet.whole else ratio
    width, height = (size, round(size / ratio)) if ratio > 1 else (round(size * ratio), size)
    there = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    turn = cv2.getPerspectiveTransform(corners.astype(np.float32), there)
    straight = cv2.warpPerspective(photo, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(straight, dtype=np.uint8), np.asarray(turn)


def sheet_ratio(corners: Floats, edge: float) -> float:
    """Estimate width by height of a rectangle from its picture.

    Two pairs of parallel edges tell the focal length, and with it the proportions (Zhang and He, "Whiteboard scanning
    and image enhancement", 2007, section 3). A sheet seen nearly straight on tells it badly, so it is kept to what
    cameras have; there it matters little.

    Args:
        corners: (4, 2) clockwise from the upper left, relative to the middle of the photo [pixel].
        edge: Longer edge of the photo [pixel].

    >>> round(sheet_ratio(np.array([[-2.0, -1], [2, -1], [2, 1], [-2, 1]]), 5.0), 6)
    2.0
    """
    one, two, four, three = (np.append(corner / edge, 1.0) for corner in corners)  # four is opposite of one
    k2 = np.cross(one, four) @ three / (np.cross(two, four) @ three)
    k3 = np.cross(one, four) @ two / (np.cross(three, four) @ two)
    across, down = k2 * two - one, k3 * three - one
    product = across[2] * down[2]
    square = -(across[:2] @ down[:2]) / product if abs(product) > 1e-4 else 0.0
    seen = np.clip(np.sqrt(square), *FOCALS) if square > 0 else FOCAL
    focal = np.sqrt(seen * FOCAL)  # corners tell it badly, and most cameras are alike
    lengths = [np.hypot(np.linalg.norm(vector[:2]) / focal, vector[2]) for vector in (across, down)]
    return float(np.clip(lengths[0] / lengths[1], 0.3, 3.3))
