"""Build a stack: what is to stand, in which order, by which motions, and what became of it.

The path of a build: the generated stack is settled, as its verdict saw it, and blocks side by side are moved apart a
little (:func:`design`); an order is found; all motions are planned (:func:`plan_stack`); only then does anything move
(:func:`build`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette, silhouette_iou
from stackgen.protocols import Verdict
from stackgen.robot.backend import execute
from stackgen.robot.build_report import BlockReport, BuildReport, PlacementError
from stackgen.robot.planning.build_order import BuildOrder, Strategy, TopDownJaws, plan_order
from stackgen.robot.planning.kinematics import SolverName
from stackgen.robot.planning.plan import BlockPlan, BuildPlan, plan_build
from stackgen.robot.planning.staging import make_room
from stackgen.robot.simulated.arm import PickNoise, SimulatedArm
from stackgen.robot.simulated.window import Window
from stackgen.robot.workcell import Grasp, Workcell
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.sim.statics.checker import StaticsChecker
from stackgen.stack import Stack
from stackgen.world import Grid, Mask

_LOOK_EVERY = 8  # steps between looks for contacts
_REST = 1.0  # after the last block [s]

Camera = Callable[[SimulatedArm], Callable[[bool], None]]
"""Makes, for an arm, what is called after every step (False) and once at the end (True)."""


@dataclass(frozen=True)
class Design:
    """What is to be built.

    Args:
        stack: Blocks where they are to be.
        generated: Stack as it was generated, settled.
        order: Order in which the blocks are placed.
        strategy: Strategy that found the order.
    """

    stack: Stack
    generated: Stack
    order: BuildOrder
    strategy: Strategy


@dataclass(frozen=True)
class PlannedBuild:
    """A build of which everything is known but how it ends.

    Args:
        design: What is built.
        plan: Motions that build it.
        workcell: Workcell of the plan.
        physics: Physics of the blocks.
    """

    design: Design
    plan: BuildPlan
    workcell: Workcell
    physics: Physics


def design(generated: Stack, workcell: Workcell, physics: Physics, strategy: Strategy = "safest") -> Design:
    """Settle a stack, make room between its blocks, and find an order.

    Raises:
        StackgenError: If the stack does not stand, or there is no safe order and the greedy one was not asked for.
    """
    verdict = _verdict(generated, physics)
    if not verdict.stable:
        fallen = ", ".join(f"{i} ({generated.names[i]})" for i in np.flatnonzero(verdict.fell))
        raise StackgenError(f"the stack does not stand, so it is not built: block {fallen} would fall")
    roomy = make_room(verdict.settled, workcell.workspace.gap / physics.cell_size)
    stack = roomy if _verdict(roomy, physics).stable else verdict.settled
    jaws = TopDownJaws(workcell.jaws, physics.cell_size, workcell.workspace.clearance)
    order = plan_order(stack, checker=StaticsChecker(physics), approach=jaws, strategy=strategy)
    if not order.safe and strategy != "greedy":
        raise StackgenError(f"no order is safe: {order.blocked}; --order greedy builds it in the paper's order")
    return Design(stack, verdict.settled, order, strategy)


def plan_stack(
    generated: Stack,
    workcell: Workcell,
    physics: Physics,
    *,
    strategy: Strategy = "safest",
    solver: SolverName = "urdf",
    placed: int = 0,
    on_block: Callable[[int], None] = lambda done: None,
) -> PlannedBuild:
    """Find out all that can be known before anything moves.

    Args:
        generated: Stack to build.
        workcell: Workcell to build it in.
        physics: Physics of the blocks.
        strategy: Strategy of the order.
        solver: Solver of the inverse kinematics.
        placed: Number of blocks that stand already.
        on_block: Called with the number of blocks that stand or are planned.

    Raises:
        StackgenError: If the stack cannot be built.
    """
    wanted = design(generated, workcell, physics, strategy)
    plan = plan_build(
        wanted.stack, wanted.order.blocks, workcell, physics, solver=solver, on_block=on_block, placed=placed
    )
    return PlannedBuild(wanted, plan, workcell, physics)


def build(
    planned: PlannedBuild,
    grid: Grid,
    *,
    target: Mask | None = None,
    grasp: Grasp = "jaws",
    noise: PickNoise = PickNoise(),  # noqa: B008 - frozen
    window: bool = False,
    on_block: Callable[[int], None] = lambda done: None,
    camera: Camera = lambda arm: lambda end: None,
) -> BuildReport:
    """Carry out a plan on the simulated arm, and see what stands.

    Args:
        planned: Build from :func:`plan_stack`.
        grid: Grid of the silhouettes.
        target: (H, W) front silhouette to compare with.
        grasp: How blocks are held: by friction, or by a fixed constraint.
        noise: Distance of the blocks from where the robot believes them to be.
        window: Whether to show it while it happens.
        on_block: Called with the number of blocks that are placed.
        camera: Camera that films it.
    """
    plan, order, physics, began = planned.plan, planned.design.order, planned.physics, time.perf_counter()
    frames = {step.block: step.waiting.frame for step in plan.blocks}
    believed = [frames[block] for block in range(len(plan.stack))]
    disturbed = noise.disturb(believed)
    with SimulatedArm(planned.workcell, plan.stack, disturbed, physics, grasp=grasp) as arm, ExitStack() as opened:
        view = opened.enter_context(Window(arm)).step if window else lambda: None
        slots = [PlacementError.between(arm.frame(block), believed[block]) for block in range(len(plan.stack))]
        film, watch = camera(arm), _Watch(arm, on_block)

        def on_step() -> None:
            watch.step()
            film(False)
            view()

        arm.on_step = on_step
        execute(plan, arm, on_start=watch.start, on_release=watch.release, on_done=watch.done)
        arm.wait(_REST)
        watch.end()
        seconds, wall_seconds = arm.time, time.perf_counter() - began
        film(True)
        blocks, built = tuple(watch.report(step, slots[step.block]) for step in plan.blocks), arm.built()
    moved = np.linalg.norm(built.poses[:, :3] - plan.stack.poses[:, :3], axis=1)
    verdict, generated = _verdict(built, physics), planned.design.generated  # awake, in a fresh world
    return BuildReport(
        blocks=blocks,
        order=planned.design.strategy,
        safe=order.safe,
        least_margin=order.least_margin,
        grasp=grasp,
        built=bool((moved < physics.fall_height).all()),
        stands=verdict.stable,
        iou_target=None if target is None else silhouette_iou(verdict.settled, target, grid) * verdict.stable,
        iou_generated=iou(silhouette(verdict.settled, grid), silhouette(generated, grid)),
        generated_iou_target=None if target is None else silhouette_iou(generated, target, grid),
        seconds=seconds,
        real_time_factor=seconds / wall_seconds,
        tracking_error=float(np.degrees(arm.tracking_error)),
        torque=tuple(np.round(arm.torque, 1).tolist()),
        stack=built,
        design=plan.stack,
    )


@dataclass
class _Watch:
    """Sees a simulated build from the outside."""

    arm: SimulatedArm
    on_block: Callable[[int], None]
    handled: BlockPlan | None = None
    released: dict[int, PlacementError] = field(default_factory=dict)
    rested: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    disturbed: dict[int, float] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)
    unplanned: dict[int, set[str]] = field(default_factory=dict)
    began: float = 0.0

    def step(self) -> None:
        """Look for contacts that were not planned."""
        if self.handled is None or self.arm.steps % _LOOK_EVERY:
            return
        block = self.handled.block
        for kind, a, b in self.arm.touches():
            if kind == "arm" and not (a in self.arm.fingers and b == block):
                what = "the table" if b < 0 else f"block {b}"
                self._note(block, f"{self.arm.indices.name(a)} touched {what}")
            elif kind == "block" and block in (a, b) and (a if b == block else b) not in self.handled.touching:
                self._note(block, f"block {block} touched block {a if b == block else b}")

    def _note(self, block: int, what: str) -> None:
        self.unplanned.setdefault(block, set()).add(what)

    def start(self, step: BlockPlan) -> None:
        """Note that a block is begun."""
        self.handled, self.began = step, self.arm.time

    def release(self, step: BlockPlan) -> None:
        """Measure a block that the jaws have let go."""
        self.released[step.block] = PlacementError.between(self.arm.frame(step.block), step.goal)

    def done(self, step: BlockPlan) -> None:
        """Note that the arm has left a block."""
        self.seconds[step.block] = self.arm.time - self.began
        self._look_at_placed()
        self.rested[step.block] = self.arm.frame(step.block)[:3, 3]
        self.on_block(len(self.rested))

    def end(self) -> None:
        """Note that all is done."""
        self.handled = None
        self._look_at_placed()

    def _look_at_placed(self) -> None:
        for block, where in self.rested.items():
            moved = float(np.linalg.norm(self.arm.frame(block)[:3, 3] - where)) * 1e3
            self.disturbed[block] = max(self.disturbed.get(block, 0.0), moved)

    def report(self, step: BlockPlan, slot_error: PlacementError) -> BlockReport:
        """Report on a block, where it is now."""
        block = step.block
        return BlockReport(
            block=block,
            shape=self.arm.stack.names[block],
            slot_error=slot_error,
            released=self.released[block],
            settled=PlacementError.between(self.arm.frame(block), step.goal),
            disturbed=self.disturbed.get(block, 0.0),
            clearance=step.clearance.distance * 1e3,
            nearest=step.clearance.between,
            ik_distance=step.distance * 1e3,
            ik_turn=float(np.degrees(step.turn)),
            seconds=self.seconds[block],
            unplanned=tuple(sorted(self.unplanned.get(block, ()))),
        )


def _verdict(stack: Stack, physics: Physics) -> Verdict:
    """Check a stack that is put down awake in a world of its own."""
    checker = SimulatorChecker(physics)
    try:
        return checker.check(stack)
    finally:
        checker.simulator.close()
