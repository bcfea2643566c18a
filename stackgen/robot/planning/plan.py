"""A whole build, planned before anything moves: every motion solved, timed and checked for collisions.

Frames are (4, 4); `tip` is that of the finger tips, the tool centre point. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.clearance import TABLE, Clearances, Near, block_corners, block_frame
from stackgen.robot.planning.kinematics import SOLVERS, InverseKinematics, SolverName, Unreachable
from stackgen.robot.planning.motion import Action, Close, Motion, Open, joint_motion, line_motion
from stackgen.robot.planning.staging import Waiting, lay_out, push_path
from stackgen.robot.workcell import Workcell, pose
from stackgen.sim.physics import Physics
from stackgen.stack import Stack

Floats = NDArray[np.float64]

_STEP = 0.02  # between joint solutions on a line [m]
_LOOK = 0.05  # between checks for collisions [s]
_SLOW = 0.015  # the last bit of the way down to a block's place [m]
_RISE = (0.0, 0.05, 0.1)  # what is added to the height of a transit that would collide [m]


class Collision(StackgenError):
    """A motion comes too near to something."""


@dataclass(frozen=True, kw_only=True)
class BlockPlan:
    """What the arm does with one block.

    Args:
        block: Number of the block in the stack.
        waiting: Place where it is fetched.
        goal: (4, 4) frame where it is to be.
        touching: Blocks, and `TABLE`, that it may touch there.
        actions: Actions in their order.
        clearance: Least distance of arm, jaws and held block from what they do not handle.
        distance, turn: Largest residual of the joint solutions [m, rad].
    """

    block: int
    waiting: Waiting
    goal: Floats
    touching: frozenset[int]
    actions: tuple[Action, ...]
    clearance: Near
    distance: float
    turn: float

    @property
    def duration(self) -> float:
        """Duration of its motions [s]; the jaws take their own time."""
        return sum(action.duration for action in self.actions if isinstance(action, Motion))


@dataclass(frozen=True)
class BuildPlan:
    """What the arm does to build a stack.

    Args:
        stack: Blocks where they are to be.
        order: Numbers of the blocks, first to last.
        blocks: Plan for each block that does not stand already, in that order.
        homing: Way back to the home position at the end.
    """

    stack: Stack
    order: tuple[int, ...]
    blocks: tuple[BlockPlan, ...]
    homing: Motion | None

    @property
    def clearance(self) -> Near:
        """Least clearance of all blocks."""
        return min((block.clearance for block in self.blocks), default=Near())


def plan_build(
    stack: Stack,
    order: ArrayLike,
    workcell: Workcell,
    physics: Physics,
    *,
    solver: SolverName = "urdf",
    on_block: Callable[[int], None] = lambda done: None,
    placed: int = 0,
) -> BuildPlan:
    """Plan all motions of a build.

    Args:
        stack: Blocks at rest where they are to be.
        order: (k,) numbers of the blocks in the order of placing.
        workcell: Arm, jaws and staging area.
        physics: Physics with the blocks' size.
        solver: Solver of the inverse kinematics.
        on_block: Called with the number of blocks that stand or are planned.
        placed: Number of blocks of the order that stand already; the plan is for the others, and starts at home.

    Raises:
        StackgenError: If a block is too large for jaws or slots, out of reach, or cannot be placed without
            touching what it should not.
    """
    numbers = tuple(int(block) for block in np.asarray(order))
    size = physics.cell_size
    waiting = lay_out(stack, numbers, workcell, size)
    goals = {block: block_frame(stack.poses[block], size) for block in numbers}
    blocks = []
    with Clearances(workcell, stack, physics) as scene:
        for block in numbers:
            scene.put_block(block, goals[block])
        # Nearer than the gap that is made for those side by side is only what it stands on, with an edge perhaps.
        near = 0.9 * workcell.workspace.gap
        touching = {block: scene.touching(block, numbers, near) for block in numbers}
        kinematics = SOLVERS[solver](arm_model(workcell.arm), workcell.home_joints)
        planner = _Planner(workcell, scene, kinematics, size)
        for block in numbers[:placed]:
            planner.put_down(block, goals[block])
        for block in numbers[placed:]:
            scene.put_block(block, waiting[block].frame)
            planner.heights[block] = waiting[block].top
        for done, block in enumerate(numbers[placed:], placed):
            try:
                blocks.append(planner.block(block, waiting[block], goals[block], touching[block]))
            except Unreachable as error:
                x, y, z = stack.poses[block, :3]
                raise StackgenError(
                    f"block {block} ({stack.names[block]}, to be placed at {x:.2f}, {y:.2f}, {z:.2f} cells) is out of"
                    f" the arm's reach: {error}"
                ) from error
            except Collision as error:
                raise StackgenError(f"block {block} ({stack.names[block]}) cannot be placed: {error}") from error
            on_block(done + 1)
        homing = joint_motion("home", planner.joints, workcell.home_joints, workcell.speeds)
    return BuildPlan(stack, numbers, tuple(blocks), homing)


@dataclass
class _Planner:
    """The arm as it will stand, step by step."""

    workcell: Workcell
    scene: Clearances
    solver: InverseKinematics
    cell_size: float
    heights: dict[int, float] = field(default_factory=dict)  # top of each block, where it is now
    joints: Floats = field(init=False)
    opening: float = field(init=False)
    held: int | None = None
    held_in_tip: Floats = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        self.joints = self.workcell.home_joints
        self.opening = self.workcell.jaws.opening

    def block(self, block: int, waiting: Waiting, goal: Floats, touching: frozenset[int]) -> BlockPlan:
        """Fetch one block and place it."""
        self.actions: list[Action] = []
        self.clearance, self.distance, self.turn = Near(), 0.0, 0.0
        self.may_touch: frozenset[int] = frozenset()
        self.handled: int | None = block
        tip_in_block = np.linalg.inv(waiting.frame) @ waiting.grasp
        if self.workcell.staging.straighten:
            self._straighten(waiting)
        grasp = waiting.grasp
        self._above(grasp)
        self._open()
        self._line("approach", grasp)
        self._close(block, tip_in_block)
        self.may_touch = frozenset({TABLE})
        place = goal @ tip_in_block
        place[2, 3] += self.workcell.workspace.drop
        self._line("lift", self._raised(grasp, max(self._safe_height(grasp), self._safe_height(place))))
        self.may_touch = frozenset()
        self._above(place)
        self.may_touch = touching
        slow = _moved(place, _SLOW)
        self._line("lower", slow)
        self._line("lower", place, speed=self.workcell.speeds.touch)
        self._release(block, goal)
        self._line("retreat", slow, speed=2 * self.workcell.speeds.touch)
        self._line("retreat", self._raised(place, self._safe_height(place)))
        return BlockPlan(
            block=block,
            waiting=waiting,
            goal=goal,
            touching=touching,
            actions=tuple(self.actions),
            clearance=self.clearance,
            distance=self.distance,
            turn=self.turn,
        )

    def _straighten(self, waiting: Waiting) -> None:
        """Push the block from both ends to the middle of its slot, with closed jaws."""
        clear = max(self.workcell.jaws.clearance, 0.01)
        for number, side in enumerate((1, -1)):
            beside, stop, away = push_path(waiting, side, self.workcell)
            over = waiting.top + clear
            if number == 0:
                self._above(beside)
                self._shut()
            else:
                self._line("straighten", self._raised(beside, over))
            self._line("straighten", beside)
            self._line("straighten", stop, speed=self.workcell.speeds.touch)
            self._line("straighten", away)
            self._line("straighten", self._raised(away, over))

    def _safe_height(self, tip: Floats) -> float:
        """Height of the finger tips at which what they hold passes over everything else by the workspace's lift."""
        hangs = 0.0
        if self.handled is not None and self.held == self.handled:
            corners = block_corners(self.scene.stack, self.handled, tip @ self.held_in_tip, self.cell_size)
            hangs = float(tip[2, 3] - corners[:, 2].min())
        others = [top for number, top in self.heights.items() if number != self.held]
        return max(others, default=0.0) + hangs + self.workcell.workspace.lift

    def _raised(self, tip: Floats, height: float) -> Floats:
        """Raise a tip to a height; never lower it."""
        return _moved(tip, max(height - tip[2, 3], 0.0))

    def _above(self, tip: Floats) -> None:
        """Move to a safe height above a tip, higher where the way there would collide."""
        height = self._safe_height(tip)
        start = self.joints
        for extra in _RISE:
            goal = self._solve(self._raised(tip, height + extra), start)
            motion = joint_motion("transit", start, goal, self.workcell.speeds)
            if motion is None:
                return
            try:
                self._append(motion)
                return
            except Collision:
                if extra == _RISE[-1]:
                    raise

    def _line(self, name: str, goal: Floats, speed: float | None = None) -> None:
        """Move straight on to a tip of the same direction."""
        start = self.workcell.tip_in_table(self.solver.arm.forward(self.joints))
        length = float(np.linalg.norm(goal[:3, 3] - start[:3, 3]))
        if length < 1e-6:
            return
        distances = np.linspace(0, length, max(3, int(np.ceil(length / _STEP)) + 1))
        joints = [self.joints]
        for distance in distances[1:]:
            tip = goal.copy()
            tip[:3, 3] = start[:3, 3] + (goal[:3, 3] - start[:3, 3]) * distance / length
            joints.append(self._solve(tip, joints[-1]))
        speeds = self.workcell.speeds
        self._append(line_motion(name, np.array(joints), distances, speed=speed or speeds.line, speeds=speeds))

    def _solve(self, tip: Floats, near: Floats) -> Floats:
        low, high = (np.array(corner) for corner in (self.workcell.workspace.low, self.workcell.workspace.high))
        if (tip[:3, 3] < low).any() or (tip[:3, 3] > high).any():
            x, y, z = tip[:3, 3]
            raise Unreachable(f"({x:.3f}, {y:.3f}, {z:.3f}) m lies outside cell.workspace")
        solution = self.solver.solve(self.workcell.flange_in_base(tip), near)
        self.distance, self.turn = max(self.distance, solution.distance), max(self.turn, solution.turn)
        return solution.joints

    def _append(self, motion: Motion) -> None:
        """Check a motion and take it as done.

        Raises:
            Collision: If arm, jaws or the held block come too near to something.
        """
        nearest = Near()
        for time in np.linspace(0, motion.duration, max(3, int(np.ceil(motion.duration / _LOOK)) + 1)):
            nearest = min(nearest, self._check(motion, motion.at(time)[0]))
        self.clearance = min(self.clearance, nearest)
        self.actions.append(motion)
        self.joints = motion.end

    def _check(self, motion: Motion, joints: Floats) -> Near:
        self.scene.put_arm(joints, self.opening)
        if self.held is not None:
            tip = self.workcell.tip_in_table(self.solver.arm.forward(joints))
            self.scene.put_block(self.held, tip @ self.held_in_tip)
        near = self.scene.of_arm(self.heights, self.handled)
        if near.distance < self.workcell.workspace.clearance:
            raise Collision(f"{motion.name} would bring {near.between} within {near.distance * 1e3:.1f} mm")
        if self.held is None:
            return near
        beside = self.scene.of_block(self.held, self.heights, self.may_touch)
        # In its row a block passes its neighbours as near as the gaps that were made for it.
        least = self.workcell.workspace.gap / 3 if motion.kind == "line" else self.workcell.workspace.clearance
        if beside.distance < least:
            raise Collision(f"{motion.name} would bring {beside.between} within {beside.distance * 1e3:.1f} mm")
        return min(near, beside)

    def _open(self) -> None:
        self.opening = self.workcell.jaws.opening
        self.actions.append(Open(self.opening))

    def _shut(self) -> None:
        self.opening = 0.0
        self.actions.append(Close(self.workcell.jaws.force))

    def _close(self, block: int, tip_in_block: Floats) -> None:
        shape = self.scene.stack.catalogue[int(self.scene.stack.shapes[block])]
        self.opening = shape.depth * self.cell_size
        self.actions.append(Close(self.workcell.jaws.force))
        self.held, self.held_in_tip = block, np.array(np.linalg.inv(tip_in_block))

    def _release(self, block: int, goal: Floats) -> None:
        self._open()
        self.put_down(block, goal)
        self.held = None

    def put_down(self, block: int, goal: Floats) -> None:
        """Note that a block is at its place."""
        self.scene.put_block(block, goal)
        self.heights[block] = float(block_corners(self.scene.stack, block, goal, self.cell_size)[:, 2].max())


def _moved(tip: Floats, up: float) -> Floats:
    """Move a tip up."""
    return pose((0.0, 0.0, up)) @ tip
