"""Every kind of picture is read in the way that suits it, and the first stack that can be built is planned."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from stackgen.api import Model
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import StackEntry, StacksFile
from stackgen.protocols import Verdict
from stackgen.robot import candidates
from stackgen.robot.build import plan_stack
from stackgen.robot.candidates import NUMBER, first_buildable, stacks_of_picture
from stackgen.robot.workcell import Staging, Workcell
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.vision.reader import read_picture
from stackgen.world import PAPER_GRID, PAPER_WORLD
from tests.conftest import TowerSampler

ROOT = Path(__file__).parents[2]
WORKCELL = Workcell(staging=Staging(straighten=False))


def cube(x: float, z: float) -> Stack:
    return Stack(np.array([0]), np.array([[x, 0, z, 0, 0, 0]]))


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
    arch = read_picture(ROOT / "examples" / "silhouettes" / "arch.png", PAPER_GRID)
    found = stacks_of_picture(arch, "arch.png", towers, seed=1, budget="6", on_step=lambda: steps.append(1))
    assert found.silhouette == "arch.png" and found.target is not None and 1 < len(steps) <= 4
    overlaps = [entry.front_iou or 0.0 for entry in found.entries]
    assert overlaps == sorted(overlaps, reverse=True) and all(e.verdict and e.verdict.stable for e in found.entries)


def test_a_picture_of_which_no_stack_stands_is_one_line(towers: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TowerSampler, "_tower", staticmethod(lambda counts, rng: cube(0, 2.5)))
    arch = read_picture(ROOT / "examples" / "silhouettes" / "arch.png", PAPER_GRID)
    with pytest.raises(StackgenError, match="none of the stacks that were tried stands; try a larger --budget"):
        stacks_of_picture(arch, "arch.png", towers, budget="3")
    with pytest.raises(StackgenError, match="leave out --weights"):
        stacks_of_picture(arch, "arch.png", towers, cells="4")


def test_where_the_best_stacks_have_too_many_blocks_the_best_of_the_smaller_ones_are_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answers = {"auto": (17, 0.96), "5": (10, 0.84), "4": (7, 0.91), "3": (5, 0.82)}  # blocks and IoU by cells

    def best(*_: object, cells: str, **__: object) -> StacksFile:
        blocks, overlap = answers[cells]
        stack = Stack(np.zeros(blocks, np.int64), np.zeros((blocks, 6)))
        verdict = Verdict(True, np.zeros(blocks, bool), np.zeros(blocks), stack)
        return StacksFile((StackEntry(stack, verdict, overlap),), PAPER_WORLD)

    monkeypatch.setattr(candidates, "best", best)
    wall = read_picture(np.pad(np.ones((60, 60), bool), 9), PAPER_GRID)
    assert [len(stacks_of_picture(wall, "a", most=most).entries[0].stack) for most in (17, 12, 5)] == [17, 7, 5]
    assert len(stacks_of_picture(wall, "a", cells="5", most=5).entries[0].stack) == 10  # as it was asked for


def test_the_work_proceeds_in_no_more_steps_than_were_told_however_many_scales_are_tried() -> None:
    steps: list[int] = []
    wall = read_picture(np.ones((60, 60), bool) & (np.indices((60, 60)).sum(0) > 20), PAPER_GRID)
    found = stacks_of_picture(wall, "wall.png", most=0, on_step=lambda: steps.append(1))
    assert len(found.entries) > 0 and len(steps) == NUMBER + 1
