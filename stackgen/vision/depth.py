"""Stack to stack (paper, "Block Stacking in the Real World"): the silhouette of a structure that a depth camera sees.

The background goes by depth: wall and table are planes, found along the picture's edges, and what stands clearly
before the one and on the other is the structure. Its front is a plane, too; drawn as seen straight on from far away, a
camera that is near, looks down or stands to one side does no harm. Then, as in the paper: a median filter and the
largest component.

Camera frame: x to the right, y down, z away from the camera. Lengths in metres; H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.images import Levels, Picture, Raster, as_bytes, of_two_tones
from stackgen.vision.masks import bounding_box, components, largest, smoothed
from stackgen.world import Mask

Floats = NDArray[np.float64]

FIELD_OF_VIEW = 69.4
"""Horizontal angle of the colour camera of a RealSense D435 and of depth frames aligned to it [deg]."""

FAR = 4.0
"""Depth readings beyond this are no readings [m]."""

IN_FRONT = 0.025
"""The structure stands before the wall by at least this [m]; depth cameras err by some millimetres."""

ON_TABLE = 0.006
"""What is higher than this above the table belongs to the structure [m]."""

FOOT = 0.012
"""A structure that ends lower than this above the table stands on it [m]."""

PIXEL = 0.002
"""Edge of a pixel of the picture of the front [m]."""

BEYOND = 10.0
"""Size from which on a structure is not drawn: its picture would be larger than any that a camera takes [m]."""

MEDIAN = 5
"""Size of the median filter on frame and front [pixel]: it smooths what depth noise does to edges."""

JOINT = 0.010
"""Parts of the structure nearer than this belong together [m]: between blocks side by side depth often fails."""

_EDGE = 0.12
"""Width of the strip along the picture's edge in which wall and table are looked for [share]."""

_WHITE = 40_000
"""Whole numbers beyond this are white paper rather than millimetres, or parts of one."""

LARGE, SMALL = 0.6, 0.03
"""Sizes of structures that are not believed without being told the unit of the depth [m]."""


@dataclass(frozen=True)
class DepthFrame:
    """One picture of a depth camera.

    Args:
        depth: (H, W) along the optical axis [m]; 0 or nan where there is no reading.
        colour: (H, W, 3) colours seen by the same pixels, or None.
        focal: Focal length [pixel]; None for the one of `FIELD_OF_VIEW`.
        center: (column, row) of the optical axis [pixel]; None for the middle.

    Raises:
        StackgenError: If there is no depth in it, the colour picture has another size, or the focal length is not
            positive.
    """

    depth: Floats
    colour: Picture | None = None
    focal: float | None = None
    center: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        depth = np.asarray(self.depth, dtype=np.float64)
        if depth.ndim != 2 or min(depth.shape) < 48:
            raise StackgenError(f"a depth frame is (H, W), at least 48 pixels each way, got {depth.shape}")
        depth = np.where(np.isfinite(depth) & (depth > 0) & (depth < FAR), depth, 0.0)
        if (depth > 0).mean() < 0.05:
            raise StackgenError(
                "the frame has no depth: fewer than 5 % of its pixels have a reading between 0 and "
                f"{FAR:g} m; is the camera covered or too near, or the depth in another unit (--depth_scale)?"
            )
        if self.colour is not None and self.colour.shape[:2] != depth.shape:
            raise StackgenError(
                f"the colour picture is {self.colour.shape[1]} x {self.colour.shape[0]} pixels and the depth"
                f" {depth.shape[1]} x {depth.shape[0]}; align one to the other when recording"
            )
        if self.focal is not None and not 0 < self.focal < np.inf:
            raise StackgenError(f"the focal length must be positive, got {self.focal:g}")
        object.__setattr__(self, "depth", depth)

    @property
    def camera(self) -> tuple[float, float, float]:
        """Focal length, column and row of the optical axis [pixel]."""
        height, width = self.depth.shape
        focal = self.focal or width / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        column, row = self.center or (width / 2, height / 2)
        return focal, column, row

    def shown(self) -> Picture:
        """Return the frame's colours (H, W, 3), or its depth in grey where it has none."""
        if self.colour is not None:
            return self.colour.copy()
        near = np.where(self.depth > 0, self.depth, self.depth.max())
        grey = 255 * (near.max() - near) / max(float(np.ptp(near)), 1e-6)
        return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)

    def points(self) -> Floats:
        """Return the point (H, W, 3) of each pixel in the camera frame [m]; the origin where there is no reading."""
        return self._rays() * self.depth[..., None]

    def on_plane(self, pixels: Mask, plane: Floats) -> Floats:
        """Return the points (n, 3) [m] where the rays of some pixels (H, W) meet a plane n p = 1 [1/m]."""
        rays = self._rays()[pixels]
        return np.asarray(rays / (rays @ plane)[:, None])

    def _rays(self) -> Floats:
        """Return the point (H, W, 3) at depth 1 of each pixel."""
        focal, column, row = self.camera
        rows, columns = np.mgrid[: self.depth.shape[0], : self.depth.shape[1]] + 0.5
        return np.stack([(columns - column) / focal, (rows - row) / focal, np.ones_like(rows)], -1)


