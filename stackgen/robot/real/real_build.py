"""A build with a real arm: rehearsed, confirmed, kept on disk block by block, and resumed after a stop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.io.terminal import Screen
from stackgen.robot.backend import ArmBackend, execute
from stackgen.robot.planning.arm_model import arm_model
from stackgen.robot.planning.plan import BlockPlan, BuildPlan
from stackgen.robot.real.build_progress import FILE, BuildProgress
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller
from stackgen.robot.real.urscript import urscript
from stackgen.robot.workcell import Workcell

PROGRAM = "build.script"
MESSAGES = "ur-rtde.log"


@dataclass(frozen=True, kw_only=True)
class RealBuild:
    """What is to be built with a real arm.

    Args:
        plan: All motions; those of the blocks that stand already are left out.
        workcell: Workcell of the plan.
        controller: Settings of the real arm's controller.
        gripper: Settings of the real jaws.
        folder: Folder for the program, the progress and the client's messages.
        progress: Progress so far.
    """

    plan: BuildPlan
    workcell: Workcell
    controller: Controller
    gripper: Gripper
    folder: Path
    progress: BuildProgress


def placed_before(folder: Path, resume: bool) -> int:
    """Read how many blocks of a build stand already, which a plan has to know.

    Raises:
        StackgenError: If there is nothing to resume.
    """
    if not resume:
        return 0
    found = BuildProgress.read(folder)
    if found.next is None:
        raise StackgenError(f"--resume: all {len(found.order)} blocks of {folder} stand already")
    return found.placed


def prepare(
    plan: BuildPlan,
    workcell: Workcell,
    folder: Path,
    *,
    controller: Controller,
    gripper: Gripper,
    resume: bool = False,
) -> RealBuild:
    """Check a plan against the workcell's limits and write its program; nothing moves.

    Args:
        plan: Plan of the build.
        workcell: Workcell of the plan.
        folder: Folder for the program, the progress and the client's messages.
        controller: Settings of the real arm's controller.
        gripper: Settings of the real jaws.
        resume: Whether the plan resumes the build in the folder.

    Raises:
        StackgenError: If it is no UR arm, a motion leaves the workspace or is too fast, or the folder holds another
            build.
    """
    if not arm_model(workcell.arm).like_ur5:
        raise StackgenError(f"--arm: ur-rtde and urscript move UR arms; {workcell.arm.urdf} (cell.arm) is another arm")
    progress = BuildProgress.of(plan.stack, plan.order, workcell)
    if resume:
        found = BuildProgress.read(folder)
        found.require_same(plan.stack, plan.order, workcell)
        progress = replace(progress, placed=found.placed)
    program = urscript(plan, workcell, controller, gripper)
    write_atomically(folder / PROGRAM, program.encode())
    return RealBuild(
        plan=plan,
        workcell=workcell,
        controller=controller,
        gripper=gripper,
        folder=folder,
        progress=progress,
    )


def show(build: RealBuild) -> None:
    """Print what would move, a row for each block."""
    table = Table("block", "from slot", "to x, y, z", "motions", "time", "clearance", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    plan = build.plan
    for step in plan.blocks:
        place = ", ".join(f"{1e3 * number:.0f}" for number in step.goal[:3, 3])
        table.add_row(
            escape(f"{step.block} ({plan.stack.names[step.block]})"),
            str(plan.order.index(step.block) + 1),
            f"{place} mm",
            str(len(step.actions)),
            f"{step.duration:.0f} s",
            f"{step.clearance.distance * 1e3:.1f} mm",
        )
    Screen().print(table)


def confirm(build: RealBuild, host: str, yes: bool) -> None:
    """Ask whether the arm may move.

    Raises:
        StackgenError: If there is no terminal to ask on, the answer is not yes, or blocks of an interrupted build
            may stand.
    """
    require_clear(build)
    if yes:
        return
    if not sys.stdin.isatty():
        raise StackgenError("--execute asks before the arm moves: run it in a terminal, or say --yes")
    screen = Screen(stderr=True)
    screen.print(
        f"The arm at {host} will move. {build.progress.describe()}. The blocks lie in their slots, nobody is within"
        " reach, and a hand is at the emergency stop?",
        highlight=False,
    )
    if screen.input("Type yes to move the arm: ").strip().lower() != "yes":
        raise StackgenError("not confirmed; nothing has moved")


def require_clear(build: RealBuild) -> None:
    """See that a new build does not forget an interrupted one: its blocks stand in the way.

    Raises:
        StackgenError: If there is one in its folder.
    """
    if build.progress.placed or not (build.folder / FILE).exists():
        return
    before = BuildProgress.read(build.folder)
    if before.placed and before.status != "done":
        raise StackgenError(
            f"{build.folder} holds a build that was interrupted, {before.describe()}: say --resume to continue it, or"
            f" clear the table and delete {build.folder / FILE}"
        )


def carry_out(
    build: RealBuild,
    host: str,
    on_block: Callable[[int], None] = lambda done: None,
) -> BuildProgress:
    """Have the real arm build.

    Args:
        build: Build from :func:`prepare`.
        host: Address of the controller.
        on_block: Called with the number of blocks that stand.

    Raises:
        StackgenError: If the arm is not ready, in which case nothing has moved, or stops, in which case the progress
            is kept; the line says how to resume.
    """
    from stackgen.robot.real.ur_arm import UrArm

    with UrArm(host, build.workcell, build.controller, build.gripper) as arm:
        return run(build, arm, arm.begin, on_block)


def run(
    build: RealBuild,
    arm: ArmBackend,
    on_start: Callable[[BlockPlan], None] = lambda step: None,
    on_block: Callable[[int], None] = lambda done: None,
) -> BuildProgress:
    """Have an arm that stands at home build, and keep the progress on disk after every block.

    Raises:
        StackgenError: If the arm stops.
        KeyboardInterrupt: With a line that says how to resume.
    """
    progress = build.progress
    progress.write(build.folder)

    def done(step: BlockPlan) -> None:
        nonlocal progress
        progress = replace(progress, placed=progress.placed + 1)
        progress.write(build.folder)
        on_block(progress.placed)

    try:
        execute(build.plan, arm, on_start=on_start, on_done=done)
    except StackgenError as error:
        replace(progress, status="stopped", why=str(error)).write(build.folder)
        raise StackgenError(f"{_reason(error)}; {how_to_resume(progress)}") from error
    except KeyboardInterrupt:
        arm.stop()
        replace(progress, status="stopped", why="interrupted").write(build.folder)
        raise KeyboardInterrupt(f"the arm was stopped; {how_to_resume(progress)}") from None
    progress = replace(progress, status="done")
    progress.write(build.folder)
    return progress


def how_to_resume(progress: BuildProgress) -> str:
    """Say how to resume a build after a stop."""
    if progress.next is None:
        return "all blocks stand; bring the arm home at the pendant"
    slot = progress.placed + 1
    return (
        f"{progress.describe()}: clear the cause at the pendant, put block {progress.next} back into slot {slot}, bring"
        " the arm home, and run the same command with --resume"
    )


def _reason(error: StackgenError) -> str:
    text = str(error)
    return text if text.startswith("the arm") else f"the arm stopped: {text}"


def send(build: RealBuild, host: str, port: int = 30002) -> None:
    """Send the program to a controller, which runs it on its own.

    Raises:
        StackgenError: If the controller is not there, or not ready.
    """
    import socket

    from stackgen.robot.real.readiness import require_ready

    require_ready(host)
    try:
        with socket.create_connection((host, port), timeout=3.0) as link:
            link.sendall((build.folder / PROGRAM).read_bytes())
    except OSError as error:
        raise StackgenError(f"the program could not be sent to {host}:{port}: {error.strerror or error}") from error
