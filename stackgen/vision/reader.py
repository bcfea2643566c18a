"""The one reader of pictures: a drawing, the photo of a sketch or a depth frame becomes a figure.

A frame has one channel of more than 256 levels. A photo shows a sheet of paper, or light that changes from place to
place; everything else is a drawing. Nothing is tried a second time in another way: what is refused is refused.

Legend: H x W pixels of the picture, h x w of the figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.vision import depth, drawings, images
from stackgen.vision.depth import DepthFrame
from stackgen.vision.drawings import Look
from stackgen.vision.images import Image8, Picture
from stackgen.vision.ink.choice import choose
from stackgen.vision.ink.rules import without_rules
from stackgen.vision.masks import bounding_box, filling, place
from stackgen.vision.options import PictureKind, PictureOptions
from stackgen.vision.photos import is_drawn_on, read_page
from stackgen.vision.sheets import Sheet, find_sheet
from stackgen.vision.straight import straight_up
from stackgen.world import Grid, Mask

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["PictureKind", "PictureOptions", "Reading", "filling", "place", "read_picture", "read_silhouette"]

FIGURE = 512
"""Longer edge of a figure [pixel], about."""

LEAST_PHOTO = 64
"""Least edge of a photo [pixel]."""

_UNCLEAR = (
    "it seems to be the photo of a sheet whose edges are not clear;"
    " crop it to the paper, or lay the sheet on a table that is darker"
)

_LEFT_OUT = 0.05
"""Share of the structure from which on what was left out, or added, is worth telling."""

_CLEAR = 0.9
"""Share of each side along which a sheet is seen in a picture that otherwise is a drawing of two tones."""

_FULL = 0.85
"""Share of a picture from which on a structure that touches all its edges may be the ground."""

_ROOM = 0.25
"""What a structure of known size may be larger than the grid [cell]."""

_STRAY = 0.025
"""How far a hand strays from a straight side, by the size of the drawing."""

_GREEN = (20, 160, 60)
_RED = (214, 39, 40)


@dataclass(frozen=True)
class Reading:
    """What was read in a picture.

    Args:
        figure: (h, w) what was drawn or seen, upright, cut out to its box, of square pixels; the longer edge has about
            `FIGURE` of them.
        kind: What the picture was taken for.
        confidence: How sure the reader is, 0..1.
        overlay: (H, W, 3) uint8, the picture with the outline of what was read in red, and that of the sheet in green.
        notes: What was left out or is doubtful, a sentence each.
        cell: Edge of a cell in pixels of `figure` where it is known, else None.
        exact: (image_size, image_size) the silhouette itself where the picture already is one of the grid's, else None.
    """

    figure: Mask
    kind: PictureKind
    confidence: float
    overlay: Picture
    notes: tuple[str, ...] = ()
    cell: float | None = None
    exact: Mask | None = None

    def describe(self) -> str:
        """Name what the picture was taken for, and how sure the reader is.

        >>> Reading(np.ones((512, 128), bool), "photo", 0.9, np.zeros((60, 80, 3), np.uint8)).describe()
        'photo of a sketch (confidence 90%)'
        """
        kinds = {"drawing": "drawing", "photo": "photo of a sketch", "depth": "depth frame"}
        return f"{kinds[self.kind]} (confidence {self.confidence:.0%})"

    def height(self, grid: Grid) -> float:
        """Return the height [cell] that the figure has on a grid: its own where it is known, else that which fills it.

        Raises:
            StackgenError: If it is known, and larger than the grid.
        """
        if self.cell is None:
            return filling(self.figure, grid)
        height, width = (edge / self.cell for edge in self.figure.shape)
        if height > grid.height + _ROOM or width > grid.width + _ROOM:
            raise StackgenError(
                f"the structure is {width:.1f} x {height:.1f} cells, and the grid {grid.width} x {grid.height};"
                " leave out --cell_size and --cells to have it scaled down"
            )
        return height

    def silhouette(self, grid: Grid) -> Mask:
        """Return the silhouette (image_size, image_size), as high as it is on a grid, or as the picture has it."""
        if self.exact is not None and len(self.exact) == grid.image_size:
            return self.exact
        return place(self.figure, grid, self.height(grid))


def read_picture(
    source: str | Path | ArrayLike | Image | DepthFrame,
    grid: Grid,
    as_: PictureKind | None = None,
    which: int | None = None,
    *,
    depth_scale: float | None = None,
    focal: float | None = None,
    cell_size: float | None = None,
    colour: str | Path | None = None,
) -> Reading:
    """Read what a picture shows.

    Args:
        source: An image file or a depth frame (.npy or 16-bit PNG); an array (H, W) of grey, (H, W, 3 or 4) of uint8
            colours, or (H, W) bool with True where the structure is; a PIL image; or the frame of a camera.
        grid: Grid of the silhouettes; a picture that already is one of them is taken as it is.
        as_: What to take the picture for; None to tell.
        which: Number of the drawing, from the left, where there are several.
        depth_scale: Metres of a step of the values of a depth frame; None for 1 mm of whole numbers and 1 m of others.
        focal: Focal length of a depth frame [pixel]; None for that of a RealSense D435.
        cell_size: Edge of a cell [m], with which a depth frame tells the structure's scale.
        colour: Picture of the same pixels as a depth frame, for the overlay.

    Raises:
        StackgenError: If the picture cannot be read, nothing is seen in it, or a number makes no sense.
    """
    if as_ is not None and as_ not in get_args(PictureKind):
        raise StackgenError(f"a picture is a {', a '.join(get_args(PictureKind))} frame, got {as_!r}")
    if cell_size is not None and not 0 < cell_size < np.inf:
        raise StackgenError(f"--cell_size must be positive, the edge of a cell in metres, got {cell_size:g}")
    if isinstance(source, DepthFrame):
        return _of_frame(source, True, cell_size)
    try:
        raster = images.load(source)
        if as_ == "depth" or (as_ is None and (depth_scale is not None or depth.is_frame(raster))):
            beside = None if colour is None else read_colours(colour)
            frame = depth.as_frame(raster, depth_scale, focal, beside)
            return _of_frame(frame, depth_scale is not None, cell_size)
        image = raster if isinstance(raster, Image8) else images.as_picture(raster)
        look = drawings.look_at(image)
        drawn = image.alpha is not None or look.sheetless or min(image.colours.shape[:2]) < LEAST_PHOTO
        seen = sheet = None if as_ == "drawing" or drawn else find_sheet(image.colours)
        if sheet is not None and (look.two_tone or sheet.seen < 4):
            clear = (sheet.sureness > _CLEAR and sheet.seen > 2) or not look.two_tone  # a light structure has gaps
            if not clear or not is_drawn_on(image.colours, sheet):
                sheet = None  # the ground between two strokes, or within a doorway, is no sheet
        if as_ == "photo" or (as_ is None and not drawn and (sheet is not None or not look.drawn)):
            return _of_photo(image, sheet, which, look.even, insisted=as_ is not None)
        reading = _of_drawing(image, grid, which, look, insisted=as_ is not None)
        if reading is None and seen is None:
            raise StackgenError(_UNCLEAR)
        return reading or _of_photo(image, seen, which, look.even, insisted=False)
    except StackgenError as error:
        raise StackgenError(f"{images.name_of(source)}: {error}") from error


def read_silhouette(source: str | Path | ArrayLike | Image, grid: Grid) -> Mask:
    """Read the front silhouette (H, W) from a picture, scaled until it fills the grid.

    A picture that already is a silhouette of this grid is taken as it is.

    Raises:
        StackgenError: If the picture cannot be read, or nothing is seen in it.

    >>> tower = np.zeros((100, 80), bool)
    >>> tower[20:60, 10:20] = True  # four times as high as wide
    >>> placed = read_silhouette(tower, Grid())
    >>> placed.shape, int(placed.sum()), int(placed[59].sum())
    ((64, 64), 784, 14)
    """
    return read_picture(source, grid).silhouette(grid)


def read_colours(path: str | Path) -> Picture:
    """Read a colour picture (H, W, 3), upright, at its full size.

    Raises:
        StackgenError: If the file is no picture.
    """
    try:
        raster = images.load(path)
        return (raster if isinstance(raster, Image8) else images.as_picture(raster)).colours
    except StackgenError as error:
        raise StackgenError(f"{path}: {error}") from error


def _of_drawing(image: Image8, grid: Grid, which: int | None, look: Look, insisted: bool) -> Reading | None:
    """Read a drawing on an even ground; None where what is found in it is a sheet that is drawn on itself."""
    drawn = drawings.find_drawn(image, look)
    ink, _ = without_rules(drawn.ink, drawn.darkness)
    found = choose(ink, which, spread=True, framed=not look.flat)
    if not insisted and not found.stroke and drawn.drawn_on(found.mask):
        return None
    notes = drawn.notes
    if found.mask.mean() > _FULL and found.mask[bounding_box(found.mask)].shape == found.mask.shape:
        notes = (
            *notes,
            "The structure fills nearly the whole picture, so what is ground is uncertain.",
        )
    sure = found.sureness * (0.8 if notes else 1.0)
    to_picture = np.array([[1 / drawn.scale, 0, drawn.place[0]], [0, 1 / drawn.scale, drawn.place[1]], [0, 0, 1]])
    overlay = _outlined(image.colours, found.mask, to_picture)
    exact = drawings.as_it_is(image, grid)
    return Reading(_figure(found.mask), "drawing", sure, overlay, (*notes, *found.notes), exact=exact)


def _of_photo(image: Image8, sheet: Sheet | None, which: int | None, even: bool, insisted: bool) -> Reading:
    """Read the photo of a sketch; on even ground what is found is no sheet, and may be cropped to its edges."""
    if min(image.colours.shape[:2]) < LEAST_PHOTO:
        height, width = image.colours.shape[:2]
        raise StackgenError(f"the photo is only {width} x {height} pixels; take a larger one")
    page = read_page(image.colours, sheet)
    found = choose(page.ink, which, spread=sheet is None and even and not insisted, beyond=page.beyond)
    if sheet is None and not even and cv2.contourArea(_hull(found.mask)) > 0.55 * found.mask.size:
        raise StackgenError(_UNCLEAR)
    notes = page.notes
    if sheet is None:
        notes = (*notes, "No sheet's edges are seen, so proportions are uncertain.")
    elif sheet.seen < 3:
        notes = (*notes, "Only two sides of the sheet are seen, so proportions are uncertain.")
    elif sheet.slanted:
        notes = (*notes, "The sheet is seen at a slant, so proportions are uncertain.")
    sure = found.sureness * (0.8 if sheet is None else sheet.sureness) * min(1.0, 0.5 + page.contrast)
    overlay = _outlined(image.colours, found.mask, np.asarray(np.linalg.inv(page.turn)))
    upright = found.mask if sheet is not None and sheet.seen > 2 else straight_up(found.mask)
    if sheet is not None:
        _polygon(overlay, sheet.corners, _GREEN)
    return Reading(_figure(upright, by_hand=True), "photo", sure, overlay, (*notes, *found.notes))


def _of_frame(frame: DepthFrame, scale_is_known: bool, cell_size: float | None) -> Reading:
    """Find the structure in a depth frame."""
    found = depth.find_structure(frame)
    doubt = None if scale_is_known else depth.doubted_size(found)
    if doubt:
        raise StackgenError(doubt)
    width, height = found.size
    notes = [f"The structure is {1e3 * width:.0f} mm wide and {1e3 * height:.0f} mm high."]
    if found.left_out > _LEFT_OUT:
        notes.append(f"What stands beside it and touches it nowhere was left out, {found.left_out:.0%} of its size.")
    if found.failing > _LEFT_OUT:
        notes.append(f"Depth fails on {found.failing:.0%} of it, which was taken to belong to it.")
    shown = frame.shown()
    shown[found.seen] = (0.55 * shown[found.seen] + 0.45 * np.array(_RED)).astype(np.uint8)
    _polygon(shown, found.outline, _GREEN)
    figure = _figure(found.front)
    cell = None if cell_size is None else cell_size / height * len(figure)
    sure = float(np.clip(1 - found.left_out - found.failing, 0.2, 1))
    return Reading(figure, "depth", sure, shown, tuple(notes), cell)


def _hull(mask: Mask) -> NDArray[np.int32]:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(cv2.convexHull(np.concatenate(contours)), np.int32)


def _figure(mask: Mask, by_hand: bool = False) -> Mask:
    """Cut a mask (H, W) out to its box, or to that of its sides where it was drawn by hand, at `FIGURE` pixels."""
    cut = mask[bounding_box(mask)]
    if by_hand:
        top, right, bottom, left = (_side(np.rot90(cut, turns)) for turns in range(4))
        cut = cut[top : len(cut) - bottom, left : cut.shape[1] - right]
    scale = FIGURE / max(cut.shape)
    size = (max(1, round(cut.shape[1] * scale)), max(1, round(cut.shape[0] * scale)))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    figure = cv2.resize(cut.astype(np.float32), size, interpolation=how) >= 0.5
    return np.asarray(figure[bounding_box(figure)])


def _side(mask: Mask) -> int:
    """Return how far (rows) the middle of the uppermost side of a mask (H, W) lies below its highest point.

    A side that was drawn by hand strays, and its highest point would tell the scale of all. A tip has no side.
    """
    reach = round(_STRAY * max(mask.shape))
    tops = np.where(mask.any(axis=0), mask.argmax(axis=0), len(mask))
    near = tops[tops <= reach]
    return int(np.median(near)) if len(near) > 4 * reach else 0


def _outlined(picture: Picture, mask: Mask, to_picture: NDArray[np.float64]) -> Picture:
    """Draw the outline of a mask into a picture, mapped by a (3, 3) homography."""
    shown = picture.copy()
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        there = cv2.perspectiveTransform(contour.astype(np.float64) + 0.5, to_picture)
        _polygon(shown, np.asarray(there, np.float64)[:, 0], _RED)
    return shown


def _polygon(picture: Picture, corners: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    thick = max(1, max(picture.shape) // 300)
    cv2.polylines(picture, [np.round(corners - 0.5).astype(np.int32)], True, colour, thick)
