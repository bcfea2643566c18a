"""The order of placing: every state stands, every block gets to its place, and no order has a larger least margin."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.errors import StackgenError
from stackgen.geometry import mirror
from stackgen.robot.planning.build_order import BuildOrder, TopDownJaws, greedy_order, plan_order
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


def stack_of(*blocks: tuple[int, float, int]) -> Stack:
    """Blocks (shape, x, layer), upright in the plane."""
    poses = np.array([[x, 0, layer + 0.5, 0, 0, 0] for _, x, layer in blocks])
    return Stack(np.array([b[0] for b in blocks]), poses)


def part(stack: Stack, blocks: tuple[int, ...]) -> Stack:
    """Some of the blocks."""
    return Stack(stack.shapes[list(blocks)], stack.poses[list(blocks)], stack.catalogue)


SEESAW = stack_of((CUBE, 0, 0), (LONG, 0, 1), (CUBE, -1.25, 2), (RECTANGLE, 0.3, 2), (TRIANGLE, 0.3, 3))
"""The cube on the left tips the beam further than the rectangle does, which stands nearly in the middle."""

ARCH = stack_of((CUBE, -1, 0), (CUBE, 1, 0), (LONG, 0, 1), (TRIANGLE, 0, 2))
COUNTERWEIGHT = stack_of((LONG, 0.58, 0), (RECTANGLE, -1, 1), (RECTANGLE, 1.01, 1), (LONG, 0.5, 2))
"""Block 1 tips over its edge unless block 3 lies on it, and block 3 does not let it pass."""


@pytest.mark.parametrize("stack", [SEESAW, ARCH])
@pytest.mark.parametrize("checker", [None, SimulatorChecker()])
def test_every_state_of_a_safe_order_stands(stack: Stack, checker: SimulatorChecker | None) -> None:
    order = plan_order(stack, checker=checker)
    assert order.safe and order.blocked is None
    assert sorted(order.blocks) == list(range(len(stack)))
    for step in range(1, len(stack) + 1):
        state = part(stack, order.blocks[:step])
        assert SimulatorChecker().check(state).stable
        margin = StaticsChecker().check(state).margin
        assert margin is not None and order.margins[step - 1] == pytest.approx(np.degrees(margin))


@pytest.mark.parametrize("stack", [SEESAW, ARCH, mirror(SEESAW)])
def test_no_order_has_a_larger_least_margin(stack: Stack) -> None:
    """Against all permutations."""
    checker, jaws, margins = StaticsChecker(), TopDownJaws(), {}

    def margin(blocks: tuple[int, ...]) -> float:
        key = frozenset(blocks)
        if key not in margins:
            verdict = checker.check(part(stack, blocks))
            margins[key] = np.degrees(verdict.margin or 0) if verdict.stable else -1.0
        return margins[key]

    def least(order: tuple[int, ...]) -> float:
        free = all(jaws(stack, order[:i], order[i]) for i in range(len(order)))
        return min(margin(order[: i + 1]) for i in range(len(order))) if free else -1.0

    best = max(map(least, permutations(range(len(stack)))))
    assert best > 0
    assert plan_order(stack).least_margin == pytest.approx(best)


def test_the_safest_order_beats_left_to_right() -> None:
    greedy, safest = plan_order(SEESAW, strategy="greedy"), plan_order(SEESAW)
    assert greedy.blocks == (0, 1, 2, 3, 4)
    assert safest.least_margin > greedy.least_margin + 2


def test_greedy_is_bottom_up_and_left_to_right() -> None:
    shuffled = stack_of((CUBE, 1, 0), (LONG, 0, 1), (CUBE, -1, 0), (TRIANGLE, 0, 2))
    assert greedy_order(shuffled) == (2, 0, 1, 3)
    assert plan_order(shuffled, strategy="greedy").blocks == (2, 0, 1, 3)


@settings(max_examples=6, deadline=None)
@given(st.permutations(range(5)))
def test_the_numbering_of_the_blocks_does_not_matter(numbering: list[int]) -> None:
    renumbered = part(SEESAW, tuple(numbering))
    assert plan_order(renumbered).least_margin == pytest.approx(plan_order(SEESAW).least_margin)


def test_a_mirrored_stack_is_as_safe() -> None:
    assert plan_order(mirror(SEESAW)).least_margin == pytest.approx(plan_order(SEESAW).least_margin)


def test_a_counterweight_needs_a_temporary_support_and_the_step_is_named() -> None:
    order = plan_order(COUNTERWEIGHT)
    assert not order.safe and sorted(order.blocks) == [0, 1, 2, 3]
    assert order.blocked is not None and "needs a temporary support" in order.blocked and "\n" not in order.blocked
    assert "block 3 (long_rectangle) is in the way of block 1 (rectangle), and without it block 1" in order.blocked
    assert "beside its support" in order.blocked
    assert SimulatorChecker().check(COUNTERWEIGHT).stable  # it is the way there that fails


def test_without_a_gripper_the_counterweight_can_be_slid_in() -> None:
    order = plan_order(COUNTERWEIGHT, approach=lambda stack, placed, block: True)
    assert order.safe and order.blocks[-1] == 1


def test_what_would_fall_is_named_by_its_number_in_the_stack() -> None:
    """The beam, block 4, is what would tip; the cubes that it carries only lose their support."""
    tower = stack_of((RECTANGLE, 0.05, 0), (CUBE, -1.57, 2), (CUBE, -0.54, 2), (CUBE, -0.51, 3), (RECTANGLE, -0.9, 1))
    order = plan_order(tower)
    assert order.blocked is not None
    assert "block 3 (cube) is in the way of block 1 (cube), and without it block 4 (rectangle) would" in order.blocked


def test_a_gripper_that_gets_nowhere_is_said_to() -> None:
    order = plan_order(ARCH, approach=lambda stack, placed, block: False)
    assert order.blocked is not None and "the gripper does not get block" in order.blocked


def test_a_tall_block_is_held_where_the_palm_clears_its_top() -> None:
    """On end a long rectangle is taken near its top: what is a layer high beside it is not in the way."""
    stack = Stack(np.array([LONG, CUBE]), np.array([[0, 0, 1.5, 0, np.pi / 2, 0], [1.1, 0, 1.5, 0, 0, 0]]))
    assert TopDownJaws()(stack, (1,), 0)


def test_greedy_says_where_it_fails() -> None:
    cantilever = stack_of((CUBE, 0, 0), (LONG, -0.9, 1), (LONG, 0.9, 2))
    order = plan_order(cantilever, strategy="greedy")
    assert not order.safe
    assert order.blocked is not None and order.blocked.startswith(
        "step 2 of 3 needs a temporary support: once block 1 (long"
    )
    assert "centre of mass 0.40 cells beside its support" in order.blocked


def test_a_hole_is_filled_before_its_walls_rise() -> None:
    well = stack_of((CUBE, -1.02, 0), (CUBE, -1.02, 1), (CUBE, 1.02, 0), (CUBE, 1.02, 1), (CUBE, 0, 0))
    order = plan_order(well)
    assert order.safe
    place = order.blocks.index(4)
    assert place < order.blocks.index(1) and place < order.blocks.index(3)


@pytest.mark.parametrize(
    ("placed", "free"),
    [
        ((CUBE, 0.0, 2), False),  # above
        ((LONG, 1.4, 2), False),  # overhangs
        ((CUBE, 0.0, 0), True),  # below
        ((CUBE, 1.02, 1), True),  # beside
        ((CUBE, 1.02, 2), False),  # beside, a layer higher: the palm
        ((CUBE, 2.02, 2), True),
        ((TRIANGLE, 0.0, 0), True),
    ],
)
def test_the_gripper_comes_from_above(placed: tuple[int, float, int], free: bool) -> None:
    stack = stack_of((CUBE, 0, 1), placed)
    assert TopDownJaws()(stack, (1,), 0) is free
    assert TopDownJaws()(stack, (), 0)


def test_the_fingers_need_room_in_front_and_behind() -> None:
    stack = Stack(np.array([CUBE, CUBE]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 1.05, 0.5, 0, 0, 0]]))
    assert not TopDownJaws()(stack, (1,), 0)
    assert TopDownJaws()(stack.with_poses([[0, 0, 0.5, 0, 0, 0], [0, 2.2, 0.5, 0, 0, 0]]), (1,), 0)


def test_the_width_of_a_triangle_that_is_lowered_narrows_upwards() -> None:
    """A block beside the apex is beside the triangle's base, too: lowering it meets nothing."""
    stack = stack_of((TRIANGLE, 0, 1), (CUBE, -1.02, 1))
    assert TopDownJaws()(stack, (1,), 0) and TopDownJaws()(stack, (0,), 1)


@pytest.mark.parametrize("k", [0, 1])
def test_the_smallest_stacks(k: int) -> None:
    order = plan_order(part(ARCH, tuple(range(k))))
    assert order.safe and order.blocks == tuple(range(k)) and len(order.margins) == k


def test_a_tower_of_more_than_ten_blocks_is_planned_in_bounded_time() -> None:
    wall = stack_of(*[(CUBE, x, layer) for layer in range(3) for x in (-2.1, -0.7, 0.7, 2.1)])
    order = plan_order(wall, approach=lambda stack, placed, block: True)
    assert order.safe and len(order.blocks) == 12
    assert order.checks <= 12 * 252


def test_an_unknown_strategy_is_named() -> None:
    with pytest.raises(StackgenError, match="safest and greedy"):
        plan_order(ARCH, strategy="random")  # type: ignore[arg-type]


def test_the_least_margin_is_that_of_the_worst_state() -> None:
    assert BuildOrder((0, 1, 2), (20.0, 5.0, 9.0), True).least_margin == 5.0
