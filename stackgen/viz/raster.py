"""A small rasteriser: a camera, and convex polygons filled where they are nearest. Pure numpy.

Pixels are (column, row) from the upper left, with centres at halves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.world import Shape

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A perspective camera that looks at the scene from the front, from a little to one side and above.

    Args:
        right, up, back: (3,) axes of the camera in the world; it looks along -back.
        eye: (3,) its place in the world [cell].
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
        """World points (..., 3) to pixels (..., 2) and to nearness (...) = 1 / distance along the axis [1/cell]."""
        relative = points - self.eye
        nearness = -1 / (relative @ self.back)
        x = relative @ self.right * nearness
        y = relative @ self.up * nearness
        return np.stack([x, -y], axis=-1) * self.scale + self.center, nearness

    @staticmethod
    def looking_at(points: Floats, size: tuple[int, int], azimuth: float, elevation: float, border: float) -> Camera:
        """Place a camera so that all `points` (n, 3) fit into `size` (width, height) less a `border` [share].

        Args:
            points: What must be seen.
            size: Of the picture [pixel].
            azimuth: Angle to the right of the front [rad].
            elevation: Angle above the ground [rad].
            border: Share of each edge left free.
        """
        back = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
        right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        low, high = points.min(axis=0), points.max(axis=0)
        eye = (low + high) / 2 + back * (2.2 * np.linalg.norm(high - low) + 1)
        draft = Camera(right, np.cross(back, right), back, eye, 1.0, np.zeros(2))
        seen, _ = draft.project(points)
        room = np.array(size) * (1 - 2 * border)
        scale = float((room / np.maximum(np.ptp(seen, axis=0), 1e-9)).min())
        center = np.array(size) / 2 - scale * (seen.min(axis=0) + seen.max(axis=0)) / 2
        return Camera(draft.right, draft.up, draft.back, eye, scale, center)


def prism_faces(shape: Shape) -> list[list[int]]:
    """Corners of each face of a prism, counter-clockwise seen from outside, as indices into its vertices.

    >>> prism_faces(Shape("wedge", ((-1, -1), (1, -1), (0, 1))))
    [[0, 1, 2], [5, 4, 3], [0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]]
    """
    n = len(shape.outline)
    sides = [[i, i + n, (i + 1) % n + n, (i + 1) % n] for i in range(n)]
    return [list(range(n)), list(range(2 * n - 1, n - 1, -1)), *sides]


def fill_nearest(
    faces: NDArray[np.int32], nearest: NDArray[np.float32], number: int, pixels: Floats, nearness: Floats
) -> None:
    """Write `number` where the face is nearer than what is there; nearness is linear on the screen."""
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


def fill(mask: NDArray[np.bool_], polygon: Floats) -> None:
    """Set the pixels of a convex polygon (n, 2)."""
    window = _covered(mask.shape, polygon)
    if window is not None:
        rows, columns, inside = window
        mask[rows, columns] |= inside


def _covered(shape: tuple[int, ...], polygon: Floats) -> tuple[slice, slice, NDArray[np.bool_]] | None:
    """The window around a convex polygon and which of its pixels have their centre inside; None if off-screen."""
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


def hull(points: Floats) -> Floats:
    """Corners of the convex hull of points (n, 2), in order."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points, qhull_options="QJ").vertices]


def borders(labels: NDArray[np.integer], grow: int) -> NDArray[np.bool_]:
    """Pixels (H, W) beside another label, and all within `grow` pixels of them."""
    border = np.zeros(labels.shape, dtype=bool)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= down
    border[:-1] |= down
    for _ in range(grow):
        border[:, 1:] |= border[:, :-1]
        border[:, :-1] |= border[:, 1:]
        border[1:] |= border[:-1]
        border[:-1] |= border[1:]
    return border
