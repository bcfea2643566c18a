"""Statics that may speak for the simulator: what it is certain of is so, and what it cannot know it leaves open."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.geometry import mirror
from stackgen.sim.checkers import AcceptLimits, accept
from stackgen.sim.simulator import Simulator
from stackgen.sim.statics.contacts import GROUND, find_contacts, find_plane_contacts
from stackgen.sim.statics.plane import PlaneStatics, StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD

FRICTION = 0.5
CUBE, RECTANGLE, LONG, TRIANGLE = range(4)


def stack_of(*blocks: tuple[int, float, float]) -> Stack:
    """Upright blocks: (shape, x, z)."""
    return Stack(np.array([b[0] for b in blocks]), np.array([[x, 0, z, 0, 0, 0] for _, x, z in blocks]))


def outcome(stack: Stack, *blocks: int, **margins: Any) -> str:
    """Of the blocks with these numbers, or of all."""
    part = np.array(blocks or range(len(stack)))
    return PlaneStatics(stack, FRICTION, replace(StaticsMargins(), **margins)).outcome(part)


def overhang(by: float) -> Stack:
    """A cube whose centre of mass lies beside the edge of the one below by so much (negative: above it)."""
    return stack_of((CUBE, 0, 0.5), (CUBE, 0.5 + by, 1.5))


def designs(number: int, seed: int = 0) -> list[Stack]:
    rng = np.random.default_rng(seed)
    return [realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD) for _ in range(number)]


# Cases that can be told by hand.


@pytest.mark.parametrize(
    ("by", "expected"), [(-0.3, "stands"), (-0.08, "stands"), (-0.01, "unsure"), (0.01, "falls"), (0.3, "falls")]
)
def test_an_overhang_is_certain_only_away_from_the_edge(by: float, expected: str) -> None:
    assert outcome(overhang(by)) == expected
    assert outcome(mirror(overhang(by))) == expected


@pytest.mark.parametrize("margin", [0.05, 0.1])
def test_each_margin_is_as_wide_as_it_says(margin: float) -> None:
    """The pull acts half a cell above the edge: pull * 0.5 has to stay inside, too."""
    inset = {"inset": margin, "pull": 0.0}
    assert [outcome(overhang(-margin + d), **inset) for d in (-3e-3, 3e-3)] == ["stands", "unsure"]
    pull = {"inset": 0.0, "pull": margin}
    assert [outcome(overhang(-margin / 2 + d), **pull) for d in (-3e-3, 3e-3)] == ["stands", "unsure"]
    outset = {"outset": margin}
    assert [outcome(overhang(margin + d), **outset) for d in (-3e-3, 3e-3)] == ["unsure", "falls"]


def test_a_counterweight_holds_what_would_fall_without_it() -> None:
    beam = stack_of((CUBE, 0, 0.5), (LONG, 0.8, 1.5), (CUBE, -0.2, 2.5), (RECTANGLE, -0.2, 3.5))
    assert outcome(beam, 0, 1) == "falls"
    assert outcome(beam) == "stands"


def test_a_bridge_needs_both_its_piers() -> None:
    bridge = stack_of((CUBE, -1, 0.5), (CUBE, 1, 0.5), (LONG, 0, 1.5), (CUBE, 0, 2.5))
    assert outcome(bridge) == "stands"
    assert [outcome(bridge, 0, 2, 3), outcome(bridge, 1, 2, 3), outcome(bridge, 0, 1, 3)] == ["falls"] * 3
    assert outcome(bridge, 0, 1, 2) == "stands"


def test_friction_alone_holds_nothing_for_certain() -> None:
    """A cube that is clamped by its edge, as by a pair of tongs: forces exist, but they need not arise."""
    tongs = stack_of(
        (CUBE, -1.41, 0.5), (CUBE, -1.5, 1.5), (CUBE, -0.5, 1.5), (RECTANGLE, -1.04, 2.5), (CUBE, -1.54, 3.5)
    )
    assert outcome(tongs) != "stands"
    assert outcome(tongs, 0, 1) == "stands"


def test_a_near_neighbour_may_prop_but_is_not_certain_to() -> None:
    """A cube beside its support leans on a pillar that is 0.05 cells away: that is for the simulator."""
    leaning = stack_of((CUBE, 0, 0.5), (CUBE, 0.52, 1.5), (CUBE, 1.57, 0.5), (CUBE, 1.57, 1.5))
    assert outcome(leaning, 0, 1) == "falls"
    assert outcome(leaning) == "unsure"


def test_what_left_the_plane_of_the_design_is_for_the_simulator() -> None:
    tower = stack_of((CUBE, 0, 0.5), (CUBE, 0, 1.5))
    for column, by in ((1, 0.2), (3, 0.1), (5, 0.1)):
        poses = tower.poses.copy()
        poses[1, column] = by
        moved = tower.with_poses(poses)
        assert outcome(moved) == "unsure" and outcome(moved, 0) == "stands"
        assert PlaneStatics(moved, FRICTION, StaticsMargins()).silent


def test_margins_that_make_no_sense_are_named() -> None:
    for wrong in ({"inset": -0.1}, {"touch": 0.2}, {"friction_kept": 1.5}, {"friction_spared": 0.9}, {"confirm": 2.0}):
        with pytest.raises(StackgenError, match=next(iter(wrong))):
            StaticsMargins(**wrong)  # type: ignore[arg-type]


# Laws.


def test_the_answer_for_a_part_is_that_for_the_part_alone() -> None:
    rng = np.random.default_rng(1)
    seen = set()
    for stack in designs(25):
        whole = PlaneStatics(stack, FRICTION, StaticsMargins())
        for _ in range(6):
            part = np.sort(rng.permutation(len(stack))[: rng.integers(2, len(stack) + 1)])
            alone = PlaneStatics(Stack(stack.shapes[part], stack.poses[part]), FRICTION, StaticsMargins())
            assert whole.outcome(part) == alone.outcome(np.arange(len(part)))
            seen.add(whole.outcome(part))
    assert seen == {"stands", "falls", "unsure"}


def test_wider_margins_only_take_certainty_away() -> None:
    for stack in designs(40, seed=2):
        narrow, wide = outcome(stack), outcome(stack, inset=0.05, pull=0.06, friction_kept=0.15, outset=0.05)
        assert wide in (narrow, "unsure")


def test_the_order_of_the_blocks_and_a_mirror_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    for stack in designs(30, seed=3):
        order = rng.permutation(len(stack))
        assert outcome(Stack(stack.shapes[order], stack.poses[order])) == outcome(stack) == outcome(mirror(stack))


def test_contacts_in_the_plane_are_those_in_space() -> None:
    tolerance = 0.015
    compared = 0
    for stack in designs(15, seed=4):
        jitter = np.random.default_rng(0).normal(0, 2e-3, stack.poses.shape) * [1, 0, 1, 0, 1, 0]
        stack = stack.with_poses(stack.poses + jitter)
        (plane,) = find_plane_contacts(stack, (tolerance,))
        there = {(int(b), int(by)): ends for b, by, ends in zip(plane.block, plane.by, plane.ends, strict=True)}
        for contact in find_contacts(stack, tolerance):
            along = np.array([contact.normal[2], -contact.normal[0]])
            patch = contact.points[:, [0, 2]] @ along
            ends = there[contact.block, contact.by] @ along
            assert ends == pytest.approx([patch.min(), patch.max()], abs=1e-6)
            compared += 1
        assert GROUND in plane.by
    assert compared > 100


def test_what_statics_is_certain_of_the_simulator_says_too() -> None:
    rng = np.random.default_rng(5)
    said = {"stands": 0, "falls": 0}
    with Simulator() as simulator:
        for design in designs(30, seed=5):
            settled = simulator.rollout(design, until_moved=0.2)
            if not accept(settled, AcceptLimits()):
                continue
            stack = settled.end
            statics = PlaneStatics(stack, FRICTION, StaticsMargins())
            for _ in range(4):
                part = np.sort(rng.permutation(len(stack))[rng.integers(1, 4) :])
                word = statics.outcome(part)
                if word == "unsure" or said[word] > 12:
                    continue
                rollout = simulator.rollout(Stack(stack.shapes[part], stack.poses[part]), until_moved=0.2)
                assert accept(rollout, AcceptLimits()) == (word == "stands")
                said[word] += 1
    assert min(said.values()) > 8
