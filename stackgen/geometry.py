"""Poses, vertices, silhouettes and IoU: pure functions of numpy arrays.

Legend: k blocks, V vertices, H x W pixels. Lengths in cells, rotation vectors in radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.stack import Stack
from stackgen.world import Grid, Mask, View

Floats = NDArray[np.float64]

# Rotations are written out here, in the arithmetic of scipy.spatial.transform (the tests compare them): importing that
# costs a second, half of what a cold `stackgen sample` may take.
_SMALL = 1e-3

_AXES: dict[View, tuple[int, int]] = {"front": (0, 2), "side": (1, 2), "top": (0, 1)}


def quaternions(rotation_vectors: ArrayLike) -> Floats:
    """(..., 3) rotation vectors [rad] to (..., 4) unit quaternions (x, y, z, w)."""
    vectors = np.asarray(rotation_vectors, dtype=np.float64)
    angle = np.sqrt((vectors**2).sum(axis=-1, keepdims=True))
    small = angle <= _SMALL  # where the sine is its series
    scale = np.where(small, 0.5 - angle**2 / 48 + angle**4 / 3840, np.sin(angle / 2) / np.where(small, 1, angle))
    return np.concatenate([vectors * scale, np.cos(angle / 2)], axis=-1)


def rotation_vectors(quaternions: ArrayLike) -> Floats:
    """(..., 4) quaternions (x, y, z, w) of any length but 0 to (..., 3) rotation vectors [rad], of angle at most pi."""
    array = np.asarray(quaternions, dtype=np.float64)
    unit = array / np.sqrt((array**2).sum(axis=-1, keepdims=True))
    unit = np.where(unit[..., 3:] < 0, -unit, unit)
    angle = 2 * np.arctan2(np.sqrt((unit[..., :3] ** 2).sum(axis=-1, keepdims=True)), unit[..., 3:])
    small = angle <= _SMALL
    scale = np.where(small, 2 + angle**2 / 12 + 7 * angle**4 / 2880, angle / np.where(small, 1, np.sin(angle / 2)))
    return scale * unit[..., :3]


def rotation_matrices(rotation_vectors: ArrayLike) -> Floats:
    """(..., 3) rotation vectors [rad] to (..., 3, 3) block_to_world rotations."""
    return quaternion_matrices(quaternions(rotation_vectors))


def quaternion_matrices(quaternions: ArrayLike) -> Floats:
    """(..., 4) unit quaternions (x, y, z, w) to (..., 3, 3) block_to_world rotations."""
    array = np.asarray(quaternions, dtype=np.float64)
    products = (array[..., :, None] * array[..., None, :]).reshape(*array.shape[:-1], 16)
    return (products.take(_PRODUCTS, axis=-1) * _FACTORS).sum(axis=-1).reshape(*array.shape[:-1], 3, 3)


_XX, _XY, _XZ, _XW, _, _YY, _YZ, _YW, _, _, _ZZ, _ZW, _, _, _, _WW = range(16)
_SQUARES = (_XX, _YY, _ZZ, _WW)
_PRODUCTS = np.array(
    [
        *(_SQUARES, (_XY, _ZW, 0, 0), (_XZ, _YW, 0, 0)),
        *((_XY, _ZW, 0, 0), _SQUARES, (_YZ, _XW, 0, 0)),
        *((_XZ, _YW, 0, 0), (_YZ, _XW, 0, 0), _SQUARES),
    ]
)
_FACTORS = np.array(
    [
        *((1, -1, -1, 1), (2, -2, 0, 0), (2, 2, 0, 0)),
        *((2, 2, 0, 0), (-1, 1, -1, 1), (2, -2, 0, 0)),
        *((2, -2, 0, 0), (2, 2, 0, 0), (-1, -1, 1, 1)),
    ]
)
"""Each element of a rotation matrix as the sum of up to four products of a quaternion's parts."""


def tilt(poses: ArrayLike) -> Floats:
    """(..., 6) poses to the angle (...) [rad] between each block's z axis and the vertical."""
    up = rotation_matrices(np.asarray(poses)[..., 3:])[..., 2, 2]
    return np.arccos(np.clip(up, -1, 1))


