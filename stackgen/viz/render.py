"""Pictures of stacks for people, drawn without a window or a graphics driver.

Every visible face of a prism is a convex polygon on the screen, filled where it is nearest;
outlines run where neighbouring pixels show different faces.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices
from stackgen.io.files import write_atomically
from stackgen.io.stacks_file import MATCHES
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.raster import Camera, borders, fill_nearest
from stackgen.world import Grid, Mask

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

SHAPE_COLOURS: tuple[Colour, ...] = (
    (84, 148, 218),  # cube: blue
    (240, 178, 62),  # rectangle: amber
    (96, 178, 128),  # long rectangle: green
    (170, 122, 200),  # triangle: violet
    (72, 184, 190),
    (206, 132, 92),
    (150, 158, 72),
    (222, 134, 176),
)
"""Colour of each shape by its index in the catalogue; they repeat after the last. Red is kept for what fell."""

FALLEN: Colour = (214, 39, 40)

_SKY = np.array([250.0, 250.0, 252.0])
_GROUND = np.array([226.0, 228.0, 233.0])
_LIGHT = np.array([-0.42, -0.62, 1.0]) / np.linalg.norm([-0.42, -0.62, 1.0])  # towards the light: left, front, above
_LINE: Colour = (44, 48, 58)
_FAR = 100.0  # [cell] blocks further out are drawn at this distance


def shape_colour(index: int) -> Colour:
    """Return the colour of the catalogue's shape `index`."""
    return SHAPE_COLOURS[index % len(SHAPE_COLOURS)]


