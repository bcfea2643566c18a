"""stackgen build: an arm builds a structure, in simulation or for real."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table
from rich.text import Text

from stackgen.commands.output import tell
from stackgen.commands.parsing import Command, Files
from stackgen.commands.progress_bar import progress_bar
from stackgen.commands.real_arm import RealArm, build_for_real, check_options, write_sheet
from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.io.stacks_file import StackEntry, StacksFile, read_stacks, write_stacks
from stackgen.names import DEFAULT
from stackgen.robot.planning.build_order import Strategy
from stackgen.robot.planning.kinematics import SolverName
from stackgen.robot.workcell import Grasp, Workcell
from stackgen.sim.statics.fit import describe_misfits
from stackgen.stack import format_block_list
from stackgen.vision.options import PictureOptions
from stackgen.vision.reader import read_picture
from stackgen.viz.render import save_image
from stackgen.world import PAPER_GRID

if TYPE_CHECKING:
    from stackgen.robot.build import PlannedBuild
    from stackgen.robot.build_report import BuildReport


@dataclass(frozen=True)
class Wanted:
    """What is built, and how it is planned.

    Args:
        stack: Number of the stack in the file, from 1.
        from_image: Drawing, photo of a sketch, or depth frame (as for `stackgen capture`) to build instead of a file:
            the best of the verified stacks for it. The folder of --out then holds silhouette.png and overlay.png, too.
        inventory: With --from_image, blocks that are available, such as cube=4,rectangle=3.
        cells: With --from_image, height of the structure in cells, such as 4, or width and height, such as 3x4; auto
            finds it. Fewer cells are fewer blocks.
        weights: With --from_image, weights of the sampler: a name, .safetensors, .ckpt or run folder.
        budget: With --from_image, limit of the search for stacks: a time, such as 5s, or a number of stacks.
        seed: Seed of the noise, and with --from_image of the stacks.
        order: Order of placing: the safest, in which every state stands, or the paper's greedy one.
        solver: Inverse-kinematics solver.
        out: Folder for build.json (the report), stacks.json (the blocks as built) and build.png (their picture).
        cell: The robot's workcell.
    """

    stack: int = 1
    from_image: Path | None = None
    inventory: str | None = None
    cells: str = "auto"
    weights: str = DEFAULT
    budget: str | None = None
    seed: int = 0
    order: Strategy = "safest"
    solver: SolverName = "urdf"
    out: Path = Path("out/build")
    cell: Workcell = field(default_factory=Workcell)


@dataclass(frozen=True)
class Simulation:
    """What only the simulated arm does.

    Args:
        grasp: Grasp by friction between parallel jaws, or by a fixed constraint, which is faster.
        noise_mm: Standard deviation of the blocks' places from where the robot believes them, in x and y [mm].
        noise_deg: Standard deviation of the blocks' turn from what the robot believes [deg].
        video: Film to write: an .mp4 (H.264, which browsers play) or a .gif, eight times as fast as the arm.
        gui: Show the build in a window, where there is a display.
    """

    grasp: Grasp = "jaws"
    noise_mm: float = 0.0
    noise_deg: float = 0.0
    video: Path | None = None
    gui: bool = False

    @property
    def asked_for(self) -> bool:
        """Whether any of it was asked for."""
        return self != Simulation()


def main(
    wanted: Wanted, picture: PictureOptions, simulation: Simulation, real: RealArm, file: Path | None = None
) -> int:
    """Build a structure with a UR5 and parallel jaws, simulated or real; exit code 1 if it does not stand in the end.

    Args:
        wanted: What is built.
        picture: What the user says of the picture of --from_image.
        simulation: What the simulated arm does.
        real: Who builds, and what a real arm needs.
        file: File of stacks (stacks.json).
    """
    placed = _check_options(wanted, simulation, real)
    if wanted.from_image is None:
        if picture != PictureOptions():
            raise StackgenError("--as, --which, --depth_scale, --focal and --cell_size go with --from_image")
        content = _from_file(file, wanted)
    else:
        if real.yes:
            raise StackgenError("a real arm asks before it moves for a picture: leave out --yes")
        content = _from_image(wanted.from_image, file, wanted, picture, len(wanted.cell.staging.slots))
    planned = _planned(content, wanted, placed)
    _make_folder(wanted.out)
    write_sheet(real, planned)
    if real.arm != "simulation":
        return build_for_real(planned, real, wanted.out)
    while True:
        result = _built(planned, wanted, simulation, content)
        _write(wanted, simulation, planned, content, result)
        _show(result)
        if result.success or wanted.from_image is None or (wanted.cells, wanted.weights) != ("auto", DEFAULT):
            break
        most = len(planned.plan.stack) - 1
        tell(f"fewer, larger blocks are easier to build: stacks of at most {most} are looked for", style="yellow")
        try:
            content = _from_image(wanted.from_image, file, wanted, picture, most)
            planned = _planned(content, wanted, placed)
        except StackgenError as error:
            tell(str(error), style="yellow")
            break
        write_sheet(real, planned)
    if wanted.from_image is not None and not result.success:
        tell("fewer, larger blocks are easier to build: give fewer --cells, such as --cells 4", style="yellow")
    written = [wanted.out, *([simulation.video] if simulation.video else [])]
    tell(f"wrote {' and '.join(map(str, written))}", wrote=written)
    return 0 if result.success else 1


def _planned(content: StacksFile, wanted: Wanted, placed: int) -> PlannedBuild:
    """Plan the first of some stacks that can be built; say where its order is not safe."""
    from stackgen.robot.build import plan_stack
    from stackgen.robot.candidates import first_buildable
    from stackgen.sim.physics import Physics

    physics = replace(Physics.recorded(content.physics), cell_size=content.cell_size)
    with progress_bar("plan", len(content.stacks[0])) as (advance, say):
        plan = partial(
            plan_stack,
            workcell=wanted.cell,
            physics=physics,
            strategy=wanted.order,
            solver=wanted.solver,
            placed=placed,
            on_block=advance,
        )
        planned = first_buildable(content.stacks, plan)
        if not planned.design.order.safe:
            say(f"the greedy order is not safe: {planned.design.order.blocked}")
    return planned


def _check_options(wanted: Wanted, simulation: Simulation, real: RealArm) -> int:
    """See that the options go together; return how many blocks stand already."""
    from stackgen.robot.real.real_build import placed_before
    from stackgen.robot.simulated.film import check_film
    from stackgen.robot.simulated.window import require_display

    if simulation.noise_mm < 0 or simulation.noise_deg < 0 or wanted.seed < 0:
        raise StackgenError("--noise_mm, --noise_deg and --seed must be at least 0")
    check_options(real, simulation.asked_for)
    placed = placed_before(wanted.out, real.resume)
    if simulation.video is not None:
        check_film(simulation.video)
    if simulation.gui:
        require_display()
    return placed


def _from_file(file: Path | None, wanted: Wanted) -> StacksFile:
    """Read the file; its one stack is the one to build."""
    if file is None:
        raise StackgenError("give a stacks.json, or a picture with --from_image")
    if wanted.inventory is not None or wanted.budget is not None or wanted.cells != "auto":
        raise StackgenError("--inventory, --budget and --cells go with --from_image: a stacks.json names its blocks")
    content = read_stacks(file)
    if not 1 <= wanted.stack <= len(content.entries):
        raise StackgenError(f"{file}: --stack must lie in 1..{len(content.entries)}, got {wanted.stack}")
    entry = content.entries[wanted.stack - 1]
    for misfit in describe_misfits(entry.stack):
        if misfit.impossible:
            raise StackgenError(f"{file}: stack {wanted.stack} cannot be built: {misfit.text}")
    return replace(content, entries=(entry,))


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StackgenError(f"--out {out}: cannot be made: {error.strerror or error}") from error


def _from_image(image: Path, file: Path | None, wanted: Wanted, picture: PictureOptions, most: int) -> StacksFile:
    """Read a picture, write what was read, and sample stacks for it: those that stand, the best first.

    Where all of them have more than `most` blocks, stacks of a smaller scale are taken, if there are such.

    Raises:
        StackgenError: If nothing is read or found, or `most` is less than the slots hold and all have more blocks.
    """
    if file is not None:
        raise StackgenError(f"give {file} or --from_image {image}, not both")
    from stackgen.api import load
    from stackgen.robot.candidates import NUMBER, stacks_of_picture
    from stackgen.search.scale import Cells

    Cells.parse(wanted.cells)  # what is wrong is said before anything is written
    if wanted.cells != "auto" and wanted.weights != DEFAULT:
        raise StackgenError("--cells belongs to the search: leave out --weights")
    model = None if wanted.weights == DEFAULT else load(wanted.weights)
    reading = read_picture(image, PAPER_GRID, **vars(picture))
    _make_folder(wanted.out)
    save_image(wanted.out / "overlay.png", reading.overlay)

    with progress_bar("stacks", NUMBER + 1) as (advance, _):
        done = iter(range(1, NUMBER + 2))
        found = stacks_of_picture(
            reading,
            image.name,
            model,
            inventory=wanted.inventory,
            budget=wanted.budget,
            seed=wanted.seed,
            cells=wanted.cells,
            most=most,
            on_step=lambda: advance(next(done)),
        )
    if len(found.stacks[0]) > most < len(wanted.cell.staging.slots):
        raise StackgenError(f"{image.name}: no stack of at most {most} blocks was found")
    assert found.block_list is not None and found.target is not None
    save_image(wanted.out / "silhouette.png", found.target)
    lines = [f"read as a {reading.describe()}", *reading.notes]
    blocks, best = format_block_list(found.block_list, found.world.catalogue), found.entries[0]
    match = f"front IoU {best.front_iou:.2f}, {'matches' if best.matches else 'does not match'}"
    tell(*lines, f"{image.name}: {blocks}; {found.comment}; {match}", read_as=reading.describe())
    return found


def _built(planned: PlannedBuild, wanted: Wanted, simulation: Simulation, content: StacksFile) -> BuildReport:
    from stackgen.robot.build import build
    from stackgen.robot.simulated.arm import PickNoise
    from stackgen.robot.simulated.film import Film

    with progress_bar("build", len(planned.plan.stack)) as (advance, _):
        return build(
            planned,
            content.world.grid,
            target=content.target,
            grasp=simulation.grasp,
            noise=PickNoise(simulation.noise_mm / 1e3, math.radians(simulation.noise_deg), wanted.seed),
            window=simulation.gui,
            on_block=advance,
            camera=Film(wanted.out / "build.png", simulation.video).camera,
        )


def _write(
    wanted: Wanted, simulation: Simulation, planned: PlannedBuild, content: StacksFile, result: BuildReport
) -> None:
    """Write build.json and stacks.json."""
    physics = planned.physics.to_json()
    plain = {
        **result.to_json(),
        "noise": {"mm": simulation.noise_mm, "deg": simulation.noise_deg, "seed": wanted.seed},
        "physics": physics,
        "cell": planned.workcell.to_json(),
    }
    write_json(wanted.out / "build.json", plain)
    entry = StackEntry(result.stack, comment="as the robot built it")
    write_stacks(wanted.out / "stacks.json", replace(content, entries=(entry,), physics=physics))


def _show(result: BuildReport) -> None:
    """Print a row for each block, and what stands in the end."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))  # 80 columns hold it
    table.add_column("block", no_wrap=True)
    headings = ("released\nxy mm", "settled\nxy mm", "z\nmm", "yaw\n°", "disturbed\nmm", "clearance\nmm", "time\ns")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for block in result.blocks:
        table.add_row(
            f"{block.block} ({block.shape})",
            f"{block.released.xy:.2f}",
            f"{block.settled.xy:.2f}",
            f"{block.settled.z:+.2f}",
            f"{block.settled.yaw:.2f}",
            f"{block.disturbed:.2f}",
            f"{block.clearance:.1f}",
            f"{block.seconds:.1f}",
        )
    tell(table, **result.to_json())
    for contact in result.unplanned:
        tell(f"not planned: {contact}", style="yellow")
    word = Text("built, and stands", "green") if result.success else Text(_what_went_wrong(result), "red")
    match = "" if result.iou_target is None else (
        f", front IoU with the target {result.iou_target:.2f} (as generated {result.generated_iou_target:.2f})"
    )  # fmt: skip
    words = (
        f"{match}; {result.order} order, least margin {result.least_margin:.1f}°;"
        f" {result.seconds:.0f} s of the arm's time, {result.real_time_factor:.1f} times real time"
    )
    tell(Text.assemble(word, words))


