"""Pictures of stacks for people: drawn with numpy alone, no window, no graphics driver.

Every visible face of a prism is a convex polygon on the screen, filled where it is nearest;
outlines run where neighbouring pixels show different faces.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices
from stackgen.io.files import write_atomically
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.raster import Camera, borders, fill, fill_nearest, hull, prism_faces
from stackgen.world import PAPER_GRID, Grid, Mask

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
    """The colour of the catalogue's shape `index`."""
    return SHAPE_COLOURS[index % len(SHAPE_COLOURS)]


def render_stack(
    stack: Stack,
    size: tuple[int, int] = (640, 480),
    fallen: ArrayLike | None = None,
    azimuth: float = 0.38,
    elevation: float = 0.26,
    grid: Grid = PAPER_GRID,
    supersample: int = 2,
) -> Picture:
    """A three-quarter view (H, W, 3) of a stack on the ground.

    The camera always shows the whole design grid and all blocks, so stacks within the grid appear at
    one scale.

    Args:
        stack: What to draw; blocks may float or overlap.
        size: (width, height) [pixel].
        fallen: (k,) blocks to outline in red.
        azimuth: Angle of the camera to the right of the front [rad].
        elevation: Angle of the camera above the ground [rad].
        grid: Whose extent is always in view.
        supersample: Drawn so many times larger, then averaged: smooth edges.

    >>> picture = render_stack(Stack([0], [[0, 0, 0.5, 0, 0, 0]]), size=(160, 120))
    >>> picture.shape, picture.dtype
    ((120, 160, 3), dtype('uint8'))
    """
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
    faces = _draw_faces(stack, blocks, camera, large)
    shown = faces.seen > 0
    canvas[shown] = faces.colours[faces.seen[shown]]
    _draw_outlines(canvas, faces, marked, supersample)
    shape = (size[1], supersample, size[0], supersample, 3)
    return np.round(canvas.reshape(shape).mean(axis=(1, 3))).astype(np.uint8)


def _ground(size: tuple[int, int], camera: Camera, blocks: Sequence[Floats]) -> NDArray[np.float32]:
    """The empty picture: ground that fades into the sky, with the blocks' soft shadows on it."""
    from PIL import Image, ImageFilter

    width, height = size
    fade = np.clip((np.arange(height) / height - 0.45) / 0.5, 0, 1)[:, None, None]
    shadow = np.zeros((height, width), dtype=bool)
    for corners in blocks:
        above = np.maximum(corners[:, 2:], 0)
        fill(shadow, hull(camera.project((corners - above * _LIGHT / _LIGHT[2]) * [1, 1, 0])[0]))
    step = 4  # a blurred shadow needs no detail
    small = Image.fromarray(shadow[::step, ::step].astype(np.uint8) * 255)
    soft = small.filter(ImageFilter.GaussianBlur(width / 130 / step)).resize(size, Image.Resampling.BILINEAR)
    dark = 1 - 0.30 * np.asarray(soft, dtype=np.float32)[..., None] / 255
    return ((_SKY + (_GROUND - _SKY) * fade).astype(np.float32) * dark).astype(np.float32)


@dataclass(frozen=True)
class _Faces:
    """What the picture shows.

    Args:
        seen: (H, W) number of the face at each pixel, 0 for none.
        colours: (faces, 3) of each face; of number 0, anything.
        blocks: (faces,) the block each belongs to; -1 for number 0.
    """

    seen: NDArray[np.int32]
    colours: NDArray[np.float32]
    blocks: NDArray[np.int64]


