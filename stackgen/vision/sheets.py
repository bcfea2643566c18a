"""The sheet of paper in a photo: where it lies, and how it looks straight on.

Its sides are straight edges. Of all quadrangles of edges that are seen, and of the photo's own, the one counts all
along whose sides it is lighter, or more colourless, inside than outside. This is judged from place to place, so that
a shadow across a side does no harm; what a shadow divides off is smaller, and counts less.

Legend: h x w pixels of the photo, N lines, Q quadrangles, T places along a line; corners (4, 2) as x, y from the upper
left clockwise; lines (N, 2, 2) as two points a pixel apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.images import Picture, as_bytes

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FOCAL = 0.75
"""Focal length of a usual camera by the photo's longer edge: a telephone's, a webcam's or a RealSense's is near it."""

LEAST_SHEET = 0.05
"""A sheet is at least this share of the photo."""

SUPPORT = 0.6
"""Least share of each side of a sheet along which it is lighter inside than outside."""

_SEARCH = 400  # longer edge at which the sheet is looked for; all lengths below are pixels of this

_TRIED = 40  # edges along which light is looked at
_MOST_LINES = 8  # those of them, level and upright ones each, that may be sides, beside the photo's own
_REACH = 500  # how far a line is followed to either side
_BESIDE = 5  # how far from a side inside and outside are compared
_STRIP = 2  # least width of what is seen of the table beyond a side
_BEYOND = 14  # so far from it, to one side, a mere line is as it is on the other
_LEAST_SEEN = 15  # a side of which less is seen tells nothing
_LEVEL_TO = 3.0  # by this a border along the photo's edges may be out of level
_AT_EDGE = 4.0  # what is nearer to the photo's edge is cut off by it
_COLOURED = 200.0  # tint of paper of which no table has the colour: beyond a side that has it is a shadow
_SAME = 0.12  # logarithm by which the light of the three channels may change otherwise in it
_LEVEL = 0.95  # light beyond a dark line by that before it

_LARGE = 0.45  # exponent of its area: what a shadow divides off is smaller

_TRIMMED = 0.04  # share of a side at either end that tells nothing of it
_ONWARD = (4, 34)  # so far beyond its corners a sheet has ended; what a shadow divides off goes on there
_GOES_ON = 0.8  # along at least this share of that
_AS_DEEP = 0.6  # and nearly as deep; stripes of a table are less
_ONE_MORE = 0.7  # what each side costs that does
_LIKE = 0.3  # a quadrangle that is less like a sheet, of all that but its size, is none
_UNSEEN = 0.8  # what each side costs that is not seen


@dataclass(frozen=True)
class Sheet:
    """A sheet of paper in a photo.

    Args:
        corners: (4, 2) corners [pixel], which may lie outside of the photo.
        sureness: How clear its sides are, 0..1.
        seen: Number of its sides that are seen; three tell how it lies, and four its proportions.
    """

    corners: Floats
    sureness: float
    seen: int = 4

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
    found = _best_quadrangle(small, np.concatenate([_edges(small), _frame(small.shape)]))
    if found is None:
        return None
    corners, sureness = found
    cut = _cut_sides(corners, small.shape)
    corners = _refined(photo, corners / factor, reach=max(2.0, 3 / factor))
    if len(cut) == 1:
        corners = _completed(corners, cut[0], photo.shape)
    return Sheet(corners, sureness, 4 - len(cut))


def _edges(small: Picture) -> Floats:
    """Find straight edges (N, 2, 2) of light and colour; ink is closed before."""
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    pieces = []
    for levels in (_log(least_channel(small)), _log(_most_channel(small)), _tint(small)):
        wide = cv2.copyMakeBorder(as_bytes(levels), 9, 9, 9, 9, cv2.BORDER_REPLICATE)  # a strip of table is no ink
        closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))[9:-9, 9:-9]
        found = detector.detect(np.ascontiguousarray(closed))[0]
        if found is not None:
            pieces.append(found.reshape(-1, 2, 2).astype(np.float64))
    if not pieces:
        return np.zeros((0, 2, 2))
    ends = np.concatenate(pieces)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-lengths)[: np.count_nonzero(lengths > 0.03 * _SEARCH)]
    return _joined(ends[order])


def _joined(ends: Floats) -> Floats:
    """Join pieces of edges (n, 2, 2), the longest first, to lines (N, 2, 2)."""
    free = np.ones(len(ends), dtype=bool)
    lines = []
    for number in range(len(ends)):
        if not free[number]:
            continue
        at, along = ends[number, 0], ends[number, 1] - ends[number, 0]
        for _ in range(2):
            across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
            members = np.abs((ends - at) @ across).max(axis=1) < 3
            at, along = _line_along(ends[members])
        free &= ~members
        lines.append([at, at + along])
    return np.array(lines[:_TRIED]).reshape(-1, 2, 2)


def _line_along(pieces: Floats) -> tuple[Floats, Floats]:
    """Fit a line to pieces of edges (n, 2, 2), by their lengths; return a point (2,) and its direction (2,)."""
    lengths = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    at = lengths @ pieces.mean(axis=1) / lengths.sum()
    x, y = (pieces - at).transpose(2, 0, 1)
    angle = np.arctan2(2 * (lengths @ (x * y)).sum(), (lengths @ (x * x - y * y)).sum()) / 2
    return at, np.array([np.cos(angle), np.sin(angle)])


def _log(levels: Picture) -> NDArray[np.float32]:
    """Return levels such that equal shares of light are equal steps."""
    return np.log(levels.astype(np.float32) + 12)


def _frame(shape: tuple[int, ...]) -> Floats:
    """Return the photo's own edges (4, 2, 2)."""
    right, bottom = shape[1] - 1.0, shape[0] - 1.0
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]])
    return np.stack([corners, corners + [[1, 0], [0, 1], [-1, 0], [0, -1]]], axis=1)


