"""How well pictures are read: rendered photos of sketches and distorted drawings of known structures.

Settled stacks of testset-v1 are drawn on paper and photographed in many ways (`examples/draw_photos.py`), or drawn on
the screen and distorted. What is read is compared with the stack's own silhouette, both scaled to the grid. A picture
is right where the IoU is at least 0.9, and wrong without a word where it is not and the reader neither refuses it nor
notes a doubt.
"""

from __future__ import annotations

import argparse
import io
import runpy
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from rich.progress import track

from benchmarks.build_order import drawn, estimate
from benchmarks.common import ROOT, argument_parser, plain_table, report, start
from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.vision.masks import bounding_box, closed, components, fitted
from stackgen.vision.reader import read_picture
from stackgen.viz.render import save_image
from stackgen.world import PAPER_GRID, Grid, Mask

Picture = NDArray[np.uint8]

RIGHT = 0.9
"""Least IoU of a silhouette that was read right."""

LARGE = Grid(image_size=480, pixels_per_cell=100, ground_margin=40)
"""Scale of what is drawn on the screen."""

DRAW = runpy.run_path(str(ROOT / "examples" / "draw_photos.py"))

DOUBTS = ("cut off", "base line", "gap", "left open", "uncertain")
"""What a note says where it tells of a doubt rather than of what was left out."""


OUTCOMES = ("right", "wrong", "doubted", "refused")


@dataclass(frozen=True)
class Answer:
    """What became of one picture: its IoU with the truth, None where it was refused, why or what was noted."""

    name: str
    overlap: float | None
    said: str
    seconds: float

    @property
    def outcome(self) -> str:
        """Right, wrong without a word, wrong with a doubt, or refused."""
        if self.overlap is None:
            return "refused"
        if self.overlap >= RIGHT:
            return "right"
        return "doubted" if any(doubt in self.said for doubt in DOUBTS) else "wrong"


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=500, help="number of photos, and of drawings")
    options.add_argument("--seed", type=int, default=0, help="seed of the structures and of how they are drawn")
    options.add_argument("--keep", type=Path, help="folder for pictures and overlays of what is not right")
    return options


def main() -> None:
    """Draw, read and compare."""
    options = parser().parse_args()
    if options.number < 1:
        raise StackgenError("--number must be at least 1")
    stacks = [stack for stack in drawn(500, options.seed) if _in_one_part(stack)][:100]
    metrics: dict[str, Any] = {"pictures": options.number, "structures": len(stacks), "seed": options.seed}
    for kind, draw in (("photos", photo_of), ("drawings", drawing_of)):
        rng = np.random.default_rng([options.seed, kind == "photos"])
        cases = ((stacks[i % len(stacks)], *draw(stacks[i % len(stacks)], rng)) for i in range(options.number))
        answers = list(_answers(track(cases, kind, total=options.number), kind, options.keep))
        metrics[kind] = summary(answers)
    report("reading", metrics, [table(metrics)], options.out)


def _in_one_part(stack: Stack) -> bool:
    """Tell whether a stack's silhouette is in one part, without holes or slits: drawn in blocks, these are not seen."""
    mask = silhouette(stack, LARGE)
    whole = closed(mask, 12)
    blank = whole & ~mask
    holes = int(components(~np.pad(whole, 1), connectivity=4)[0].max()) > 1
    return int(components(mask)[0].max()) == 1 and not holes and np.count_nonzero(blank) < 0.004 * mask.sum()


