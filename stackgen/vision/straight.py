"""A sheet seen straight on, and a drawing without one set upright by its own sides.

Legend: h x w pixels of the photo; corners (4, 2) as x, y from the upper left clockwise.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.vision.images import Picture
from stackgen.vision.sheets import FOCAL, Sheet
from stackgen.world import Mask

Floats = NDArray[np.float64]

FOCALS = (0.6, 1.6)
"""Least and largest focal length that is believed, by the photo's longer edge."""

SHEETS = (0.707, 0.773)
"""Proportions of sheets of A4 and of Letter."""

_BETWEEN = 0.755  # nearer to Letter, as most sheets are of A4

_TELLS = 1e-3  # least product of how much further the far ends of both sides are with which they tell the focal length

_HELD = np.radians([25.0, 8.0, 12.0])
"""How far a camera is usually turned about its axes to the right, down and ahead, before a sheet [rad]."""

_STRAY = np.radians(2.0)
"""How far a hand turns a side that is as long as the drawing [rad]."""


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
    ratio = _usual(ratio) if sheet.seen == 4 else ratio
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
    square = -(across[:2] @ down[:2]) / product if abs(product) > _TELLS else 0.0
    seen = np.clip(np.sqrt(square), *FOCALS) if square > 0 else FOCAL
    focal = np.sqrt(seen * FOCAL)  # corners tell it badly, and most cameras are alike
    lengths = [np.hypot(np.linalg.norm(vector[:2]) / focal, vector[2]) for vector in (across, down)]
    return float(np.clip(lengths[0] / lengths[1], 0.3, 3.3))


def straight_up(mask: Mask) -> Mask:
    """Turn a drawing (H, W) until its sides are level and upright, as those of blocks are.

    It stands for the sheet where no edges of one are seen: the drawing's own sides tell how the camera was held, which
    is looked for by least squares among usual ways to hold it.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    size = max(max(cv2.boundingRect(contour)[2:]) for contour in contours)
    sides = _sides(contours, size)
    middle, focal = np.array(mask.shape[::-1]) / 2, FOCAL * max(mask.shape)
    lengths = np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1)
    upright = np.abs(_angles(sides)) > np.pi / 4
    weights = np.sqrt(lengths / size) / _STRAY

    def off(turns: Floats) -> Floats:
        """How far sides are from level or upright, and how unusual the turns of the camera [rad] are."""
        angles = _angles(_seen_turned(sides, turns, middle, focal))
        wrong = np.where(upright, np.abs(angles) - np.pi / 2, angles)
        return np.concatenate([weights * wrong, turns / _HELD])

    from scipy.optimize import least_squares  # here: importing it costs most pictures more than reading them

    turns = np.asarray(least_squares(off, np.zeros(3), loss="soft_l1").x)
    around = np.concatenate(contours)[:, 0].astype(np.float64)
    there = _seen_turned(around, turns, middle, focal)
    low, high = there.min(axis=0), there.max(axis=0)
    scale, edge = 0.8 * max(mask.shape) / max(float((high - low).max()), 1.0), 0.1 * max(mask.shape)
    corners = np.array([[0, 0], [mask.shape[1], 0], mask.shape[::-1], [0, mask.shape[0]]], np.float64)
    goal = (_seen_turned(corners, turns, middle, focal) - low) * scale + edge
    turn = cv2.getPerspectiveTransform(corners.astype(np.float32), goal.astype(np.float32))
    width, height = np.round((high - low) * scale + 2 * edge).astype(int)
    turned = np.asarray(cv2.warpPerspective(mask.astype(np.float32), turn, (int(width), int(height)))) >= 0.5
    return turned if turned.any() else mask


def _sides(contours: Sequence[cv2.typing.MatLike], size: int) -> Floats:
    """Return the ends (n, 2, 2) of the long straight sides that are nearly level or upright."""
    found = []
    for contour in contours:
        points = cv2.approxPolyDP(contour, 0.02 * size, True)[:, 0].astype(np.float64)
        found.append(np.stack([points, np.roll(points, -1, axis=0)], axis=1))
    sides = np.concatenate(found)
    angles = np.abs(_angles(sides))
    near = np.minimum(angles, np.pi / 2 - angles) < np.radians(25)
    return np.asarray(sides[near & (np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1) > 0.12 * size)])


def _angles(sides: Floats) -> Floats:
    """Return the angles (n,) of sides (n, 2, 2) above the horizontal, whichever way they go [-pi / 2..pi / 2]."""
    x, y = (sides[:, 1] - sides[:, 0]).T
    return np.asarray(np.arctan(y / np.where(x == 0, 1e-9, x)))


def _seen_turned(points: Floats, turns: Floats, middle: Floats, focal: float) -> Floats:
    """Return where points (..., 2) [pixel] are seen when the camera is turned about its three axes [rad]."""
    turn, _ = cv2.Rodrigues(turns)
    rays = np.concatenate([(points - middle) / focal, np.ones((*points.shape[:-1], 1))], axis=-1) @ turn.T
    return np.asarray(rays[..., :2] / np.maximum(rays[..., 2:], 0.05) * focal + middle)
