"""Accept and fell: two questions to one rollout, and the checker that asks PyBullet."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.protocols import StabilityChecker
from stackgen.sim.checkers import AcceptLimits, SimulatorChecker, accept, fell
from stackgen.sim.physics import Engine, Physics, default_engine, engine_version
from stackgen.sim.simulator import Rollout
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD, Catalogue, Shape
from tests.sim.engines import ENGINES

LIMITS, PHYSICS = AcceptLimits(), Physics()


def rollout(*changes: tuple[int, float], at_rest: bool = True) -> Rollout:
    """Of two blocks; the second ends changed: (place in the pose, by how much)."""
    start = Stack(np.array([0, 1]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
    poses = start.poses.copy()
    for place, change in changes:
        poses[1, place] += change
    return Rollout(start, start.with_poses(poses), at_rest, 1.0)


@pytest.mark.parametrize(
    ("seen", "accepted", "fallen"),
    [
        (rollout(), True, False),
        (rollout((0, 0.15), (2, -0.1)), True, False),
        (rollout((0, 0.3)), False, False),  # slid: no data, but nothing fell
        (rollout((1, -0.3)), False, False),
        (rollout((2, -0.3)), False, False),  # sank by less than half a cell
        (rollout((2, -0.51)), False, True),
        (rollout((2, 0.3)), False, False),  # rose
        (rollout((4, 0.2)), False, False),  # leans
        (rollout((5, 1.0)), True, False),  # turned about the vertical
        (rollout(at_rest=False), False, False),
        (rollout((2, -3.0), at_rest=False), False, True),
    ],
)
def test_accept_and_fell_are_different_questions(seen: Rollout, accepted: bool, fallen: bool) -> None:
    assert accept(seen, LIMITS) is accepted
    assert fell(seen, PHYSICS).tolist() == [False, fallen]


def test_the_limits_are_the_limits() -> None:
    assert accept(rollout((0, 0.5), (4, 0.5)), AcceptLimits(displacement=0.51, tilt=0.51))
    assert not accept(rollout((0, 0.5)), AcceptLimits(displacement=0.49))
    assert not accept(rollout((4, 0.5)), AcceptLimits(displacement=1, tilt=0.49))
    assert fell(rollout((2, -0.2)), Physics(fall_height=0.1)).tolist() == [False, True]
    assert not fell(rollout((2, -PHYSICS.fall_height)), PHYSICS).any()  # more than half a cell, not just half


def test_a_stack_that_leaned_before_is_measured_from_there() -> None:
    start = Stack(np.array([0]), np.array([[0, 0, 0.5, 0, 0.3, 0]]))
    assert accept(Rollout(start, start, True, 1.0), LIMITS)
    upright = start.with_poses([[0, 0, 0.5, 0, 0, 0]])
    assert not accept(Rollout(start, upright, True, 1.0), LIMITS)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_verdict_says_which_block_fell_and_how_far(engine: Engine) -> None:
    checker = SimulatorChecker(Physics(engine=engine))
    poses = np.zeros((3, 6))
    poses[:, 2], poses[2, 0] = [0.5, 1.5, 2.5], 3  # the third has nothing under it
    verdict = checker.check(Stack(np.zeros(3, int), poses))
    assert not verdict.stable and verdict.fell.tolist() == [False, False, True]
    assert verdict.drop == pytest.approx([0, 0, 2], abs=0.02)
    assert verdict.settled.poses[:, 2] == pytest.approx([0.5, 1.5, 0.5], abs=0.02)
    assert verdict.at_rest and checker.physics == Physics(engine=engine)
    good = checker.check(Stack(np.zeros(2, int), poses[:2]))
    assert good.stable and not good.fell.any()


@pytest.mark.parametrize("engine", ENGINES)
def test_the_early_end_gives_the_same_verdicts(engine: Engine) -> None:
    physics = Physics(engine=engine)
    rng = np.random.default_rng(1)
    stacks = []
    for _ in range(16):
        stack = realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)
        keep = np.sort(rng.permutation(len(stack))[: len(stack) - 2])
        stacks.append(Stack(stack.shapes[keep], stack.poses[keep]))
    whole, early = SimulatorChecker(physics), SimulatorChecker(physics, until_fall=True)
    verdicts, soon = whole.check_all(stacks), early.check_all(stacks)
    assert [v.stable for v in verdicts] == [v.stable for v in soon]
    assert 0 < sum(v.stable for v in verdicts) < len(stacks)
    for verdict, stack in zip(verdicts, stacks, strict=True):
        assert verdict.stable == (not verdict.fell.any()) == bool(verdict.drop.max() <= 0.5)
        assert (whole.check(stack).settled.poses == verdict.settled.poses).all()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("make", [SimulatorChecker, StaticsChecker])
def test_every_checker_says_of_many_stacks_what_it_says_of_each(
    make: Callable[[Physics], StabilityChecker], engine: Engine
) -> None:
    physics = Physics(engine=engine, friction=0.4)
    checker = make(physics)
    assert checker.physics == physics
    stands = Stack(np.array([0, 0]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
    falls = stands.with_poses([[0, 0, 0.5, 0, 0, 0], [0.9, 0, 1.5, 0, 0, 0]])
    verdicts = checker.check_all(iter([stands, falls, stands]))
    assert [verdict.stable for verdict in verdicts] == [True, False, True]
    for stack, verdict in zip((stands, falls), verdicts, strict=False):
        alone = checker.check(stack)
        assert alone.fell.tolist() == verdict.fell.tolist() and (alone.drop == verdict.drop).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_one_simulator_takes_stacks_of_several_catalogues(engine: Engine) -> None:
    physics = Physics(engine=engine)
    tower = np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]])
    slabs = Catalogue((Shape.box("slab", 2, 0.5), Shape.box("cube", 1)))
    stacks = [
        Stack(np.array([0, 0]), tower),
        Stack(np.array([0, 1]), np.array([[0, 0, 0.25, 0, 0, 0], [0.4, 0, 1.0, 0, 0, 0]]), slabs),
    ]
    together = SimulatorChecker(physics).check_all(stacks + stacks)
    for stack, first, again in zip(stacks, together[:2], together[2:], strict=True):
        alone = SimulatorChecker(physics).check(stack)
        assert (alone.settled.poses == first.settled.poses).all() and (first.settled.poses == again.settled.poses).all()


@pytest.mark.parametrize(("engine", "package"), [("bullet", "pybullet"), ("mujoco", "mujoco")])
def test_the_physics_travel_with_the_engine_s_name(engine: Engine, package: str) -> None:
    plain = Physics(engine=engine, friction=0.7).to_json()
    assert plain["engine"] == engine_version(engine) and plain["engine"].startswith(f"{package} ")
    assert Physics(**Physics.settings_of(plain)) == Physics(engine=engine, friction=0.7)
    assert ("solver_iterations" in plain, "solref" in plain) == (engine == "bullet", engine == "mujoco")


def test_what_was_made_before_engines_were_named_is_bullet_s() -> None:
    assert Physics.settings_of({"friction": 0.3}) == {"engine": "bullet", "friction": 0.3}


def test_numbers_of_bullet_are_refused_where_mujoco_simulates() -> None:
    with pytest.raises(StackgenError, match="time_step and contact_threshold belong to Bullet: leave them out"):
        Physics(engine="mujoco", time_step=0.001, contact_threshold=0.003)
    with pytest.raises(StackgenError, match="engine must be bullet or mujoco, got 'ode'"):
        Physics(engine="ode")  # type: ignore[arg-type]


def test_the_engine_is_bullet_where_it_is_installed_and_else_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    for installed, engine in (({"pybullet", "mujoco"}, "bullet"), ({"mujoco"}, "mujoco"), (set(), "bullet")):
        monkeypatch.setattr("stackgen.sim.physics.find_spec", lambda name, there=installed: name in there or None)
        assert default_engine.__wrapped__() == engine


@pytest.mark.parametrize(
    "wrong", [{"friction": -0.1}, {"time_step": 0.0}, {"density": -1.0}, {"watch": np.inf}, {"gravity": "low"}], ids=str
)
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(StackgenError, match=f"physics: {next(iter(wrong))} must be"):
        Physics(**wrong)


def test_a_world_without_friction_or_gravity_is_possible() -> None:
    assert Physics(friction=0, gravity=0).to_json()["friction"] == 0
