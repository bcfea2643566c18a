"""What a user may say of a picture; loads nothing that reads one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PictureKind = Literal["drawing", "photo", "depth"]


@dataclass(frozen=True)
class PictureOptions:
    """What the user says of a picture, as arguments of :func:`read_picture`.

    Args:
        as_: What to take the picture for; told by default.
        which: Number of the drawing, from the left, where there are several.
        depth_scale: Metres of a step of a depth frame's values, such as 0.00025; by default whole numbers are
            millimetres and others are metres.
        focal: Focal length of a depth frame [pixel]; that of a RealSense D435 by default.
        cell_size: Edge of a cube before a depth camera [m], with which the structure keeps its scale.
    """

    as_: PictureKind | None = None
    which: int | None = None
    depth_scale: float | None = None
    focal: float | None = None
    cell_size: float | None = None
