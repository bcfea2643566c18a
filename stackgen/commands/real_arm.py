"""What `stackgen build` does with a real arm: its options, the dry run, and the build."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stackgen.commands.output import tell, wrote
from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller

if TYPE_CHECKING:
    from stackgen.robot.build import PlannedBuild

ArmName = Literal["simulation", "ur-rtde", "urscript"]


@dataclass(frozen=True)
class RealArm:
    """Who builds, and what a real arm needs.

    Args:
        arm: Arm that builds: simulated, real through ur-rtde, or real with a URScript program that it runs alone.
        host: Address of the real arm's controller.
        staging_sheet: Sheet to write, to lay the blocks out on to scale: a .pdf of A4 pages or an .svg.
        controller: The real arm's controller.
        gripper: The real jaws.
        execute: Have the real arm move; without it everything else is done.
        yes: Do not ask before the real arm moves.
        resume: Continue a real build that was interrupted with its next block.
    """

    arm: ArmName = "simulation"
    host: str | None = None
    staging_sheet: Path | None = None
    controller: Controller = field(default_factory=Controller)
    gripper: Gripper = field(default_factory=Gripper)
    execute: bool = False
    yes: bool = False
    resume: bool = False

    @property
    def address(self) -> str:
        """Address of the controller; empty if none was given."""
        return self.host or self.controller.host


def check_options(real: RealArm, only_simulated: bool) -> None:
    """See that the options go together, before anything is computed.

    Args:
        real: Options of the real arm.
        only_simulated: Whether an option was given that makes sense for the simulated arm alone.

    Raises:
        StackgenError: If they do not.
    """
    from stackgen.robot.real.staging_sheet import check_suffix

    if real.staging_sheet is not None:
        check_suffix(real.staging_sheet)
    if real.arm == "simulation":
        if real.execute or real.yes or real.resume or real.host:
            raise StackgenError("--host, --execute, --yes and --resume go with a real arm: say --arm ur-rtde")
        return
    if only_simulated:
        raise StackgenError(f"--video, --gui, --grasp and --noise_* go with the simulated arm, not with {real.arm}")
    if real.execute and not real.address:
        raise StackgenError("--execute needs the address of the arm's controller: --host")
    if real.yes and not real.execute:
        raise StackgenError("--yes answers what --execute asks: say both, or neither")
    if real.resume and real.arm == "urscript":
        raise StackgenError("--resume goes with --arm ur-rtde: a program that the arm runs alone keeps no progress")


def write_sheet(real: RealArm, planned: PlannedBuild) -> None:
    """Write the staging sheet, if one was asked for."""
    if real.staging_sheet is None:
        return
    from stackgen.robot.real.staging_sheet import write_staging_sheet

    plan, size = planned.plan, planned.physics.cell_size
    write_staging_sheet(real.staging_sheet, plan.stack, order=plan.order, workcell=planned.workcell, cell_size=size)
    wrote(real.staging_sheet)


def build_for_real(planned: PlannedBuild, real: RealArm, out: Path) -> int:
    """Rehearse a build, and with --execute have the real arm carry it out.

    Raises:
        StackgenError: If a limit is exceeded, the arm is not ready, or stops.
    """
    from stackgen.robot.real.real_build import MESSAGES, PROGRAM, carry_out, confirm, prepare, send, show

    build = prepare(
        planned.plan,
        planned.workcell,
        out,
        controller=real.controller,
        gripper=real.gripper,
        resume=real.resume,
    )
    show(build)
    wrote(out / PROGRAM)
    if not real.execute:
        tell("dry run: nothing has moved; --execute moves the arm", executed=False)
        return 0
    confirm(build, real.address, real.yes)
    if real.arm == "urscript":
        send(build, real.address)
        tell(f"sent to {real.address}, which builds on its own now", executed=True)
        return 0
    from stackgen.robot.real.ur_arm import client_messages

    with client_messages(out / MESSAGES), progress_bar("build", len(planned.plan.order)) as (advance, _):
        progress = carry_out(build, real.address, advance)
    tell(f"built: {progress.describe()}", style="green", executed=True)
    return 0
