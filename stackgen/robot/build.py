"""Build a stack: what is to stand, in which order, by which motions, and what became of it.

The path of a build: the generated stack is settled, as its verdict saw it, and blocks side by side are moved apart a
little (`design`); an order is found; all motions are planned; only then does anything move.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette, silhouette_iou
from stackgen.protocols import Verdict
from stackgen.robot.backend import ArmBackend, Open, perform
from stackgen.robot.planning.order import BuildOrder, Strategy, TopDownJaws, plan_order
from stackgen.robot.planning.plan import BlockPlan, BuildPlan
from stackgen.robot.planning.staging import make_room
from stackgen.robot.report import BlockReport, BuildReport, PlacementError
from stackgen.robot.simulated.arm import PickNoise, SimulatedArm
from stackgen.robot.simulated.window import Window
from stackgen.robot.workcell import Cell, Grasp
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, Grid, Mask

_LOOK_EVERY = 8  # steps between looks for contacts
_REST = 1.0  # after the last block [s]


@dataclass(frozen=True)
class Design:
    """What is to be built.

    Args:
        stack: The blocks where they are to be.
        generated: As generated, settled.
        order: In which they are placed.
        strategy: That found it.
    """

    stack: Stack
    generated: Stack
    order: BuildOrder
    strategy: Strategy


def design(generated: Stack, cell: Cell, physics: Physics, strategy: Strategy = "safest") -> Design:
    """Settle a stack, make room between its blocks, and find an order.

    Raises:
        StackgenError: If the stack does not stand, or there is no safe order and the greedy one was not asked for.
    """
    checker = SimulatorChecker(physics, generated.catalogue)
    try:
        verdict = checker.check(generated)
        if not verdict.stable:
            fallen = ", ".join(f"{i} ({generated.names[i]})" for i in np.flatnonzero(verdict.fell))
            raise StackgenError(f"the stack does not stand, so it is not built: block {fallen} would fall")
        roomy = make_room(verdict.settled, cell.workspace.gap / physics.cell_size)
        stack = roomy if checker.check(roomy).stable else verdict.settled
    finally:
        checker.simulator.close()
    jaws = TopDownJaws(cell.jaws, physics.cell_size, cell.workspace.clearance)
    order = plan_order(stack, approach=jaws, strategy=strategy)
    if not order.safe and strategy != "greedy":
        raise StackgenError(f"no order is safe: {order.blocked}; --order greedy builds it in the paper's order")
    return Design(stack, verdict.settled, order, strategy)


def execute(
    plan: BuildPlan,
    arm: ArmBackend,
    on_start: Callable[[BlockPlan], None] = lambda block: None,
    on_release: Callable[[BlockPlan], None] = lambda block: None,
    on_done: Callable[[BlockPlan], None] = lambda block: None,
    first: int = 0,
) -> None:
    """Have an arm carry out a plan.

    Args:
        plan: From :func:`plan_build`.
        arm: At the place where the first motion starts.
        on_start, on_release, on_done: Called before each block, when the jaws have let it go, and after it.
        first: The step to begin with.

    Raises:
        StackgenError: If the arm stops on its own.
    """
    for step in plan.blocks[first:]:
        on_start(step)
        last_open = max(i for i, action in enumerate(step.actions) if isinstance(action, Open))
        for number, action in enumerate(step.actions):
            perform(action, arm)
            stopped = arm.state().stopped
            if stopped is not None:
                raise StackgenError(f"the arm stopped at block {step.block}: {stopped}")
            if number == last_open:
                on_release(step)
        on_done(step)
    if plan.homing is not None:
        arm.move(plan.homing)


@dataclass
class _Watch:
    """Sees a simulated build from the outside."""

    arm: SimulatedArm
    handled: BlockPlan | None = None
    released: dict[int, PlacementError] = field(default_factory=dict)
    rested: dict[int, np.ndarray] = field(default_factory=dict)
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
        """A block is begun."""
        self.handled, self.began = step, self.arm.time

    def release(self, step: BlockPlan) -> None:
        """The jaws have let go."""
        self.released[step.block] = PlacementError.between(self.arm.frame(step.block), step.goal)

    def done(self, step: BlockPlan) -> None:
        """The arm has left a block."""
        self.seconds[step.block] = self.arm.time - self.began
        self._look_at_placed()
        self.rested[step.block] = self.arm.frame(step.block)[:3, 3]

    def end(self) -> None:
        """All is done."""
        self.handled = None
        self._look_at_placed()

    def _look_at_placed(self) -> None:
        for block, where in self.rested.items():
            moved = float(np.linalg.norm(self.arm.frame(block)[:3, 3] - where)) * 1e3
            self.disturbed[block] = max(self.disturbed.get(block, 0.0), moved)


def build(
    wanted: Design,
    plan: BuildPlan,
    cell: Cell,
    physics: Physics,
    grasp: Grasp = "jaws",
    noise: PickNoise = PickNoise(),  # noqa: B008 - frozen
    window: bool = False,
    target: Mask | None = None,
    grid: Grid = PAPER_GRID,
    on_block: Callable[[int], None] = lambda done: None,
    camera: Callable[[SimulatedArm], Callable[[bool], None]] | None = None,
) -> BuildReport:
    """Carry out a plan on the simulated arm, and see what stands.

    Args:
        wanted: What is built.
        plan: Its motions.
        cell, physics: Those of the plan.
        grasp: By friction, or by a fixed constraint.
        noise: How far the blocks lie from where the robot believes.
        window: Show it while it happens.
        target: (H, W) front silhouette to compare with.
        grid: Of the target.
        on_block: Told how many blocks are placed.
        camera: Makes, for the arm, what is called after every step (False) and once at the end (True).
    """
    frames = {step.block: step.waiting.frame for step in plan.blocks}
    believed = [frames[block] for block in range(len(plan.stack))]
    begin = time.perf_counter()
    with ExitStack() as opened:
        arm = opened.enter_context(SimulatedArm(cell, plan.stack, noise.disturb(believed), physics, grasp))
        view = opened.enter_context(Window(arm)).step if window else lambda: None
        slots = [PlacementError.between(arm.frame(block), believed[block]) for block in range(len(plan.stack))]
        film = camera(arm) if camera else lambda end: None
        watch = _watched(plan, arm, on_block, film, view)
        seconds, wall = arm.time, time.perf_counter() - begin
        film(True)
        built = arm.built()
        goals = {step.block: PlacementError.between(arm.frame(step.block), step.goal) for step in plan.blocks}
        tracking, torque = float(np.degrees(arm.tracking_error)), tuple(np.round(arm.torque, 1).tolist())
    blocks = tuple(_block_report(step, plan.stack, watch, slots, goals) for step in plan.blocks)
    moved = np.linalg.norm(built.poses[:, :3] - plan.stack.poses[:, :3], axis=1)
    verdict = _fresh_verdict(built, physics)
    front = silhouette(verdict.settled, grid=grid)
    return BuildReport(
        blocks,
        wanted.strategy,
        wanted.order.safe,
        wanted.order.least_margin,
        grasp,
        bool((moved < physics.fall_height).all()),
        verdict.stable,
        None if target is None else silhouette_iou(verdict.settled, target, grid=grid) * verdict.stable,
        iou(front, silhouette(wanted.generated, grid=grid)),
        None if target is None else silhouette_iou(wanted.generated, target, grid=grid),
        seconds,
        seconds / wall,
        tracking,
        torque,
        built,
        plan.stack,
    )


def _watched(
    plan: BuildPlan,
    arm: SimulatedArm,
    on_block: Callable[[int], None],
    film: Callable[[bool], None],
    view: Callable[[], None],
) -> _Watch:
    """Carry out a plan and wait until all is at rest; what was seen."""
    watch = _Watch(arm)

    def on_step() -> None:
        watch.step()
        film(False)
        view()

    def on_done(step: BlockPlan) -> None:
        watch.done(step)
        on_block(len(watch.rested))

    arm.on_step = on_step
    execute(plan, arm, watch.start, watch.release, on_done)
    arm.wait(_REST)
    watch.end()
    return watch


def _block_report(
    step: BlockPlan,
    stack: Stack,
    watch: _Watch,
    slots: list[PlacementError],
    settled: dict[int, PlacementError],
) -> BlockReport:
    block = step.block
    return BlockReport(
        block,
        stack.names[block],
        slots[block],
        watch.released[block],
        settled[block],
        watch.disturbed.get(block, 0.0),
        step.clearance.distance * 1e3,
        step.clearance.between,
        step.distance * 1e3,
        float(np.degrees(step.turn)),
        watch.seconds[block],
        tuple(sorted(watch.unplanned.get(block, ()))),
    )


def _fresh_verdict(stack: Stack, physics: Physics) -> Verdict:
    """Of a stack put down awake in a world of its own."""
    checker = SimulatorChecker(physics, stack.catalogue)
    try:
        return checker.check(stack)
    finally:
        checker.simulator.close()
