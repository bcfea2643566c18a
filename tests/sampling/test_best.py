"""The best stacks of a drawing: search first, the network where it finds too little, the simulator's word on all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.protocols import Verdict
from stackgen.sampling.best import ENOUGH, best_stacks
from stackgen.search.problem import SearchSettings
from stackgen.search.scale import Cells
from stackgen.search.solver import solve
from stackgen.sim.checkers import SimulatorChecker
from stackgen.stack import Stack
from stackgen.vision.reader import read_picture
from stackgen.world import PAPER_GRID, PAPER_WORLD, Mask

TOWER = Stack(np.zeros(4, int), np.array([[0, 0, z + 0.5, 0, 0, 0] for z in range(4)]))
SLANT = np.pad(np.tri(40, 120, 0, bool) ^ np.tri(40, 120, -30, bool), 40)  # no stack has an IoU of 0.8 with it


def ask_nobody(target: Mask, block_list: object) -> Sequence[Stack]:
    raise AssertionError("the search has an answer: the network is not to be asked")


def test_who_has_a_good_answer_asks_nobody_else() -> None:
    reading = read_picture(silhouette(TOWER, PAPER_GRID), PAPER_GRID)
    found = best_stacks(reading, PAPER_WORLD, SimulatorChecker(), proposals=ask_nobody)
    assert found.asked == (len(found.chosen), 0) and found.chosen[0].front_iou > 0.98 and not found.late


def test_the_network_is_asked_where_nothing_fits_and_its_stacks_are_delivered_as_they_settled() -> None:
    asked: list[Mask] = []

    def proposals(target: Mask, block_list: object) -> Sequence[Stack]:
        asked.append(target)
        return [
            Stack(np.array([0, 1]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.52, 0, 0, 0]]))
        ]  # the upper one floats

    found = best_stacks(
        read_picture(SLANT, PAPER_GRID),
        PAPER_WORLD,
        SimulatorChecker(),
        cells=Cells(2),
        number=99,
        settings=SearchSettings(near=1),
        proposals=proposals,
    )
    assert len(asked) == 1 and asked[0].shape == (64, 64) and found.asked[1] == 1
    assert max(candidate.front_iou for candidate in found.chosen) < ENOUGH
    (proposed,) = [c.stack for c in found.chosen if not np.isclose(c.stack.poses[:, 2] % 0.5, 0).all()]
    assert proposed.poses[:, 2] == pytest.approx([0.5, 1.5], abs=0.01)


def test_the_largest_margin_comes_first_where_that_is_preferred() -> None:
    reading = read_picture(silhouette(TOWER, PAPER_GRID), PAPER_GRID)
    settings = SearchSettings(prefer="margin")
    found = best_stacks(reading, PAPER_WORLD, SimulatorChecker(), settings=settings)
    wanted = solve(found.target, PAPER_WORLD, settings=settings)
    assert [one.layout for one in found.chosen] == [answer.layout for answer in wanted]


def test_the_checker_has_the_last_word() -> None:
    class Nay(SimulatorChecker):
        def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
            return [Verdict(False, np.ones(len(s), bool), np.ones(len(s)), s) for s in stacks]

    reading = read_picture(silhouette(TOWER, PAPER_GRID), PAPER_GRID)
    assert not any(c.verdict.stable for c in best_stacks(reading, PAPER_WORLD, Nay()).chosen)


def test_a_budget_that_is_too_small_gives_the_best_so_far_and_says_so() -> None:
    found = best_stacks(
        read_picture(SLANT, PAPER_GRID),
        PAPER_WORLD,
        SimulatorChecker(),
        cells=Cells(3),
        settings=SearchSettings(seconds=1e-3),
    )
    assert found.late and len(found.chosen) >= 1


def test_blocks_that_can_build_nothing_are_one_line() -> None:
    with pytest.raises(StackgenError, match="nothing that stands was found; give more cells"):
        best_stacks(
            read_picture(silhouette(TOWER, PAPER_GRID), PAPER_GRID),
            PAPER_WORLD,
            SimulatorChecker(),
            block_list=np.array([0, 0, 0, 10]),
        )
