"""What the tests of vision look at: the stacks and photos of examples/, read on the paper's grid."""

from __future__ import annotations

import runpy
from functools import partial
from pathlib import Path
from types import SimpleNamespace

from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.vision import reader
from stackgen.vision.masks import fitted
from stackgen.world import PAPER_GRID, Mask

ROOT = Path(__file__).parents[2]
PHOTOS = ROOT / "examples" / "photos"
DRAWN = runpy.run_path(str(ROOT / "examples" / "draw_photos.py"))
STACKS: dict[str, Stack] = {name: DRAWN[name] for name in ("ARCH", "CASTLE", "HOUSE")}
ARCH, CASTLE, HOUSE = STACKS.values()
read_silhouette = partial(reader.read_silhouette, grid=PAPER_GRID)


def truth(stack: Stack) -> Mask:
    """The stack's own silhouette, framed as read ones are."""
    return fitted(silhouette(stack, PAPER_GRID), PAPER_GRID)


def camera_that_is_not_there() -> SimpleNamespace:
    """As pyrealsense2 is without a camera."""

    def start(*_: object) -> None:
        raise RuntimeError("No device connected")

    return SimpleNamespace(
        pipeline=lambda: SimpleNamespace(start=start),
        config=lambda: SimpleNamespace(enable_stream=lambda *_: None),
        stream=SimpleNamespace(depth=0, color=1),
        format=SimpleNamespace(z16=0, rgb8=1),
    )
