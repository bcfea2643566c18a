"""What a hand, a camera and a scanner do to a figure: turns, slants, wavering edges, rounded corners, specks.

Legend: H x W pixels of a silhouette.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from stackgen.data.generation.drawing.figures import Figure, Floats
from stackgen.vision.drawings import grid_offset
from stackgen.vision.masks import largest
from stackgen.world import Grid, Mask

_TURN, _SLANT = np.radians(6), np.radians(11)  # most of either
_SMALLEST, _LARGEST = 0.8, 1.1  # scale
_ROOM = 1.5  # pixels that stay free on every side of a picture


def _turned(rng: np.random.Generator) -> Floats:
    c, s = np.cos(angle := rng.uniform(-_TURN, _TURN)), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _slanted(rng: np.random.Generator) -> Floats:
    return np.array([[1.0, np.tan(rng.uniform(-_SLANT, _SLANT))], [0.0, 1.0]])


def _scaled(rng: np.random.Generator) -> Floats:
    high = rng.uniform(_SMALLEST, _LARGEST)
    return np.diag([high * rng.uniform(0.95, 1.05) if rng.random() < 0.5 else high, high])


def _wavering(mask: Mask, rng: np.random.Generator) -> Mask:
    """Edges that waver over the length of a block or two."""
    rows, columns = np.indices(mask.shape).astype(np.float32)
    reach, sigma = rng.uniform(0.6, 2.0), rng.uniform(3, 7)
    moves = [cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), sigma) for _ in range(2)]
    down, right = (np.float32(reach) * (move / move.std()).astype(np.float32) for move in moves)
    moved = cv2.remap(mask.astype(np.float32), columns + right, rows + down, cv2.INTER_LINEAR)
    return np.asarray(moved >= 0.5)


def _rounded(mask: Mask, rng: np.random.Generator) -> Mask:
    """Corners as a thick pencil leaves them, outside and inside."""
    size = 2 * int(rng.integers(1, 4)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disc) > 0) if opened.any() else mask


def _rough(mask: Mask, rng: np.random.Generator) -> Mask:
    """Pixels changed on either side of the edges."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    ink = mask.astype(np.uint8)
    edge = cv2.dilate(ink, cross) != cv2.erode(ink, cross)
    return mask ^ (edge & (rng.random(mask.shape) < rng.uniform(0.1, 0.35)))


def _specked(mask: Mask, rng: np.random.Generator) -> Mask:
    """Some specks of ink, or holes in it."""
    spotted = mask.astype(np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        row, column = (int(rng.integers(3, size - 3)) for size in mask.shape)
        cv2.circle(spotted, (column, row), int(rng.integers(0, 3)), int(not mask[row, column]), -1)
    return np.asarray(spotted > 0)


BENDS: dict[str, Callable[[np.random.Generator], Floats]] = {
    "turned": _turned,
    "slanted": _slanted,
    "scaled": _scaled,
}
"""What maps the corners of a figure, by a (2, 2) matrix."""

BLOTS: dict[str, Callable[[Mask, np.random.Generator], Mask]] = {
    "wavering": _wavering,
    "rounded": _rounded,
    "rough": _rough,
    "specks": _specked,
}
"""What changes the pixels of a silhouette (H, W)."""

EFFECTS = (*BENDS, *BLOTS)


def put_down(figure: Figure, grid: Grid, effects: list[str], rng: np.random.Generator) -> Mask | None:
    """Draw a figure with some effects into a silhouette (H, W): on the ground, in the middle or beside it.

    Two of three figures stand on the cells of the grid, as pictures are shown to samplers; the others anywhere.

    Returns:
        The silhouette; None if nothing is left of the figure.
    """
    for name in effects:
        if name in BENDS:
            figure = figure.mapped(BENDS[name](rng))
    low, high = figure.box
    room = np.array([grid.image_size - 2 * _ROOM, grid.image_size - grid.ground_margin - _ROOM]) / grid.pixels_per_cell
    scale = min(1.0, *(room / np.maximum(high - low, 1e-6)))
    shift = -np.array([(low[0] + high[0]) / 2, low[1]]) * scale
    anywhere = rng.random() < 1 / 3
    if anywhere:
        free = max(0.0, room[0] - scale * (high[0] - low[0])) / 2
        shift[0] += rng.uniform(-free, free)
    mask = figure.mapped(scale * np.eye(2), shift).painted(grid)
    if not mask.any():
        return None
    mask = np.roll(mask, grid_offset(mask, grid), axis=1) if not anywhere else mask
    for name in effects:
        if name in BLOTS:
            mask = BLOTS[name](mask, rng)
    return _on_the_ground(mask, grid)


def _on_the_ground(mask: Mask, grid: Grid) -> Mask | None:
    """Keep what is above the ground line and connected with the most of it, and let that down to it."""
    foot = grid.image_size - round(grid.ground_margin)
    mask = np.concatenate([mask[:foot], np.zeros_like(mask[foot:])])
    if not mask.any():
        return None
    kept = largest(mask, 2)
    lowest = np.flatnonzero(kept.any(axis=1))[-1]
    return np.roll(mask, foot - 1 - lowest, axis=0) if lowest < foot - 1 else mask
