"""Where the blocks of a stack touch: convex prisms in any pose, and the ground.

Two convex bodies touch in one patch. The face that separates them best carries it; the patch is what
lies of the other body within a tolerance of that face's plane, clipped to the face. That one rule
covers a block on a block, on the ground, on a triangle's slope, on its apex, and side by side. (Two
bodies that only cross edge over edge, which no stack of nearly upright blocks does, are not found.)

Legend: k blocks, P pairs, F faces, V vertices, E edges of a block, C corners of a face; blocks with
fewer repeat their first. Lengths in cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import rotation_matrices
from stackgen.stack import Stack
from stackgen.world import Catalogue, Shape

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Point = tuple[float, float]

GROUND = -1
"""The number of the ground, where a block's number is expected."""

FLAT = 0.2
"""Sine of the angle up to which an edge counts as lying in a plane: where it leaves the tolerance the patch
ends. Steeper edges touch with their end only."""

SIDE = 0.02
"""Upright faces touch only up to this far apart [cell]: weight closes gaps below a block, not beside it."""

_LEDGE = 1e-3
"""Blocks that touch corner to corner touch sideways: a ledge narrower than this bears nothing [cell]."""

_SAME = 1e-6
"""Corners of a patch nearer than this are one [cell]."""


@dataclass(frozen=True)
class Contact:
    """A patch in which one block is pushed by another or by the ground.

    Args:
        block: The block that is pushed.
        by: The block that owns the face, or GROUND.
        normal: (3,) unit vector out of that face, into `block`.
        tangent: (3,) unit vector in the face.
        points: (p, 3) corners of the patch [cell]: one, two, or a convex polygon's.
    """

    block: int
    by: int
    normal: Floats
    tangent: Floats
    points: Floats

    @cached_property
    def center(self) -> Floats:
        """(3,) mean of the corners [cell]."""
        return self.points.mean(axis=0)

    @property
    def upright(self) -> bool:
        """Whether the faces are nearly vertical, so that they bear no weight."""
        return abs(self.normal[2]) < FLAT

    def supports(self, block: int) -> bool:
        """Tell whether it pushes this block upwards."""
        upwards = self.normal[2] if block == self.block else -self.normal[2]
        return block in (self.block, self.by) and bool(upwards > FLAT)

    def other(self, block: int) -> int:
        """Return the number on the other side."""
        return self.by if block == self.block else self.block


@dataclass(frozen=True)
class _Bodies:
    """Blocks in the world."""

    vertices: Floats  # (k, V, 3)
    normals: Floats  # (k, F, 3) outwards
    offsets: Floats  # (k, F): a point x is outside a face where normal @ x > offset
    corners: Ints  # (k, F, C) vertices of each face, counter-clockwise from outside
    edges: Ints  # (k, E, 2) vertices of each edge


@dataclass(frozen=True)
class _Molds:
    """The shapes of a catalogue in their own frames, as arrays of equal size."""

    vertices: Floats  # (S, V, 3)
    normals: Floats  # (S, F, 3)
    corners: Ints  # (S, F, C)
    edges: Ints  # (S, E, 2)


def find_contacts(stack: Stack, tolerance: float) -> list[Contact]:
    """Find all patches of a stack.

    Args:
        stack: The blocks.
        tolerance: Faces up to this far apart touch [cell]; how deep they are in each other does not matter.
    """
    bodies = _place(stack)
    return _on_ground(bodies, tolerance) + _between(bodies, tolerance)


@dataclass(frozen=True)
class PlaneContacts:
    """Contacts of blocks that all stand in the plane of a design, seen from the front: c segments.

    Args:
        block, by: (c,) number of the block that is pushed, and of the one that owns the face or GROUND.
        normal: (c, 2) unit vector out of the face, x and z.
        ends: (c, 2, 2) both ends of the segment, x and z [cell]; the second lies further along (normal z, -normal x).
        upright: (c,) whether the faces are nearly vertical.
    """

    block: Ints
    by: Ints
    normal: Floats
    ends: Floats
    upright: NDArray[np.bool_]

    def on_top(self) -> PlaneContacts:
        """Leave out the contacts between upright faces."""
        flat = ~self.upright
        return PlaneContacts(self.block[flat], self.by[flat], self.normal[flat], self.ends[flat], self.upright[flat])


