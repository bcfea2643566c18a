"""Construction by deconstruction: what is kept stands, is four cells high, and is there once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from stackgen.data.generation.deconstruction import Judge, deconstruct, surely_falls
from stackgen.data.generation.templates import Template, draw_template, realize
from stackgen.geometry import block_vertices, tilt
from stackgen.sim.verdict import AcceptLimits, accept, fell
from stackgen.sim.world import Simulator
from stackgen.stack import Stack

Family = list[tuple[tuple[int, ...], Stack]]

LIMITS = AcceptLimits()


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


@pytest.fixture(scope="module")
def families(simulator: Simulator) -> list[tuple[Stack, Family]]:
    """Four templates that stand, and all that is left of them."""
    judge = Judge(simulator, LIMITS, settle_twice=True)
    found: list[tuple[Stack, Family]] = []
    rng = np.random.default_rng(3)
    while len(found) < 4:
        template = realize(draw_template(rng), rng)
        if len(template) > 9:
            continue
        family = list(deconstruct(template, judge))
        if len(family) > 3:
            found.append((template, family))
    return found


def without(stack: Stack, *blocks: int) -> Stack:
    keep = [b for b in range(len(stack)) if b not in blocks]
    return Stack(stack.shapes[keep], stack.poses[keep])


def of(key: str) -> Stack:
    """A design as text, put down on its cells."""
    rng = np.random.default_rng(0)
    stack = realize(Template.from_key(key), rng)
    poses = stack.poses.copy()
    poses[:, 0] = np.round(poses[:, 0] * 2) / 2
    return stack.with_poses(poses)


def test_every_stack_is_four_cells_high(families: list[tuple[Stack, Family]]) -> None:
    for _, family in families:
        for _, stack in family:
            corners = np.concatenate(block_vertices(stack))
            assert corners[:, 2].max() == pytest.approx(4, abs=0.15)
            assert corners[:, 2].min() == pytest.approx(0, abs=0.05)


def test_at_most_four_blocks_are_taken_and_no_way_of_taking_them_twice(families: list[tuple[Stack, Family]]) -> None:
    for template, family in families:
        ways = [removed for removed, _ in family]
        assert ways[0] == () and len(set(ways)) == len(ways)
        assert all(removed == tuple(sorted(set(removed))) and len(removed) <= 4 for removed in ways)
        assert [len(removed) for removed in ways] == sorted(len(removed) for removed in ways)
        for removed, stack in family:
            assert stack.shapes.tolist() == np.delete(template.shapes, removed).tolist()


def test_every_stack_is_one_removal_away_from_a_stack_that_stands(families: list[tuple[Stack, Family]]) -> None:
    for _, family in families:
        ways = {removed for removed, _ in family}
        for removed in ways - {()}:
            assert any(tuple(b for b in removed if b != block) in ways for block in removed)


def test_every_first_removal_was_tried(families: list[tuple[Stack, Family]], simulator: Simulator) -> None:
    """What is missing falls, or would take the last block of the top row."""
    for template, family in families:
        settled, ways = family[0][1], {removed for removed, _ in family}
        top = np.flatnonzero(template.poses[:, 2] == template.poses[:, 2].max())
        for block in range(len(template)):
            first = simulator.rollout(without(settled, block))
            stands = accept(first, LIMITS) and accept(simulator.rollout(first.end), LIMITS)
            assert ((block,) in ways) == (stands and top.tolist() != [block])


def test_what_is_kept_stands_when_it_is_put_down_again(
    families: list[tuple[Stack, Family]], simulator: Simulator
) -> None:
    stacks = [stack for _, family in families for _, stack in family]
    rollouts = [simulator.rollout(stack) for stack in stacks]
    assert len(rollouts) > 20
    assert not any(fell(rollout, simulator.physics).any() for rollout in rollouts)
    assert np.mean([accept(rollout, LIMITS) for rollout in rollouts]) > 0.98
    assert max(tilt(stack.poses).max() for stack in stacks) < 0.3


def test_what_is_kept_differs(families: list[tuple[Stack, Family]]) -> None:
    for _, family in families:
        seen: list[Stack] = []
        for _, stack in family:
            for other in seen:
                same = stack.shapes.tolist() == other.shapes.tolist()
                assert not same or np.abs(stack.poses - other.poses).max() > 0.5
            seen.append(stack)


def test_the_number_of_removals_is_a_setting(simulator: Simulator) -> None:
    judge = Judge(simulator, LIMITS, settle_twice=False)
    table = of("0@0,0@1,0@2/2@0/2@0/1@0,0@2")
    ways = [[removed for removed, _ in deconstruct(table, judge, most)] for most in range(3)]
    assert ways[0] == [()]
    assert len(ways[0]) < len(ways[1]) < len(ways[2])
    assert ways[2][: len(ways[1])] == ways[1]


def test_the_last_block_of_the_top_row_stays(simulator: Simulator) -> None:
    judge = Judge(simulator, LIMITS, settle_twice=False)
    tower = of("2@0/2@0/2@0/1@0,0@2")
    ways = {removed for removed, _ in deconstruct(tower, judge)}
    assert ways == {(), (3,), (4,)}  # either of the top row, never both; each lower one carries all


def test_a_design_that_falls_gives_nothing(simulator: Simulator) -> None:
    judge = Judge(simulator, LIMITS, settle_twice=False)
    assert list(deconstruct(of("0@0/2@0/2@0/2@0"), judge)) == []


def test_settling_twice_is_stricter_and_settling_is_what_it_says(simulator: Simulator) -> None:
    once, twice = (Judge(simulator, LIMITS, settle_twice=t) for t in (False, True))
    stack = of("2@0/1@0,0@2/2@0/3@1")
    rollout = simulator.rollout(stack)
    settled, again = once.settle(stack), twice.settle(stack)
    assert settled is not None and again is not None
    assert (settled.poses == rollout.end.poses).all()
    assert (again.poses == simulator.rollout(rollout.end).end.poses).all()
    assert Judge(simulator, AcceptLimits(displacement=1e-9), False).settle(stack) is None


# The short cut past the simulator.


def test_what_surely_falls_is_never_what_the_simulator_accepts(
    families: list[tuple[Stack, Family]], simulator: Simulator
) -> None:
    rng = np.random.default_rng(0)
    sure = 0
    for _ in range(60):
        _, family = families[rng.integers(len(families))]
        stack = family[rng.integers(len(family))][1]
        rest = without(stack, *rng.permutation(len(stack))[: rng.integers(1, 3)])
        if surely_falls(rest):
            sure += 1
            assert not accept(simulator.rollout(rest), LIMITS)
    assert 15 < sure < 60


@pytest.mark.parametrize(
    ("stack", "falls"),
    [
        (of("2@0/2@0/1@0/3@1"), False),
        (without(of("2@0/2@0/1@0/3@1"), 1), True),  # a floor is missing
        (of("0@0/0@1"), True),  # beside, not above
        (of("1@0/2@0"), False),  # the centre of mass is above the edge: too close to say
        (of("0@0/2@0"), True),
        (of("0@0,0@2/2@0"), False),  # a bridge
        (of("0@0/2@0/0@0"), False),  # an overhang with a weight on it is for the simulator
        (of("0@3"), False),
    ],
)
def test_what_surely_falls(stack: Stack, falls: bool) -> None:
    assert surely_falls(stack) is falls
