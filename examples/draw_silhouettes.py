"""Draws the pictures of examples/silhouettes: `python examples/draw_silhouettes.py [FOLDER]`.

Each was designed by hand, corner by corner in its own pixels, as a person would draw it: with a brush on paper, as a
flat icon, as a photo in uneven light. None comes from the generator.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

Point = tuple[float, float]
Colour = tuple[int, int, int]
WHITE, BLACK = (255, 255, 255), (0, 0, 0)


@dataclass(frozen=True)
class Drawing:
    """Filled outlines on a background.

    Args:
        file: Name; the suffix decides the format.
        size: (width, height) [pixel].
        outlines: Corners (x, y) [pixel] from the upper left, with the colour to fill them with;
            later ones cover earlier ones.
        paper: Background colour; None is transparent.
        wobble: How far a hand strays from straight lines [pixel].
        blur: Softness of the edges [pixel].
        light: How much darker the right side is lit, as in a photo [0..1].
        grain: Noise of a camera or of paper [0..255].
    """

    file: str
    size: tuple[int, int]
    outlines: tuple[tuple[Colour, tuple[Point, ...]], ...]
    paper: Colour | None = WHITE
    wobble: float = 0.0
    blur: float = 0.0
    light: float = 0.0
    grain: float = 0.0


def box(left: float, top: float, right: float, bottom: float) -> tuple[Point, ...]:
    """The corners of a rectangle [pixel]."""
    return (left, top), (right, top), (right, bottom), (left, bottom)


INK, NAVY, BRICK, ROOF, SAND, MOSS = (
    (38, 36, 40),
    (24, 44, 92),
    (178, 74, 52),
    (120, 34, 40),
    (222, 190, 128),
    (62, 96, 60),
)

DRAWINGS = (
    Drawing(
        "arch.png",
        (300, 400),
        ((BLACK, ((45, 360), (45, 80), (255, 80), (255, 360), (185, 360), (185, 150), (115, 150), (115, 360))),),
    ),
    Drawing(  # a bridge between two towers, white chalk on a board, photographed
        "bridge.jpg",
        (1200, 900),
        (
            ((232, 230, 222), box(280, 200, 440, 840)),
            ((232, 230, 222), box(760, 200, 920, 840)),
            ((232, 230, 222), box(280, 360, 920, 520)),
        ),
        paper=(44, 62, 54),
        wobble=3,
        blur=1.6,
        light=0.25,
        grain=7,
    ),
    Drawing(  # a town house with a stepped gable: brick walls, a darker roof, a door one can see through
        "house.png",
        (640, 640),
        (
            (BRICK, box(140, 340, 500, 580)),
            (BRICK, box(200, 220, 440, 340)),
            (ROOF, ((260, 220), (320, 100), (380, 220))),
            ((196, 222, 240), box(260, 460, 380, 580)),
        ),
        paper=(196, 222, 240),
    ),
    Drawing(
        "stairs.jpg",
        (800, 800),
        (
            (
                INK,
                (
                    (80, 720),
                    (80, 560),
                    (240, 560),
                    (240, 400),
                    (400, 400),
                    (400, 240),
                    (560, 240),
                    (560, 80),
                    (720, 80),
                    (720, 720),
                ),
            ),
        ),
        paper=(238, 232, 216),
        wobble=2.5,
        blur=1.0,
        grain=5,
    ),
    Drawing(  # a pointed tower on a plinth, white on black and small
        "tower.png",
        (96, 128),
        ((WHITE, ((12, 116), (12, 92), (36, 92), (36, 44), (48, 20), (60, 44), (60, 92), (84, 92), (84, 116))),),
        paper=BLACK,
    ),
    Drawing("t.png", (256, 256), ((NAVY, box(48, 32, 192, 80)), (NAVY, box(96, 80, 144, 224))), paper=(250, 214, 90)),
    Drawing(  # a gate with two pointed turrets, a transparent sticker
        "gate.png",
        (500, 500),
        (
            (MOSS, ((100, 450), (100, 150), (150, 50), (200, 150), (200, 450))),
            (MOSS, ((300, 450), (300, 150), (350, 50), (400, 150), (400, 450))),
            (MOSS, box(100, 150, 400, 250)),
        ),
        paper=None,
    ),
    Drawing(  # a castle, sandstone against a dusky sky
        "castle.jpg",
        (1024, 768),
        (
            (SAND, box(232, 424, 792, 704)),
            (SAND, box(232, 284, 372, 424)),
            (SAND, box(652, 284, 792, 424)),
            (BRICK, ((232, 284), (302, 144), (372, 284))),
            (BRICK, ((652, 284), (722, 144), (792, 284))),
        ),
        paper=(52, 48, 88),
        blur=0.8,
        grain=3,
    ),
    Drawing(  # a step pyramid in felt-tip on paper, half in the shade
        "pyramid.jpg",
        (1600, 1200),
        (
            (
                (206, 92, 30),
                (
                    (320, 1080),
                    (320, 840),
                    (440, 840),
                    (440, 600),
                    (560, 600),
                    (560, 360),
                    (680, 360),
                    (680, 120),
                    (920, 120),
                    (920, 360),
                    (1040, 360),
                    (1040, 600),
                    (1160, 600),
                    (1160, 840),
                    (1280, 840),
                    (1280, 1080),
                ),
            ),
        ),
        paper=(236, 238, 240),
        wobble=5,
        blur=2.0,
        light=0.2,
        grain=6,
    ),
    Drawing(
        "chair.png",
        (60, 72),
        (
            (
                (90, 90, 90),
                ((9, 64), (9, 8), (23, 8), (23, 36), (51, 36), (51, 64), (37, 64), (37, 50), (23, 50), (23, 64)),
            ),
        ),
    ),
    Drawing(  # a church: steeple and nave, its lower edge is the picture's
        "church.png",
        (420, 360),
        ((NAVY, ((50, 360), (50, 120), (90, 40), (130, 120), (130, 200), (370, 200), (370, 360))),),
        paper=(240, 240, 236),
        wobble=1,
    ),
    Drawing(  # a terrace of three gabled houses, a dark-mode icon
        "terrace.png",
        (512, 512),
        (
            (
                (120, 200, 255),
                (
                    (100, 466),
                    (100, 154),
                    (152, 50),
                    (204, 154),
                    (256, 50),
                    (308, 154),
                    (360, 50),
                    (412, 154),
                    (412, 466),
                ),
            ),
        ),
        paper=(22, 22, 28),
    ),
)


def draw(drawing: Drawing) -> Image.Image:
    """The picture, anti-aliased by drawing it four times as large."""
    zoom = 4 if max(drawing.size) <= 800 else 2
    paper = (*(drawing.paper or BLACK), 255 if drawing.paper else 0)
    image = Image.new("RGBA", (drawing.size[0] * zoom, drawing.size[1] * zoom), paper)
    pen = ImageDraw.Draw(image)
    for number, (colour, corners) in enumerate(drawing.outlines):
        path = by_hand(corners, drawing.wobble, seed=number)
        pen.polygon([(x * zoom - 0.5, y * zoom - 0.5) for x, y in path], fill=(*colour, 255))
    image = image.resize(drawing.size, Image.Resampling.BOX)
    image = image if drawing.paper is None else image.convert("RGB")
    if drawing.blur:
        image = image.filter(ImageFilter.GaussianBlur(drawing.blur))
    return photographed(image, drawing) if drawing.light or drawing.grain else image


def by_hand(corners: tuple[Point, ...], wobble: float, seed: int) -> list[Point]:
    """The outline with each straight line bent a little, as a hand does."""
    if not wobble:
        return list(corners)
    rng = np.random.default_rng(seed)
    path = []
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b = np.array(start, float), np.array(end, float)
        across = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
        bend, waves = rng.uniform(-1, 1, 2) * wobble
        for t in np.linspace(0, 1, 24, endpoint=False):
            stray = bend * np.sin(np.pi * t) + 0.6 * waves * np.sin(3 * np.pi * t)
            path.append(tuple(a + (b - a) * t + across * stray))
    return path


def photographed(image: Image.Image, drawing: Drawing) -> Image.Image:
    """Uneven light and grain."""
    pixels = np.asarray(image, dtype=np.float64)
    pixels = pixels * np.linspace(1, 1 - drawing.light, pixels.shape[1])[None, :, None]
    grain = np.random.default_rng(0).normal(0, drawing.grain, (*pixels.shape[:2], 1))
    return Image.fromarray(np.clip(pixels + grain, 0, 255).astype(np.uint8))


def save(drawing: Drawing, folder: Path) -> None:
    """Write one picture: the tower as a palette, the arch grey, the pyramid on its side with an EXIF note."""
    image = draw(drawing)
    options: dict = {"quality": 82} if drawing.file.endswith(".jpg") else {"optimize": True}
    if drawing.file == "arch.png":
        image = image.convert("L")
    elif drawing.file == "tower.png":
        image = image.convert("P")
    elif drawing.file == "pyramid.jpg":  # as phones store what they took upright
        exif = Image.Exif()
        exif[0x0112] = 6
        image, options = image.transpose(Image.Transpose.ROTATE_90), {"quality": 70, "exif": exif}
    image.save(folder / drawing.file, **options)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "silhouettes"
    target.mkdir(parents=True, exist_ok=True)
    for item in DRAWINGS:
        save(item, target)