def render_stack(
    stack: Stack,
    size: tuple[int, int] = (640, 480),
    fallen: ArrayLike | None = None,
    azimuth: float = 0.38,
    elevation: float = 0.26,
    *,
    grid: Grid,
    supersample: int = 2,
) -> Picture:
    """Draw a three-quarter view (H, W, 3) of a stack on the ground.

    The camera always shows the whole design grid and all blocks, so stacks within the grid appear at
    one scale.

    Args:
        stack: The stack; its blocks may float or overlap.
        size: (width, height) [pixel].
        fallen: (k,) blocks to outline in red.
        azimuth: Angle of the camera to the right of the front [rad].
        elevation: Angle of the camera above the ground [rad].
        grid: Design grid, whose extent is always in view.
        supersample: Factor by which the picture is drawn larger before it is averaged, for smooth edges.

    Raises:
        StackgenError: If `fallen` is not one value for each block.

    >>> picture = render_stack(Stack([0], [[0, 0, 0.5, 0, 0, 0]]), size=(160, 120), grid=Grid())
    >>> picture.shape, picture.dtype
    ((120, 160, 3), dtype('uint8'))
    """
    import cv2

    marked = np.zeros(len(stack), dtype=bool) if fallen is None else np.asarray(fallen, dtype=bool)
    if marked.shape != (len(stack),):
        raise StackgenError(f"fallen must say yes or no for each of {len(stack)} blocks, got shape {marked.shape}")
    poses = stack.poses.copy()
    poses[:, :3] = np.clip(poses[:, :3], -_FAR, _FAR)
    blocks = block_vertices(stack.with_poses(poses))
    w, h = grid.width / 2, float(grid.height)
    room = np.array([[x, y, z] for x in (-w, w) for y in (-0.5, 0.5) for z in (0.0, h)])
    large = (size[0] * supersample, size[1] * supersample)
    camera = Camera.looking_at(np.concatenate([room, *blocks]), large, azimuth, elevation, border=0.06)
    canvas = _ground(large, camera, blocks)
    faces = draw_faces(stack, blocks, camera, np.zeros(canvas.shape[:2], dtype=np.float32), _shade)
    shown = faces.seen > 0
    canvas[shown] = faces.colours[faces.seen[shown]]
    _draw_outlines(canvas, faces, marked, supersample)
    return np.round(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def _ground(size: tuple[int, int], camera: Camera, blocks: Sequence[Floats]) -> NDArray[np.float32]:
    """Draw the empty picture: ground that fades into the sky, with the blocks' soft shadows on it."""
    import cv2

    width, height = size
    fade = np.clip((np.arange(height) / height - 0.45) / 0.5, 0, 1)[:, None, None]
    step = 4  # a blurred shadow needs no detail
    shadow = np.zeros((height // step, width // step), dtype=np.uint8)
    for corners in blocks:
        above = np.maximum(corners[:, 2:], 0)
        pixels, _ = camera.project((corners - above * _LIGHT / _LIGHT[2]) * [1, 1, 0])
        cv2.fillConvexPoly(shadow, cv2.convexHull(np.round(pixels / step - 0.5).astype(np.int32)), 255)
    soft = cv2.resize(cv2.GaussianBlur(shadow, (0, 0), width / 130 / step), size).astype(np.float32)
    dark = 1 - 0.30 * soft[..., None] / 255
    return ((_SKY + (_GROUND - _SKY) * fade).astype(np.float32) * dark).astype(np.float32)


@dataclass(frozen=True)
class Faces:
    """The faces that a picture shows.

    Args:
        seen: (H, W) number of the face at each pixel, 0 for none.
        colours: (faces, 3) colour of each face; that of number 0 has no meaning.
        blocks: (faces,) the block each face belongs to; -1 for number 0.
    """

    seen: NDArray[np.int32]
    colours: NDArray[np.float32]
    blocks: NDArray[np.int64]


def draw_faces(
    stack: Stack,
    blocks: Sequence[Floats],
    camera: Camera,
    nearest: NDArray[np.float32],
    shade: Callable[[Floats, Floats], Floats],
) -> Faces:
    """Fill every face that is turned to the camera where it is the nearest.

    Args:
        stack: Gives the blocks' shapes.
        blocks: Corners (V, 3) of each block in the world [cell].
        camera: The camera.
        nearest: (H, W) nearness of what is seen already [1/cell]; that of the faces is written into it.
        shade: Colour (3,) of a face from the colour of its shape and its outward unit normal, (3,) each.
    """
    seen = np.zeros(nearest.shape, dtype=np.int32)
    colours, owners = [np.zeros(3)], [-1]
    for block, (index, corners) in enumerate(zip(stack.shapes, blocks, strict=True)):
        base = np.array(shape_colour(index), dtype=np.float64)
        for face in stack.catalogue[index].faces:
            polygon = corners[face]
            normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
            if (camera.eye - polygon[0]) @ normal > 0:
                fill_nearest(seen, nearest, len(colours), *camera.project(polygon))
                colours.append(shade(base, normal / np.linalg.norm(normal)))
                owners.append(block)
    return Faces(seen, np.array(colours, dtype=np.float32), np.array(owners))


def _shade(base: Floats, normal: Floats) -> Floats:
    """Shade a face in soft light: what points to the light is bright, what points up sees the sky."""
    light = 0.68 + 0.34 * max(0.0, float(normal @ _LIGHT)) + 0.14 * max(0.0, normal[2])
    return np.clip(base * light + 255 * 0.22 * max(0.0, light - 0.8), 0, 255)


def _draw_outlines(canvas: NDArray[np.float32], faces: Faces, fallen: NDArray[np.bool_], supersample: int) -> None:
    """Darken the edges between faces, more between blocks, and draw fallen blocks' outlines thick and red."""
    blocks = faces.blocks[faces.seen]
    canvas[borders(faces.seen)] *= 0.72
    thin = _thick(borders(blocks), supersample // 2)
    canvas[thin] = canvas[thin] * 0.25 + np.array(_LINE, dtype=np.float32) * 0.75
    if fallen.any():
        is_fallen = np.append(fallen, False)[blocks]  # block -1, nothing, did not fall
        canvas[_thick(borders(np.where(is_fallen, blocks, -1)), supersample + supersample // 2)] = FALLEN


def _thick(line: NDArray[np.bool_], grow: int) -> NDArray[np.bool_]:
    """Add all pixels within `grow` pixels of a line (H, W)."""
    import cv2

    return np.asarray(cv2.dilate(line.view(np.uint8), np.ones((2 * grow + 1,) * 2, np.uint8)), dtype=bool)


_PANEL = 300  # [pixel] edge of each picture of a contact sheet
_CAPTION = 62  # [pixel] height of the text under it
_GAP = 12  # [pixel]
_PER_ROW = 4
_GOOD: Colour = (30, 130, 76)
_MUTED: Colour = (96, 100, 110)


def contact_sheet(
    target: Mask | None,
    stacks: Sequence[Stack],
    verdicts: Sequence[Verdict | None] | None = None,
    ious: Sequence[float | None] | None = None,
    title: str = "",
    *,
    grid: Grid,
) -> Picture:
    """Draw the target and every stack as it was sampled, with its verdict, in one picture (H, W, 3).

    Blocks are numbered from 0, as in `stacks.json`; those that fell are outlined in red.

    Args:
        target: Silhouette asked for, shown at the left; None leaves it out.
        stacks: The stacks, shown in this order, four pictures a row.
        verdicts: Verdict on each stack, or None.
        ious: Front IoU of each stack, or None.
        title: Headline; none if empty.
        grid: Design grid of the stacks.

    Raises:
        StackgenError: If there are not as many verdicts or IoUs as stacks.
    """
    from PIL import Image, ImageDraw

    all_verdicts = verdicts or [None] * len(stacks)
    all_ious = ious or [None] * len(stacks)
    if not len(stacks) == len(all_verdicts) == len(all_ious):
        raise StackgenError(
            f"{len(stacks)} stacks need as many verdicts and IoUs, not {len(all_verdicts)}, {len(all_ious)}"
        )
    panels = [] if target is None else [(_target_picture(target), [("target", _LINE)])]
    for number, (stack, verdict, score) in enumerate(zip(stacks, all_verdicts, all_ious, strict=True), 1):
        picture = render_stack(stack, (_PANEL, _PANEL), None if verdict is None else verdict.fell, grid=grid)
        panels.append((picture, _caption(number, stack, verdict, score)))
    columns, rows = min(len(panels), _PER_ROW), math.ceil(len(panels) / _PER_ROW)
    head = 44 if title else 0
    size = (_GAP + columns * (_PANEL + _GAP), _GAP + head + rows * (_PANEL + _CAPTION + _GAP))
    sheet = Image.new("RGB", size, (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    _write(pen, (_GAP, _GAP), title, 24, _LINE, size[0] - 2 * _GAP)
    for place, (picture, lines) in enumerate(panels):
        x = _GAP + place % _PER_ROW * (_PANEL + _GAP)
        y = _GAP + head + place // _PER_ROW * (_PANEL + _CAPTION + _GAP)
        sheet.paste(Image.fromarray(picture), (x, y))
        pen.rectangle((x, y, x + _PANEL - 1, y + _PANEL - 1), outline=(206, 208, 214))
        for line, (text, colour) in enumerate(lines):
            _write(pen, (x + 2, y + _PANEL + 6 + 27 * line), text, 20 if line == 0 else 17, colour, _PANEL - 4)
    return np.asarray(sheet)


def overview(sheets: Sequence[Picture], across: int = 2) -> Picture:
    """Put contact sheets (H, W, 3) beside and below each other, at half their size, `across` a row."""
    import cv2

    small = [cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for sheet in sheets]
    height, width = (max(sheet.shape[axis] for sheet in small) for axis in (0, 1))
    canvas = np.full((math.ceil(len(small) / across) * height, min(across, len(small)) * width, 3), 255, np.uint8)
    for place, sheet in enumerate(small):
        y, x = place // across * height, place % across * width
        canvas[y : y + sheet.shape[0], x : x + sheet.shape[1]] = sheet
    return canvas


def _target_picture(target: Mask) -> Picture:
    """Draw the silhouette dark on light, each pixel a square."""
    from PIL import Image

    mask = np.asarray(target, dtype=bool)
    colours = np.where(mask[..., None], _LINE, _SKY).astype(np.uint8)
    return np.asarray(Image.fromarray(colours).resize((_PANEL, _PANEL), Image.Resampling.NEAREST))


def _caption(number: int, stack: Stack, verdict: Verdict | None, score: float | None) -> list[tuple[str, Colour]]:
    """Write the two lines under a stack: its verdict, and how well it matches."""
    match = "" if score is None else f"front IoU {score:.2f}"
    if verdict is None:
        return [(f"{number}", _LINE), (match, _MUTED)]
    if verdict.stable:
        told = "" if score is None else ", matches" if score >= MATCHES else ", does not match"
        return [(f"{number}: stands", _GOOD), (match + told, _MUTED)]
    fallen = np.flatnonzero(verdict.fell)
    worst = int(fallen[np.argmax(verdict.drop[fallen])]) if len(fallen) else 0
    which = f"block {worst} ({stack.names[worst].replace('_', ' ')}) fell {verdict.drop[worst]:.1f} cells"
    more = f", {len(fallen) - 1} more" if len(fallen) > 1 else ""
    return [(f"{number}: falls" + (f"   {match}" if match else ""), FALLEN), (which + more, _MUTED)]


def _write(pen: ImageDraw, place: tuple[int, int], text: str, size: int, colour: Colour, width: int) -> None:
    """Write text in Pillow's own font, shortened to `width` [pixel]."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    shown = text = "".join(c if c.isprintable() else " " for c in text)
    while shown and pen.textlength(shown, font) > width:
        text = text[:-1]
        shown = text + "..." if text else ""
    pen.text(place, shown, fill=colour, font=font)


def save_image(path: str | Path, picture: ArrayLike) -> None:
    """Write a picture (H, W, 3) uint8, or a mask (H, W) bool, as PNG or JPEG by the suffix of `path`.

    Raises:
        StackgenError: If the suffix is another one, or the file cannot be written.
    """
    from PIL import Image

    formats = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
    kind = formats.get(Path(path).suffix.lower())
    if kind is None:
        raise StackgenError(f"{path}: pictures are written as {', '.join(formats)}; change the file's suffix")
    array = np.asarray(picture)
    data = io.BytesIO()
    Image.fromarray(array.astype(np.uint8) * 255 if array.dtype == bool else array).save(data, kind)
    write_atomically(path, data.getvalue())
