"""The picture that a person watches while a model trains: what was asked for, what was generated, what became of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stackgen.evaluation.protocol import Scene
from stackgen.geometry import silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.render import FALLEN, Colour, Picture
from stackgen.world import Grid, Mask

_SCALE = 2  # of the pictures' pixels to the silhouettes'
_ACROSS = 4  # scenes beside each other
_GAP, _CAPTION, _HEADS, _LETTERS = 8, 36, 122, 22  # [pixel]
_GOOD: Colour = (30, 130, 76)
_INK: Colour = (40, 42, 48)
_LIGHT: Colour = (238, 240, 244)


def silhouette_sheet(
    scenes: Sequence[Scene], stacks: Sequence[Stack], verdicts: Sequence[Verdict | None], grid: Grid
) -> Picture:
    """Draw for each scene its target, the silhouettes of its stack as generated and settled, and the verdict.

    Dashboards show the picture a few hundred pixels wide: few scenes lie beside each other, the next ones below them.

    Args:
        scenes: What was asked for, one a column.
        stacks: A stack for each scene.
        verdicts: The verdict on each stack; None where there was no physics.
        grid: Grid of the silhouettes.
    """
    from PIL import Image, ImageDraw, ImageFont

    step = grid.image_size * _SCALE + _GAP
    band = 3 * step + _CAPTION
    across = min(len(scenes), _ACROSS)
    bands = -(-len(scenes) // _ACROSS)
    sheet = Image.new("RGB", (_HEADS + across * step, _GAP + bands * band), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(_LETTERS)
    for number in range(3 * bands):
        head, y = ("target", "generated", "settled")[number % 3], _GAP + number // 3 * band + number % 3 * step
        pen.text((_GAP, y + step // 2), head, fill=_INK, font=font, anchor="lm")
    for number, (scene, stack, verdict) in enumerate(zip(scenes, stacks, verdicts, strict=True)):
        x, y = _HEADS + number % _ACROSS * step, _GAP + number // _ACROSS * band
        tone = FALLEN if verdict is not None and not verdict.stable else _INK
        masks = [(scene.silhouette, _INK), (silhouette(stack, grid, "front"), _INK)]
        if verdict is not None:
            masks.append((silhouette(verdict.settled, grid, "front"), tone))
            text, colour = ("stands", _GOOD) if verdict.stable else (f"{int(verdict.fell.sum())} fell", FALLEN)
            pen.text((x, y + 3 * step + _CAPTION // 2 - _GAP), text, fill=colour, font=font, anchor="lm")
        for row, (mask, ink) in enumerate(masks):
            sheet.paste(Image.fromarray(_coloured(mask, ink)), (x, y + row * step))
    return np.asarray(sheet)


def _coloured(mask: Mask, colour: Colour) -> Picture:
    picture = np.where(np.asarray(mask, bool)[..., None], np.array(colour), np.array(_LIGHT)).astype(np.uint8)
    return picture.repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)
