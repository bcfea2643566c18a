"""Every kind of picture is read in the way that suits it, and the first stack that can be built is planned."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from stackgen.api import Model
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.robot.build import plan_stack
from stackgen.robot.candidates import first_buildable, silhouette_of, stacks_of_picture
from stackgen.robot.workcell import Staging, Workcell
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.vision.reader import read_silhouette
from stackgen.viz.render import save_image
from stackgen.world import PAPER_GRID
from tests.conftest import TowerSampler

ROOT = Path(__file__).parents[2]
WORKCELL = Workcell(staging=Staging(straighten=False))


def cube(x: float, z: float) -> Stack:
    return Stack(np.array([0]), np.array([[x, 0, z, 0, 0, 0]]))


def test_a_clean_picture_and_the_photo_of_an_outline_are_both_read(tmp_path: Path) -> None:
    clean = silhouette_of(ROOT / "examples" / "silhouettes" / "arch.png", PAPER_GRID)
    assert np.array_equal(clean, read_silhouette(ROOT / "examples" / "silhouettes" / "arch.png", PAPER_GRID))
    light = np.linspace(150, 235, 400)[None, :] * np.ones((300, 1))  # paper in uneven light
    photo = light.copy()
    photo[60:240, 160:240] = 30
    photo[68:232, 168:232] = light[68:232, 168:232]  # only the outline of a tower is drawn
    file = tmp_path / "photo.png"
    save_image(file, np.repeat(photo.astype(np.uint8)[..., None], 3, axis=2))
    seen = silhouette_of(file, PAPER_GRID)
    rows, columns = np.nonzero(seen)
    assert seen[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].mean() > 0.9  # filled in


def test_a_depth_frame_is_seen_as_capture_does() -> None:
    seen = silhouette_of(ROOT / "examples" / "photos" / "stack-house-depth.png", PAPER_GRID)
    house = silhouette_of(ROOT / "examples" / "photos" / "sketch-house.jpg", PAPER_GRID)
    assert iou(seen, house) > 0.98  # the same house


def test_the_line_about_a_depth_frame_names_its_file(tmp_path: Path) -> None:
    np.save(tmp_path / "wall.npy", np.full((120, 160), 1.0))
    with pytest.raises(StackgenError, match=r"wall\.npy: nothing stands in front"):
        silhouette_of(tmp_path / "wall.npy", PAPER_GRID)


def test_the_first_stack_that_can_be_built_is_planned() -> None:
    hanging, far, near = cube(0, 2.5), cube(30, 0.5), cube(1, 0.5)
    placed: list[int] = []
    plan = partial(plan_stack, workcell=WORKCELL, physics=Physics(), solver="closed-form", on_block=placed.append)
    planned = first_buildable([hanging, far, near], plan)
    assert planned.design.stack.poses[0, 0] == pytest.approx(1, abs=0.01)
    assert planned.plan.order == (0,) and placed == [1]


def test_where_none_can_be_built_the_first_says_why() -> None:
    with pytest.raises(StackgenError, match=r"block 0 \(cube\) would fall"):
        first_buildable([cube(0, 2.5), cube(30, 0.5)], partial(plan_stack, workcell=WORKCELL, physics=Physics()))


def test_of_a_picture_only_stacks_that_stand_are_kept_the_best_first(towers: Model) -> None:
    steps: list[int] = []
    arch = ROOT / "examples" / "silhouettes" / "arch.png"
    found = stacks_of_picture(arch, towers, seed=1, budget="6", on_step=lambda: steps.append(1))
    assert found.silhouette == "arch.png" and found.target is not None and 1 < len(steps) <= 4
    overlaps = [entry.front_iou or 0.0 for entry in found.entries]
    assert overlaps == sorted(overlaps, reverse=True) and all(e.verdict and e.verdict.stable for e in found.entries)


def test_a_picture_of_which_no_stack_stands_is_one_line(towers: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TowerSampler, "_tower", staticmethod(lambda counts, rng: cube(0, 2.5)))
    with pytest.raises(StackgenError, match="none of the stacks that were tried stands; try a larger --budget"):
        stacks_of_picture(ROOT / "examples" / "silhouettes" / "arch.png", towers, budget="3")
