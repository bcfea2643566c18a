"""From a depth frame to a silhouette: what is recovered is what stands there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.stack import Stack
from stackgen.vision.cameras import Rig, simulated_frame
from stackgen.vision.depth import DepthFrame, find_structure
from stackgen.vision.masks import fitted
from stackgen.vision.reader import read_picture
from stackgen.world import PAPER_GRID
from tests.vision.conftest import ARCH, CASTLE, HOUSE, PHOTOS, truth


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
    assert iou(fitted(found.front, PAPER_GRID), truth(stack)) >= 0.9 and found.left_out < 0.01


def test_sizes_are_in_metres() -> None:
    width, height = find_structure(simulated_frame(CASTLE, Rig(elevation=10))).size
    assert width == pytest.approx(0.20, abs=0.006) and height == pytest.approx(0.20, abs=0.010)


def test_the_camera_may_stand_nearer_or_further() -> None:
    near, far = (find_structure(simulated_frame(HOUSE, Rig(distance=d))).front for d in (0.55, 0.9))
    assert iou(fitted(near, PAPER_GRID), fitted(far, PAPER_GRID)) >= 0.9


def test_a_block_beside_the_structure_is_left_out() -> None:
    beside = Stack(np.append(ARCH.shapes, 0), np.vstack([ARCH.poses, [3.2, 0, 0.5, 0, 0, 0]]))
    found = find_structure(simulated_frame(beside))
    assert iou(fitted(found.front, PAPER_GRID), truth(ARCH)) >= 0.9
    assert found.left_out == pytest.approx(1 / 9, abs=0.03)  # a cube beside nine cells


@pytest.mark.parametrize(("name", "stack"), [("stack-castle", CASTLE), ("stack-house", HOUSE)])
def test_the_example_frames_are_of_their_stacks(name: str, stack: Stack) -> None:
    reading = read_picture(PHOTOS / f"{name}-depth.png", PAPER_GRID, colour=PHOTOS / f"{name}-color.jpg")
    assert reading.kind == "depth" and iou(fitted(reading.figure, PAPER_GRID), truth(stack)) >= 0.9


@pytest.mark.parametrize(
    ("dtype", "scale"),
    [("<f8", None), ("<f4", None), ("<f2", None), (">f4", None), ("<u2", None), (">u2", None), ("<i2", None),
     ("<u4", None), ("<i4", 0.00025)],
)  # fmt: skip
def test_arrays_of_any_numbers_are_read_in_their_unit(dtype: str, scale: float | None, tmp_path: Path) -> None:
    depth = simulated_frame(ARCH, Rig(size=(320, 240))).depth
    step = 1 if np.dtype(dtype).kind == "f" else scale or 0.001
    np.save(tmp_path / "a.npy", np.round(depth / step).astype(dtype) if step != 1 else depth.astype(dtype))
    reading = read_picture(tmp_path / "a.npy", PAPER_GRID, depth_scale=scale, cell_size=0.05)
    assert reading.kind == "depth" and iou(fitted(reading.figure, PAPER_GRID), truth(ARCH)) >= 0.88
    assert reading.cell is not None and len(reading.figure) / reading.cell == pytest.approx(4, abs=0.15)


def test_a_size_that_cannot_be_is_doubted_until_the_unit_is_told(tmp_path: Path) -> None:
    quarters = np.round(simulated_frame(CASTLE).depth * 4000).astype(np.uint16)
    Image.fromarray(quarters).save(tmp_path / "l515.png")
    with pytest.raises(StackgenError, match=r"l515\.png: the structure would be .* --depth_scale 0\.00025"):
        read_picture(tmp_path / "l515.png", PAPER_GRID)
    reading = read_picture(tmp_path / "l515.png", PAPER_GRID, depth_scale=0.00025)
    assert iou(fitted(reading.figure, PAPER_GRID), truth(CASTLE)) >= 0.9


def test_holes_and_flying_pixels_do_no_harm() -> None:
    frame = simulated_frame(CASTLE)
    seen = find_structure(frame)
    rows, columns = np.nonzero(seen.seen)
    depth = frame.depth.copy()
    middle = int(np.median(columns))
    depth[rows.max() - 40 : rows.max() - 15, middle - 12 : middle + 12] = 0  # a shiny patch
    rng = np.random.default_rng(0)
    beside = rng.choice(len(rows), 200)
    depth[rows[beside] - rng.integers(0, 12, 200), columns[beside] + rng.integers(-8, 8, 200)] += 0.08
    found = find_structure(DepthFrame(depth, None, frame.focal))
    assert iou(fitted(found.front, PAPER_GRID), fitted(seen.front, PAPER_GRID)) >= 0.95 and found.failing > 0.01


def test_a_frame_is_told_from_a_picture_of_16_bits(tmp_path: Path) -> None:
    drawn = np.where(truth(ARCH), 900, 64000).astype(np.uint16)
    Image.fromarray(drawn).save(tmp_path / "drawing.png")
    assert read_picture(tmp_path / "drawing.png", PAPER_GRID).kind == "drawing"
    with pytest.raises(StackgenError, match="nothing stands in front"):
        read_picture(tmp_path / "drawing.png", PAPER_GRID, as_="depth")


def test_the_background_alone_holds_nothing() -> None:
    empty = Stack(np.zeros(0, dtype=int), np.zeros((0, 6)))
    with pytest.raises(StackgenError, match="nothing stands in front of the background"):
        find_structure(simulated_frame(empty))


@pytest.mark.parametrize(
    ("focal", "line"), [(1.0, r"would be .* m: see"), (30.0, "too far apart to be a front"), (1e9, "no plane front")]
)
def test_a_wrong_focal_length_is_one_line_at_once(focal: float, line: str) -> None:
    with pytest.raises(StackgenError, match=line):
        find_structure(DepthFrame(simulated_frame(ARCH).depth, None, focal))


def test_a_frame_without_depth_is_refused() -> None:
    with pytest.raises(StackgenError, match="the frame has no depth"):
        DepthFrame(np.zeros((480, 640)))
    with pytest.raises(StackgenError, match="align"):
        DepthFrame(np.ones((480, 640)), np.zeros((240, 320, 3), dtype=np.uint8))


def test_examples_stay_small() -> None:
    assert all(path.stat().st_size < 60_000 for path in PHOTOS.iterdir())
