"""A contact sheet for each method: what it got right, and beside it what it got wrong."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stackgen.evaluation.protocol import Scene
from stackgen.evaluation.report.results import Result
from stackgen.evaluation.results import Evaluation, SceneResult
from stackgen.io.files import write_atomically
from stackgen.protocols import StabilityChecker
from stackgen.viz.render import Picture, contact_sheet
from stackgen.world import Grid

_SHRINK = 0.6
_GAP = 24  # [pixel], before shrinking
_HEADING = 54  # [pixel]
_HEADINGS = (("stands and matches", (30, 130, 76)), ("falls, or misses the target", (214, 39, 40)))


EXAMPLES = 4
"""Successes on a sheet, and as many failures."""


class Example(NamedTuple):
    """A sample of a scene, and its number, from 0."""

    scene: SceneResult
    number: int


def pick_examples(evaluation: Evaluation, number: int = EXAMPLES) -> tuple[list[Example], list[Example]]:
    """Pick successes and failures of a method, neither the best nor the worst: spread evenly over the scenes.

    A success is valid: it stands and matches; everything else is a failure. At most one of each kind is
    taken from a scene.
    """
    found: tuple[list[Example], list[Example]] = ([], [])
    for scene in evaluation.scenes:
        valid = [sample.valid for sample in scene.score.samples]
        for kind, wanted in enumerate((True, False)):
            if wanted in valid:
                found[kind].append(Example(scene, valid.index(wanted)))
    return _spread(found[0], number), _spread(found[1], number)


def _spread(examples: Sequence[Example], number: int) -> list[Example]:
    """Take some examples, evenly spaced."""
    places = np.linspace(0, len(examples) - 1, min(number, len(examples))).round().astype(int)
    return [examples[place] for place in places]


def draw_sheets(
    results: Sequence[Result], scenes: Mapping[str, Scene], checker: StabilityChecker, folder: Path, *, grid: Grid
) -> list[str]:
    """Draw a picture for each row, of its last block list; answer the lines of Markdown that show them.

    The samples shown are simulated once more, to the end, to say how far what fell did fall.

    Args:
        results: Results of the rows.
        scenes: Scenes by name.
        checker: Says of the samples shown which blocks fall.
        folder: Where the pictures go.
        grid: Scale of the targets.

    Raises:
        StackgenError: If a picture cannot be written.
    """
    shown = []
    for result in {result.row.name: result for result in results}.values():
        columns = [[_panel(example, scenes, checker, grid) for example in some]
                   for some in pick_examples(result.evaluation)]  # fmt: skip
        if not any(columns):
            continue
        name = f"sheet-{result.row.slug}.png"
        _save(_sheet(*columns), folder / name)
        shown.append(
            f"**{result.row.name}**, {result.list_name} block lists; samples spread evenly over the "
            "scenes, drawn as they were sampled, with the blocks that then fell in red:"
            f"\n\n![{result.row.name}]({name})"
        )
    return shown


def _panel(example: Example, scenes: Mapping[str, Scene], checker: StabilityChecker, grid: Grid) -> Picture:
    """Draw target and sample, with what became of it."""
    scene, number = example
    stack, front_iou = scene.stacks[number], scene.score.samples[number].front_iou
    return contact_sheet(scenes[scene.name].silhouette, [stack], [checker.check(stack)], [front_iou], grid=grid)


def _sheet(successes: Sequence[Picture], failures: Sequence[Picture]) -> Picture:
    """Put successes at the left and failures at the right, under their headings."""
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