def _what_went_wrong(result: BuildReport) -> str:
    if result.built:
        return "built, but does not stand"
    fallen = np.linalg.norm(result.stack.poses[:, :3] - result.design.poses[:, :3], axis=1)
    worst = int(np.argmax(fallen))
    return f"not built: block {worst} ({result.stack.names[worst]}) is {fallen[worst]:.1f} cells from its place"


COMMAND = Command(
    "build",
    main,
    """
    stackgen build examples/stacks/arch.json --video arch.mp4
    stackgen build out/arch/stacks.json --stack 2 --noise_mm 1 --noise_deg 1 --out out/built
    stackgen build --from_image examples/silhouettes/house.png --inventory cube=6,triangle=2 --video house.gif
    stackgen build out/arch/stacks.json --config configs/robot/ur5.yaml --cell.base.position "[0, 0.42, 0]"
    stackgen build examples/stacks/arch.json --staging_sheet sheet.pdf --arm urscript
    stackgen build examples/stacks/arch.json --arm ur-rtde --host 192.168.0.10 --execute
    """,
    files=Files("file", "FILE", "File of stacks (stacks.json).", optional=True),
    reports=True,
    settings={"wanted": Wanted, "picture": PictureOptions, "simulation": Simulation, "real": RealArm},
    flags={
        "gui": "Show the build in a window, where there is a display.",
        "execute": "Have the real arm move; without it everything else is done.",
        "yes": "Do not ask before the real arm moves.",
        "resume": "Continue a real build that was interrupted with its next block.",
    },
    hidden=("cell", "controller", "gripper", "depth_scale", "focal", "cell_size"),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as for `sample`
    return COMMAND.run(argv)