def centers_of_mass(stack: Stack) -> Floats:
    """(k, 3) centres of mass in the world [cell]."""
    offsets = np.array([stack.catalogue[s].center_of_mass for s in stack.shapes]).reshape(-1, 3)
    return stack.poses[:, :3] + np.einsum("kij,kj->ki", rotation_matrices(stack.poses[:, 3:]), offsets)


def block_vertices(stack: Stack) -> list[Floats]:
    """Corners (V, 3) of each block in the world [cell]."""
    rotations = rotation_matrices(stack.poses[:, 3:])
    return [
        stack.catalogue[shape].vertices @ rotation.T + pose[:3]
        for shape, rotation, pose in zip(stack.shapes, rotations, stack.poses, strict=True)
    ]


def mirror(stack: Stack) -> Stack:
    """Reflection at the plane x = 0: again a stack, for shapes whose outline is symmetric.

    >>> mirror(Stack([0], [[1, 0, 0.5, 0, 0.1, 0.2]])).poses.tolist()
    [[-1.0, 0.0, 0.5, 0.0, -0.1, -0.2]]
    """
    return stack.with_poses(stack.poses * np.array([-1, 1, 1, 1, -1, -1]) + 0.0)


def silhouette(stack: Stack, grid: Grid, view: View = "front", margin: int = 0) -> Mask:
    """Orthographic silhouette (H, W): a pixel is set when its centre is covered by a block.

    Front shows (x, z), side (y, z), top (x, y), the second axis upwards. `margin` adds pixels on all
    four sides. A convex block covers, in each row of pixels, the interval between the leftmost and
    the rightmost crossing of the segments that join its projected corners.
    """
    rows, columns = grid.vertical(view, margin), grid.horizontal(margin)
    picture = np.zeros((len(rows), len(columns)), dtype=bool)
    for corners in block_vertices(stack):
        left, right = row_intervals(corners[:, _AXES[view]], rows)
        picture |= (columns >= left[:, None]) & (columns <= right[:, None])
    return picture


def row_intervals(points: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Where the convex hull of `points` (V, 2) crosses each row: leftmost and rightmost, (H,) each.

    Rows that miss it get the empty interval (inf, -inf).
    """
    i, j = np.triu_indices(len(points), 1)
    low, high = points[i], points[j]
    swap = low[:, 1] > high[:, 1]
    low, high = np.where(swap[:, None], high, low), np.where(swap[:, None], low, high)
    rise = high[:, 1] - low[:, 1]
    crosses = (low[:, 1] <= rows[:, None]) & (rows[:, None] < high[:, 1])  # (H, pairs); flat segments never cross
    fraction = (rows[:, None] - low[:, 1]) / np.where(rise == 0, 1, rise)
    x = low[:, 0] + fraction * (high[:, 0] - low[:, 0])
    return np.where(crosses, x, np.inf).min(axis=1), np.where(crosses, x, -np.inf).max(axis=1)


def iou(a: Mask, b: Mask) -> float:
    """Intersection over union of two masks of one size; 1 when both are empty.

    >>> iou(np.array([[True, True, False]]), np.array([[False, True, True]]))
    0.3333333333333333
    """
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 1.0


def silhouette_iou(stack: Stack, target: Mask, grid: Grid, view: View = "front") -> float:
    """IoU of a stack's silhouette with a target (H, W); what is off the canvas counts as outside the target."""
    wide, low = grid.image_size / 2 / grid.pixels_per_cell, -grid.ground_margin / grid.pixels_per_cell
    corners = np.concatenate([np.empty((0, 3)), *block_vertices(stack)])
    if (np.abs(corners[:, :2]) < wide).all() and (low < corners[:, 2]).all() and (corners[:, 2] < low + 2 * wide).all():
        return iou(silhouette(stack, grid, view), np.asarray(target, dtype=bool))
    margin = grid.image_size
    half = (grid.image_size / 2 + margin) / grid.pixels_per_cell - 2
    middle = (grid.image_size / 2 - grid.ground_margin) / grid.pixels_per_cell  # height of the picture's centre
    near = stack.poses.copy()
    near[:, :2] = np.clip(near[:, :2], -half, half)  # a block further out is still counted as outside
    near[:, 2] = np.clip(near[:, 2], middle - half, middle + half)
    picture = silhouette(stack.with_poses(near), grid, view, margin)
    return iou(picture, np.pad(np.asarray(target, dtype=bool), margin))