def find_plane_contacts(stack: Stack, tolerances: Sequence[float]) -> list[PlaneContacts]:
    """Find all contacts of blocks near the plane y = 0 that are turned about the y axis alone, for each tolerance.

    Args:
        stack: The blocks; depths and small departures from the plane do not matter.
        tolerances: Largest gaps between faces that touch, upright ones, too [cell].
    """
    bodies = _place(stack)
    owner, face, other = _touching_faces(bodies, max(tolerances), max(tolerances))
    normal = bodies.normals[owner, face][:, [0, 2]]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _SAME)
    along = np.stack([normal[:, 1], -normal[:, 0]], axis=1)[..., None]
    corners = np.take_along_axis(bodies.vertices[owner], bodies.corners[owner, face][..., None], axis=1)[..., [0, 2]]
    faces = (corners @ along)[..., 0]
    vertices, edges = bodies.vertices[other], bodies.edges[other]
    heights = ((vertices[..., [0, 2]] - corners[:, :1]) @ normal[..., None])[..., 0]
    foot = (corners[:, 0] * normal).sum(axis=1, keepdims=True) * normal  # of the face's line
    upright = np.abs(normal[:, 1]) < FLAT
    found = []
    for tolerance in tolerances:
        points, near = _slice(bodies.vertices, bodies.edges, bodies.vertices[..., 2], tolerance)
        low, high = _extent(points[..., 0], near)
        floor = np.flatnonzero(low <= high)
        points, near = _slice(vertices, edges, heights, tolerance)
        first, last = _extent((points[..., [0, 2]] @ along)[..., 0], near)
        reach = np.stack([np.maximum(first, faces.min(axis=1)), np.minimum(last, faces.max(axis=1))], axis=1)
        touch = np.flatnonzero(reach[:, 0] <= reach[:, 1])
        ends = foot[touch, None] + reach[touch][..., None] * along[touch].transpose(0, 2, 1)
        ground = np.stack([np.stack([low, high], axis=1)[floor], np.zeros((len(floor), 2))], axis=2)
        found.append(
            PlaneContacts(
                np.concatenate([floor, other[touch]]),
                np.concatenate([np.full(len(floor), GROUND), owner[touch]]),
                np.concatenate([np.tile([0.0, 1.0], (len(floor), 1)), normal[touch]]),
                np.concatenate([ground, ends]),
                np.concatenate([np.zeros(len(floor), dtype=bool), upright[touch]]),
            )
        )
    return found


