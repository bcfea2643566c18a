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

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.vision.cells import Ints, block_list, in_cells
from stackgen.vision.drawings import read_silhouette
from stackgen.world import PAPER_GRID, Grid, Mask

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

FIELD_OF_VIEW = 69.4
"""Horizontal, of the colour camera of a RealSense D435 [deg]; depth frames aligned to it have it, too."""

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
"""Of the filter on the picture of the front [pixel]: it smooths what depth noise does to edges."""

JOINT = 0.010
"""Parts of the structure nearer than this belong together [m]: between blocks side by side depth often fails."""

ALIKE = 0.85
"""IoU with the silhouette as seen, stretched, from which on the structure is taken to be made of whole cells."""

_EDGE = 0.12
"""Width of the strip along the picture's edge in which wall and table are looked for [share]."""


@dataclass(frozen=True)
class Frame:
    """What a depth camera delivers.

    Args:
        depth: (H, W) along the optical axis [m]; 0 or nan where there is no reading.
        colour: (H, W, 3) seen by the same pixels; None without.
        focal: Focal length [pixel]; None for the one of `FIELD_OF_VIEW`.
        center: (column, row) of the optical axis [pixel]; None for the middle.

    Raises:
        StackgenError: If there is no depth in it, or the colour picture has another size.
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
        object.__setattr__(self, "depth", depth)

    @property
    def camera(self) -> tuple[float, float, float]:
        """Focal length, column and row of the optical axis [pixel]."""
        height, width = self.depth.shape
        focal = self.focal or width / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        column, row = self.center or (width / 2, height / 2)
        return focal, column, row

    def points(self) -> Floats:
        """(H, W, 3) of each pixel in the camera frame [m]; the origin where there is no reading."""
        focal, column, row = self.camera
        rows, columns = np.mgrid[: self.depth.shape[0], : self.depth.shape[1]] + 0.5
        return (
            np.stack([(columns - column) / focal, (rows - row) / focal, np.ones_like(rows)], -1) * self.depth[..., None]
        )


@dataclass(frozen=True)
class Capture:
    """What was found in a frame.

    Args:
        silhouette: (H, W) on the grid: that of the cells where the structure is made of whole cells, else as seen.
        as_seen: (H, W) on the grid.
        cells: (rows, columns) empty, full or triangle, the first row on the ground; None where it is not made of
            whole cells.
        counts: (S,) block list by the heuristic; None without cells, or with too many.
        seen: (H, W) of the frame: pixels of the structure.
        front: (h, w) the structure's front as seen straight on, `PIXEL` a pixel.
        outline: (4, 2) corners of that picture in the frame [pixel], from the upper left clockwise.
        size: Width and height of the structure [m].
        left_out: What stands beside it and touches it nowhere, as a share of it.
    """

    silhouette: Mask
    as_seen: Mask
    cells: Ints | None
    counts: Ints | None
    seen: Mask
    front: Mask
    outline: Floats
    size: tuple[float, float]
    left_out: float


def capture(frame: Frame, grid: Grid = PAPER_GRID) -> Capture:
    """The silhouette of the structure in a frame.

    Args:
        frame: From a camera in front of the structure.
        grid: Scale and place of the silhouette.

    Raises:
        StackgenError: If nothing stands in front of the background.
    """
    planes = _background(frame)
    foreground = _median(in_front(frame, planes), 5) & (frame.depth > 0)
    if foreground.mean() < 5e-4:
        raise StackgenError(
            f"nothing stands in front of the background: no block is nearer than it by {1e3 * IN_FRONT:g} mm"
        )
    seen = largest(foreground, round(_pixels(frame, foreground, JOINT)))
    picture, outline = _straight_on(frame, seen, planes)
    front = largest(_median(picture, MEDIAN), round(JOINT / PIXEL))
    rows, columns = np.flatnonzero(front.any(axis=1)), np.flatnonzero(front.any(axis=0))
    size = (float(np.ptp(columns) + 1) * PIXEL, float(np.ptp(rows) + 1) * PIXEL)
    as_seen = read_silhouette(front, grid, exact=False)
    cells, silhouette = in_cells(as_seen, ALIKE, grid) or (None, as_seen)
    counts = None if cells is None else block_list(cells)
    left_out = np.count_nonzero(foreground & ~seen) / np.count_nonzero(seen)
    return Capture(silhouette, as_seen, cells, counts, seen, front, outline, size, left_out)


def read_frame(depth: str | Path, colour: str | Path | None = None, focal: float | None = None) -> Frame:
    """A frame from files.

    Args:
        depth: A .npy of floats [m] or of whole numbers [mm], or a PNG of 16 bits [mm].
        colour: The picture of the same pixels.
        focal: Focal length [pixel]; that of a RealSense by default.

    Raises:
        StackgenError: If a file is missing or something else, or has no depth.
    """
    try:
        return Frame(_read_depth(Path(depth)), None if colour is None else read_picture(colour), focal)
    except StackgenError as error:
        raise (
            error if str(error).startswith((str(depth), str(colour))) else StackgenError(f"{depth}: {error}")
        ) from error


def is_depth(path: str | Path) -> bool:
    """Whether a file is a depth frame rather than a picture: a .npy, or an image of one channel of 16 bits."""
    import cv2

    path = Path(path)
    if path.suffix == ".npy" or not path.is_file():
        return path.suffix == ".npy"
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return values is not None and values.ndim == 2 and values.dtype == np.uint16


def _read_depth(path: Path) -> Floats:
    import cv2

    try:
        data = path.read_bytes()
        if path.suffix == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except (OSError, ValueError, EOFError, cv2.error) as error:
        reason = getattr(error, "strerror", None) or "it is no array of numbers"
        raise StackgenError(f"{path}: cannot be read: {reason}") from error
    if (
        values is None
        or values.ndim != 2
        or values.dtype not in (np.uint16, np.int32, np.int64, np.float32, np.float64)
    ):
        raise StackgenError(f"{path}: is no depth frame; give a 16-bit PNG in mm, or a .npy (H, W) in m or whole mm")
    return values.astype(np.float64) / (1 if values.dtype.kind == "f" else 1000)


def read_picture(path: str | Path) -> Picture:
    """A colour picture (H, W, 3), upright.

    Raises:
        StackgenError: If there is none.
    """
    import cv2

    try:
        data = np.frombuffer(Path(path).read_bytes(), np.uint8)
    except OSError as error:
        raise StackgenError(f"{path}: cannot be read: {error.strerror}") from error
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise StackgenError(f"{path}: is not an image that can be read; give a PNG or JPEG file")
    return np.ascontiguousarray(picture[..., ::-1])


def in_front(frame: Frame, planes: Sequence[Floats | None]) -> Mask:
    """(H, W) pixels whose points are on this side of wall and table, and not too near to them.

    Args:
        frame: H x W pixels.
        planes: (3,) n of each plane n p = 1 [1/m], the wall's and the table's; None where there is none.
    """
    found = frame.depth > 0
    points = frame.points()
    for plane, room in zip(planes, (IN_FRONT, ON_TABLE), strict=True):
        if plane is not None:
            found &= (1 - points @ plane) / np.linalg.norm(plane) > room
    return np.asarray(found)


def _background(frame: Frame) -> tuple[Floats | None, Floats | None]:
    """The planes of the wall and of the table.

    The wall's has most of the readings along the upper edge and the upper halves of the others, the table's most of
    those in the rest of the strip that lie before the wall. Either may be out of sight: the table is to a camera at
    its height.
    """
    height, width = frame.depth.shape
    rows, columns = np.mgrid[:height, :width]
    band_y, band_x = round(_EDGE * height), round(_EDGE * width)
    edge = (rows < band_y) | (rows >= height - band_y) | (columns < band_x) | (columns >= width - band_x)
    strip, above = edge & (frame.depth > 0), rows < height // 2
    points = frame.points()
    wall = _plane_of_most(points[strip & above])
    rest = strip & ~above
    if wall is not None:
        rest &= (1 - points @ wall) / np.linalg.norm(wall) > IN_FRONT
    enough = np.count_nonzero(rest) > 0.1 * np.count_nonzero(strip & ~above)
    return wall, _plane_of_most(points[rest]) if enough else None


def _plane_of_most(points: Floats, tolerance: float = 0.012, rounds: int = 200) -> Floats | None:
    """n (3,) of the plane n p = 1 through most of the points (n, 3), None if it meets fewer than a third.

    Searched among planes through three of them (RANSAC), then fitted to all those that lie in it. What is fitted is
    1 / z, which is linear in x / z and y / z: that does not favour what is far away.
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


