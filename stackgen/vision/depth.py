"""Stack to stack (paper, "Block Stacking in the Real World"): the silhouette of a structure that a depth camera sees.

The background goes by depth: wall and table are planes, found along the picture's edges, and what stands clearly
before the one and on the other is the structure. Its front is a plane, too; drawn as seen straight on from far away, a
camera that is near, looks down or stands to one side does no harm. Then, as in the paper: a median filter, the largest
component, resized and pasted onto the grid. What is nearly made of whole cells is taken to be: samplers know their
edges.

Camera frame: x to the right, y down, z away from the camera. Lengths in metres; H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.cells import Ints, in_cells
from stackgen.vision.drawings import Picture, read_picture, read_silhouette
from stackgen.vision.masks import bounding_box, largest, smoothed
from stackgen.world import Grid, Mask

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

MEDIAN = 5
"""Size of the median filter on frame and front [pixel]: it smooths what depth noise does to edges."""

JOINT = 0.010
"""Parts of the structure nearer than this belong together [m]: between blocks side by side depth often fails."""

ALIKE = 0.85
"""Least IoU with the stretched silhouette for the structure to count as made of whole cells."""

_EDGE = 0.12
"""Width of the strip along the picture's edge in which wall and table are looked for [share]."""

_DTYPES = (np.uint16, np.int32, np.int64, np.float32, np.float64)
"""Kinds of numbers that a depth file may hold."""


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
                f"{FAR:g} m; is the camera covered or too near, or the file in another unit?"
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

    def points(self) -> Floats:
        """Return the point (H, W, 3) of each pixel in the camera frame [m]; the origin where there is no reading."""
        focal, column, row = self.camera
        rows, columns = np.mgrid[: self.depth.shape[0], : self.depth.shape[1]] + 0.5
        rays = np.stack([(columns - column) / focal, (rows - row) / focal, np.ones_like(rows)], -1)
        return rays * self.depth[..., None]


@dataclass(frozen=True)
class SeenStructure:
    """The structure that was found in a depth frame.

    Args:
        silhouette: (H, W) on the grid: that of the cells where the structure is made of whole cells, else as seen.
        as_seen: (H, W) on the grid, as seen.
        cells: (rows, columns) EMPTY, FULL or TRIANGLE, the first row on the ground; None where the structure is not
            made of whole cells.
        block_list: (S,) block list guessed from the cells; None without cells, or with too many.
        seen: (H, W) of the frame: pixels of the structure.
        front: (h, w) the structure's front as seen straight on, `PIXEL` a pixel.
        outline: (4, 2) corners of that picture in the frame [pixel], from the upper left clockwise.
        size: Width and height of the structure [m].
        left_out: What stands beside the structure and touches it nowhere, as a share of it.
    """

    silhouette: Mask
    as_seen: Mask
    cells: Ints | None
    block_list: Ints | None
    seen: Mask
    front: Mask
    outline: Floats
    size: tuple[float, float]
    left_out: float


def find_structure(frame: DepthFrame, grid: Grid) -> SeenStructure:
    """Find the structure in a depth frame, and its silhouette.

    Args:
        frame: Frame of a camera in front of the structure.
        grid: Scale and place of the silhouette.

    Raises:
        StackgenError: If nothing stands in front of the background, or the structure has no plane front.
    """
    planes = _background(frame)
    foreground = smoothed(in_front(frame, planes), MEDIAN) & (frame.depth > 0)
    if foreground.mean() < 5e-4:
        raise StackgenError(
            f"nothing stands in front of the background: no block is nearer than it by {1e3 * IN_FRONT:g} mm"
        )
    pixels_per_metre = frame.camera[0] / float(np.median(frame.depth[foreground]))
    seen = largest(foreground, round(JOINT * pixels_per_metre))
    picture, outline = _straight_on(frame, seen, planes)
    front = largest(smoothed(picture, MEDIAN), round(JOINT / PIXEL))
    rows, columns = bounding_box(front)
    size = ((columns.stop - columns.start) * PIXEL, (rows.stop - rows.start) * PIXEL)
    as_seen = read_silhouette(front, grid, exact=False)
    silhouette, cells, block_list = in_cells(as_seen, ALIKE, grid)
    left_out = np.count_nonzero(foreground & ~seen) / np.count_nonzero(seen)
    return SeenStructure(silhouette, as_seen, cells, block_list, seen, front, outline, size, left_out)


def read_frame(depth: str | Path, colour: str | Path | None = None, focal: float | None = None) -> DepthFrame:
    """Read a depth frame from files.

    Args:
        depth: A .npy of floats [m] or of whole numbers [mm], or a PNG of 16 bits [mm].
        colour: Picture of the same pixels, or None.
        focal: Focal length [pixel]; that of a RealSense D435 by default.

    Raises:
        StackgenError: If a file is missing or something else, or has no depth.
    """
    values, picture = _read_depth(Path(depth)), None if colour is None else read_picture(colour)
    try:
        return DepthFrame(values, picture, focal)
    except StackgenError as error:
        raise StackgenError(f"{depth}: {error}") from error


def is_depth(path: str | Path) -> bool:
    """Tell whether a file is a depth frame rather than a picture: a .npy, or an image of one channel of 16 bits."""
    path = Path(path)
    if path.suffix == ".npy" or not path.is_file():
        return path.suffix == ".npy"
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return values is not None and values.ndim == 2 and values.dtype == np.uint16


def _read_depth(path: Path) -> Floats:
    """Read depths (H, W) [m]."""
    try:
        data = path.read_bytes()
        if path.suffix == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except (OSError, ValueError, EOFError, cv2.error) as error:
        reason = getattr(error, "strerror", None) or "it is no array of numbers"
        raise StackgenError(f"{path}: cannot be read: {reason}") from error
    if values is None or values.ndim != 2 or values.dtype not in _DTYPES:
        raise StackgenError(f"{path}: is no depth frame; give a 16-bit PNG in mm, or a .npy (H, W) in m or whole mm")
    return values.astype(np.float64) / (1 if values.dtype.kind == "f" else 1000)


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


def _straight_on(frame: DepthFrame, seen: Mask, planes: tuple[Floats | None, Floats | None]) -> tuple[Mask, Floats]:
    """Draw the structure as seen straight on from far away, and find that picture's corners (4, 2) in the frame.

    Its points are projected along the normal of its front: tops and sides of blocks fall on the edges of their fronts.
    """
    points = frame.points()[seen]
    plane = _plane_of_most(points)
    if plane is None:
        raise StackgenError("the structure has no plane front: place the camera before it, and the blocks in one plane")
    right, up = _axes(plane, planes[1])
    normal = np.cross(right, up)  # towards the camera
    middle = np.median(points, axis=0)
    origin = middle + (1 - middle @ plane) / (plane @ normal) * normal
    x, y = (points - origin) @ right, (origin - points) @ up
    low, high = [np.quantile(values, [0.0005, 0.9995]) for values in (x, y)]
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