def _draw_faces(stack: Stack, blocks: Sequence[Floats], camera: Camera, size: tuple[int, int]) -> _Faces:
    """Fill every face turned to the camera where it is the nearest."""
    seen = np.zeros((size[1], size[0]), dtype=np.int32)
    nearest = np.zeros((size[1], size[0]), dtype=np.float32)
    colours, owners = [np.zeros(3)], [-1]
    for block, (index, corners) in enumerate(zip(stack.shapes, blocks, strict=True)):
        base = np.array(shape_colour(index), dtype=np.float64)
        for face in prism_faces(stack.catalogue[index]):
            polygon = corners[face]
            normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
            if (camera.eye - polygon[0]) @ normal <= 0:
                continue
            pixels, nearness = camera.project(polygon)
            fill_nearest(seen, nearest, len(colours), pixels, nearness)
            colours.append(_shade(base, normal / np.linalg.norm(normal)))
            owners.append(block)
    return _Faces(seen, np.array(colours, dtype=np.float32), np.array(owners))


def _shade(base: Floats, normal: Floats) -> Floats:
    """A face's colour in soft light: what points to the light is bright, what points up sees the sky."""
    light = 0.68 + 0.34 * max(0.0, float(normal @ _LIGHT)) + 0.14 * max(0.0, normal[2])
    return np.clip(base * light + 255 * 0.22 * max(0.0, light - 0.8), 0, 255)


def _draw_outlines(canvas: NDArray[np.float32], faces: _Faces, fallen: NDArray[np.bool_], supersample: int) -> None:
    """Darken the edges between faces, more between blocks, and draw fallen blocks' outlines thick and red."""
    blocks = faces.blocks[faces.seen]
    canvas[borders(faces.seen, 0)] *= 0.72
    thin = borders(blocks, supersample // 2)
    canvas[thin] = canvas[thin] * 0.25 + np.array(_LINE, dtype=np.float32) * 0.75
    if fallen.any():
        is_fallen = np.append(fallen, False)[blocks]  # block -1, nothing, did not fall
        canvas[borders(np.where(is_fallen, blocks, -1), supersample + supersample // 2)] = FALLEN


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
    grid: Grid = PAPER_GRID,
) -> Picture:
    """One picture (H, W, 3) of what was asked for and of every stack as it was sampled, with its verdict.

    Blocks are numbered from 0, as in `stacks.json`; those that fell are outlined in red.

    Args:
        target: Silhouette asked for, shown at the left; None leaves it out.
        stacks: Shown in this order, four pictures a row.
        verdicts: One for each stack, where there is one.
        ious: Front IoU of each stack, where there is one.
        title: Headline; none if empty.
        grid: Of the target and the stacks.
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


def _target_picture(target: Mask) -> Picture:
    """The silhouette, dark on light, each pixel a square."""
    from PIL import Image

    mask = np.asarray(target, dtype=bool)
    colours = np.where(mask[..., None], _LINE, _SKY).astype(np.uint8)
    return np.asarray(Image.fromarray(colours).resize((_PANEL, _PANEL), Image.Resampling.NEAREST))


def _caption(number: int, stack: Stack, verdict: Verdict | None, score: float | None) -> list[tuple[str, Colour]]:
    """The two lines under a stack: what became of it, and how well it matches."""
    match = "" if score is None else f"front IoU {score:.2f}"
    if verdict is None:
        return [(f"{number}", _LINE), (match, _MUTED)]
    if verdict.stable:
        return [(f"{number}: stands", _GOOD), (match, _MUTED)]
    fallen = np.flatnonzero(verdict.fell)
    worst = int(fallen[np.argmax(verdict.drop[fallen])]) if len(fallen) else 0
    which = f"block {worst} ({stack.names[worst].replace('_', ' ')}) fell {verdict.drop[worst]:.1f} cells"
    more = f", {len(fallen) - 1} more" if len(fallen) > 1 else ""
    return [(f"{number}: falls" + (f"   {match}" if match else ""), FALLEN), (which + more, _MUTED)]


def _write(pen: ImageDraw, place: tuple[int, int], text: str, size: int, colour: Colour, width: int) -> None:
    """Text in Pillow's own font, shortened to `width` [pixel]."""
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
        StackgenError: If the suffix is another, or the file cannot be written.
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
