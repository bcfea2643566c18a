"""Draws the photos of examples/photos: `python examples/draw_photos.py [FOLDER]`.

They show sheets of paper with a drawing, lying on a table, as if photographed by hand: askew, in uneven light, a little
blurred and grainy. Beside them are frames of a simulated depth camera before a stack on a table.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

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
        slant: How far the corners of the sheet are from those of an upright one [share].
        turn: Angle by which the sheet is turned in the photo [deg].
        light: How much darker the darkest corner is than the brightest [0..1].
        wobble: How far the pen strays [cell].
        blur: Standard deviation of the blur [pixel].
        grain: Standard deviation of the sensor's noise [0..255].
        seed: Seed of hand and sensor.
    """

    filled: bool = False
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

SHEET = (1188, 840)
"""Size of the paper, A4 lying on its side [pixel]."""


def sheet_with(stack: Stack, photo: Photo, cell: float = 150.0) -> Picture:
    """Draw the front of a stack on a sheet, (h, w) grey; `cell` is the edge of a cube [pixel]."""
    rng = np.random.default_rng(photo.seed)
    paper = np.full(SHEET[::-1], 240, dtype=np.uint8)
    middle, ground = SHEET[0] * 0.52, SHEET[1] * 0.5 + 2 * cell
    for index, corners in zip(stack.shapes, block_vertices(stack), strict=True):
        front = corners[: len(stack.catalogue[index].outline), [0, 2]]
        line = _by_hand(np.stack([middle + front[:, 0] * cell, ground - front[:, 1] * cell], axis=1), photo, cell, rng)
        if photo.filled:
            cv2.fillPoly(paper, [np.round(line).astype(np.int32)], 52)
        cv2.polylines(paper, [np.round(line).astype(np.int32)], True, 52, 9, cv2.LINE_AA)
    return paper


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
    table = np.array([120.0, 92.0, 66.0]) * (1 + 0.10 * np.sin(np.arange(height) / 9)[:, None, None])
    scene = np.broadcast_to(table, (height, width, 3)).copy()
    corners = np.array([[0, 0], [sheet.shape[1], 0], sheet.shape[::-1], [0, sheet.shape[0]]], dtype=np.float32)
    there = _askew(corners, photo, size)
    turn = cv2.getPerspectiveTransform(corners, there.astype(np.float32))
    grey = cv2.warpPerspective(sheet, turn, size, flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.ones_like(sheet), turn, size, flags=cv2.INTER_NEAREST)
    scene = np.where(mask[..., None] > 0, grey[..., None] * np.array([1.0, 0.99, 0.95]), scene)
    rows, columns = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    lamp = np.exp(-((columns - 0.15) ** 2 + (rows - 0.1) ** 2) / 0.9)
    light = 1 - photo.light * (lamp.max() - lamp) / np.ptp(lamp)
    soft = cv2.GaussianBlur(scene * light[..., None], (0, 0), photo.blur)
    return np.clip(np.round(soft + rng.normal(0, photo.grain, soft.shape)), 0, 255).astype(np.uint8)


def _askew(corners: Floats, photo: Photo, size: tuple[int, int]) -> Floats:
    """Find where the corners of the sheet (4, 2) appear in a photo taken from its lower edge with a turned camera."""
    angle, lean = np.radians(photo.turn), 6 * photo.slant
    flat = (corners - corners.mean(axis=0)) / corners[:, 0].max()
    flat = flat @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    depth = 1.0 - flat[:, 1] * np.sin(lean)  # a sheet's width away; what is higher up is further
    seen = np.stack([flat[:, 0], flat[:, 1] * np.cos(lean)], axis=1) / depth[:, None]
    room = 0.86 * np.array(size)
    scale = float((room / np.ptp(seen, axis=0)).min())
    return np.asarray((seen - (seen.min(axis=0) + seen.max(axis=0)) / 2) * scale + np.array(size) / 2)


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
