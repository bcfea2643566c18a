"""Sketch to stack (paper, "Block Stacking in the Real World"): from the photo of a hand drawing to a block list.

The sheet is found and seen straight on; the light on it is a smooth surface, fitted to its blank parts and divided
out; what is left is binarised and closed, outlines are filled in, and a median filter smooths. Then, as in the paper, a
box of 4 x 4 cells is put around the drawing, and each cell is full, empty or a triangle; runs of full cells are
covered with the longest blocks that fit.

Legend: H x W pixels, rows and columns of cells from the lower left.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.cells import Ints, in_cells
from stackgen.vision.drawings import Picture, read_picture, read_silhouette
from stackgen.vision.masks import bounding_box, smoothed, without_specks
from stackgen.world import Grid, Mask

Floats = NDArray[np.float64]

WORK_SIZE = 1000
"""Longer edge [pixel] that photos are brought to."""

FOCAL = 0.75
"""Focal length of a usual camera by the photo's longer edge: a telephone's, a webcam's or a RealSense's is near it."""

FOCALS = (0.6, 1.6)
"""Least and largest focal length that is believed, by the photo's longer edge."""

SHEET = 0.15
"""A sheet is at least this share of the photo; where none is found the whole photo is sheet."""

FAINTEST = 0.12
"""Ink takes away at least this share of the light."""

SPECK = 0.03
"""Parts under this share of the largest are dirt."""

ALIKE = 0.75
"""Least IoU with the stretched drawing for it to count as made of whole cells."""


@dataclass(frozen=True)
class Sketch:
    """The drawing that was found in a photo.

    Args:
        silhouette: (H, W) on the grid: that of the cells where the drawing is made of whole cells, else as drawn.
        drawn: (H, W) on the grid, as drawn.
        cells: (rows, columns) EMPTY, FULL or TRIANGLE, the first row on the ground; None where the drawing is not
            made of whole cells.
        block_list: (S,) block list guessed from the cells; None without cells, or with too many.
        sheet: (4, 2) corners of the sheet in the photo [pixel], from the upper left clockwise.
        photo: (h, w, 3) at `WORK_SIZE`.
        ink: (h', w') the drawing on the sheet, filled in.
    """

    silhouette: Mask
    drawn: Mask
    cells: Ints | None
    block_list: Ints | None
    sheet: Floats
    photo: Picture
    ink: Mask


def read_sketch(source: str | Path | Picture, grid: Grid) -> Sketch:
    """Read the drawing in a photo.

    Args:
        source: An image file, or (h, w, 3) uint8.
        grid: Scale and place of the silhouette.

    Raises:
        StackgenError: If there is no photo, nothing drawn, an outline that is open, or more than one drawing.
    """
    if not isinstance(source, str | Path):
        return _sketch(_scaled(np.asarray(source, dtype=np.uint8)), grid)
    picture = read_picture(source)
    try:
        return _sketch(_scaled(picture), grid)
    except StackgenError as error:
        raise StackgenError(f"{source}: {error}") from error


def _sketch(photo: Picture, grid: Grid) -> Sketch:
    """Take the steps one after the other."""
    sheet = find_sheet(photo)
    ink = one_drawing(filled_in(binarised(straightened(photo, sheet))))
    drawn = read_silhouette(ink, grid, exact=False)
    silhouette, cells, block_list = in_cells(drawn, ALIKE, grid)
    return Sketch(silhouette, drawn, cells, block_list, sheet, photo, ink)


def _scaled(picture: Picture) -> Picture:
    """Bring a photo to `WORK_SIZE`."""
    if min(picture.shape[:2]) < 64:
        raise StackgenError(f"the photo is only {picture.shape[1]} x {picture.shape[0]} pixels; take a larger one")
    factor = WORK_SIZE / max(picture.shape[:2])
    size = (round(picture.shape[1] * factor), round(picture.shape[0] * factor))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size, interpolation=how), dtype=np.uint8)