def _best_quadrangle(small: Picture, lines: Floats) -> tuple[Floats, float] | None:
    """Return the corners of the quadrangle of lines (N, 2, 2) most like a sheet, and how clear its sides are."""
    steps, depths, known = _steps(small, lines)
    clearest = np.argsort(-(depths - steps / 3)[:, :-4, -1].max(axis=0))  # depth counts more than length
    upright = np.abs(_normals(lines)[clearest]).argmax(axis=1) == 0
    of_both = [clearest[upright == turned][:_MOST_LINES] for turned in (False, True)]  # stripes of a table are many
    chosen = np.concatenate([*of_both, len(lines) + np.arange(-4, 0)])
    lines, steps, depths, known = lines[chosen], steps[:, chosen], depths[:, chosen], known[chosen]
    sides, corners, ends = _quadrangles(lines, small.shape)
    if not len(sides):
        return None
    inside = ((corners.mean(axis=1)[:, None] - lines[sides, 0]) * _normals(lines)[sides]).sum(axis=2) > 0
    low, high = np.sort(ends, axis=2).transpose(2, 0, 1)

    def between(start: Floats, end: Floats) -> tuple[Floats, Floats, Floats]:
        """Return at how many places (Q, 4) between two a side is known, at which share it steps down, and how deep."""
        first, last = (np.clip(np.round(place + _REACH), 0, 2 * _REACH).astype(int) for place in (start, end))
        of = known[sides, last] - known[sides, first]
        share, deep = ((told[inside * 1, sides, last] - told[inside * 1, sides, first]) for told in (steps, depths))
        return of, share / np.maximum(of, 1), deep / np.maximum(of, 1)

    of, share, deep = between(low + _TRIMMED * (high - low), high - _TRIMMED * (high - low))
    seen = of >= _LEAST_SEEN
    sureness, depth = (np.where(seen, told, 1).min(axis=1) for told in (share, deep))
    mean = (share * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    onward = np.zeros(len(sides))
    for start, end in ((high + _ONWARD[0], high + _ONWARD[1]), (low - _ONWARD[1], low - _ONWARD[0])):
        there, steady, as_deep = between(start, end)
        goes_on = (there >= _LEAST_SEEN) & (steady > _GOES_ON) & (as_deep > _AS_DEEP * deep)
        onward += np.count_nonzero(goes_on, axis=1)
    areas = np.abs(_cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)) / 2 / (small.shape[0] * small.shape[1])
    like = sureness * mean * depth**0.5 * _UNSEEN ** np.count_nonzero(~seen, axis=1) * _ONE_MORE**onward
    score = like * np.minimum(areas, 1) ** _LARGE
    enough = (np.count_nonzero(seen, axis=1) > 2) | ((np.count_nonzero(seen, axis=1) == 2) & (areas > 0.5))
    score[(sureness < SUPPORT) | (like < _LIKE) | ~enough | _is_frame(corners, small.shape)] = 0
    best = int(score.argmax())
    return (_clockwise(corners[best]), float(sureness[best])) if score[best] else None


