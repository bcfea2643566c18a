"""Construction by deconstruction: what is kept stands, is four cells high, and is there once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from stackgen.data.generation.deconstruction import Settler, deconstruct, surely_falls
from stackgen.data.generation.designs import Design, draw_design, realize
from stackgen.geometry import block_vertices, tilt
from stackgen.sim.checkers import AcceptLimits, accept, fell
from stackgen.sim.simulator import Rollout, Simulator
from stackgen.sim.statics.plane import StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD

Family = list[tuple[tuple[int, ...], Stack]]

LIMITS = AcceptLimits()


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    with Simulator() as simulator:
        yield simulator


@pytest.fixture(scope="module")
def families(simulator: Simulator) -> list[tuple[Stack, Family]]:
    """Four templates that stand, and all that is left of them."""
    settler = Settler(simulator, LIMITS, settle_twice=True)
    found: list[tuple[Stack, Family]] = []
    rng = np.random.default_rng(3)
    while len(found) < 4:
        template = realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)
        if len(template) > 9:
            continue
        family = list(deconstruct(template, settler))
        if len(family) > 3:
            found.append((template, family))
    return found


def without(stack: Stack, *blocks: int) -> Stack:
    keep = [b for b in range(len(stack)) if b not in blocks]
    return Stack(stack.shapes[keep], stack.poses[keep])


def upright(*blocks: tuple[int, float, float]) -> Stack:
    """Blocks as (shape, x, z)."""
    return Stack(np.array([b[0] for b in blocks]), np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks]))


def of(key: str) -> Stack:
    """A design as text, put down on its cells."""
    rng = np.random.default_rng(0)
    stack = realize(Design.from_key(key), rng, PAPER_WORLD)
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
    settler = Settler(simulator, LIMITS, settle_twice=False)
    table = of("0@0,0@1,0@2/2@0/2@0/1@0,0@2")
    ways = [[removed for removed, _ in deconstruct(table, settler, most)] for most in range(3)]
    assert ways[0] == [()]
    assert len(ways[0]) < len(ways[1]) < len(ways[2])
    assert ways[2][: len(ways[1])] == ways[1]


def test_the_last_block_of_the_top_row_stays(simulator: Simulator) -> None:
    settler = Settler(simulator, LIMITS, settle_twice=False)
    tower = of("2@0/2@0/2@0/1@0,0@2")
    ways = {removed for removed, _ in deconstruct(tower, settler)}
    assert ways == {(), (3,), (4,)}  # either of the top row, never both; each lower one carries all


def test_a_design_that_falls_gives_nothing(simulator: Simulator) -> None:
    settler = Settler(simulator, LIMITS, settle_twice=False)
    assert list(deconstruct(of("0@0/2@0/2@0/2@0"), settler)) == []


def test_settling_twice_is_stricter_and_settling_is_what_it_says(simulator: Simulator) -> None:
    once, twice = (Settler(simulator, LIMITS, settle_twice=t) for t in (False, True))
    stack = of("2@0/1@0,0@2/2@0/3@1")
    rollout = simulator.rollout(stack)
    settled, again = once.settle(stack), twice.settle(stack)
    assert settled is not None and again is not None
    assert (settled.stack.poses == rollout.end.poses).all()
    assert (again.stack.poses == simulator.rollout(rollout.end).end.poses).all()
    assert Settler(simulator, AcceptLimits(displacement=1e-9), False).settle(stack) is None


# The short cuts past the simulator.


class Counting:
    """A simulator that counts what it is asked."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.physics = simulator.physics
        self.rollouts = 0

    def rollout(self, stack: Stack, **options: float) -> Rollout:
        self.rollouts += 1
        return self.simulator.rollout(stack, **options)  # type: ignore[arg-type]


def certified(simulator: Simulator | Counting, **margins: float) -> Settler:
    return Settler(simulator, LIMITS, settle_twice=True, margins=replace(StaticsMargins(), **margins))  # type: ignore[arg-type]


def test_with_statics_the_family_of_a_sure_design_is_the_same_but_for_what_has_no_margin(
    families: list[tuple[Stack, Family]], simulator: Simulator
) -> None:
    counting = Counting(simulator)
    settler = certified(counting)
    sure = both = differ = 0
    for template, family in families:
        ways, simulated = {way for way, _ in deconstruct(template, settler)}, {way for way, _ in family}
        if ways:  # else the design is one at its limit
            sure += 1
            both += len(ways & simulated)
            differ += len(ways ^ simulated)
    assert sure >= 3 and both > 20 and differ <= 0.1 * both
    assert sure <= counting.rollouts < 0.5 * both


def test_what_is_certain_to_stand_stays_where_it_was(
    families: list[tuple[Stack, Family]], simulator: Simulator
) -> None:
    counting = Counting(simulator)
    settled = certified(counting).settle(families[0][0])
    assert settled is not None and settled.outcome == "stands" and counting.rollouts == 1
    for place in range(len(settled.stack)):
        rest = settled.less(place)
        kept = np.delete(np.arange(len(settled.stack)), place)
        assert (rest.part == kept).all() and (rest.stack.poses == settled.stack.poses[kept]).all()
        if rest.outcome != "unsure":
            before = counting.rollouts
            assert certified(counting).settle_rest(rest) is (rest if rest.outcome == "stands" else None)
            assert counting.rollouts == before


def test_a_family_does_not_depend_on_what_was_judged_before(
    families: list[tuple[Stack, Family]], simulator: Simulator
) -> None:
    settler = certified(simulator, inset=0.05)  # more that is unsure
    (first, _), (second, _) = families[:2]

    def content(template: Stack) -> list[tuple[tuple[int, ...], bytes]]:
        return [(way, stack.poses.tobytes()) for way, stack in deconstruct(template, settler, 2)]

    alone = content(second)
    content(first)
    assert content(second) == alone and len(alone) > 3


def test_only_sure_designs_are_built_unless_one_says_otherwise(simulator: Simulator) -> None:
    """The rectangle's centre of mass is 0.01 cells inside the edge of the cube that bears it."""
    design = upright((0, 0, 0.5), (1, 0.49, 1.5))
    counting = Counting(simulator)
    assert certified(counting).settle(design) is None and counting.rollouts == 0
    certified(counting, sure_designs=False).settle(design)
    assert counting.rollouts >= 1
    fallen = upright((0, 0, 0.5), (1, 0.6, 1.5))
    before = counting.rollouts
    assert certified(counting, sure_designs=False).settle(fallen) is None and counting.rollouts == before


def test_what_leans_is_no_data_even_if_it_stands(simulator: Simulator) -> None:
    """A cube beside its support comes to lean on a pillar."""
    leaning = upright((0, 0, 0.5), (0, 0.51, 1.5), (0, 1.53, 0.5), (0, 1.53, 1.5))
    simulated, settler = Settler(simulator, LIMITS, settle_twice=True), certified(simulator, sure_designs=False)
    assert simulated.settle(leaning) is not None
    assert settler.settle(leaning) is None


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