def find_sheet(photo: Picture) -> Floats:
    """Find the corners (4, 2) of the sheet of paper in a photo [pixel], from the upper left clockwise.

    A sheet is white, convex, and has four corners. In uneven light its dark end may be hardly brighter than a table in
    the sun: of several thresholds the one counts whose quadrangle has the clearest edges. Without a sheet the corners
    are the photo's own.
    """
    height, width = photo.shape[:2]
    white = cv2.medianBlur(photo.min(axis=2), 9)  # of a coloured table one channel is darker than of grey paper
    level, _ = cv2.threshold(white, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    found = [_four_corners(np.asarray(white > share * level, dtype=np.uint8)) for share in np.arange(1.0, 0.35, -0.08)]
    sheets = [_clockwise(corners) for corners in found if corners is not None]
    if not sheets:
        return np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    return max(sheets, key=lambda corners: _step(white, corners))


def _step(white: NDArray[np.uint8], corners: Floats) -> float:
    """Return by what share it becomes darker across the four edges of a clockwise quadrangle (4, 2), at least."""
    steps, off = [], 0.01 * max(white.shape)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        inwards = off * np.array([-along[1], along[0]])
        points = start + np.linspace(0.1, 0.9, 40)[:, None] * (end - start)
        inside, outside = (
            white[tuple(np.clip(np.round(p).astype(int)[:, ::-1], 0, np.array(white.shape) - 1).T)].astype(float)
            for p in (points + inwards, points - inwards)
        )
        steps.append(float(np.median((inside - outside) / np.maximum(inside, 1))))
    return min(steps)


def _four_corners(bright: NDArray[np.uint8]) -> Floats | None:
    """Find the corners (4, 2) of the largest bright part, if it is a quadrangle as large as a sheet."""
    bright = cv2.morphologyEx(bright, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8)).astype(np.uint8)
    contours, _ = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    hull = cv2.convexHull(contour)
    corners = cv2.approxPolyDP(hull, 0.03 * cv2.arcLength(hull, True), True)[:, 0].astype(np.float64)
    area = cv2.contourArea(hull)
    full = len(corners) == 4 and cv2.contourArea(corners.astype(np.float32)) > 0.93 * area
    large = SHEET * bright.size <= area <= 0.97 * bright.size and cv2.contourArea(contour) >= 0.85 * area
    return corners if full and large else None


def _clockwise(corners: Floats) -> Floats:
    """Order corners (4, 2) from the upper left clockwise, as they are seen in the photo."""
    middle = corners.mean(axis=0)
    angles = np.arctan2(*(corners - middle).T[::-1])
    corners = corners[np.argsort(angles)]  # y points down: growing angles run clockwise
    return np.roll(corners, -int(corners.sum(axis=1).argmin()), axis=0)


