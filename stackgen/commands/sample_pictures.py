"""What `stackgen sample` does with each picture: read, draw, write and say what became of it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

from rich.progress import Progress

from stackgen.api import Model
from stackgen.commands.output import is_quiet, tell, wrote
from stackgen.commands.verdict_table import verdict_facts, verdict_table
from stackgen.errors import StackgenError, printable
from stackgen.io.files import require_folder, staged
from stackgen.io.stacks_file import StacksFile, write_stacks
from stackgen.io.terminal import Screen
from stackgen.names import CheckerName
from stackgen.sampling.verified import Budget
from stackgen.search.scale import Cells
from stackgen.stack import format_block_list
from stackgen.vision.options import PictureOptions
from stackgen.vision.reader import Reading, read_picture
from stackgen.viz.gltf import write_glb
from stackgen.viz.render import Picture, contact_sheet, overview, save_image
from stackgen.world import PAPER_GRID

Draw = Callable[[Path, Reading], StacksFile]

POOR = 0.8
"""Front IoU below which a line says what could help."""


def of_model(model: Model, asked: dict[str, Any], verify: CheckerName | None, budget: str | None, cells: Cells) -> Draw:
    """Make the function that samples from a model; mistakes come to light before any work is done."""
    if budget is not None and verify is None:
        raise StackgenError("--budget limits --verify: give both, or neither")
    _ = model.predictor if asked["blocks"] is None else model.counts(asked["blocks"])
    _ = None if asked["inventory"] is None else model.inventory(asked["inventory"])
    sample: Callable[..., StacksFile] = partial(model.sample_checked, **asked)
    if verify is not None:
        sample = partial(model.sample_verified, **asked, verify=verify, budget=Budget.parse(budget) if budget else None)

    def draw(image: Path, reading: Reading) -> StacksFile:
        if cells.high is not None:
            figure = cells.stretched(reading.figure)
            reading = replace(reading, figure=figure, cell=len(figure) / cells.high, exact=None)
        return replace(sample(reading), silhouette=image.name)

    return draw


def answer_all(
    images: Sequence[Path], folders: Sequence[Path], picture: PictureOptions, out: Path, draw: Draw, verified: bool
) -> int:
    """Answer all pictures that can be read; name the others at the end."""
    results: list[StacksFile] = []
    sheets: list[Picture] = []
    refused: list[StackgenError] = []
    seen: list[Sequence[str]] = []
    screen = Screen(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal or is_quiet()) as progress:
        task = progress.add_task("", total=len(images))
        try:
            for image, folder in zip(images, folders, strict=True):
                progress.update(task, description=image.name)
                try:
                    reading = read_picture(image, PAPER_GRID, **vars(picture))
                    result = draw(image, reading)
                except StackgenError as error:
                    refused.append(error if image.name in str(error) else StackgenError(f"{image}: {error}"))
                    continue
                finally:
                    progress.advance(task)
                sheets.append(write_result(result, folder, reading.overlay))
                results.append(result)
                seen.append((f"read as a {reading.describe()}", *reading.notes))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{len(results)} of {len(images)} images are finished in {out}") from None
    if not results:
        raise refused[0]
    if len(images) > 1:
        save_image(out / "overview.png", overview(sheets))
    code = report(results, seen, out, verified)
    for reason in refused:
        print(f"stackgen: error: {printable(reason)}", file=sys.stderr)
    return 2 if refused else code


def report(results: Sequence[StacksFile], seen: Sequence[Sequence[str]], out: Path, verified: bool) -> int:
    """Tell what was seen in the images and became of them; the exit code is 1 if a verified stack falls after all."""
    for result, lines in zip(results, seen, strict=True):
        tell(f"{result.silhouette}: {' '.join([f'{lines[0]}.', *lines[1:]])}")
    tell(verdict_table("image", [(result.silhouette or "", result.entries) for result in results], most=1))
    falls = False
    for result in results if verified else ():
        tell(f"{result.silhouette}: {result.comment}")
        for number, entry in enumerate(result.entries, 1):
            if entry.verdict is None or not entry.verdict.stable:
                falls = True
                why = entry.comment or "the simulator does not agree that it stands"
                tell(f"{result.silhouette}: stack {number} falls: {why}", style="red")
    for result in results if verified else ():
        most = max((entry.front_iou or 0.0 for entry in result.entries), default=0.0)
        if most < POOR:
            tell(
                f"{result.silhouette}: the best fit is {most:.2f}; more cells (--cells), other blocks in the inventory,"
                " or leaving --blocks out could help"
            )
    facts = [
        {
            "image": result.silhouette,
            "found": lines,
            "comment": result.comment,
            "stacks": [
                {"blocks": format_block_list(entry.stack.counts, entry.stack.catalogue), **verdict_facts(entry)}
                for entry in result.entries
            ],
        }
        for result, lines in zip(results, seen, strict=True)
    ]
    tell(images=facts)
    wrote(out)
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