@dataclass(frozen=True)
class SeenStructure:
    """The structure that was found in a depth frame.

    Args:
        seen: (H, W) of the frame: pixels of the structure.
        front: (h, w) the structure's front as seen straight on, `PIXEL` a pixel.
        outline: (4, 2) corners of that picture in the frame [pixel], from the upper left clockwise.
        size: Width and height of the structure [m].
        left_out: What stands beside the structure and touches it nowhere, as a share of it.
        failing: Share of the structure without a reading that was taken to belong to it.
    """

    seen: Mask
    front: Mask
    outline: Floats
    size: tuple[float, float]
    left_out: float
    failing: float


def find_structure(frame: DepthFrame) -> SeenStructure:
    """Find the structure in a depth frame, a camera's in front of it.

    Raises:
        StackgenError: If nothing stands in front of the background, or the structure has no plane front.
    """
    planes = _background(frame)
    foreground = smoothed(in_front(frame, planes) & _supported(frame), MEDIAN) & (frame.depth > 0)
    if foreground.mean() < 5e-4:
        raise StackgenError(
            f"nothing stands in front of the background: no block is nearer than it by {1e3 * IN_FRONT:g} mm"
        )
    pixels_per_metre = frame.camera[0] / float(np.median(frame.depth[foreground]))
    seen = largest(foreground, round(min(JOINT * pixels_per_metre, max(foreground.shape))))
    holes = _failed_within(frame, seen)
    picture, outline = _straight_on(frame, seen, holes, planes)
    front = largest(smoothed(picture, MEDIAN), round(JOINT / PIXEL))
    if not front.any():
        raise StackgenError("the structure's points are too far apart to be a front: see --depth_scale and --focal")
    rows, columns = bounding_box(front)
    size = ((columns.stop - columns.start) * PIXEL, (rows.stop - rows.start) * PIXEL)
    whole = np.count_nonzero(seen)
    left_out = np.count_nonzero(foreground & ~seen) / whole
    return SeenStructure(seen | holes, front, outline, size, left_out, np.count_nonzero(holes) / whole)


