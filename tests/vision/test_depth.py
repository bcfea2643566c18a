"""From a depth frame to a silhouette: what is recovered is what stands there."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.stack import Stack
from stackgen.vision import depth
from stackgen.vision.cameras import Rig, simulated_frame
from stackgen.vision.depth import DepthFrame, read_frame
from stackgen.world import PAPER_GRID
from tests.vision.conftest import ARCH, CASTLE, HOUSE, PHOTOS, truth

find_structure = partial(depth.find_structure, grid=PAPER_GRID)


@pytest.mark.parametrize(
    ("stack", "rig"),
    [
        (ARCH, Rig(elevation=0)),
        (CASTLE, Rig(elevation=8)),
        (HOUSE, Rig(elevation=15, azimuth=15)),
        (HOUSE, Rig(elevation=25, azimuth=-12, distance=0.6)),
        (CASTLE, Rig(elevation=8, noise=0, failing=0)),
    ],
)
def test_the_silhouette_is_that_of_the_stack(stack: Stack, rig: Rig) -> None:
    found = find_structure(simulated_frame(stack, rig))
    assert iou(found.as_seen, truth(stack)) >= 0.9
    assert iou(found.silhouette, truth(stack)) >= 0.98
    assert found.block_list is not None and found.left_out < 0.01


def test_what_is_not_made_of_whole_cells_stays_as_seen() -> None:
    poses = [[0.5 * z, 0, z + 0.5, 0, 0, 0] for z in range(4)]
    steps = Stack(np.array([0, 1, 1, 1]), np.array(poses))
    found = find_structure(simulated_frame(steps))
    assert np.array_equal(found.silhouette, found.as_seen) and found.cells is None and found.block_list is None


def test_sizes_are_in_metres() -> None:
    width, height = find_structure(simulated_frame(CASTLE, Rig(elevation=10))).size
    assert width == pytest.approx(0.20, abs=0.006) and height == pytest.approx(0.20, abs=0.010)


def test_the_camera_may_stand_nearer_or_further() -> None:
    near, far = (find_structure(simulated_frame(HOUSE, Rig(distance=d))).silhouette for d in (0.55, 0.9))
    assert iou(near, far) >= 0.9


def test_a_block_beside_the_structure_is_left_out() -> None:
    beside = Stack(np.append(ARCH.shapes, 0), np.vstack([ARCH.poses, [3.2, 0, 0.5, 0, 0, 0]]))
    found = find_structure(simulated_frame(beside))
    assert iou(found.silhouette, truth(ARCH)) >= 0.9
    assert found.left_out == pytest.approx(1 / 9, abs=0.03)  # a cube beside nine cells


@pytest.mark.parametrize(("name", "stack"), [("stack-castle", CASTLE), ("stack-house", HOUSE)])
def test_the_example_frames_are_of_their_stacks(name: str, stack: Stack) -> None:
    frame = read_frame(PHOTOS / f"{name}-depth.png", PHOTOS / f"{name}-color.jpg")
    assert iou(find_structure(frame).silhouette, truth(stack)) >= 0.9


def test_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    depth = np.round(simulated_frame(ARCH, Rig(size=(160, 120))).depth, 3)
    np.save(tmp_path / "metres.npy", depth)
    np.save(tmp_path / "millimetres.npy", np.round(depth * 1000).astype(np.uint16))
    for name in ("metres.npy", "millimetres.npy"):
        assert np.allclose(read_frame(tmp_path / name).depth, depth)


def test_the_background_alone_holds_nothing() -> None:
    empty = Stack(np.zeros(0, dtype=int), np.zeros((0, 6)))
    with pytest.raises(StackgenError, match="nothing stands in front of the background"):
        find_structure(simulated_frame(empty))


def test_a_frame_without_depth_is_refused() -> None:
    with pytest.raises(StackgenError, match="the frame has no depth"):
        DepthFrame(np.zeros((480, 640)))
    with pytest.raises(StackgenError, match="align"):
        DepthFrame(np.ones((480, 640)), np.zeros((240, 320, 3), dtype=np.uint8))


def test_examples_stay_small() -> None:
    assert all(path.stat().st_size < 60_000 for path in PHOTOS.iterdir())