def _quadrangles(lines: Floats, shape: tuple[int, ...]) -> tuple[Ints, Floats, Floats]:
    """Make quadrangles of lines (N, 2, 2), the last four of which are the photo's own edges.

    Returns:
        (Q, 4) numbers of the lines that are their sides; (Q, 4, 2) their corners, each at the end of its side; and
        (Q, 4, 2) where along its line each side begins and ends [pixel].
    """
    along = lines[:, 1] - lines[:, 0]
    angles = _cross(along[:, None], along)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = _cross(lines[:, 0] - lines[:, None, 0], along) / angles  # (N, N) of the crossing, along the first line
    meet = (np.abs(angles) > 0.34) & (np.abs(places) < 3 * _REACH)
    four = np.array(list(combinations(range(len(lines)), 4)))
    around = np.concatenate([four, four[:, [0, 2, 1, 3]], four[:, [0, 1, 3, 2]]])
    after = np.roll(around, -1, axis=1)
    opposite = np.abs(angles[around[:, :2], around[:, 2:]]).max(axis=1) < 0.8
    kept = meet[around, after].all(axis=1) & opposite & (np.count_nonzero(around >= len(lines) - 4, axis=1) <= 2)
    around, after = around[kept], after[kept]
    ends = np.stack([places[around, np.roll(around, 1, axis=1)], places[around, after]], axis=2)
    corners = lines[around, 0] + ends[..., 1:] * along[around]
    size = np.array(shape[1::-1])
    near = ((corners > -0.6 * size) & (corners < 1.6 * size)).all(axis=(1, 2))
    sides = corners - np.roll(corners, 1, axis=1)
    turns = _cross(sides, np.roll(sides, -1, axis=1))
    convex = (turns > 0).all(axis=1) | (turns < 0).all(axis=1)
    large = np.abs(_cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)) > 2 * LEAST_SHEET * size.prod()
    kept = near & convex & large
    return around[kept], corners[kept], ends[kept]


def _steps(small: Picture, lines: Floats) -> tuple[Floats, Floats, Floats]:
    """Tell where along lines (N, 2, 2) it steps down from paper to table, as sums from their first place on.

    Returns:
        (2, N, T + 1) at how many places it does, with the paper on the one side and on the other; (2, N, T + 1) how
        deep, up to 1 each; and (N, T + 1) at how many both sides are seen: none of the last four, the photo's own.
    """
    seen = (least_channel(small), _most_channel(small), _tint(small), *cv2.split(small))
    levels = [np.asarray(of, np.float32).ravel() for of in seen]
    size = np.array(small.shape[1::-1])
    points = lines[:, :1] + np.arange(-_REACH, _REACH)[:, None] * (lines[:, 1:] - lines[:, :1])

    def beside(shift: int, count: int = len(levels)) -> list[NDArray[np.float32]]:
        there = np.round(points + shift * _normals(lines)[:, None]).astype(int)
        x, y = np.clip(there, 0, size - 1).transpose(2, 0, 1)
        index = y * size[0] + x
        return [of[index] for of in levels[:count]]

    known = np.asarray(((points >= _STRIP) & (points < size - _STRIP)).all(axis=2))
    known[-4:] = False
    counts, depths = [], []
    for side in (-1, 1):
        light, value, tint, *colours = beside(side * _BESIDE)
        dark, low, dull, *others = beside(-side * _BESIDE)
        far, high, away = beside(-side * _BEYOND, 3)
        (within,) = beside(side * _BEYOND, 1)
        darker = np.log(np.maximum((light + 8) / (dark + 8), (value + 8) / (low + 8)))
        shares = [np.log((one + 8) / (other + 8)) for one, other in zip(colours, others, strict=True)]
        in_shadow = (tint < _COLOURED) & (np.ptp(shares, axis=0) < _SAME)
        down = np.maximum(darker / 0.13, (tint - dull) / 18)
        dark_line = (far > _LEVEL * light) & (high > _LEVEL * value) & (away > tint - 9)
        light_line = within + 8 < np.minimum(0.7 * (light + 8), 1.15 * (dark + 8))
        down[dark_line | light_line | in_shadow | ~known] = 0
        counts.append(_counted(down >= 1))
        depths.append(_counted(np.clip(down / 3, 0, 1)))
    return np.stack(counts), np.stack(depths), _counted(known)


