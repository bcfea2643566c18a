"""stackgen sample: silhouettes to stacks, with verdicts, pictures and 3-D files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from rich.console import Console
from rich.progress import Progress

from stackgen.api import DEFAULT, load
from stackgen.commands.parsing import Command, Files
from stackgen.commands.verdict_table import verdict_table
from stackgen.errors import StackgenError
from stackgen.io.files import require_folder, staged
from stackgen.io.stacks_file import StacksFile, write_stacks
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.protocols import CheckerName
from stackgen.stack import format_block_list
from stackgen.viz.gltf import write_glb
from stackgen.viz.render import Picture, contact_sheet, overview, save_image

if TYPE_CHECKING:
    from stackgen.sampling.verified import Budget


def main(
    images: list[Path],
    out: Path,
    num_samples: int = 3,
    blocks: str | None = None,
    inventory: str | None = None,
    seed: int = 0,
    weights: str = DEFAULT,
    block_list_weights: str = DEFAULT,
    sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
    verify: CheckerName | None = None,
    budget: str | None = None,
) -> int:
    """Turn silhouettes into stacks of blocks and simulate each; with --verify the exit code is 1 if any falls.

    Args:
        images: Pictures of structures.
        out: Folder for stacks.json, stacks.png and a GLB for each stack; several images get a folder
            each in it, beside overview.png.
        num_samples: Number of stacks for each image.
        blocks: Block list, such as cube=3,rectangle=2; the network chooses one by default.
        inventory: Blocks that are available, such as cube=4,rectangle=3; the block list is chosen among them.
        seed: Seed of the samples: the same seed gives the same stacks, unless --budget is a time.
        weights: Weights of the sampler: a name, a .safetensors file, a .ckpt file or a run folder.
        block_list_weights: Weights of the block-list network: a name, a .safetensors file, a .ckpt file or a run
            folder.
        sampler: Settings by which a diffusion model samples; the weights' own where one is null.
        verify: Verified sampling: many stacks are drawn and checked by the simulator (the default after --verify
            alone) or by statics, and the best are kept; where nothing stands, the next likely block list is tried.
        budget: Limit of --verify for each image: a time, such as 1s, or a number of draws for each block list,
            such as 64 (the default).
    """
    if num_samples < 1:
        raise StackgenError(f"--num_samples must be at least 1, got {num_samples}")
    spent = _budget(verify, budget)
    folders = result_folders(images, out)
    model = load(weights, block_list_weights, sampler)
    # Mistakes come to light before any work is done.
    _ = model.predictor if blocks is None else model.counts(blocks)
    _ = None if inventory is None else model.inventory(inventory)
    for image in images:
        model.read(image)
    asked: dict[str, Any] = {"num_samples": num_samples, "seed": seed, "blocks": blocks, "inventory": inventory}
    draw: Callable[..., StacksFile] = partial(model.sample_checked, **asked)
    if verify:
        draw = partial(model.sample_verified, **asked, verify=verify, budget=spent)
    results: list[StacksFile] = []
    sheets: list[Picture] = []
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        task = progress.add_task("", total=len(images) * (num_samples + 2))
        try:
            for image, folder in zip(images, folders, strict=True):
                progress.update(task, description=image.name)
                result = draw(image, on_step=lambda: progress.advance(task))
                sheets.append(write_result(result, folder))
                progress.advance(task)
                results.append(result)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{len(results)} of {len(images)} images are finished in {out}") from None
    if len(images) > 1:
        save_image(out / "overview.png", overview(sheets))
    return report(results, out, verified=verify is not None)


def report(results: Sequence[StacksFile], out: Path, verified: bool) -> int:
    """Print what became of the images; the exit code is 1 if a stack falls that was said to be verified."""
    console = Console()
    console.print(verdict_table("image", [(result.silhouette or "", result.entries) for result in results], most=1))
    falls = False
    for result in results if verified else ():
        console.print(f"{result.silhouette}: {result.comment}", highlight=False)
        for number, entry in enumerate(result.entries, 1):
            if entry.verdict is None or not entry.verdict.stable:
                falls = True
                why = entry.comment or "the simulator does not agree that it stands"
                console.print(f"[red]{result.silhouette}: stack {number} falls: {why}[/]", highlight=False)
    console.print(f"wrote {out}", highlight=False)
    return int(falls)


def _budget(verify: CheckerName | None, budget: str | None) -> Budget | None:
    if budget is None:
        return None
    if verify is None:
        raise StackgenError("--budget limits --verify: give both, or neither")
    from stackgen.sampling.verified import Budget

    return Budget.parse(budget)


def result_folders(images: Sequence[Path], out: Path) -> list[Path]:
    """Name a folder for each image: `out` itself for one, else one in it like the image; equal names are numbered.

    Raises:
        StackgenError: If no folder can be made there.

    >>> [folder.name for folder in result_folders([Path("a.png"), Path("b/a.jpg")], Path("no-such-folder"))]
    ['a', 'a-2']
    """
    require_folder(out, f"--out {out}")
    if len(images) == 1:
        return [out]
    names: list[str] = []
    for image in images:
        candidates = chain([image.stem], (f"{image.stem}-{number}" for number in count(2)))
        names.append(next(name for name in candidates if name not in names))
    return [out / name for name in names]


def write_result(result: StacksFile, folder: Path) -> Picture:
    """Write stacks.json, stacks.png and stack-N.glb, all of them or none; return the contact sheet."""
    assert result.block_list is not None
    title = f"{result.silhouette}: {format_block_list(result.block_list, result.world.catalogue)}"
    verdicts = [entry.verdict for entry in result.entries]
    ious = [entry.front_iou for entry in result.entries]
    sheet = contact_sheet(result.target, result.stacks, verdicts, ious, title, grid=result.world.grid)
    with staged(folder, replaces="stack-[0-9]*.glb") as stage:
        for number, stack in enumerate(result.stacks, 1):
            write_glb(stage / f"stack-{number}.glb", stack, cell_size=result.cell_size)
        save_image(stage / "stacks.png", sheet)
        write_stacks(stage / "stacks.json", result)
    return sheet


COMMAND = Command(
    "sample",
    main,
    """
    stackgen sample examples/silhouettes/arch.png --out out/arch
    stackgen sample sketch.jpg --blocks cube=3,rectangle=2,triangle=1 --num_samples 5 --out out/sketch
    stackgen sample sketch.jpg --inventory cube=4,rectangle=3 --verify --budget 1s --out out/sketch
    stackgen sample sketch.jpg --sampler.kind dpm --sampler.steps 8 --out out/sketch
    """,
    files=Files("images", "IMAGE", "Pictures of structures: PNG or JPEG, any size, colours and polarity.", many=True),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    # A few stacks keep one thread busy; more threads only wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return COMMAND.run(with_checker(argv))


def with_checker(argv: Sequence[str]) -> list[str]:
    """Write out what `--verify` alone means: the simulator.

    >>> with_checker(["a.png", "--verify", "--budget", "1s"])
    ['a.png', '--verify', 'simulator', '--budget', '1s']
    """
    checkers, arguments = get_args(CheckerName), list(argv)
    for place in reversed(range(len(arguments))):
        if arguments[place] == "--verify" and arguments[place + 1 : place + 2] not in [[name] for name in checkers]:
            arguments.insert(place + 1, checkers[0])
    return arguments