def _extent(coordinates: Floats, of: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return the least and largest coordinate (P,) of some of the points (P, V); inf and -inf of none."""
    low = np.where(of, coordinates, np.inf).min(axis=1, initial=np.inf)
    return low, np.where(of, coordinates, -np.inf).max(axis=1, initial=-np.inf)


def _on_ground(bodies: _Bodies, tolerance: float) -> list[Contact]:
    """Find the patches between blocks and the ground."""
    blocks = np.flatnonzero(bodies.vertices[..., 2].min(axis=1, initial=np.inf) <= tolerance)
    points, near = _slice(bodies.vertices[blocks], bodies.edges[blocks], bodies.vertices[blocks][..., 2], tolerance)
    up, contacts = np.array([0.0, 0.0, 1.0]), []
    for block, corners, keep in zip(blocks.tolist(), points, near, strict=True):
        patch = hull([(x, y) for x, y, _ in corners[keep].tolist()])
        along = bodies.vertices[block, 1] - bodies.vertices[block, 0]
        tangent = np.array([along[0], along[1], 0.0])
        length = np.linalg.norm(tangent)
        tangent = tangent / length if length > _SAME else np.array([1.0, 0.0, 0.0])
        contacts.append(Contact(block, GROUND, up, tangent, np.array([(x, y, 0.0) for x, y in patch])))
    return contacts


def _between(bodies: _Bodies, tolerance: float) -> list[Contact]:
    """Find the patches between blocks."""
    owner, face, other = _touching_faces(bodies, tolerance, min(tolerance, SIDE))
    normals = bodies.normals[owner, face]  # (P, 3)
    corners = np.take_along_axis(bodies.vertices[owner], bodies.corners[owner, face][..., None], axis=1)  # (P, C, 3)
    origin = corners[:, 0]
    tangent = corners[:, 1] - origin
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    axes = np.stack([tangent, np.cross(normals, tangent)], axis=2)  # (P, 3, 2)
    vertices = bodies.vertices[other] - origin[:, None]
    heights = np.einsum("pvi,pi->pv", vertices, normals)
    points, near = _slice(vertices, bodies.edges[other], heights, tolerance)
    flat_points = points @ axes
    flat_faces = (corners - origin[:, None]) @ axes
    contacts = []
    for i in range(len(owner)):
        patch = clip(hull(_pairs(flat_points[i][near[i]])), _pairs(flat_faces[i]))
        if patch:
            where = origin[i] + np.array(patch) @ axes[i].T
            contacts.append(Contact(int(other[i]), int(owner[i]), normals[i], tangent[i], where))
    return contacts


def _touching_faces(bodies: _Bodies, tolerance: float, side: float) -> tuple[Ints, Ints, Ints]:
    """Find the pairs of blocks that no face separates by more than the tolerance.

    Returns:
        For each pair the block that owns the face which separates them best, the number of that face, and the
        other block; (P,) each.
    """
    low, high = bodies.vertices.min(axis=1), bodies.vertices.max(axis=1)
    near = (low[:, None] <= high + tolerance).all(axis=2)
    one, two = np.nonzero(np.triu(near & near.T, 1))
    owner, other = np.stack([one, two]), np.stack([two, one])  # (2, P): each pair both ways
    reach = np.einsum("opfi,opvi->opfv", bodies.normals[owner], bodies.vertices[other])
    apart = reach.min(axis=3) - bodies.offsets[owner]  # (2, P, F)
    upright = np.abs(bodies.normals[owner][..., 2]) < FLAT
    face = (apart + _LEDGE * upright).argmax(axis=2)  # (2, P)
    gap = np.take_along_axis(apart, face[..., None], axis=2)[..., 0]
    beside = np.take_along_axis(upright, face[..., None], axis=2)[..., 0]
    touch = np.flatnonzero((gap <= np.where(beside, side, tolerance)).all(axis=0))
    # Where both have such a face, as parallel ones are, rounding must not choose: the lower block has it.
    height = low[:, 2] + high[:, 2]
    first = gap[0] + np.where(height[one] < height[two], 1e-3, -1e-3) >= gap[1]
    way = np.where(first, 0, 1)[touch]
    return owner[way, touch], face[way, touch], other[way, touch]


def _slice(vertices: Floats, edges: Ints, heights: Floats, tolerance: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return points (P, V + E, 3) that span what is up to `tolerance` high of each body, and which of them do so."""
    pair = np.arange(len(vertices))[:, None]
    start, end = vertices[pair, edges[..., 0]], vertices[pair, edges[..., 1]]
    low, high = heights[pair, edges[..., 0]], heights[pair, edges[..., 1]]
    rise = high - low
    crosses = ((low <= tolerance) != (high <= tolerance)) & (np.abs(rise) < FLAT * np.linalg.norm(end - start, axis=2))
    fraction = (tolerance - low) / np.where(rise == 0, 1, rise)
    cuts = start + fraction[..., None] * (end - start)
    return np.concatenate([vertices, cuts], axis=1), np.concatenate([heights <= tolerance, crosses], axis=1)


def _place(stack: Stack) -> _Bodies:
    """Move the shapes of a stack to their poses."""
    molds = _cast(stack.catalogue)
    rotation = rotation_matrices(stack.poses[:, 3:]).transpose(0, 2, 1)
    vertices = molds.vertices[stack.shapes] @ rotation + stack.poses[:, None, :3]
    normals = molds.normals[stack.shapes] @ rotation
    corners = molds.corners[stack.shapes]
    first = np.take_along_axis(vertices, corners[..., 0][..., None], axis=1)
    return _Bodies(vertices, normals, (normals * first).sum(axis=2), corners, molds.edges[stack.shapes])


@lru_cache(maxsize=8)
def _cast(catalogue: Catalogue) -> _Molds:
    """Collect the shapes of a catalogue as arrays of equal size."""
    parts = [_features(shape) for shape in catalogue]
    vertices, normals, corners, edges = (
        [_padded(part[i], max(len(p[i]) for p in parts)) for part in parts] for i in range(4)
    )
    return _Molds(np.array(vertices), np.array(normals), np.array(corners), np.array(edges))


def _features(shape: Shape) -> tuple[Floats, Floats, Ints, Ints]:
    """Return vertices (V, 3), face normals (F, 3), face corners (F, C) and edges (E, 2) of a prism."""
    faces = shape.faces
    most = max(4, len(shape.outline))
    corners = np.array([face + face[:1] * (most - len(face)) for face in faces])
    origin, along, across = (shape.vertices[corners[:, i]] for i in range(3))
    normals = np.cross(along - origin, across - origin)
    edges = {(min(a, b), max(a, b)) for face in faces for a, b in zip(face, face[1:] + face[:1], strict=True)}
    return (
        shape.vertices,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        corners,
        np.array(sorted(edges)),
    )


def _padded(rows: NDArray, length: int) -> NDArray:
    return np.concatenate([rows, np.repeat(rows[:1], length - len(rows), axis=0)])


def _pairs(points: Floats) -> list[Point]:
    return [(x, y) for x, y in points.tolist()]


def hull(points: list[Point]) -> list[Point]:
    """Return the corners of the convex hull, counter-clockwise; of points on a line its two ends.

    OpenCV's hull works in 32 bits, and takes longer for so few points.

    >>> hull([(0, 0), (1, 0), (0.5, 0.1), (1, 1), (0, 1), (1, 0)])
    [(0, 0), (1, 0), (1, 1), (0, 1)]
    """
    ordered = sorted(set(points))
    if len(ordered) < 3:
        return ordered
    around: list[Point] = []
    for sweep in (ordered, ordered[::-1]):
        chain: list[Point] = []
        for x, y in sweep:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > _SAME * _SAME:
                    break
                chain.pop()
            chain.append((x, y))
        around += chain[:-1]
    return around


def clip(polygon: list[Point], window: list[Point]) -> list[Point]:
    """Return the corners of a convex polygon's part in a convex window; both are counter-clockwise.

    The polygon may be a point or a line. Corners of the window may repeat.

    >>> clip([(-1, 0.5), (3, 0.5)], [(0, 0), (2, 0), (2, 1), (0, 1)])
    [(2.0, 0.5), (0.0, 0.5)]
    """
    for (ax, ay), (bx, by) in zip(window, window[1:] + window[:1], strict=True):
        ex, ey = bx - ax, by - ay
        if ex == ey == 0:
            continue
        inside = [ex * (y - ay) - ey * (x - ax) for x, y in polygon]
        kept: list[Point] = []
        for i, (x, y) in enumerate(polygon):
            before = inside[i - 1]
            if (before < 0) != (inside[i] < 0):
                fraction = before / (before - inside[i])
                px, py = polygon[i - 1]
                kept.append((px + fraction * (x - px), py + fraction * (y - py)))
            if inside[i] >= 0:
                kept.append((x, y))
        polygon = kept
        if not polygon:
            return []
    return _distinct(polygon)


def _distinct(polygon: list[Point]) -> list[Point]:
    """Leave out corners that repeat an earlier one."""
    kept: list[Point] = []
    for x, y in polygon:
        if all(abs(x - a) + abs(y - b) > _SAME for a, b in kept):
            kept.append((x, y))
    return kept
