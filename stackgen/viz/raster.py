"""A small rasteriser in numpy: a camera, and convex polygons filled where they are nearest.

Pixels are (column, row) from the upper left, with centres at halves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A perspective camera in front of the scene.

    Args:
        right, up, back: (3,) axes of the camera in the world; it looks along -back.
        eye: (3,) place of the camera in the world [cell].
        scale: Pixels per unit of tangent.
        center: (2,) the pixel (column, row) straight ahead.
    """

    right: Floats
    up: Floats
    back: Floats
    eye: Floats
    scale: float
    center: Floats

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Project world points (..., 3) to pixels (..., 2) and nearness (...), 1 / distance along the axis [1/cell]."""
        relative = points - self.eye
        nearness = -1 / (relative @ self.back)
        x = relative @ self.right * nearness
        y = relative @ self.up * nearness
        return np.stack([x, -y], axis=-1) * self.scale + self.center, nearness

    @staticmethod
    def looking_at(points: Floats, size: tuple[int, int], azimuth: float, elevation: float, border: float) -> Camera:
        """Place a camera so that all `points` (n, 3) fit into `size` (width, height) less a `border` [share].

        Args:
            points: What must be seen [cell].
            size: Width and height of the picture [pixel].
            azimuth: Angle to the right of the front [rad].
            elevation: Angle above the ground [rad].
            border: Share of each edge left free.
        """
        right, up, back = camera_axes(azimuth, elevation)
        low, high = points.min(axis=0), points.max(axis=0)
        eye = (low + high) / 2 + back * (2.2 * np.linalg.norm(high - low) + 1)
        draft = Camera(right, up, back, eye, 1.0, np.zeros(2))
        seen, _ = draft.project(points)
        room = np.array(size) * (1 - 2 * border)
        scale = float((room / np.maximum(np.ptp(seen, axis=0), 1e-9)).min())
        center = np.array(size) / 2 - scale * (seen.min(axis=0) + seen.max(axis=0)) / 2
        return Camera(right, up, back, eye, scale, center)


def camera_axes(azimuth: float, elevation: float) -> tuple[Floats, Floats, Floats]:
    """Return the axes (right, up, back) of a camera to the right of the front and above the ground [rad]."""
    back = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return right, np.cross(back, right), back


def fill_nearest(
    faces: NDArray[np.int32], nearest: NDArray[np.float32], number: int, pixels: Floats, nearness: Floats
) -> None:
    """Write `number` where a convex face is nearer than what is there; nearness is linear on the screen."""
    window = _covered(faces.shape, pixels)
    if window is None:
        return
    rows, columns, inside = window
    basis = np.column_stack([pixels, np.ones(len(pixels))])
    a, b, c = np.linalg.lstsq(basis, nearness, rcond=None)[0]
    near = (np.arange(columns.start, columns.stop) + 0.5) * a + ((np.arange(rows.start, rows.stop) + 0.5) * b + c)[
        :, None
    ]
    wins = inside & (near > nearest[rows, columns] * (1 + 1e-6))
    faces[rows, columns][wins] = number
    nearest[rows, columns][wins] = near[wins]


def _covered(shape: tuple[int, ...], polygon: Floats) -> tuple[slice, slice, NDArray[np.bool_]] | None:
    """Find the window around a convex polygon and its pixels whose centre is inside; None if it is off-screen."""
    (left, top), (right, bottom) = polygon.min(axis=0), polygon.max(axis=0)
    x0, x1 = (int(np.clip(np.ceil(v - 0.5), 0, shape[1])) for v in (left, right))
    y0, y1 = (int(np.clip(np.ceil(v - 0.5), 0, shape[0])) for v in (top, bottom))
    if x0 >= x1 or y0 >= y1:
        return None
    x, y = np.arange(x0, x1) + 0.5, (np.arange(y0, y1) + 0.5)[:, None]
    ends = np.roll(polygon, -1, axis=0)
    turn = np.sign((polygon[:, 0] * ends[:, 1] - ends[:, 0] * polygon[:, 1]).sum())
    low, high = np.full(y.shape, -np.inf), np.full(y.shape, np.inf)
    for (px, py), (dx, dy) in zip(polygon, ends - polygon, strict=True):
        if abs(dy) < 1e-9:
            continue
        crossing = px + (y - py) * dx / dy
        if dy * turn > 0:
            high = np.minimum(high, crossing)
        else:
            low = np.maximum(low, crossing)
    return slice(y0, y1), slice(x0, x1), (x >= low) & (x < high)


def borders(values: NDArray[Any], step: float = 0.0) -> NDArray[np.bool_]:
    """Find the pixels (H, W) that differ by more than `step` from the one beside, above or below."""
    border = np.zeros(values.shape, dtype=bool)
    for axis in (0, 1):
        differs = np.swapaxes(np.abs(np.diff(values, axis=axis)) > step, 0, axis)
        along = np.swapaxes(border, 0, axis)
        along[1:] |= differs
        along[:-1] |= differs
    return border
