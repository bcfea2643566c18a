"""Pictures show what is there: each block in its colour, what fell in red, nothing cut off."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz import render
from stackgen.viz.render import FALLEN, save_image
from stackgen.world import PAPER_GRID

render_stack = partial(render.render_stack, grid=PAPER_GRID)
contact_sheet = partial(render.contact_sheet, grid=PAPER_GRID)
ONE_EACH = Stack(np.arange(4), np.array([[-1.5, 0, 0.5], [0.2, 0, 0.5], [0, 0, 1.5], [0, 0, 2.5]]) @ np.eye(3, 6))


def single(shape: int = 0, z: float = 0.5, x: float = 0.0) -> Stack:
    return Stack(np.array([shape]), np.array([[x, 0, z, 0, 0, 0]]))


def hue(picture: NDArray) -> NDArray:
    """(H, W) hue of the coloured pixels, -1 where grey."""
    hsv = np.asarray(Image.fromarray(picture).convert("HSV"), dtype=int)
    return np.where(hsv[..., 1] > 70, hsv[..., 0], -1)


def coloured(picture: NDArray) -> NDArray:
    return hue(picture) >= 0


def red(picture: NDArray) -> NDArray:
    return np.all(np.abs(picture.astype(int) - FALLEN) < 30, axis=-1)


def test_each_shape_has_its_own_colour_and_none_is_red() -> None:
    hues = [int(np.median(h[h >= 0])) for h in (hue(render_stack(single(s), (200, 150))) for s in range(4))]
    apart = [abs((a - b + 128) % 256 - 128) for i, a in enumerate(hues) for b in hues[:i]]
    assert min(apart) > 15
    assert min(min(h, 256 - h) for h in hues) > 15
    seen = hue(render_stack(ONE_EACH))
    assert all((np.abs(seen - h) < 6).sum() > 500 for h in hues)


def test_seen_from_straight_ahead_the_picture_is_the_silhouette() -> None:
    picture = coloured(render_stack(ONE_EACH, (400, 400), azimuth=0, elevation=0))
    shown = picture[np.ix_(np.flatnonzero(picture.any(1)), np.flatnonzero(picture.any(0)))]
    truth = silhouette(ONE_EACH, PAPER_GRID)
    truth = truth[np.ix_(np.flatnonzero(truth.any(1)), np.flatnonzero(truth.any(0)))]
    scaled = Image.fromarray(truth).resize(shown.shape[::-1], Image.Resampling.NEAREST)
    assert iou(shown, np.asarray(scaled)) > 0.93


def test_the_nearer_block_hides_the_farther_one_whatever_their_order() -> None:
    poses = np.array([[0, 0, 0.5, 0, 0, 0], [0, 2, 0.5, 0, 0, 0]])
    front_cube = Stack(np.array([0, 1]), poses)
    reverse = Stack(np.array([1, 0]), poses[::-1])
    a, b = (render_stack(s, (300, 200), azimuth=0, elevation=0.01) for s in (front_cube, reverse))
    assert (a == b).all()
    alone = render_stack(single(0), (300, 200), azimuth=0, elevation=0.01)
    cube_hue = np.median(hue(alone)[coloured(alone)])
    both = hue(a)
    middle = both[:, 150]
    assert (np.abs(middle[middle >= 0] - cube_hue) < 8).mean() > 0.85  # the rest is the far one's upper edge


def test_only_what_fell_is_outlined_in_red() -> None:
    assert not red(render_stack(ONE_EACH)).any()
    for block in range(4):
        marked = red(render_stack(ONE_EACH, fallen=np.arange(4) == block))
        assert marked.sum() > 300
    everything = red(render_stack(ONE_EACH, fallen=np.ones(4, bool)))
    assert everything.sum() > marked.sum()
    with pytest.raises(StackgenError, match="4 blocks"):
        render_stack(ONE_EACH, fallen=[True])


@pytest.mark.parametrize("x", [0.0, 9.0, -40.0, 1e9])
def test_whatever_strays_stays_in_the_picture(x: float) -> None:
    stack = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [x, 3, 0.5, 0.3, 0.2, 0.1]]))
    picture = render_stack(stack, (320, 240), elevation=0.5)
    shown = coloured(picture)
    assert shown.any()
    assert not (shown[0].any())
    assert not (shown[-1].any())
    assert not (shown[:, 0].any())
    assert not (shown[:, -1].any())


def test_a_shadow_lies_on_the_ground_and_an_empty_stack_is_an_empty_picture() -> None:
    empty = render_stack(Stack(np.zeros(0, int), np.zeros((0, 6))), (200, 150))
    assert np.ptp(empty.reshape(-1, 3).astype(int), axis=1).max() < 12
    with_block = render_stack(single(), (200, 150)).astype(int)
    darker = (empty.astype(int) - with_block).min(axis=-1) > 8
    assert (darker & ~coloured(with_block.astype(np.uint8))).sum() > 50


def test_size_and_smoothness() -> None:
    assert render_stack(ONE_EACH, (123, 77)).shape == (77, 123, 3)
    rough, fine = (render_stack(ONE_EACH, (200, 150), supersample=n).astype(float) for n in (1, 3))
    assert np.abs(rough - fine).mean() < 12


def test_a_contact_sheet_has_a_panel_for_each_and_tells_what_fell() -> None:
    stands = Verdict(True, np.zeros(4, bool), np.zeros(4), ONE_EACH)
    falls = Verdict(False, np.arange(4) == 2, np.array([0, 0, 1.5, 0.1]), ONE_EACH)
    target = silhouette(ONE_EACH, PAPER_GRID)
    sheet = contact_sheet(target, [ONE_EACH, ONE_EACH, ONE_EACH], [stands, falls, None], [0.91, 0.0, None], "arch.png")
    width = sheet.shape[1] // 4
    reds = [red(sheet[:, i * width : (i + 1) * width]).sum() for i in range(4)]
    assert reds[2] > 300
    assert reds[0] == reds[1] == reds[3] == 0
    tiles = [coloured(sheet[:, i * width : (i + 1) * width]).sum() for i in range(4)]
    assert tiles[0] == 0
    assert min(tiles[1:]) > 1000
    assert sheet.shape[0] < contact_sheet(target, [ONE_EACH] * 4).shape[0]  # a second row
    assert contact_sheet(None, [ONE_EACH]).shape[1] < sheet.shape[1] / 2
    with pytest.raises(StackgenError, match="2 stacks"):
        contact_sheet(target, [ONE_EACH] * 2, [stands])


def test_long_titles_do_not_widen_the_sheet() -> None:
    a, b = (contact_sheet(None, [ONE_EACH], title=t) for t in ("short", "long\nand strange \u2603 " * 30))
    assert a.shape == b.shape


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPEG"])
def test_an_image_is_saved_by_its_suffix(suffix: str, tmp_path: Path) -> None:
    picture = render_stack(ONE_EACH, (90, 60))
    save_image(tmp_path / f"a{suffix}", picture)
    back = np.asarray(Image.open(tmp_path / f"a{suffix}")).astype(int)
    assert np.abs(back - picture).mean() < (0.1 if suffix == ".png" else 6)
    save_image(tmp_path / "mask.png", silhouette(ONE_EACH, PAPER_GRID))
    assert (np.asarray(Image.open(tmp_path / "mask.png")) == silhouette(ONE_EACH, PAPER_GRID) * 255).all()
    with pytest.raises(StackgenError, match="suffix"):
        save_image(tmp_path / "a.gif", picture)
    assert len(list(tmp_path.iterdir())) == 2


def test_drawing_needs_no_torch_and_no_matplotlib() -> None:
    code = (
        "import sys, numpy as np; from stackgen.viz.render import *; from stackgen.stack import Stack;"
        "import stackgen.viz.raster, stackgen.vision.drawings; assert 'cv2' not in sys.modules;"
        "contact_sheet(np.eye(64) > 0, [Stack([0], [[0, 0, 0.5, 0, 0, 0]])], grid=Grid());"
        "import stackgen.viz.gltf, stackgen.viz.page, stackgen.vision.drawings, stackgen.io.stacks_file;"
        "print([m for m in ('torch', 'matplotlib', 'trimesh', 'pybullet', 'jsonschema') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