def as_frame(
    raster: Raster, scale: float | None = None, focal: float | None = None, colour: Picture | None = None
) -> DepthFrame:
    """Take what a file or an array holds for a depth frame.

    Args:
        raster: What was read; a picture of 8 bits is refused.
        scale: Metres of a step of its values; None for 1 mm of whole numbers and 1 m of others.
        focal: Focal length [pixel]; None for that of a RealSense D435.
        colour: Picture of the same pixels, or None.

    Raises:
        StackgenError: If it has no depth, or a number is not positive.
    """
    if not isinstance(raster, Levels):
        raise StackgenError("is no depth frame but a picture of 8 bits; give a 16-bit PNG, or a .npy (H, W)")
    if scale is not None and not 0 < scale < np.inf:
        raise StackgenError(f"--depth_scale must be positive, the metres of a step of the values, got {scale:g}")
    values = np.nan_to_num(raster.values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    unit = scale if scale is not None else 1.0 if raster.values.dtype.kind == "f" else 1e-3
    return DepthFrame(values * unit, colour, focal)


def is_frame(raster: Raster) -> bool:
    """Tell a depth frame from a picture: it has many levels, not only that of the ink and that of the paper."""
    if not isinstance(raster, Levels) or min(raster.values.shape) < 48:
        return False
    values = raster.values[np.isfinite(raster.values)].astype(np.float64)
    whole = raster.values.dtype.kind in "ui"
    if whole and values.max() > 30000 and (of_two_tones(as_bytes(raster.values)) or np.quantile(values, 0.9) > _WHITE):
        return False
    if len(values) < 0.05 * raster.values.size:
        return raster.values.size > 100_000
    low, high = np.quantile(values, [0.005, 0.995])
    ends = np.minimum(values - values.min(), values.max() - values) < 0.02 * max(np.ptp(values), 1e-9)
    near = np.minimum(np.abs(values - low), np.abs(values - high)) < 0.03 * max(high - low, 1e-9)
    return not (ends.mean() > 0.9 or (near.mean() > 0.9 and high > 0.5 * 65535))


def doubted_size(found: SeenStructure) -> str | None:
    """Say why the size of a structure is not believed; None where it is."""
    width, height = found.size
    if SMALL <= max(width, height) <= LARGE:
        return None
    return (
        f"the structure would be {1e3 * width:.0f} x {1e3 * height:.0f} mm, so the depth seems to be in another unit;"
        " give the metres of a step of its values, such as --depth_scale 0.00025 (or 0.001, if that is the size)"
    )


def _supported(frame: DepthFrame) -> Mask:
    """Find the readings (H, W) with others beside them at their depth: flying pixels hang between near and far."""
    depth = np.pad(frame.depth, 1)
    height, width = frame.depth.shape
    near = np.zeros((height, width), dtype=np.int64)
    for row in range(3):
        for column in range(3):
            beside = depth[row : row + height, column : column + width]
            near += np.abs(beside - frame.depth) < 0.012 * np.maximum(frame.depth, 0.5)
    return np.asarray(near >= 5) & (frame.depth > 0)  # itself is one of them


def _failed_within(frame: DepthFrame, seen: Mask) -> Mask:
    """Find the holes (H, W) of what is seen where readings fail rather than show what is behind."""
    labels, areas = components(~seen, connectivity=4)
    failed = np.bincount(labels[frame.depth <= 0], minlength=len(areas))
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    holes = failed > 0.5 * np.maximum(areas, 1)
    holes[edge] = holes[0] = False
    return np.asarray(holes[labels])


def in_front(frame: DepthFrame, planes: Sequence[Floats | None]) -> Mask:
    """Find the pixels (H, W) whose points are on this side of wall and table, and not too near to them.

    Args:
        frame: H x W pixels.
        planes: (3,) n of the wall's and the table's plane n p = 1 [1/m]; None where there is none.
    """
    found = frame.depth > 0
    points = frame.points()
    for plane, room in zip(planes, (IN_FRONT, ON_TABLE), strict=True):
        if plane is not None:
            found &= (1 - points @ plane) / np.linalg.norm(plane) > room
    return np.asarray(found)


def _background(frame: DepthFrame) -> tuple[Floats | None, Floats | None]:
    """Find the planes of the wall and of the table.

    The wall has most of the readings along the upper edge and the upper halves of the others, the table most of
    those in the rest of the strip that lie before the wall. Either may be out of sight: a camera at the table's height
    does not see it.
    """
    height, width = frame.depth.shape
    band_y, band_x = round(_EDGE * height), round(_EDGE * width)
    strip = frame.depth > 0
    strip[band_y : height - band_y, band_x : width - band_x] = False
    above = np.arange(height)[:, None] < height // 2
    points = frame.points()
    wall = _plane_of_most(points[strip & above])
    rest = strip & ~above
    if wall is not None:
        rest &= (1 - points @ wall) / np.linalg.norm(wall) > IN_FRONT
    enough = np.count_nonzero(rest) > 0.1 * np.count_nonzero(strip & ~above)
    return wall, _plane_of_most(points[rest]) if enough else None


def _plane_of_most(points: Floats, tolerance: float = 0.012, rounds: int = 200) -> Floats | None:
    """Find n (3,) of the plane n p = 1 through most of the points (n, 3), None if it meets fewer than a third.

    The plane is searched among those through three points (RANSAC), then fitted to all points that lie in it. What is
    fitted is 1 / z, which is linear in x / z and y / z: that does not favour what is far away.
    """
    if len(points) < 50:
        return None
    rng = np.random.default_rng(0)
    some = points[rng.choice(len(points), min(len(points), 4000), replace=False)]
    terms, values = some / some[:, 2:], 1 / some[:, 2]
    fits, best = np.zeros(len(some), dtype=bool), 0
    for _ in range(rounds):
        three = rng.choice(len(some), 3, replace=False)
        if abs(np.linalg.det(terms[three])) < 1e-4:
            continue
        near = np.abs(terms @ np.linalg.solve(terms[three], values[three]) - values) < tolerance * values
        if np.count_nonzero(near) > best:
            fits, best = near, int(np.count_nonzero(near))
    if best < len(some) / 3:
        return None
    return np.asarray(np.linalg.lstsq(terms[fits], values[fits], rcond=None)[0])


def _straight_on(
    frame: DepthFrame, seen: Mask, holes: Mask, planes: tuple[Floats | None, Floats | None]
) -> tuple[Mask, Floats]:
    """Draw the structure as seen straight on from far away, and find that picture's corners (4, 2) in the frame.

    Its points are projected along the normal of its front: tops and sides of blocks fall on the edges of their fronts.
    Where readings fail within it, its front is taken to go on.
    """
    points = frame.points()[seen]
    plane = _plane_of_most(points)
    if plane is None:
        raise StackgenError("the structure has no plane front: place the camera before it, and the blocks in one plane")
    right, up = _axes(plane, planes[1])
    normal = np.cross(right, up)  # towards the camera
    points = np.concatenate([points, frame.on_plane(holes, plane)])
    middle = np.median(points, axis=0)
    origin = middle + (1 - middle @ plane) / (plane @ normal) * normal
    x, y = (points - origin) @ right, (origin - points) @ up
    low, high = [np.quantile(values, [0.0005, 0.9995]) for values in (x, y)]
    if max(np.ptp(low), np.ptp(high)) > BEYOND:
        raise StackgenError(
            f"the structure would be {np.ptp(low):.3g} x {np.ptp(high):.3g} m: see --depth_scale and --focal"
        )
    border = 0.03
    columns = np.floor((x - low[0] + border) / PIXEL).astype(int)
    rows = np.floor((y - high[0] + border) / PIXEL).astype(int)
    width, height = (int((np.ptp(span) + 2 * border) / PIXEL) for span in (low, high))
    inside = (0 <= columns) & (columns < width) & (0 <= rows) & (rows < height)
    picture = np.zeros((height, width), dtype=np.uint8)
    picture[rows[inside], columns[inside]] = 1
    picture = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).astype(np.uint8)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) * PIXEL - border
    world = origin + (low[0] + corners[:, :1]) * right - (high[0] + corners[:, 1:]) * up
    if planes[1] is not None:
        ground = (1 - origin @ planes[1]) / (up @ planes[1])  # upwards from the origin to the table
        _down_to(picture, round((-ground - high[0] + border) / PIXEL))
    focal, column, row = frame.camera
    return picture > 0, world[:, :2] / world[:, 2:] * focal + [column, row]


def _axes(front: Floats, table: Floats | None) -> tuple[Floats, Floats]:
    """Return unit vectors to the right and upwards in the front; the table tells what is upright, else the camera."""
    away = front / np.linalg.norm(front)
    right = np.cross(table, away) if table is not None else np.array([1.0, 0, 0])
    right = right - (right @ away) * away
    right *= np.sign(right[0]) / np.linalg.norm(right)
    return right, np.cross(right, away)


def _down_to(picture: Picture, ground: int) -> None:
    """Extend what ends a little above the ground row down to it: the feet of blocks are too near to the table."""
    top = ground - round(FOOT / PIXEL)
    if 0 < top < ground <= len(picture):
        picture[top:ground] |= picture[top - 1]
        picture[ground:] = 0
