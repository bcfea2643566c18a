"""Depth cameras: a RealSense on a cable, and a simulated one before a stack on a table with a wall behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError, require
from stackgen.geometry import block_vertices
from stackgen.stack import Stack
from stackgen.vision.depth import FIELD_OF_VIEW, DepthFrame
from stackgen.viz.raster import Camera, borders, camera_axes
from stackgen.viz.render import draw_faces

Floats = NDArray[np.float64]

_WALL = np.array([236.0, 234.0, 228.0])
_TABLE = np.array([214.0, 205.0, 190.0])
_LIGHT = np.array([-0.45, -0.65, 0.62])  # unit vector towards the light


@dataclass(frozen=True)
class Rig:
    """Place and quality of the simulated camera.

    Args:
        distance: Distance from the middle of the structure [m].
        elevation: Angle above the horizontal [deg].
        azimuth: Angle to the right of the front [deg].
        wall: Distance of the wall behind the middle of the structure [m].
        size: (width, height) of the frame [pixel].
        noise: Standard deviation of a reading at 0.7 m [m]; it grows with the square of the distance.
        failing: Share of the readings beside an edge in depth that fail; half a percent of the others do.

    Raises:
        StackgenError: If the camera would stand in the wall, the table or the structure.
    """

    distance: float = 0.75
    elevation: float = 8.0
    azimuth: float = 0.0
    wall: float = 0.35
    size: tuple[int, int] = (640, 480)
    noise: float = 0.0015
    failing: float = 0.3

    def __post_init__(self) -> None:
        if not (0 <= self.elevation <= 60 and abs(self.azimuth) <= 60 and 0.2 <= self.distance <= 3):
            raise StackgenError(
                "rig: elevation must lie in 0..60 degrees, azimuth in -60..60 and distance in 0.2..3 m,"
                f" got {self.elevation:g}, {self.azimuth:g} and {self.distance:g}"
            )
        if not (self.wall > 0.05 and self.noise >= 0 and 0 <= self.failing <= 1 and min(self.size) >= 48):
            raise StackgenError("rig: wall must be over 0.05 m, noise at least 0, failing in 0..1 and size at least 48")


def simulated_frame(stack: Stack, rig: Rig = Rig(), cell_size: float = 0.05, seed: int = 0) -> DepthFrame:
    """Simulate what a depth camera sees of a stack on a table before a wall, with the noise of a real one.

    Args:
        stack: The stack, in the world frame.
        rig: Place and quality of the camera.
        cell_size: Edge of a cube [m].
        seed: Seed of the noise.

    >>> frame = simulated_frame(Stack([0], [[0, 0, 0.5, 0, 0, 0]]), Rig(elevation=0, noise=0, failing=0))
    >>> round(float(np.median(frame.depth[270:300, 310:330])), 3)  # the front of the cube is half a cell nearer
    0.725
    """
    rng = np.random.default_rng(seed)
    width, height = rig.size
    camera = _camera(rig, cell_size)
    nearest, colours = _background(camera, rig, cell_size)
    faces = draw_faces(stack, block_vertices(stack), camera, nearest, _shade)
    colours = np.where(faces.seen[..., None] > 0, faces.colours[faces.seen], colours)
    depth = _as_measured(cell_size / nearest.astype(np.float64), rig, rng)
    return DepthFrame(depth, _as_photographed(colours, rng), camera.scale, (width / 2, height / 2))


def _shade(base: Floats, normal: Floats) -> Floats:
    """Shade a face in the light of a lamp."""
    return base * (0.62 + 0.4 * max(0.0, float(normal @ _LIGHT)))


def _camera(rig: Rig, cell_size: float) -> Camera:
    """Place the camera: it looks at the middle of the design grid, two cells up."""
    right, up, back = camera_axes(math.radians(rig.azimuth), math.radians(rig.elevation))
    focal = rig.size[0] / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    eye = np.array([0, 0, 2.0]) + back * rig.distance / cell_size
    return Camera(right, up, back, eye, focal, np.array(rig.size) / 2)


def _background(camera: Camera, rig: Rig, cell_size: float) -> tuple[NDArray[np.float32], Floats]:
    """Return the nearness (H, W) of wall and table [1/cell] and their colours (H, W, 3)."""
    width, height = rig.size
    rows, columns = np.mgrid[:height, :width] + 0.5
    x, y = (columns - camera.center[0]) / camera.scale, (camera.center[1] - rows) / camera.scale
    rays = x[..., None] * camera.right + y[..., None] * camera.up - camera.back  # of depth 1
    wall = rays[..., 1] / (rig.wall / cell_size - camera.eye[1])
    table = -rays[..., 2] / camera.eye[2]
    is_table = table > wall
    nearness = np.maximum(np.maximum(wall, table), 1e-3)
    light = 1.06 - 0.22 * columns / width - 0.10 * rows / height
    return nearness.astype(np.float32), np.where(is_table[..., None], _TABLE, _WALL) * light[..., None]


def _as_measured(depth: Floats, rig: Rig, rng: np.random.Generator) -> Floats:
    """Return readings (H, W) in whole millimetres: noisy, and failing here and there, more so beside edges."""
    if not rig.noise and not rig.failing:
        return depth
    noisy = depth + rng.normal(0, rig.noise, depth.shape) * (depth / 0.7) ** 2
    edge = borders(depth, 0.03)
    failed = rng.random(depth.shape) < np.where(edge, rig.failing, 0.005 * bool(rig.failing))
    return np.where(failed, 0, np.round(noisy, 3))


def _as_photographed(colours: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Soften colours (H, W, 3) as a lens does, and add the grain of a sensor."""
    soft = cv2.GaussianBlur(colours, (0, 0), 0.8)
    return np.clip(np.round(soft + rng.normal(0, 3, colours.shape)), 0, 255).astype(np.uint8)


def realsense_frame(timeout: float = 5.0, skipped: int = 15) -> DepthFrame:
    """Take one frame of the first RealSense camera, its depth aligned to its colours.

    Args:
        timeout: Longest wait for each frame [s].
        skipped: Number of frames until exposure has settled.

    Raises:
        StackgenError: If the package or the camera is missing, or the camera sends nothing.
    """
    realsense: Any = require("pyrealsense2", "realsense")
    pipeline, settings = realsense.pipeline(), realsense.config()
    settings.enable_stream(realsense.stream.depth, 640, 480, realsense.format.z16, 30)
    settings.enable_stream(realsense.stream.color, 640, 480, realsense.format.rgb8, 30)
    try:
        profile = pipeline.start(settings)
    except RuntimeError as error:
        raise StackgenError(f"no RealSense camera answers ({error}): plug it into a USB 3 port") from error
    try:
        for _ in range(skipped):
            pipeline.wait_for_frames(round(1000 * timeout))
        frames = realsense.align(realsense.stream.color).process(pipeline.wait_for_frames(round(1000 * timeout)))
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        lens = colour.profile.as_video_stream_profile().intrinsics
        unit = profile.get_device().first_depth_sensor().get_depth_scale()
        values = np.asarray(depth.get_data(), dtype=np.float64) * unit
        return DepthFrame(values, np.array(colour.get_data(), dtype=np.uint8), lens.fx, (lens.ppx, lens.ppy))
    except RuntimeError as error:
        raise StackgenError(f"the RealSense camera sends nothing ({error}): unplug it and plug it in again") from error
    finally:
        pipeline.stop()
