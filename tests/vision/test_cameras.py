"""Cameras: a stand-in for a RealSense sends what a real one would."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.vision.cameras import realsense_frame, simulated_frame
from stackgen.vision.depth import find_structure
from stackgen.vision.masks import fitted
from stackgen.world import PAPER_GRID
from tests.vision.conftest import CASTLE, camera_that_is_not_there, truth


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(StackgenError, match=r"stackgen\[realsense\]"):
        realsense_frame()


def test_a_realsense_frame_is_depth_in_metres_seen_by_the_colour_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in for the camera that sends a simulated frame, in units of a quarter of a millimetre."""
    sent, stopped = simulated_frame(CASTLE), []
    lens = SimpleNamespace(fx=sent.focal, ppx=320.0, ppy=240.0)
    profile = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(intrinsics=lens))
    frames = SimpleNamespace(
        get_depth_frame=lambda: SimpleNamespace(get_data=lambda: np.round(sent.depth * 4000).astype(np.uint16)),
        get_color_frame=lambda: SimpleNamespace(get_data=lambda: sent.colour, profile=profile),
    )
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025)
    device = SimpleNamespace(first_depth_sensor=lambda: sensor)
    pipeline = SimpleNamespace(
        start=lambda _: SimpleNamespace(get_device=lambda: device),
        wait_for_frames=lambda _: frames,
        stop=lambda: stopped.append(True),
    )
    camera = camera_that_is_not_there()
    camera.pipeline = lambda: pipeline
    camera.align = lambda _: SimpleNamespace(process=lambda frames: frames)
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera)
    frame = realsense_frame()
    assert np.abs(frame.depth - sent.depth).max() < 2e-4 and stopped == [True]
    assert frame.camera == (sent.focal, 320.0, 240.0)
    assert iou(fitted(find_structure(frame).front, PAPER_GRID), truth(CASTLE)) >= 0.9
