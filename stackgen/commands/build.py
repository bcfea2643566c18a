"""stackgen build: a UR5 builds a structure, in simulation or for real."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from stackgen.api import DEFAULT
from stackgen.commands.parsing import Command, Files
from stackgen.commands.progress_bar import progress_bar
from stackgen.commands.real_arm import RealArm, build_for_real, check_options, placed_before, write_sheet
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.io.files import write_atomically
from stackgen.io.stacks_file import Entry, StacksFile, read_stacks, write_stacks
from stackgen.robot.planning.kinematics import SolverName
from stackgen.robot.planning.order import Strategy
from stackgen.robot.workcell import Cell, Grasp
from stackgen.stack import format_block_list
from stackgen.world import Grid, Mask

if TYPE_CHECKING:
    from stackgen.robot.build import Design
    from stackgen.robot.planning.plan import BuildPlan
    from stackgen.robot.report import BuildReport
    from stackgen.sim.physics import Physics


def main(
    file: Path | None = None,
    stack: int = 1,
    from_image: Path | None = None,
    inventory: str | None = None,
    weights: str = DEFAULT,
    budget: str | None = None,
    order: Strategy = "safest",
    grasp: Grasp = "jaws",
    solver: SolverName = "urdf",
    noise_mm: float = 0.0,
    noise_deg: float = 0.0,
    seed: int = 0,
    out: Path = Path("out/build"),
    video: Path | None = None,
    gui: bool = False,
    cell: Cell = Cell(),  # noqa: B008 - frozen
    execute: bool = False,
    yes: bool = False,
    resume: bool = False,
    real: RealArm = RealArm(),  # noqa: B008 - frozen
) -> int:
    """Build a structure with a UR5 and parallel jaws, simulated or real; exit code 1 if it does not stand in the end.

    Args:
        file: A stacks.json.
        stack: Which of its stacks, counted from 1.
        from_image: Build what is in a picture, the photo of a sketch, or a depth frame (as for `stackgen capture`),
            instead: block list, verified stacks, the best of them.
        inventory: With --from_image, the blocks there are, such as cube=4,rectangle=3.
        weights: With --from_image, the sampler's: a name, a .safetensors, a .ckpt or the folder of a run.
        budget: With --from_image, what finding a stack may cost: a time such as 5s or a number of draws.
        order: The safest order, in which every state stands, or the paper's greedy one.
        grasp: By friction between parallel jaws, or by a fixed constraint, which is faster.
        solver: Of the inverse kinematics.
        noise_mm: How far the blocks lie from where the robot believes, along x and along y: standard deviation [mm].
        noise_deg: How far they are turned: standard deviation [deg].
        seed: Of the noise, and with --from_image of the stacks.
        out: Folder for build.json, the report, stacks.json, what was built, and build.png, a picture of it.
        video: Film the build: an .mp4 (H.264, which browsers play) or a .gif, eight times as fast as the arm.
        gui: Show the build in a window.
        cell: The robot's cell.
        execute: Have the real arm move; without it everything but that is done.
        yes: Do not ask before the real arm moves.
        resume: Go on with the next block of a real build that was interrupted.
        real: Who builds, and what a real arm needs.
    """
    from stackgen.robot.simulated.film import check_film
    from stackgen.robot.simulated.window import require_display

    if noise_mm < 0 or noise_deg < 0 or seed < 0:
        raise StackgenError("--noise_mm, --noise_deg and --seed must be at least 0")
    only_simulated = gui or video is not None or noise_mm > 0 or noise_deg > 0 or grasp != "jaws"
    check_options(real, execute, yes, resume, only_simulated)
    placed = placed_before(out, resume)
    if video is not None:
        check_film(video)
    if gui:
        require_display()
    content, entries = (
        _from_file(file, stack, inventory, budget)
        if from_image is None
        else _from_image(from_image, file, inventory, weights, budget, seed)
    )
    physics = _physics(content)
    wanted, plan = _planned(entries, cell, physics, order, solver, placed)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StackgenError(f"--out {out}: cannot be made: {error.strerror or error}") from error
    write_sheet(real, plan, cell, physics.cell_size)
    if real.arm != "simulation":
        return build_for_real(plan, cell, real, out, execute, yes, resume)
    noise = noise_mm / 1e3, float(np.radians(noise_deg)), seed
    result = _built(wanted, plan, cell, physics, grasp, noise, content, gui, out / "build.png", video)
    _write(out, result, content, cell, physics, noise)
    _show(result)
    written = [out, *([video] if video else [])]
    Console().print(f"wrote {' and '.join(map(str, written))}", highlight=False)
    return 0 if result.success else 1


def _from_file(
    file: Path | None, number: int, inventory: str | None, budget: str | None
) -> tuple[StacksFile, list[Entry]]:
    if file is None:
        raise StackgenError("give a stacks.json, or a picture with --from_image")
    if inventory is not None or budget is not None:
        raise StackgenError("--inventory and --budget go with --from_image: a stacks.json names its blocks")
    content = read_stacks(file)
    if not 1 <= number <= len(content.entries):
        raise StackgenError(f"{file}: --stack must lie in 1..{len(content.entries)}, got {number}")
    return content, [content.entries[number - 1]]


def _from_image(
    image: Path, file: Path | None, inventory: str | None, weights: str, budget: str | None, seed: int
) -> tuple[StacksFile, list[Entry]]:
    """Silhouette, block list and stacks that a simulator judged; those that stand, the best first.

    Raises:
        StackgenError: If nothing that stands was found.
    """
    if file is not None:
        raise StackgenError(f"give {file} or --from_image {image}, not both")
    from stackgen.api import load
    from stackgen.sampling.verified import Budget

    model = load(weights)
    seen = _seen(image, model.grid)
    spent = None if budget is None else Budget.parse(budget)
    number = 3
    with progress_bar("stacks", number + 1) as (advance, _):
        done = iter(range(1, number + 2))
        found = model.sample_verified(
            seen, number, seed, inventory=inventory, budget=spent, on_step=lambda: advance(next(done))
        )
    found = replace(found, silhouette=image.name)
    standing = [entry for entry in found.entries if entry.verdict is not None and entry.verdict.stable]
    if not standing:
        raise StackgenError(f"{image}: none of the stacks that were tried stands; try a larger --budget")
    assert found.block_list is not None
    blocks = format_block_list(found.block_list, found.catalogue)
    Console().print(f"{image.name}: {blocks}; {found.comment}; front IoU {standing[0].front_iou:.2f}", highlight=False)
    return found, standing


_SAME = 0.7
"""Front IoU from which on the two ways to read a picture are taken to have seen the same."""


def _seen(image: Path, grid: Grid) -> Mask:
    """The silhouette in a drawing, in the photo of one, or in a depth frame.

    A clean picture is read by its colours; that fails, or sees something else, where light is uneven or only the
    outline is drawn: then it is a sketch.
    """
    from stackgen.vision.depth import capture, is_depth, read_frame
    from stackgen.vision.drawings import read_silhouette
    from stackgen.vision.sketches import read_sketch

    if is_depth(image):
        return capture(read_frame(image), grid).silhouette
    try:
        sketch = read_sketch(image, grid).silhouette
    except StackgenError:
        return read_silhouette(image, grid)
    try:
        drawing = read_silhouette(image, grid)
    except StackgenError:
        return sketch
    return drawing if iou(drawing, sketch) >= _SAME else sketch


def _physics(content: StacksFile) -> Physics:
    from stackgen.sim.physics import Physics

    return replace(Physics.of_world(content.physics), cell_size=content.cell_size)


def _planned(
    entries: Sequence[Entry], cell: Cell, physics: Physics, order: Strategy, solver: SolverName, placed: int
) -> tuple[Design, BuildPlan]:
    """All that can be found out before anything moves, of the first stack that can be built.

    Raises:
        StackgenError: If none can; it says why of the first.
    """
    from stackgen.robot.build import design
    from stackgen.robot.planning.plan import plan_build

    reasons = []
    for entry in entries:
        try:
            wanted = design(entry.stack, cell, physics, order)
            with progress_bar("plan", len(wanted.stack)) as (advance, say):
                if not wanted.order.safe:
                    say(f"the greedy order is not safe: {wanted.order.blocked}")
                return wanted, plan_build(wanted.stack, wanted.order.blocks, cell, physics, solver, advance, placed)
        except StackgenError as error:
            reasons.append(error)
    raise reasons[0]


def _built(
    wanted: Design,
    plan: BuildPlan,
    cell: Cell,
    physics: Physics,
    grasp: Grasp,
    noise: tuple[float, float, int],
    content: StacksFile,
    gui: bool,
    picture: Path,
    video: Path | None,
) -> BuildReport:
    from stackgen.robot.build import build
    from stackgen.robot.simulated.arm import PickNoise
    from stackgen.robot.simulated.film import Film

    with progress_bar("build", len(wanted.stack)) as (advance, _):
        return build(
            wanted,
            plan,
            cell,
            physics,
            grasp,
            PickNoise(*noise),
            gui,
            content.target,
            content.grid,
            advance,
            Film(picture, video).camera,
        )


def _write(
    out: Path,
    result: BuildReport,
    content: StacksFile,
    cell: Cell,
    physics: Physics,
    noise: tuple[float, float, int],
) -> None:
    """build.json and stacks.json."""
    plain = {
        **result.to_json(),
        "noise": {"mm": noise[0] * 1e3, "deg": float(np.degrees(noise[1])), "seed": noise[2]},
        "physics": physics.to_json(),
        "cell": cell.to_json(),
    }
    write_atomically(out / "build.json", (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())
    entry = Entry(result.stack, comment="as the robot built it")
    write_stacks(out / "stacks.json", replace(content, entries=(entry,), physics=physics.to_json()))


def _show(result: BuildReport) -> None:
    """A row for each block, and what stands in the end."""
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
    console = Console()
    console.print(table)
    for contact in result.unplanned:
        console.print(f"[yellow]not planned: {contact}[/]", highlight=False)
    word = "[green]built, and stands[/]" if result.success else "[red]" + _what_went_wrong(result) + "[/]"
    match = "" if result.iou_target is None else (
        f", front IoU with the target {result.iou_target:.2f} (as generated {result.generated_iou_target:.2f})"
    )  # fmt: skip
    console.print(
        f"{word}{match}; {result.order} order, least margin {result.least_margin:.1f}°;"
        f" {result.seconds:.0f} s of the arm's time, {result.real_time_factor:.1f} times real time",
        highlight=False,
    )


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
    files=Files("file", "FILE", "A stacks.json.", optional=True),
    settings=("real", RealArm),
    flags={
        "gui": "Show the build in a window, where there is a display.",
        "execute": "Have the real arm move; without it everything but that is done.",
        "yes": "Do not ask before the real arm moves.",
        "resume": "Go on with the next block of a real build that was interrupted.",
    },
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as for `sample`
    return COMMAND.run(argv)