def photo_of(stack: Stack, rng: np.random.Generator) -> tuple[bytes, str]:
    """Photograph a sketch of a stack; return a JPEG and what makes it hard."""
    style = rng.choice(["blocks", "outline", "outline", "hatched", "filled"])
    inks = [(52, 52, 52), (40, 60, 160), (190, 40, 40), (30, 110, 60), (110, 110, 115), (225, 110, 30)]
    photo = DRAW["Photo"](
        filled=bool(style == "filled"),
        style="outline" if style == "filled" else str(style),
        ink=inks[rng.integers(len(inks))],
        width=int(rng.integers(4, 15)),
        crayon=float(rng.choice([0, 0, 0.15, 0.3])),
        paper=str(rng.choice(["plain", "plain", "ruled", "squared"])),
        tone=[(240, 240, 240), (240, 240, 240), (240, 240, 240), (242, 228, 130), (222, 215, 200)][rng.integers(5)],
        beside=bool(rng.random() < 0.25),
        shadow=float(rng.choice([0, 0.3, 0.5, 0.6])),
        softness=float(rng.uniform(2, 30)),
        table=[(120, 92, 66), (60, 62, 66), (150, 120, 95), (35, 50, 60), (165, 160, 150)][rng.integers(5)],
        zoom=float(rng.choice([1.0, 1.0, 0.8, 1.15, 1.15, 1.6])),
        slant=float(rng.uniform(0, 0.13)),
        turn=float(rng.uniform(-12, 12)),
        light=float(rng.uniform(0, 0.6)),
        wobble=float(rng.uniform(0.005, 0.03)),
        blur=float(rng.uniform(0.5, 1.8)),
        grain=float(rng.uniform(1, 7)),
        seed=int(rng.integers(2**31)),
    )
    sheet = DRAW["sheet_with"](stack, photo, cell=float(rng.uniform(80, 150)))
    picture = DRAW["photographed"](sheet, photo)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=int(rng.integers(40, 95)))
    hard = [
        style,
        photo.paper,
        f"zoom {photo.zoom}",
        f"shadow {photo.shadow}",
        f"table {photo.table[0]}",
        f"tone {photo.tone[2]}",
    ]
    return buffer.getvalue(), " ".join(hard + ["beside"] * photo.beside)


def drawing_of(stack: Stack, rng: np.random.Generator) -> tuple[bytes, str]:
    """Draw a stack on the screen and distort it; return a file of some format and what was done."""
    mask = silhouette(stack, LARGE)
    style = str(rng.choice(["filled", "outline"]))
    ink = _outlined(mask, int(rng.integers(3, 26))) if style == "outline" else mask
    did = [style]
    if rng.random() < 0.15:
        ink = ink.copy()
        bottom = bounding_box(mask)[0].stop
        ink[bottom - 2 : bottom + 4, 15:-15] = True
        did.append("ground")
    if rng.random() < 0.4:
        ink, crop = _cropped(ink, rng)
        did.append(crop)
    tones = [((0, 0, 0), (255, 255, 255)), ((170, 45, 40), (240, 232, 215)), ((40, 60, 120), (225, 230, 235)),
             ((90, 90, 90), (250, 250, 250))]  # fmt: skip
    inner, outer = tones[rng.integers(4)]
    if "crop" not in did[-1] and rng.random() < 0.25:
        inner, outer = outer, inner
        did.append("inverted")
    picture = Image.fromarray(np.where(ink[..., None], inner, outer).astype(np.uint8))
    if rng.random() < 0.25:
        edge = int(rng.integers(1, 5))
        picture = ImageOps.expand(picture, edge, tuple(int(v) for v in rng.integers(0, 256, 3)))
        did.append(f"border {edge}")
    scale = float(rng.uniform(0.35, 3))
    width, height = (max(64, round(n * scale)) for n in picture.size)
    picture = picture.resize((width, height), Image.Resampling.BICUBIC)
    if rng.random() < 0.4:
        grain = rng.normal(0, rng.uniform(1, 12), (*picture.size[::-1], 3))
        picture = Image.fromarray(np.clip(np.asarray(picture) + grain, 0, 255).astype(np.uint8))
        did.append("grain")
    data, form = _saved(picture, rng)
    return data, " ".join([*did, form])


def _outlined(mask: Mask, width: int) -> Mask:
    """Draw the outline of a mask with a pen."""
    canvas = np.zeros(mask.shape, np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, contours, -1, 1, width)
    return canvas > 0