def _straight_on(frame: Frame, seen: Mask, planes: tuple[Floats | None, Floats | None]) -> tuple[Mask, Floats]:
    """The structure as seen straight on from far away, and the corners (4, 2) of that picture in the frame.

    Its points are projected along the normal of its front: tops and sides of blocks fall on the edges of their fronts.
    """
    import cv2

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
    """Unit vectors to the right and upwards in the front; upright is what the table says, else the camera."""
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


def largest(mask: Mask, gap: int) -> Mask:
    """The largest component of a mask; parts at most `gap` pixels apart are one component.

    >>> largest(np.array([[1, 1, 0, 0, 0, 1]], dtype=bool), 1).tolist()
    [[True, True, False, False, False, False]]
    """
    import cv2

    radius = max(0, gap // 2)
    kernel = np.ones((2 * radius + 1,) * 2, np.uint8)
    _, labels = cv2.connectedComponents(cv2.dilate(mask.astype(np.uint8), kernel))
    areas = np.bincount(labels[mask], minlength=1)
    areas[0] = 0
    return np.asarray(mask & (labels == areas.argmax()))


def _median(mask: Mask, size: int) -> Mask:
    import cv2

    return np.asarray(cv2.medianBlur(mask.astype(np.uint8) * 255, size) > 0)


def _pixels(frame: Frame, seen: Mask, length: float) -> float:
    """How many pixels of the frame a length is at the structure's depth."""
    return length * frame.camera[0] / float(np.median(frame.depth[seen]))
