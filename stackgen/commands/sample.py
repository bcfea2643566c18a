"""stackgen sample: silhouettes to stacks, with verdicts, pictures and 3-D files."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.progress import Progress

from stackgen.api import DEFAULT, Model, best, load
from stackgen.commands.parsing import Command, Files
from stackgen.commands.verdict_table import verdict_table
from stackgen.errors import StackgenError
from stackgen.io.files import require_folder, staged
from stackgen.io.stacks_file import StacksFile, write_stacks
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.protocols import CheckerName
from stackgen.sampling.verified import Budget
from stackgen.search.scale import Cells
from stackgen.search.solver import Preference, SearchSettings
from stackgen.stack import format_block_list
from stackgen.vision.reader import Reading, read_picture
from stackgen.viz.gltf import write_glb
from stackgen.viz.render import Picture, contact_sheet, overview, save_image
from stackgen.world import PAPER_GRID

Draw = Callable[[Path, Reading], StacksFile]

POOR = 0.8
"""Front IoU below which a line says what could help."""


def main(
    images: list[Path],
    out: Path,
    num_samples: int = 3,
    blocks: str | None = None,
    inventory: str | None = None,
    seed: int = 0,
    cells: str = "auto",
    prefer: Preference = "fit",
    one_shot: bool = False,
    weights: str = DEFAULT,
    block_list_weights: str = DEFAULT,
    sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
    verify: CheckerName | None = None,
    budget: str | None = None,
) -> int:
    """Turn pictures into stacks of blocks and simulate each; the exit code is 1 if any falls, but for single samples.

    Search and network look for the best stacks together. Single samples of the network alone, as the paper has them,
    are drawn with --one_shot or with any option that says which weights sample, or how.

    Args:
        images: Pictures of structures.
        out: Folder for stacks.json, stacks.png, silhouette.png, overlay.png and a GLB for each stack; several images
            get a folder each in it, beside overview.png.
        num_samples: Number of stacks for each image.
        blocks: Block list, such as cube=3,rectangle=2; it is chosen by default.
        inventory: Blocks that are available, such as cube=4,rectangle=3; the block list is chosen among them.
        seed: Seed of the samples: the same seed gives the same stacks, unless --budget is a time.
        cells: Height of the structure in cells, such as 6, or width and height, such as 6x5; auto finds it, up to 8.
        prefer: Stacks that come first: those of the best fit, or of those that fit nearly as well the ones of the
            largest margin against tilting.
        weights: Weights of the sampler: a name (search is one), a .safetensors file, a .ckpt file or a run folder.
        block_list_weights: Weights of the block-list network: a name, a .safetensors file, a .ckpt file or a run
            folder.
        sampler: Settings by which a diffusion model samples; the weights' own where one is null.
        verify: Verified sampling: many stacks are drawn and checked by the simulator (the default after --verify
            alone) or by statics, and the best are kept; where nothing stands, the next likely block list is tried.
        budget: Limit for each image: a time, such as 1s; with --verify also a number of draws for each block list,
            such as 64 (the default).
    """
    if num_samples < 1:
        raise StackgenError(f"--num_samples must be at least 1, got {num_samples}")
    folders = result_folders(images, out)
    asked: dict[str, Any] = {"num_samples": num_samples, "seed": seed, "blocks": blocks, "inventory": inventory}
    own = one_shot or verify is not None or sampler != SamplerConfig()
    if own or weights != DEFAULT or block_list_weights != DEFAULT:
        if cells != "auto" or prefer != "fit":
            raise StackgenError("--cells and --prefer belong to the search: leave out what asks for single samples")
        draw = _of_model(load(weights, block_list_weights, sampler), asked, verify, budget)
    else:
        seconds = None if budget is None else Budget.parse(budget).seconds
        if budget is not None and seconds is None:
            raise StackgenError(f"--budget {budget} is a number of draws, which limits --verify: give both, or a time")
        Cells.parse(cells)
        search = SearchSettings(seconds=seconds, prefer=prefer)

        def draw(image: Path, reading: Reading) -> StacksFile:
            return replace(best(reading, **asked, cells=cells, search=search), silhouette=image.name)

    return _all(images, folders, out, draw, verified=not (own or weights != DEFAULT) or verify is not None)


def _of_model(model: Model, asked: dict[str, Any], verify: CheckerName | None, budget: str | None) -> Draw:
    """Make the function that samples from a model; mistakes come to light before any work is done."""
    if budget is not None and verify is None:
        raise StackgenError("--budget limits --verify: give both, or neither")
    _ = model.predictor if asked["blocks"] is None else model.counts(asked["blocks"])
    _ = None if asked["inventory"] is None else model.inventory(asked["inventory"])
    sample: Callable[..., StacksFile] = partial(model.sample_checked, **asked)
    if verify is not None:
        sample = partial(model.sample_verified, **asked, verify=verify, budget=Budget.parse(budget) if budget else None)
    return lambda image, reading: sample(image)


def _all(images: Sequence[Path], folders: Sequence[Path], out: Path, draw: Draw, verified: bool) -> int:
    """Answer all pictures that can be read; name the others at the end."""
    results: list[StacksFile] = []
    sheets: list[Picture] = []
    refused: list[StackgenError] = []
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        task = progress.add_task("", total=len(images))
        try:
            for image, folder in zip(images, folders, strict=True):
                progress.update(task, description=image.name)
                try:
                    reading = read_picture(image, PAPER_GRID)
                    result = draw(image, reading)
                except StackgenError as error:
                    refused.append(error if image.name in str(error) else StackgenError(f"{image}: {error}"))
                    continue
                finally:
                    progress.advance(task)
                sheets.append(write_result(result, folder, reading.overlay))
                results.append(result)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{len(results)} of {len(images)} images are finished in {out}") from None
    if not results:
        raise refused[0]
    if len(images) > 1:
        save_image(out / "overview.png", overview(sheets))
    code = report(results, out, verified)
    for reason in refused:
        print(f"stackgen: error: {reason}", file=sys.stderr)
    return 2 if refused else code


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
    for result in results if verified else ():
        most = max((entry.front_iou or 0.0 for entry in result.entries), default=0.0)
        if most < POOR:
            console.print(
                f"{result.silhouette}: the best fit is {most:.2f}; more cells (--cells), other blocks"
                " in the inventory, or leaving --blocks out could help",
                highlight=False,
                soft_wrap=True,
            )
    console.print(f"wrote {out}", highlight=False)
    return int(falls)


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


def write_result(result: StacksFile, folder: Path, overlay: Picture) -> Picture:
    """Write stacks.json, pictures of target, reading and stacks, and stack-N.glb, all or none; return the sheet."""
    assert result.block_list is not None and result.target is not None
    title = f"{result.silhouette}: {format_block_list(result.block_list, result.world.catalogue)}"
    verdicts = [entry.verdict for entry in result.entries]
    ious = [entry.front_iou for entry in result.entries]
    sheet = contact_sheet(result.target, result.stacks, verdicts, ious, title, grid=result.world.grid)
    with staged(folder, replaces="stack-[0-9]*.glb") as stage:
        for number, stack in enumerate(result.stacks, 1):
            write_glb(stage / f"stack-{number}.glb", stack, cell_size=result.cell_size)
        save_image(stage / "stacks.png", sheet)
        save_image(stage / "silhouette.png", result.target)
        save_image(stage / "overlay.png", overlay)
        write_stacks(stage / "stacks.json", result)
    return sheet


COMMAND = Command(
    "sample",
    main,
    """
    stackgen sample examples/silhouettes/arch.png --out out/arch
    stackgen sample sketch.jpg --blocks cube=3,rectangle=2,triangle=1 --num_samples 5 --out out/sketch
    stackgen sample sketch.jpg --inventory cube=4,rectangle=3 --verify --budget 1s --out out/sketch
    stackgen sample tower.png --cells 6 --prefer margin --out out/tower
    stackgen sample sketch.jpg --sampler.kind dpm --sampler.steps 8 --out out/sketch
    """,
    files=Files("images", "IMAGE", "Pictures of structures: PNG or JPEG, any size, colours and polarity.", many=True),
    flags={"one_shot": "Draw single samples of the network, as the paper does."},
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