def _counted(told: NDArray[np.generic]) -> Floats:
    """Return the sums over the first 0, 1, ... T places (N, T + 1) of what is told of each (N, T)."""
    return np.pad(np.cumsum(told, axis=1, dtype=np.float64), ((0, 0), (1, 0)))


def _normals(lines: Floats) -> Floats:
    """Return the directions (N, 2) square to lines (N, 2, 2)."""
    along = lines[:, 1] - lines[:, 0]
    return np.stack([-along[:, 1], along[:, 0]], axis=1)


def _cross(one: Floats, two: Floats) -> Floats:
    """Return the cross products (...) of vectors (..., 2)."""
    return np.asarray(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])


def _is_frame(corners: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Tell which quadrangles (Q, 4, 2) are a border along the photo's edges, and level, rather than a sheet."""
    ends = _frame(shape)[:, 0]
    far = np.abs(corners[:, :, None] - ends).max(axis=3).min(axis=1).max(axis=1)
    askew = np.abs(corners - np.roll(corners, 1, axis=1)).min(axis=2).max(axis=1)
    return np.asarray((far < 0.05 * max(shape)) & (askew < _LEVEL_TO))


def _cut_sides(corners: Floats, shape: tuple[int, ...]) -> list[int]:
    """Return the numbers of the sides that are edges of the photo rather than of the sheet."""
    far = np.array(shape[1::-1]) - 1
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    at_edge = (sides.max(axis=1) <= _AT_EDGE) | ((far - sides).max(axis=1) <= _AT_EDGE)
    return np.flatnonzero(at_edge.any(axis=1)).tolist()


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


def _crossing(one: Floats, two: Floats) -> Floats:
    """Return where two lines (2, 2) cross; nan where they are parallel."""
    (p, q), (r, s) = one, two
    a, b = q - p, s - r
    across = a[0] * b[1] - a[1] * b[0]
    if abs(across) < 1e-6:
        return np.full(2, np.nan)
    return np.asarray(p + ((r - p)[0] * b[1] - (r - p)[1] * b[0]) / across * a)


def least_channel(picture: Picture) -> NDArray[np.uint8]:
    """Return the least channel (h, w) of a colour picture: that in which ink of any colour is dark, and wood, too."""
    return np.asarray(cv2.min(cv2.min(picture[..., 0], picture[..., 1]), picture[..., 2]), np.uint8)


def _most_channel(picture: Picture) -> NDArray[np.uint8]:
    """Return the largest channel (h, w) of a colour picture."""
    return np.asarray(cv2.max(cv2.max(picture[..., 0], picture[..., 1]), picture[..., 2]), np.uint8)


def _tint(small: Picture) -> NDArray[np.float32]:
    """Return how colourless each pixel is, 255 for grey: least by largest channel, which a shadow hardly changes."""
    most = _most_channel(small).astype(np.float32)
    return np.asarray(255 * (least_channel(small).astype(np.float32) + 8) / (most + 8), np.float32)


def _clockwise(corners: Floats) -> Floats:
    """Order corners (4, 2) from the upper left clockwise, as they are seen in the photo."""
    middle = corners.mean(axis=0)
    angles = np.arctan2(*(corners - middle).T[::-1])
    corners = corners[np.argsort(angles)]  # y points down: growing angles run clockwise
    return np.roll(corners, -int(corners.sum(axis=1).argmin()), axis=0)
