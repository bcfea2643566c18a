"""Drawings of the page: packed bits to masks, and masks to the picture that `stackgen sample` reads alike.

Legend: n x n pixels of a drawing, its lowest row on the ground.
"""

from __future__ import annotations

import base64
import binascii
import io

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.studio.requests import CELL, Drawing
from stackgen.vision.drawings import fits
from stackgen.vision.masks import bounding_box
from stackgen.vision.reader import Reading, read_picture
from stackgen.world import PAPER_GRID, Grid, Mask, View

Picture = NDArray[np.uint8]

EMPTY = "nothing is drawn yet: draw a structure, or choose one of the examples"


def mask_of(drawing: Drawing) -> Mask:
    """Unpack a drawing, and let it down to the ground.

    Raises:
        StackgenError: If the bits are not as many as the cells take, or nothing is drawn.
    """
    mask = unpack(drawing.bits, drawing.cells * CELL)
    if not mask.any():
        raise StackgenError(EMPTY)
    below = int(mask[::-1].any(axis=1).argmax())
    return np.roll(mask, below, axis=0)


def pack(mask: Mask) -> str:
    """Pack a mask (n, n) as the page does.

    >>> mask = np.eye(56, dtype=bool)
    >>> bool((unpack(pack(mask), 56) == mask).all())
    True
    """
    return base64.b64encode(np.packbits(mask, axis=1).tobytes()).decode("ascii")


def unpack(bits: str, size: int) -> Mask:
    """Inverse of :func:`pack`.

    Raises:
        StackgenError: If they are not the bits of such a mask.
    """
    wanted = size * -(-size // 8)
    try:
        content = base64.b64decode(bits, validate=True)
    except (binascii.Error, ValueError):
        raise StackgenError("drawing.bits is not base64") from None
    if len(content) != wanted:
        raise StackgenError(f"drawing.bits holds {len(content)} bytes, but {size} x {size} pixels take {wanted}")
    rows = np.frombuffer(content, dtype=np.uint8).reshape(size, -1)
    return np.unpackbits(rows, axis=1, count=size).astype(bool)


def picture_of(mask: Mask) -> Picture:
    """Draw a mask (n, n) black on white, as it is downloaded and read.

    What fits the paper's grid becomes one of its silhouettes, pixel by pixel.
    """
    figure = mask[bounding_box(mask)]
    size, per_cell = PAPER_GRID.image_size, int(PAPER_GRID.pixels_per_cell)
    room = size - 2 * int(PAPER_GRID.ground_margin)
    if max(figure.shape) > room:
        return np.where(np.pad(figure, per_cell), 0, 255).astype(np.uint8)
    canvas = np.zeros((size, size), dtype=bool)
    columns = np.flatnonzero(mask.any(axis=0))
    left = columns[0] + (size - len(mask)) // 2  # where it was drawn, or in the middle of a smaller picture
    left = int(np.clip(left, size - room - (size - room) // 2, size - (size - room) // 2 - figure.shape[1]))
    bottom = size - int(PAPER_GRID.ground_margin)
    canvas[bottom - len(figure) : bottom, left : left + figure.shape[1]] = figure
    return np.where(canvas, 0, 255).astype(np.uint8)


def reading_of(picture: Picture) -> Reading:
    """Read the picture of a drawing; one of the grid's silhouettes is at once what reading it would say."""
    mask = picture == 0
    if len(mask) != PAPER_GRID.image_size or not fits(mask, PAPER_GRID):
        return read_picture(picture, PAPER_GRID)
    return Reading(mask[bounding_box(mask)], "drawing", 1.0, np.repeat(picture[..., None], 3, axis=2), exact=mask)


def png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(picture).save(content, "PNG")
    return content.getvalue()


def cells_high(mask: Mask) -> int:
    """Height of a drawing in whole cells, at least 1."""
    return max(1, round(len(mask[bounding_box(mask)]) / CELL))


def views(stack: Stack, target: Mask, grid: Grid) -> dict[View, dict[str, object]]:
    """Compare a stack (as it stands) with a drawing from three sides.

    From the side and from above, what was asked for is the drawing as a slice of the depth of the stack's blocks.

    Returns:
        For each view the packed silhouettes of target and stack (H, W), and their IoU.
    """
    depth = max((stack.catalogue[int(shape)].depth for shape in stack.shapes), default=1.0)
    across = np.abs(grid.horizontal()) <= depth / 2
    deep = np.abs(grid.vertical("top")) <= depth / 2
    targets: dict[View, Mask] = {
        "front": target,
        "side": np.outer(target.any(axis=1), across),
        "top": np.outer(deep, target.any(axis=0)),
    }
    answer: dict[View, dict[str, object]] = {}
    for view, wanted in targets.items():
        seen = silhouette(stack, grid, view)
        answer[view] = {"target": pack(wanted), "stack": pack(seen), "iou": round(iou(seen, wanted), 4)}
    return answer
