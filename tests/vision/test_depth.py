"""From a depth frame to a silhouette: what is recovered is what stands there."""

from __future__ import annotations

import json
import runpy
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stackgen.commands.cli import main
from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.vision import depth, drawings
from stackgen.vision.cameras import Rig, realsense_frame, simulated_frame
from stackgen.vision.depth import DepthFrame, read_frame
from stackgen.vision.masks import largest
from stackgen.world import PAPER_GRID

read_silhouette = partial(drawings.read_silhouette, grid=PAPER_GRID)
find_structure = partial(depth.find_structure, grid=PAPER_GRID)
ROOT = Path(__file__).parents[2]
PHOTOS = ROOT / "examples" / "photos"
DRAWN = runpy.run_path(str(ROOT / "examples" / "draw_photos.py"))
CASTLE, HOUSE, ARCH = (DRAWN[name] for name in ("CASTLE", "HOUSE", "ARCH"))


def truth(stack: Stack) -> np.ndarray:
    return read_silhouette(silhouette(stack, PAPER_GRID), exact=False)


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


def test_the_largest_component_bridges_small_gaps_only() -> None:
    mask = np.zeros((20, 30), dtype=bool)
    mask[:, 2:10] = mask[:, 12:16] = mask[:, 25:28] = True
    assert np.array_equal(np.flatnonzero(largest(mask, 4).any(axis=0)), [*range(2, 10), *range(12, 16)])
    assert np.array_equal(np.flatnonzero(largest(mask, 0).any(axis=0)), [*range(2, 10)])


def test_the_command_writes_what_sample_takes_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "castle.png"
    assert main(["capture", "--depth", str(PHOTOS / "stack-castle-depth.png"), "--out", str(out)]) == 0
    assert "mm wide" in capsys.readouterr().out
    assert iou(read_silhouette(out), truth(CASTLE)) >= 0.9
    assert (tmp_path / "castle-overlay.png").stat().st_size > 1000


def test_a_simulated_capture_tells_its_iou(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(ROOT / "examples" / "stacks" / "arch.json")
    assert main(["capture", "--simulate", file, "--elevation", "12", "--out", str(tmp_path / "a.png")]) == 0
    assert float(capsys.readouterr().out.split("truth: ")[1]) >= 0.9


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give one of --depth"),
        (["--depth", "no.png"], "no.png: cannot be read: No such file"),
        (["--depth", "zero.npy"], "zero.npy: the frame has no depth"),
        (["--depth", "words.npy"], "words.npy: cannot be read"),
        (["--depth", "empty.png"], "empty.png: is no depth frame"),
        (["--depth", "wall.npy"], "nothing stands in front of the background"),
        (["--realsense"], "RealSense"),
        (["--sketch", "no.jpg", "--realsense"], "give one of"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pyrealsense2", _camera_that_is_not_there())
    np.save("zero.npy", np.zeros((120, 160)))
    np.save("wall.npy", np.ones((120, 160)))
    np.save("words.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    Path("empty.png").touch()
    assert main(["capture", "--out", "out.png", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not Path("out.png").exists()


def _camera_that_is_not_there() -> SimpleNamespace:
    """As pyrealsense2 is without a camera."""

    def start(*_: object) -> None:
        raise RuntimeError("No device connected")

    return SimpleNamespace(
        pipeline=lambda: SimpleNamespace(start=start),
        config=lambda: SimpleNamespace(enable_stream=lambda *_: None),
        stream=SimpleNamespace(depth=0, color=1),
        format=SimpleNamespace(z16=0, rgb8=1),
    )


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
    camera = _camera_that_is_not_there()
    camera.pipeline = lambda: pipeline
    camera.align = lambda _: SimpleNamespace(process=lambda frames: frames)
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera)
    frame = realsense_frame()
    assert np.abs(frame.depth - sent.depth).max() < 2e-4 and stopped == [True]
    assert frame.camera == (sent.focal, 320.0, 240.0)
    assert iou(find_structure(frame).silhouette, truth(CASTLE)) >= 0.9


def test_examples_stay_small() -> None:
    assert all(path.stat().st_size < 60_000 for path in PHOTOS.iterdir())


def test_a_stack_number_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = ROOT / "examples" / "stacks" / "arch.json"
    number = len(json.loads(file.read_text())["stacks"]) + 1
    arguments = ["capture", "--simulate", str(file), "--stack", str(number), "--out", str(tmp_path / "a.png")]
    assert main(arguments) == 2
    assert "--stack must lie in 1.." in capsys.readouterr().err
