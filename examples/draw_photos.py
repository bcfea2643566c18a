"""Draws the photos of examples/photos: `python examples/draw_photos.py [FOLDER]`.

They show sheets of paper with a drawing, lying on a table, as if photographed by hand: askew, in uneven light, a
little blurred and grainy. Beside them are frames of a simulated depth camera before a stack on a table.
`benchmarks/reading.py` draws hundreds of such photos, with shadows, ruled paper and crayons.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import block_vertices
from stackgen.stack import Stack
from stackgen.vision.cameras import Rig, simulated_frame

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


@dataclass(frozen=True)
class Photo:
    """How a sheet is drawn on and photographed.

    Args:
        filled: Whether blocks are filled; otherwise each is drawn in outline.
        style: How what is not filled is drawn: each block in outline, the outline of all, or hatched.
        ink: Colour of the pen; None for a dark grey one.
        width: Width of the pen [pixel of the sheet].
        crayon: Share of the paper that a crayon leaves bare in its stroke [0..1].
        paper: Lines of the paper.
        tone: Colour of the paper.
        beside: Whether a name, a sun and a ground line are drawn, too.
        shadow: Share of the light that a shadow takes from part of the photo [0..1].
        softness: Width of the shadow's border [pixel].
        table: Colour of the table.
        zoom: Size of the sheet in the photo; what is over 1.1 or so runs off it.
        slant: How far the corners of the sheet are from those of an upright one [share].
        turn: Angle by which the sheet is turned in the photo [deg].
        light: How much darker the darkest corner is than the brightest [0..1].
        wobble: How far the pen strays [cell].
        blur: Standard deviation of the blur [pixel].
        grain: Standard deviation of the sensor's noise [0..255].
        seed: Seed of hand and sensor.
    """

    filled: bool = False
    style: Literal["blocks", "outline", "hatched"] = "blocks"
    ink: tuple[int, int, int] | None = None
    width: int = 9
    crayon: float = 0.0
    paper: Literal["plain", "ruled", "squared"] = "plain"
    tone: tuple[int, int, int] = (240, 240, 240)
    beside: bool = False
    shadow: float = 0.0
    softness: float = 20.0
    table: tuple[float, float, float] = (120.0, 92.0, 66.0)
    zoom: float = 1.0
    slant: float = 0.10
    turn: float = 6.0
    light: float = 0.45
    wobble: float = 0.02
    blur: float = 1.2
    grain: float = 4.0
    seed: int = 0


def stack_of(*blocks: tuple[int, float, int]) -> Stack:
    """Blocks (shape, x, layer), upright in the plane."""
    poses = np.array([[x, 0, layer + 0.5, 0, 0, 0] for _, x, layer in blocks])
    return Stack(np.array([b[0] for b in blocks]), poses)


ARCH = stack_of(*[(CUBE, x, z) for z in range(3) for x in (-1, 1)], (LONG, 0, 3))
CASTLE = stack_of(
    *[(RECTANGLE, x, z) for z in (0, 1) for x in (-1, 1)], *[(CUBE, x, 2) for x in (-1.5, 1.5)], (TRIANGLE, -1.5, 3),
    (TRIANGLE, 1.5, 3),
)  # fmt: skip
HOUSE = stack_of((CUBE, -1, 0), (CUBE, 1, 0), (LONG, 0, 1), (RECTANGLE, -0.5, 2), (CUBE, 1, 2), (TRIANGLE, 0, 3))

FOCAL = 0.75
"""Focal length of the camera, by the photo's longer edge."""

SHEET = (1188, 840)
"""Size of the paper, A4 lying on its side [pixel]."""