def straightened(photo: Picture, sheet: Floats) -> NDArray[np.uint8]:
    """Return the sheet as seen straight on, (h', w') grey, less a border where its edge might show."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    if np.allclose(sheet, [[0, 0], [grey.shape[1], 0], grey.shape[::-1], [0, grey.shape[0]]]):
        return np.asarray(grey, dtype=np.uint8)
    ratio = sheet_ratio(sheet - np.array(grey.shape[::-1]) / 2, max(grey.shape))
    width, height = (900, round(900 / ratio)) if ratio > 1 else (round(900 * ratio), 900)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    turn = cv2.getPerspectiveTransform(sheet.astype(np.float32), corners)
    straight = cv2.warpPerspective(grey, turn, (width, height))
    border = 22
    return np.asarray(straight[border:-border, border:-border], dtype=np.uint8)


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
    focal = np.clip(np.sqrt(square), *FOCALS) if square > 0 else FOCAL
    lengths = [np.hypot(np.linalg.norm(vector[:2]) / focal, vector[2]) for vector in (across, down)]
    return float(lengths[0] / lengths[1])


def binarised(grey: NDArray[np.uint8]) -> Mask:
    """Find where ink takes light away (H, W), by a threshold that follows the light.

    Raises:
        StackgenError: If the sheet is empty.
    """
    light = _light(grey.astype(np.float64))
    share = np.clip(grey / np.maximum(light, 1), 0, 1.2)  # of the light, that comes back
    ink = share < 1 - FAINTEST
    if np.count_nonzero(ink) < 3e-4 * ink.size or np.quantile(share, 0.001) > 1 - 1.4 * FAINTEST:
        raise StackgenError("nothing is drawn on the sheet; draw a structure with a dark pen, filled or in outline")
    middle = (float(np.median(share[ink])) + 1) / 2  # between ink and paper, in the middle of a blurred edge
    return np.asarray(share < min(middle, 1 - FAINTEST))


def _light(grey: Floats) -> Floats:
    """Estimate the light (H, W) on the blank sheet: a cubic surface, fitted again and again without what is darker."""
    height, width = grey.shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
    step = max(1, max(grey.shape) // 150)
    some, values = terms[::step, ::step].reshape(-1, terms.shape[-1]), grey[::step, ::step].ravel()
    blank = values > np.quantile(values, 0.35)
    for _ in range(8):
        surface = np.linalg.lstsq(some[blank], values[blank], rcond=None)[0]
        blank = values > 0.93 * (some @ surface)
    return np.asarray(terms @ surface)


def filled_in(ink: Mask) -> Mask:
    """Fill in the outlines of a drawing; what is filled already keeps its windows.

    An outline within an outline that it does not touch is a window's. A missing base line is drawn.

    Raises:
        StackgenError: If an outline is open.
    """
    size = max(ink.shape)
    ink = without_specks(ink, SPECK / 10)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (size // 160) + 1,) * 2)
    closed = cv2.morphologyEx(ink.astype(np.uint8), cv2.MORPH_CLOSE, kernel).astype(np.uint8)
    stroke = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (size // 45) + 1,) * 2)
    if np.count_nonzero(cv2.morphologyEx(closed, cv2.MORPH_OPEN, stroke)) > 0.4 * np.count_nonzero(closed):
        whole = closed  # filled
    else:
        whole = _inside(closed)
        if np.count_nonzero(whole) < 2 * np.count_nonzero(closed):
            rows, columns = np.nonzero(closed)
            base, thick = int(rows.max()), max(2, size // 200)
            feet = columns[rows > base - size // 40]
            cv2.line(closed, (int(feet.min()), base - thick), (int(feet.max()), base - thick), 1, thick)
            whole = _inside(closed)
        if np.count_nonzero(whole) < 2 * np.count_nonzero(closed):
            raise StackgenError("the outline of the drawing is open; close its gaps, or fill it in")
    return smoothed(whole > 0, 2 * (size // 130) + 1)


def _inside(ink: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Fill what the outermost outlines enclose, less what outlines within them do."""
    contours, tree = cv2.findContours(ink, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    parents = tree[0, :, 3]
    whole = np.zeros_like(ink)
    for value, wanted in ((1, 0), (0, 2)):
        for number, contour in enumerate(contours):
            depth, parent = 0, parents[number]
            while parent >= 0:
                depth, parent = depth + 1, parents[parent]
            if depth == wanted and cv2.contourArea(contour) > 1e-3 * ink.size:
                cv2.drawContours(whole, [contour], -1, value, cv2.FILLED)
    return whole if whole.any() else ink


def one_drawing(mask: Mask) -> Mask:
    """Remove dirt, and see that one drawing is left.

    Raises:
        StackgenError: If there are several, half a cell or more apart, or it runs off the sheet.
    """
    mask = without_specks(mask, SPECK)
    if not mask.any():
        raise StackgenError("nothing but specks is drawn on the sheet; draw a structure with a dark pen")
    rows, _ = bounding_box(mask)
    gap = max(3, (rows.stop - rows.start) // 8 // 2 * 2 + 1)
    number, _ = cv2.connectedComponents(cv2.dilate(mask.astype(np.uint8), np.ones((gap, gap), np.uint8)))
    if number > 2:
        raise StackgenError(f"{number - 1} drawings are on the sheet; cover or crop all but one")
    if mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any():
        raise StackgenError("the drawing runs off the sheet; leave some blank paper around it")
    return mask
