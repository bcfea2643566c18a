"""A contact sheet for each method: what it got right, and beside it what it got wrong."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from stackgen.evaluation.protocol import Scene
from stackgen.evaluation.report.pick import Example, pick_examples
from stackgen.evaluation.report.rows import LIST_NAMES, Line
from stackgen.io.files import write_atomically
from stackgen.protocols import StabilityChecker
from stackgen.viz.render import Picture, contact_sheet
from stackgen.world import PAPER_GRID, Grid

_SHRINK = 0.6
_GAP = 24  # [pixel], before shrinking
_HEADING = 54  # [pixel]
_HEADINGS = (("stands and matches", (30, 130, 76)), ("falls, or misses the target", (214, 39, 40)))


def draw_sheets(
    lines: Sequence[Line], scenes: Mapping[str, Scene], checker: StabilityChecker, folder: Path, grid: Grid = PAPER_GRID
) -> list[str]:
    """A picture for each row, of its last block list; answers the lines of Markdown that show them.

    The samples shown are simulated once more, to the end, to say how far what fell did fall.

    Args:
        lines: Answers.
        scenes: By name.
        checker: Judges the samples shown.
        folder: Where the pictures go.
        grid: Of targets and stacks.

    Raises:
        StackgenError: If a picture cannot be written.
    """
    shown = []
    for line in {line.row.name: line for line in lines}.values():
        successes, failures = pick_examples(line.evaluation)
        columns = [[example for example in some if example.scene.stacks and example.scene.name in scenes]
                   for some in (successes, failures)]  # fmt: skip
        if not any(columns):
            continue
        picture = _sheet(*([_panel(example, scenes, checker, grid) for example in column] for column in columns))
        name = f"sheet-{line.row.slug}.png"
        _save(picture, folder / name)
        shown.append(
            f"**{line.row.name}**, {LIST_NAMES[line.block_list]} block lists; samples spread evenly over the scenes, "
            f"drawn as they were sampled, what then fell in red:\n\n![{line.row.name}]({name})"
        )
    return shown


def _panel(example: Example, scenes: Mapping[str, Scene], checker: StabilityChecker, grid: Grid) -> Picture:
    """Target and sample, with what became of it."""
    stack = example.scene.stacks[example.number]
    target = scenes[example.scene.name].silhouette
    return contact_sheet(target, [stack], [checker.check(stack)], [example.front_iou], grid=grid)


def _sheet(successes: Sequence[Picture], failures: Sequence[Picture]) -> Picture:
    """Successes at the left, failures at the right, under their headings."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = (successes or failures)[0].shape[:2]
    size = (2 * width + _GAP, _HEADING + max(len(successes), len(failures)) * height)
    sheet = Image.new("RGB", size, (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    for column, (pictures, (heading, colour)) in enumerate(zip((successes, failures), _HEADINGS, strict=True)):
        left = column * (width + _GAP)
        text = heading if pictures else f"{heading}: none"
        pen.text((left + 14, 14), text, fill=colour, font=ImageFont.load_default(28))
        for row, picture in enumerate(pictures):
            sheet.paste(Image.fromarray(picture), (left, _HEADING + row * height))
    small = (round(size[0] * _SHRINK), round(size[1] * _SHRINK))
    return np.asarray(sheet.resize(small, Image.Resampling.LANCZOS))


def _save(picture: Picture, path: Path) -> None:
    """Write a PNG of few colours: a third of the bytes."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(picture).quantize(128, dither=Image.Dither.NONE).save(data, "PNG", optimize=True)
    write_atomically(path, data.getvalue())
