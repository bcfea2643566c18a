"""A picture's structure is the same whatever the picture's size, colours, polarity, format and noise."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from stackgen.errors import StackgenError
from stackgen.geometry import iou, mirror, silhouette
from stackgen.stack import Stack
from stackgen.vision import reader
from stackgen.vision.drawings import grid_offset
from stackgen.world import PAPER_GRID, Grid, Mask
from tests.vision.conftest import ROOT

read_silhouette = partial(reader.read_silhouette, grid=PAPER_GRID)
LARGE = Grid(image_size=480, pixels_per_cell=100, ground_margin=40)

# Centred, four cells high or wide, on the ground: reading them changes nothing.
STACKS: dict[str, tuple[list[int], list[float], list[float]]] = {
    "gate": ([0, 0, 0, 0, 2, 3, 3], [-1, 1, -1, 1, 0, -1, 1], [0.5, 0.5, 1.5, 1.5, 2.5, 3.5, 3.5]),
    "stairs": ([1, 1, 2, 1, 0], [-1, 1, 0.5, 1, 1.5], [0.5, 0.5, 1.5, 2.5, 3.5]),
    "table": ([0, 0, 1, 1], [-1.5, 1.5, -1, 1], [0.5, 0.5, 1.5, 1.5]),
    "apart": ([0, 0, 0, 0, 0, 0, 0, 3], [-1.5, -1.5, -1.5, -1.5, 1.5, 1.5, 1.5, 1.5], [0.5, 1.5, 2.5, 3.5] * 2),
}


def stack_of(name: str) -> Stack:
    shapes, x, z = STACKS[name]
    poses = np.zeros((len(shapes), 6))
    poses[:, 0], poses[:, 2] = x, z
    return Stack(np.array(shapes), poses)


def painted(
    mask: Mask, ink: tuple[int, int, int] = (0, 0, 0), paper: tuple[int, int, int] = (255, 255, 255)
) -> Image.Image:
    return Image.fromarray(np.where(mask[..., None], ink, paper).astype(np.uint8))


def saved(image: Image.Image, path: Path, **options: object) -> Path:
    image.save(path, **options)  # type: ignore[arg-type]
    return path


@pytest.fixture(params=STACKS)
def stack(request: pytest.FixtureRequest) -> Stack:
    return stack_of(request.param)


@pytest.mark.parametrize("blur", [0, 2, 4])
@pytest.mark.parametrize("size", [32, 64, 150, 480, 1300])
def test_drawings_of_any_size_and_softness_come_back_as_the_truth(stack: Stack, size: int, blur: int) -> None:
    drawing = painted(silhouette(stack, LARGE)).filter(ImageFilter.GaussianBlur(blur))
    read = read_silhouette(np.asarray(drawing.resize((size, size), Image.Resampling.BOX)))
    # At 7 pixels a cell the tip of a blurred triangle is lost, and the rest is scaled up to make up for it.
    assert iou(read, silhouette(stack, PAPER_GRID)) >= (0.95 if size > 40 else 0.9)


COLOURS = [
    ((0, 0, 0), (255, 255, 255)),
    ((255, 255, 255), (0, 0, 0)),
    ((250, 240, 160), (255, 255, 255)),
    ((200, 40, 40), (40, 140, 40)),
    ((60, 120, 60), (120, 90, 60)),
    ((180, 180, 180), (140, 140, 140)),
]


@pytest.mark.parametrize(("ink", "paper"), COLOURS)
def test_colours_and_polarity_do_not_matter(
    stack: Stack, ink: tuple[int, int, int], paper: tuple[int, int, int]
) -> None:
    mask = silhouette(stack, LARGE)
    assert (read_silhouette(np.asarray(painted(mask, ink, paper))) == read_silhouette(mask)).all()


@pytest.mark.parametrize("quality", [15, 50, 95])
def test_jpeg_noise_does_not_matter(stack: Stack, quality: int, tmp_path: Path) -> None:
    path = saved(painted(silhouette(stack, LARGE), (180, 40, 30), (90, 130, 200)), tmp_path / "a.jpg", quality=quality)
    assert iou(read_silhouette(path), silhouette(stack, PAPER_GRID)) >= 0.97


def as_mode(mode: str) -> Callable[[Image.Image], Image.Image]:
    return lambda image: image.convert(mode)


def as_16_bit(image: Image.Image) -> Image.Image:
    return Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 120 + 700)


def as_alpha(image: Image.Image) -> Image.Image:
    alpha = np.asarray(image.convert("L")) == 0
    return Image.fromarray(np.dstack([np.full((*alpha.shape, 3), 255), alpha * 255]).astype(np.uint8))


def as_stencil(image: Image.Image) -> Image.Image:
    pixels = np.array(as_alpha(image))
    pixels[..., 3] = 255 - pixels[..., 3]
    return Image.fromarray(pixels)


FORMS = {m: as_mode(m) for m in ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK")}
FORMS |= {"16 bit": as_16_bit, "alpha": as_alpha, "stencil": as_stencil}


@pytest.mark.parametrize("form", FORMS)
def test_the_kind_of_image_does_not_matter(stack: Stack, form: str, tmp_path: Path) -> None:
    mask = silhouette(stack, LARGE)
    image = FORMS[form](painted(mask))
    path = saved(image, tmp_path / ("a.tif" if image.mode == "CMYK" else "a.png"))
    assert (read_silhouette(path) == read_silhouette(mask)).all()


@pytest.mark.parametrize("form", ["1", "P", "alpha"])
def test_the_kind_of_a_large_image_does_not_matter_either(form: str, tmp_path: Path) -> None:
    mask = np.kron(silhouette(stack_of("gate"), LARGE), np.ones((4, 4), dtype=bool))
    image = painted(mask, (10, 60, 200), (250, 220, 90)) if form == "P" else painted(mask)
    path = saved(FORMS[form](image), tmp_path / "a.png")
    assert iou(read_silhouette(path), read_silhouette(mask)) > 0.99


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int32", "float32"])
def test_the_kind_of_array_does_not_matter(stack: Stack, dtype: str) -> None:
    mask = silhouette(stack, LARGE)
    assert (
        read_silhouette(mask.astype(dtype) * 200 if dtype != "float32" else mask.astype(dtype)) == read_silhouette(mask)
    ).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_turned_as_its_exif_says(orientation: int, tmp_path: Path) -> None:
    T = Image.Transpose
    undo = [
        None,
        T.FLIP_LEFT_RIGHT,
        T.ROTATE_180,
        T.FLIP_TOP_BOTTOM,
        T.TRANSPOSE,
        T.ROTATE_90,
        T.TRANSVERSE,
        T.ROTATE_270,
    ]
    mask = silhouette(stack_of("stairs"), LARGE)
    image, turn = painted(mask), undo[orientation - 1]
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = saved(image if turn is None else image.transpose(turn), tmp_path / "a.png", exif=exif)
    assert (read_silhouette(path) == read_silhouette(mask)).all()


@pytest.mark.parametrize(("left", "top", "right", "bottom"), [(0, 0, 300, 0), (90, 200, 10, 0), (500, 7, 7, 300)])
def test_where_the_structure_is_does_not_matter(stack: Stack, left: int, top: int, right: int, bottom: int) -> None:
    mask = silhouette(stack, LARGE)
    moved = np.pad(mask, ((top, bottom), (left, right)))
    picture = np.asarray(painted(moved, (20, 30, 60), (240, 230, 200)))
    assert iou(read_silhouette(picture), read_silhouette(mask)) >= 0.97


def test_a_structure_may_stand_on_the_pictures_lower_edge(stack: Stack) -> None:
    mask = silhouette(stack, Grid(image_size=480, pixels_per_cell=100, ground_margin=0))
    assert (read_silhouette(np.asarray(painted(mask))) == silhouette(stack, PAPER_GRID)).mean() > 0.998


def test_mirrored_pictures_give_mirrored_silhouettes(stack: Stack) -> None:
    soft = painted(silhouette(stack, LARGE)).filter(ImageFilter.GaussianBlur(2))
    picture = np.asarray(soft.resize((233, 233)))
    assert (read_silhouette(picture[:, ::-1]) == read_silhouette(picture)[:, ::-1]).mean() > 0.998
    assert (
        read_silhouette(silhouette(mirror(stack), LARGE)) == read_silhouette(silhouette(stack, LARGE))[:, ::-1]
    ).all()


def test_specks_and_pinholes_are_dirt_but_small_blocks_are_not() -> None:
    mask = silhouette(stack_of("gate"), LARGE)
    dirty = mask.copy()
    dirty[3:9, 3:9] = True  # in the corner
    dirty[20:23, 400] = True
    dirty[150:154, 150:154] = False
    assert (read_silhouette(dirty) == read_silhouette(mask)).all()
    rng = np.random.default_rng(0)
    noisy = np.where(rng.random(mask.shape) < 0.02, ~mask, mask)  # salt and pepper
    assert iou(read_silhouette(np.asarray(painted(noisy))), read_silhouette(mask)) > 0.95
    wide = np.zeros((400, 400), dtype=bool)
    wide[200:300, 20:320] = True
    wide[280:300, 350:370] = True  # 1.3 % of the area, apart
    assert read_silhouette(wide)[:, 55:].any()


def test_pale_parts_belong_to_the_structure_and_uneven_light_does_not() -> None:
    stack = stack_of("gate")
    mask = silhouette(stack, LARGE)
    two_tone = np.array(painted(mask, (40, 20, 20)))
    two_tone[: 4 * 35 + 60][mask[: 4 * 35 + 60]] = (250, 220, 150)  # pale turrets
    assert (read_silhouette(two_tone) == read_silhouette(mask)).all()
    shade = np.linspace(1, 0.7, mask.shape[1])[None, :, None]
    lit = np.random.default_rng(0).normal(np.asarray(painted(mask, (60, 60, 70), (235, 230, 220))) * shade, 5)
    assert iou(read_silhouette(np.clip(lit, 0, 255).astype(np.uint8)), silhouette(stack, PAPER_GRID)) > 0.97


def test_it_fills_the_height_and_where_too_wide_the_width() -> None:
    for height, width in [(400, 100), (300, 300), (100, 400), (120, 200)]:
        drawn = np.zeros((500, 600), dtype=bool)
        drawn[50 : 50 + height, 70 : 70 + width] = True
        read = read_silhouette(drawn)
        rows, columns = np.flatnonzero(read.any(1)), np.flatnonzero(read.any(0))
        scale = 56 / max(height, width)
        assert (len(rows), len(columns)) == pytest.approx((height * scale, width * scale), abs=0.51)
        assert rows[-1] == 59
        assert columns[0] + columns[-1] == 63


def test_a_silhouette_of_the_grid_is_taken_as_it_is_wherever_it_stands() -> None:
    shapes, x, z = STACKS["gate"]
    poses = np.zeros((len(shapes), 6))
    poses[:, 0], poses[:, 2], poses[:, 5] = np.array(x) + 0.3, z, 0.02
    mask = silhouette(Stack(np.array(shapes), poses), PAPER_GRID)
    for picture in (mask, mask.astype(np.uint8), np.asarray(painted(mask)), 255 - 255 * mask.astype(np.uint8)):
        assert (read_silhouette(picture) == mask).all()
    floating = np.roll(mask, -2, axis=0)
    assert read_silhouette(floating)[59].any()


def test_another_grid_gives_its_own_size() -> None:
    assert (
        read_silhouette(silhouette(stack_of("stairs"), PAPER_GRID), grid=LARGE) == silhouette(stack_of("stairs"), LARGE)
    ).mean() > 0.98


@pytest.mark.parametrize("margin", [6, 10, 40])
def test_a_wall_is_no_border_however_little_paper_is_left_around_it(margin: int) -> None:
    wall = np.pad(np.full((420, 420), 30, np.uint8), margin, constant_values=245)
    assert read_silhouette(wall).sum() == pytest.approx(56**2, abs=60)
    if margin < 40:  # a frame around an empty sheet
        with pytest.raises(StackgenError, match="one colour"):
            read_silhouette(255 - wall)


def truncated(path: Path) -> None:
    buffer = io.BytesIO()
    painted(silhouette(stack_of("gate"), LARGE)).save(buffer, "PNG" if path.suffix == ".png" else "JPEG")
    path.write_bytes(buffer.getvalue()[: len(buffer.getvalue()) // 2])


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "missing": ("a.png", lambda p: None, "no such file"),
    "folder": ("a", Path.mkdir, "folder"),
    "empty": ("a.png", Path.touch, "empty"),
    "text": ("a.png", lambda p: p.write_text("hello"), "not an image"),
    "truncated png": ("a.png", truncated, "cut short"),
    "truncated jpeg": ("a.jpg", truncated, "cut short"),
    "one colour": ("a.png", lambda p: Image.new("RGB", (90, 90), (9, 200, 30)).save(p), "all one colour"),
    "nearly one colour": (
        "a.png",
        lambda p: Image.fromarray(np.random.default_rng(0).integers(200, 215, (90, 90), dtype=np.uint8)).save(p),
        "nothing is drawn",
    ),
    "small": ("a.png", lambda p: Image.new("L", (7, 90)).save(p), "only 7 x 90 pixels"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_gets_one_line_that_names_it_and_the_trouble(case: str, tmp_path: Path) -> None:
    name, make, trouble = BAD[case]
    path = tmp_path / name
    make(path)
    with pytest.raises(StackgenError, match=trouble) as caught:
        read_silhouette(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def bad_arrays() -> list[tuple[NDArray, str]]:
    dot = np.zeros((200, 200), dtype=bool)
    dot[100:105, 100:106] = True
    return [
        (np.zeros((64, 64), bool), "nothing is set"),
        (np.ones((64, 64), bool), "everything is set"),
        (np.full((64, 64), np.nan), "not finite"),
        (np.zeros((64, 64, 7), np.uint8), "must be"),
        (np.zeros((0, 64)), "must be"),
        (np.zeros((4, 4), bool), "only 4 x 4"),
        (dot, "only 6 x 5"),
    ]


@pytest.mark.parametrize(("array", "trouble"), bad_arrays())
def test_a_bad_array_gets_one_line(array: NDArray, trouble: str) -> None:
    with pytest.raises(StackgenError, match=trouble) as caught:
        read_silhouette(array)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shift", [-6, -3, 0, 2, 5])
@pytest.mark.parametrize("name", STACKS)
def test_grid_offset_undoes_a_shift(name: str, shift: int) -> None:
    stack = stack_of(name)
    widest = np.ptp(np.flatnonzero(silhouette(stack, PAPER_GRID).any(axis=0))) + 1
    if widest + 2 * abs(shift) > 64:
        pytest.skip("does not fit on the canvas")
    moved = np.roll(silhouette(stack, PAPER_GRID), shift, axis=1)
    there = np.flatnonzero(silhouette(stack, PAPER_GRID).any(axis=0))[0]
    phase = (there + shift + grid_offset(moved, PAPER_GRID) - 32) % 14
    assert min(phase, 14 - phase) <= 1


@pytest.mark.parametrize("name", STACKS)
def test_grid_offset_of_the_mirror_image_is_as_large(name: str) -> None:
    mask = silhouette(stack_of(name), PAPER_GRID)
    assert abs(grid_offset(mask[:, ::-1], PAPER_GRID)) == abs(grid_offset(mask, PAPER_GRID))


def test_a_picture_with_a_palette_is_read_as_without(tmp_path: Path) -> None:
    for name in ("tower", "house"):
        drawn = Image.open(ROOT / "examples" / "silhouettes" / f"{name}.png").convert("RGB")
        drawn.quantize(5, dither=Image.Dither.NONE).save(tmp_path / "palette.png")
        figures = [reader.read_picture(source, PAPER_GRID).figure for source in (drawn, tmp_path / "palette.png")]
        assert np.abs(np.subtract(figures[0].shape, figures[1].shape)).max() <= 2
        assert abs(int(figures[0].sum()) - int(figures[1].sum())) < 0.005 * figures[0].sum()
