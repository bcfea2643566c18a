"""A build is planned before anything moves; what the arm then does is what was planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.robot.backend import ArmState, execute
from stackgen.robot.build import build, design, plan_stack
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.motion import Close, Motion, Open
from stackgen.robot.planning.plan import BuildPlan, plan_build
from stackgen.robot.simulated.arm import PickNoise
from stackgen.robot.workcell import Base, Staging, Workcell, Workspace
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID


def stack_of(shapes: Sequence[int], poses: Sequence[Sequence[float]]) -> Stack:
    return Stack(np.array(shapes), np.array(poses, dtype=float))


PHYSICS = Physics()
WORKCELL = Workcell()
PLAIN = Workcell(staging=replace(Staging(), straighten=False))
CUBE = stack_of([0], [[0.2, 0, 0.5, 0, 0, 0.1]])
GATE = stack_of([0, 0, 1], [[-0.5, 0, 0.5, 0, 0, 0], [0.5, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]])


@pytest.fixture(scope="module")
def gate() -> BuildPlan:
    """Two cubes that touch, and a rectangle on them."""
    return plan_stack(GATE, PLAIN, PHYSICS, solver="closed-form").plan


def motions(plan: BuildPlan) -> list[Motion]:
    return [action for step in plan.blocks for action in step.actions if isinstance(action, Motion)]


def test_every_motion_starts_where_the_one_before_ended(gate: BuildPlan) -> None:
    where = PLAIN.home_joints
    for motion in motions(gate):
        assert np.allclose(motion.positions[0], where, atol=1e-6)
        where = motion.end
    assert gate.homing is not None and np.allclose(gate.homing.end, PLAIN.home_joints)


def test_a_block_is_fetched_and_placed_step_by_step(gate: BuildPlan) -> None:
    names = [getattr(action, "name", type(action).__name__) for action in gate.blocks[0].actions]
    assert names == [
        "transit", "Open", "approach", "Close", "lift", "transit", "lower", "lower", "Open", "retreat", "retreat",
    ]  # fmt: skip


def test_cubes_that_touched_have_room_and_the_arm_keeps_clear(gate: BuildPlan) -> None:
    assert np.diff(gate.stack.poses[:2, 0])[0] * 0.05 - 0.05 == pytest.approx(PLAIN.workspace.gap, abs=1e-4)
    assert gate.clearance.distance > PLAIN.workspace.gap / 3
    assert gate.blocks[-1].touching == {0, 1} and gate.blocks[0].touching >= {-1}


def test_the_tip_ends_where_the_block_is_to_be(gate: BuildPlan) -> None:
    for step in gate.blocks:
        placed = [action for action in step.actions if isinstance(action, Motion) and action.name == "lower"][-1]
        tip = PLAIN.tip_in_table(arm_model(PLAIN.arm).forward(placed.end))
        frame = tip @ np.linalg.inv(step.waiting.grasp) @ step.waiting.frame
        assert np.allclose(frame[:3, 3] - step.goal[:3, 3], [0, 0, PLAIN.workspace.drop], atol=1e-5)


def test_straightening_pushes_from_both_ends() -> None:
    plan = plan_build(CUBE, [0], WORKCELL, PHYSICS, solver="closed-form")
    names = [action.name for action in motions(plan)]
    assert names.count("straighten") == 9 and names.index("straighten") < names.index("approach")


@pytest.mark.parametrize(
    ("workcell", "message"),
    [
        (Workcell(base=Base((0.0, 0.9, 0.0))), r"block 0 \(cube, .*\) is out of the arm's reach"),
        (Workcell(workspace=replace(Workspace(), high=(0.25, 0.4, 0.6))), r"lies outside cell\.workspace"),
    ],
)
def test_what_is_out_of_reach_is_refused(workcell: Workcell, message: str) -> None:
    cube = stack_of([0], [[0, 0, 0.5, 0, 0, 0]])
    with pytest.raises(StackgenError, match=message):
        plan_build(cube, [0], replace(workcell, staging=_right()), PHYSICS, solver="closed-form")


def _right() -> Staging:
    return replace(Staging(), slots=((0.29, -0.1, 0.0),))


def test_a_block_between_two_towers_cannot_be_placed() -> None:
    """The palm is wider than a cube."""
    xz = [(-1.05, 0.5), (-1.05, 1.5), (1.05, 0.5), (1.05, 1.5), (0, 0.5)]
    stack = stack_of([0] * 5, [[x, 0, z, 0, 0, 0] for x, z in xz])
    with pytest.raises(StackgenError, match=r"block 4 \(cube\) cannot be placed: lower would bring .* within"):
        plan_build(stack, [0, 1, 2, 3, 4], PLAIN, PHYSICS, solver="closed-form")


def test_a_stack_that_falls_is_not_built() -> None:
    with pytest.raises(StackgenError, match=r"does not stand, so it is not built: block 1 \(cube\) would fall"):
        design(stack_of([0, 0], [[0, 0, 0.5, 0, 0, 0], [0.7, 0, 1.5, 0, 0, 0]]), WORKCELL, PHYSICS)


@dataclass
class _Recorder:
    """An arm that does at once what it is told, and stops on its own after some motions."""

    stops_after: int = 1000
    done: list[str] = field(default_factory=list)
    joints: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))

    def move(self, motion: Motion) -> None:
        self.done.append(motion.name)
        self.joints = motion.end

    def open(self, width: float) -> None:
        self.done.append("open")

    def close(self, force: float) -> None:
        self.done.append("close")

    def state(self) -> ArmState:
        return ArmState(self.joints, 0.0, "protective stop" if len(self.done) >= self.stops_after else None)

    def stop(self) -> None:
        self.done.append("stop")


def test_an_arm_does_what_was_planned_and_nothing_else(gate: BuildPlan) -> None:
    arm, released = _Recorder(), []
    execute(gate, arm, on_release=lambda step: released.append((step.block, len(arm.done))))
    planned = [a.name if isinstance(a, Motion) else type(a).__name__.lower() for s in gate.blocks for a in s.actions]
    assert arm.done == [*planned, "home"]
    assert [block for block, _ in released] == list(gate.order)
    assert all(arm.done[number - 1] == "open" for _, number in released)
    assert {type(action) for step in gate.blocks for action in step.actions} == {Motion, Open, Close}


def test_an_arm_that_stops_is_not_moved_on(gate: BuildPlan) -> None:
    arm = _Recorder(stops_after=14)
    with pytest.raises(StackgenError, match=rf"stopped at block {gate.order[1]}: protective stop"):
        execute(gate, arm)
    assert len(arm.done) == 14


def test_an_order_s_margins_are_those_of_the_build_s_friction() -> None:
    margins = [design(CUBE, PLAIN, replace(PHYSICS, friction=friction)).order.least_margin for friction in (0.3, 0.5)]
    assert margins == pytest.approx(np.degrees(np.arctan([0.3, 0.5])), abs=0.1)


def test_noise_is_the_same_for_the_same_seed() -> None:
    frames = [np.eye(4)] * 3
    a, b, c = (np.array(PickNoise(1e-3, 0.01, seed).disturb(frames)) for seed in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert np.array_equal(PickNoise().disturb(frames), frames)


@pytest.mark.parametrize("grasp", ["jaws", "fixed"])
def test_a_cube_that_lies_beside_its_place_is_built_to_a_fraction_of_a_millimetre(grasp: str) -> None:
    planned = plan_stack(CUBE, WORKCELL, PHYSICS)
    noise = PickNoise(2e-3, 0.02, seed=1) if grasp == "jaws" else PickNoise()
    report = build(planned, PAPER_GRID, grasp="fixed" if grasp == "fixed" else "jaws", noise=noise)
    (block,) = report.blocks
    assert report.success and report.unplanned == ()
    assert (block.slot_error.xy > 1) == (grasp == "jaws")
    assert block.settled.xy < 0.4 and abs(block.settled.z) < 0.2 and block.settled.yaw < 0.5
    assert report.iou_generated > 0.97 and report.tracking_error < 1
    assert 10 < report.seconds < 30


@pytest.mark.slow
def test_a_gate_is_built_with_noise() -> None:
    report = build(plan_stack(GATE, WORKCELL, PHYSICS), PAPER_GRID, noise=PickNoise(1e-3, 0.017, seed=3))
    assert report.success and report.unplanned == ()
    assert np.median([block.settled.xy for block in report.blocks]) < 0.5
    assert max(block.disturbed for block in report.blocks) < 0.3
