"""Blocks wait on the face they will stand on, in slots that they fit, with room made between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices
from stackgen.robot.planning.staging import lay_out, make_room, push_path
from stackgen.robot.workcell import Base, Jaws, Staging, Workcell
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE


def stack_of(shapes: Sequence[int], poses: Sequence[Sequence[float]]) -> Stack:
    return Stack(np.array(shapes), np.array(poses, dtype=float))


WORKCELL, SIZE = Workcell(), 0.05
FEW = Workcell(staging=Staging(slots=((0.3, 0.0, 0.0),)))


def row(*xs: float) -> Stack:
    return stack_of([0] * len(xs), [[x, 0, 0.5, 0, 0, 0] for x in xs])


@pytest.mark.parametrize("shape", range(4))
@pytest.mark.parametrize("lean", [-0.1, 0.0, 0.15])
def test_a_block_waits_on_the_table_on_its_lowest_face(shape: int, lean: float) -> None:
    stack = stack_of([shape], [[0, 0, 0.5, 0, lean, 0.3]])
    waiting = lay_out(stack, (0,), WORKCELL, SIZE)[0]
    corners = stack.catalogue[shape].vertices * SIZE @ waiting.frame[:3, :3].T + waiting.frame[:3, 3]
    slot = WORKCELL.staging.slots[0]
    assert corners[:, 2].min() == pytest.approx(0, abs=1e-12)
    assert np.count_nonzero(corners[:, 2] < 1e-9) >= 4  # a face, not an edge
    assert (corners.min(axis=0) + corners.max(axis=0))[:2] / 2 == pytest.approx(slot[:2])
    assert corners[:, 2].max() == pytest.approx(waiting.top)


def test_a_plank_on_its_end_waits_on_its_end() -> None:
    stack = stack_of([1], [[0, 0, 1.0, 0, math.pi / 2, 0]])
    assert lay_out(stack, (0,), WORKCELL, SIZE)[0].top == pytest.approx(2 * SIZE)


def test_fingers_push_from_both_ends_to_the_middle_of_the_slot() -> None:
    waiting = lay_out(stack_of([1], [[0, 0, 0.5, 0, 0, 0]]), (0,), WORKCELL, SIZE)[0]
    slot = np.array(WORKCELL.staging.slots[0][:2])
    for side in (-1, 1):
        beside, stop, away = (frame[:3, 3] for frame in push_path(waiting, side, WORKCELL))
        assert stop[0] - slot[0] == pytest.approx(side * (SIZE + WORKCELL.jaws.pad_width / 2))
        assert side * (beside[0] - stop[0]) > side * (away[0] - stop[0]) > 0
        assert beside[1:] == pytest.approx(stop[1:])


def refused(stack: Stack, workcell: Workcell) -> str:
    with pytest.raises(StackgenError) as error:
        lay_out(stack, tuple(range(len(stack))), workcell, SIZE)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_does_not_fit_is_refused() -> None:
    narrow = Workcell(jaws=replace(Jaws(), opening=0.06))
    short = Workcell(staging=replace(Staging(), length=0.15))
    lying = stack_of([0], [[0, 0, 0.5, 0.8, 0, 0]])
    assert "wider than the jaws" in refused(row(0), narrow)
    assert "too small: 2 blocks, but 1 slots" in refused(row(0, 2), FEW)
    assert "too small: block 0 (rectangle)" in refused(stack_of([1], [[0, 0, 0.5, 0, 0, 0]]), short)
    assert "leans more than 20 degrees" in refused(lying, WORKCELL)


def test_a_workcell_of_numbers_that_make_no_sense_is_refused() -> None:
    for change in ({"base": Base(yaw=np.nan)}, {"home": (np.inf,) * 6}, {"jaws": replace(Jaws(), force=0.0)}):
        with pytest.raises(StackgenError, match=r"cell: (yaw|home|force) must be"):
            Workcell(**change)


def gaps(stack: Stack) -> list[float]:
    corners = sorted(block_vertices(stack), key=lambda block: float(block[:, 0].min()))
    return [float(b[:, 0].min() - a[:, 0].max()) for a, b in pairwise(corners)]


def test_blocks_that_touch_are_moved_apart_and_others_stay() -> None:
    roomy = make_room(row(-1, 0, 1, 2.5), 0.05)
    assert gaps(roomy)[:2] == pytest.approx([0.05, 0.05], abs=1e-6)
    assert roomy.poses[:3, 0].mean() == pytest.approx(0, abs=1e-9)
    assert roomy.poses[3, 0] == 2.5
    assert np.array_equal(roomy.poses[:, 1:], row(-1, 0, 1, 2.5).poses[:, 1:])


def test_blocks_one_on_the_other_are_left_alone() -> None:
    tower = stack_of([0, 0], [[0, 0, 0.5, 0, 0, 0], [0.1, 0, 1.5, 0, 0, 0]])
    assert np.array_equal(make_room(tower, 0.05).poses, tower.poses)


def test_every_shape_of_the_paper_fits_the_shipped_cell() -> None:
    poses = [[0, 0, 0.5, 0, 0, 0]] * len(PAPER_CATALOGUE)
    assert len(lay_out(stack_of(range(len(PAPER_CATALOGUE)), poses), (0, 1, 2, 3), WORKCELL, SIZE)) == 4