def sheet_with(stack: Stack, photo: Photo, cell: float = 150.0) -> Picture:
    """Draw the front of a stack on a sheet, (h, w, 3); `cell` is the edge of a cube [pixel]."""
    rng = np.random.default_rng(photo.seed)
    sheet = np.full((*SHEET[::-1], 3), photo.tone, dtype=np.uint8)
    _rule(sheet, photo.paper)
    drawn = np.zeros(SHEET[::-1], dtype=np.uint8)  # how much ink there is
    middle, ground = SHEET[0] * 0.52, SHEET[1] * 0.5 + 2 * cell
    outlines = [
        np.stack([middle + front[:, 0] * cell, ground - front[:, 1] * cell], axis=1)
        for index, corners in zip(stack.shapes, block_vertices(stack), strict=True)
        for front in [corners[: len(stack.catalogue[index].outline), [0, 2]]]
    ]
    if photo.style != "blocks":
        outlines = _around(outlines)
    lines = [np.round(_by_hand(corners, photo, cell, rng)).astype(np.int32) for corners in outlines]
    if photo.filled and photo.style == "blocks":
        for line in lines:
            cv2.fillPoly(drawn, [line], 255)
    elif photo.filled:
        cv2.fillPoly(drawn, lines, 255)  # what is outlined within stays open
    if photo.style == "hatched":
        drawn = np.maximum(drawn, _hatched(lines, photo, rng))
    if photo.style == "blocks" or not photo.filled:
        cv2.polylines(drawn, lines, True, 255, photo.width, cv2.LINE_AA)
    _draw_beside(sheet, drawn, photo, cell, rng)
    if photo.crayon:
        grain = cv2.GaussianBlur(rng.normal(0, 1, drawn.shape), (0, 0), 1.2)
        drawn[grain > np.quantile(grain, 1 - photo.crayon)] = 0
    share = drawn[..., None] / 255
    ink = np.array(photo.ink or (52, 52, 52))
    return np.asarray(np.round(sheet * (1 - share) + ink * share), dtype=np.uint8)


def _rule(sheet: Picture, paper: str) -> None:
    """Draw the lines of ruled or squared paper."""
    height, width = sheet.shape[:2]
    if paper == "ruled":
        for row in range(70, height, 42):
            cv2.line(sheet, (0, row), (width, row), (150, 180, 220), 2)
        cv2.line(sheet, (110, 0), (110, height), (235, 150, 150), 2)
    if paper == "squared":
        for row in range(10, height, 30):
            cv2.line(sheet, (0, row), (width, row), (185, 200, 215), 2)
        for column in range(10, width, 30):
            cv2.line(sheet, (column, 0), (column, height), (185, 200, 215), 2)


