"""What `stackgen build` does with a real arm: its options, the dry run, and the build."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console

from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError
from stackgen.robot.real.gripper import Gripper
from stackgen.robot.real.program import Controller

if TYPE_CHECKING:
    from stackgen.robot.planning.plan import BuildPlan
    from stackgen.robot.workcell import Cell

ArmName = Literal["simulation", "ur-rtde", "urscript"]


@dataclass(frozen=True)
class RealArm:
    """Who builds, and what a real arm needs.

    Args:
        arm: The simulated arm, a real one through ur-rtde, or a real one that runs the URScript program by itself.
        host: Address of the real arm's controller.
        staging_sheet: Write a sheet to lay the blocks out on, to scale: a .pdf of A4 pages or an .svg.
        controller: What the real arm's controller has to know.
        gripper: How the real jaws are driven.
    """

    arm: ArmName = "simulation"
    host: str | None = None
    staging_sheet: Path | None = None
    controller: Controller = field(default_factory=Controller)
    gripper: Gripper = field(default_factory=Gripper)

    @property
    def address(self) -> str:
        """Of the controller; empty if none was given."""
        return self.host or self.controller.host


def check_options(real: RealArm, execute: bool, yes: bool, resume: bool, only_simulated: bool) -> None:
    """See that the options go together, before anything is computed.

    Args:
        real: Who builds.
        execute, yes, resume: As given.
        only_simulated: Whether an option was given that makes sense for the simulated arm alone.

    Raises:
        StackgenError: If they do not.
    """
    from stackgen.robot.real.staging_sheet import check_suffix

    if real.staging_sheet is not None:
        check_suffix(real.staging_sheet)
    if real.arm == "simulation":
        if execute or yes or resume or real.host:
            raise StackgenError("--host, --execute, --yes and --resume go with a real arm: say --arm ur-rtde")
        return
    if only_simulated:
        raise StackgenError(f"--video, --gui, --grasp and --noise_* go with the simulated arm, not with {real.arm}")
    if execute and not real.address:
        raise StackgenError("--execute needs the address of the arm's controller: --host")
    if yes and not execute:
        raise StackgenError("--yes answers what --execute asks: say both, or neither")
    if resume and real.arm == "urscript":
        raise StackgenError("--resume goes with --arm ur-rtde: a program that the arm runs alone keeps no progress")


def placed_before(out: Path, resume: bool) -> int:
    """How many blocks stand already."""
    from stackgen.robot.real.build import placed_before

    return placed_before(out, resume)


def write_sheet(real: RealArm, plan: BuildPlan, cell: Cell, cell_size: float) -> None:
    """The staging sheet, if one was asked for."""
    if real.staging_sheet is None:
        return
    from stackgen.robot.real.staging_sheet import write_staging_sheet

    write_staging_sheet(real.staging_sheet, plan.stack, plan.order, cell, cell_size)
    Console().print(f"wrote {real.staging_sheet}", highlight=False)


def build_for_real(
    plan: BuildPlan, cell: Cell, real: RealArm, out: Path, execute: bool, yes: bool, resume: bool
) -> int:
    """Rehearse a build, and with --execute have the real arm carry it out.

    Raises:
        StackgenError: If a limit is exceeded, the arm is not ready, or stops.
    """
    from stackgen.robot.real.build import MESSAGES, PROGRAM, carry_out, confirm, prepare, send, show

    build = prepare(plan, cell, real.controller, real.gripper, out, resume)
    show(build)
    console = Console()
    console.print(f"wrote {out / PROGRAM}", highlight=False)
    if not execute:
        console.print("dry run: nothing has moved; --execute moves the arm", highlight=False)
        return 0
    confirm(build, real.address, yes)
    if real.arm == "urscript":
        send(build, real.address)
        console.print(f"sent to {real.address}, which builds on its own now", highlight=False)
        return 0
    from stackgen.robot.real.rtde import client_messages

    with client_messages(out / MESSAGES), progress_bar("build", len(plan.order)) as (advance, _):
        progress = carry_out(build, real.address, advance)
    console.print(f"[green]built: {progress.describe()}[/]", highlight=False)
    return 0