def _cropped(ink: Mask, rng: np.random.Generator) -> tuple[Mask, str]:
    """Crop to the ink on some sides."""
    rows, columns = bounding_box(ink)
    sides = rng.random(4) < 0.6
    top, left = (rows.start if sides[0] else 0), (columns.start if sides[1] else 0)
    bottom, right = (rows.stop if sides[2] else ink.shape[0]), (columns.stop if sides[3] else ink.shape[1])
    return ink[top:bottom, left:right], f"crop {int(sides.sum())}"


def _saved(picture: Image.Image, rng: np.random.Generator) -> tuple[bytes, str]:
    """Save a picture in one of many forms."""
    form = str(rng.choice(["png", "jpg", "webp", "palette", "alpha", "16bit", "cmyk", "gif", "bmp"]))
    buffer = io.BytesIO()
    if form == "jpg":
        picture.save(buffer, "JPEG", quality=int(rng.integers(25, 95)))
    elif form == "webp":
        picture.save(buffer, "WEBP", quality=int(rng.integers(30, 95)))
    elif form == "palette":
        picture.convert("P").save(buffer, "PNG")
    elif form == "alpha":
        rim = np.full(picture.size[::-1], 255, np.uint8)
        rim[[0, -1]] = rim[:, [0, -1]] = 0
        picture.putalpha(Image.fromarray(rim))
        picture.save(buffer, "PNG")
    elif form == "16bit":
        Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257).save(buffer, "PNG")
    elif form == "cmyk":
        picture.convert("CMYK").save(buffer, "TIFF")
    else:
        picture.save(buffer, form.upper())
    return buffer.getvalue(), form


def _answers(cases: Any, kind: str, keep: Path | None) -> Iterator[Answer]:
    """Read pictures one after the other."""
    for number, (stack, data, name) in enumerate(cases):
        own = fitted(silhouette(stack, LARGE, margin=LARGE.image_size // 4), PAPER_GRID)
        with Image.open(io.BytesIO(data)) as image:
            image.load()
        begin = time.process_time()
        overlay = None
        try:
            reading = read_picture(image, PAPER_GRID)
            overlap, said, overlay = (
                iou(fitted(reading.figure, PAPER_GRID), own),
                " ".join(reading.notes),
                reading.overlay,
            )
            if kind != ("photos" if reading.kind == "photo" else "drawings"):
                name += f" as {reading.kind}"
        except StackgenError as error:
            overlap, said = None, str(error)
        answer = Answer(name, overlap, said, time.process_time() - begin)
        if keep is not None and answer.outcome != "right":
            keep.mkdir(parents=True, exist_ok=True)
            shown = np.asarray(image.convert("RGB")) if overlay is None else overlay
            save_image(keep / f"{kind}-{number}-{answer.outcome}.png", shown)
            print(kind, number, answer.outcome, overlap, name, said)
        yield answer


def summary(answers: Sequence[Answer]) -> dict[str, Any]:
    """Shares of the outcomes with 95 % intervals, reasons of refusals, and times."""
    seconds = [answer.seconds for answer in answers]
    reasons = Counter(answer.said.partition(": ")[2].partition(";")[0] for answer in answers if answer.overlap is None)
    return {
        **{outcome: estimate([answer.outcome == outcome for answer in answers]) for outcome in OUTCOMES},
        "refusals": dict(reasons.most_common()),
        "seconds_median": float(np.median(seconds)),
        "seconds_95": float(np.quantile(seconds, 0.95)),
    }


def table(metrics: dict[str, Any]) -> Any:
    """The shares as a table."""
    headings = ("pictures", "right [%]", "wrong without a word [%]", "wrong, doubted [%]", "refused [%]", "seconds")
    rows = []
    for kind in ("photos", "drawings"):
        of = metrics[kind]
        shares = [
            f"{100 * share['value']:.1f} ({100 * share['low']:.1f} to {100 * share['high']:.1f})"
            for share in (of[outcome] for outcome in OUTCOMES)
        ]
        rows.append((kind, *shares, f"{of['seconds_median']:.2f}"))
    return plain_table("pictures read, from files of known structures", headings, rows)


if __name__ == "__main__":
    start(main)