def _around(outlines: list[Floats]) -> list[Floats]:
    """Return the outlines of all blocks together: around them, and around what they leave open."""
    whole = np.zeros(SHEET[::-1], dtype=np.uint8)
    for corners in outlines:
        cv2.fillPoly(whole, [np.round(corners).astype(np.int32)], 1)
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)).astype(np.uint8)
    contours, _ = cv2.findContours(whole, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return [cv2.approxPolyDP(contour, 5, True)[:, 0].astype(np.float64) for contour in contours]


def _hatched(lines: list[NDArray[np.int32]], photo: Photo, rng: np.random.Generator) -> Picture:
    """Hatch the inside of outlines to and fro."""
    inside, strokes = (np.zeros(SHEET[::-1], dtype=np.uint8) for _ in range(2))
    cv2.fillPoly(inside, lines, 255)
    left, top, width, height = cv2.boundingRect(np.concatenate(lines))
    lean = rng.uniform(-0.4, 0.4) * height
    for column in np.arange(left - height, left + width + height, 1.3 * photo.width):
        x = int(column + rng.normal(0, 1.5))
        cv2.line(strokes, (x, top), (int(x + lean), top + height), 255, photo.width, cv2.LINE_AA)
    return np.asarray(np.minimum(inside, strokes), dtype=np.uint8)


def _draw_beside(sheet: Picture, drawn: Picture, photo: Photo, cell: float, rng: np.random.Generator) -> None:
    """Draw a name, a sun and a ground line."""
    if not photo.beside:
        return
    cv2.putText(sheet, "MIA 5", (140, 100), cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, 2, (200, 40, 40), 5, cv2.LINE_AA)
    cv2.circle(sheet, (SHEET[0] - 110, 100), 42, (250, 205, 50), -1, cv2.LINE_AA)
    row = SHEET[1] * 0.5 + 2 * cell + photo.width
    points = [(column, row + rng.normal(0, 2)) for column in range(60, SHEET[0] - 60, 25)]
    cv2.polylines(drawn, [np.round(points).astype(np.int32)], False, 255, photo.width, cv2.LINE_AA)


def _by_hand(corners: Floats, photo: Photo, cell: float, rng: np.random.Generator) -> Floats:
    """Trace the outline (n, 2) with a point every tenth of a cell, as a hand does."""
    pieces = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        steps = max(2, round(float(np.linalg.norm(end - start)) / (0.1 * cell)))
        pieces.append(start + (end - start) * np.arange(steps)[:, None] / steps)
    points = np.concatenate(pieces)
    stray = rng.normal(0, 1, points.shape)
    smooth = sum(np.roll(stray, shift, axis=0) for shift in range(-2, 3)) / np.sqrt(5)
    return np.asarray(points + smooth * photo.wobble * cell)


def photographed(sheet: Picture, photo: Photo, size: tuple[int, int] = (960, 720)) -> Picture:
    """Photograph the sheet on a wooden table, (h, w, 3)."""
    rng = np.random.default_rng(photo.seed + 1)
    width, height = size
    table = np.array(photo.table) * (1 + 0.10 * np.sin(np.arange(height) / 9)[:, None, None])
    scene = np.broadcast_to(table, (height, width, 3)).copy()
    corners = np.array([[0, 0], [sheet.shape[1], 0], sheet.shape[1::-1], [0, sheet.shape[0]]], dtype=np.float32)
    there = _askew(corners, photo, size)
    turn = cv2.getPerspectiveTransform(corners, there.astype(np.float32))
    seen = cv2.warpPerspective(sheet, turn, size, flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.ones_like(sheet), turn, size, flags=cv2.INTER_NEAREST)
    scene = np.where(mask > 0, seen * np.array([1.0, 0.99, 0.95]), scene)
    rows, columns = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    lamp = np.exp(-((columns - 0.15) ** 2 + (rows - 0.1) ** 2) / 0.9)
    light = 1 - photo.light * (lamp.max() - lamp) / np.ptp(lamp)
    if photo.shadow:
        light *= 1 - photo.shadow * _shade(photo, size, rng)
    soft = cv2.GaussianBlur(scene * light[..., None], (0, 0), photo.blur)
    return np.clip(np.round(soft + rng.normal(0, photo.grain, soft.shape)), 0, 255).astype(np.uint8)


def _shade(photo: Photo, size: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Return where a hand's or a lamp's shadow falls (height, width), 0..1."""
    width, height = size
    shade = np.zeros((height, width), dtype=np.float32)
    corner = np.array([rng.uniform(0.4, 0.75) * width, rng.uniform(0.3, 0.6) * height])
    shape = np.array([corner, corner + [0.35 * width, -0.05 * height], [1.3 * width, height], [1.3 * width, 2 * height],
                      [corner[0] - 0.1 * width, 2 * height]])  # fmt: skip
    if rng.random() < 0.5:
        shape[:, 0] = width - shape[:, 0]
    cv2.fillPoly(shade, [np.round(shape).astype(np.int32)], 1.0)
    return np.asarray(cv2.GaussianBlur(shade, (0, 0), photo.softness), np.float64)


def _askew(corners: Floats, photo: Photo, size: tuple[int, int]) -> Floats:
    """Find where the corners of the sheet (4, 2) appear in a photo taken from its lower edge with a turned camera."""
    angle, lean = np.radians(photo.turn), 6 * photo.slant
    flat = (corners - corners.mean(axis=0)) / corners[:, 0].max()
    flat = flat @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    room, away = 0.86 * photo.zoom * np.array(size), 2.0
    for _ in range(20):  # until the sheet is as large in the photo as it should be; what is higher up is further
        depth = away - flat[:, 1] * np.sin(lean)
        seen = FOCAL * max(size) * np.stack([flat[:, 0], flat[:, 1] * np.cos(lean)], axis=1) / depth[:, None]
        away *= float((2 * np.abs(seen).max(axis=0) / room).max())
    return np.asarray(seen + np.array(size) / 2)  # the camera looks at the middle of the sheet


SKETCHES = {
    "sketch-arch.jpg": (ARCH, Photo(filled=False, seed=1)),
    "sketch-castle.jpg": (CASTLE, Photo(filled=True, slant=0.13, turn=-9, light=0.55, seed=2)),
    "sketch-house.jpg": (HOUSE, Photo(filled=False, slant=0.05, turn=3, light=0.3, wobble=0.03, seed=3)),
}
FRAMES = {
    "stack-castle": (CASTLE, Rig(distance=0.55, elevation=10, azimuth=8, size=(320, 240))),
    "stack-house": (HOUSE, Rig(distance=0.55, elevation=16, azimuth=-12, size=(320, 240))),
}


def main(folder: Path) -> None:
    """Make all photos and frames."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (stack, photo) in SKETCHES.items():
        picture = photographed(sheet_with(stack, photo), photo)
        cv2.imwrite(str(folder / name), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 72])
    for name, (stack, rig) in FRAMES.items():
        frame = simulated_frame(stack, rig)
        assert frame.colour is not None
        cv2.imwrite(str(folder / f"{name}-depth.png"), np.round(frame.depth * 1000).astype(np.uint16))
        cv2.imwrite(str(folder / f"{name}-color.jpg"), frame.colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "photos")
