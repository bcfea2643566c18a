"""Photos of sketches and drawings are told apart and read, or refused with the true reason."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.vision.masks import fitted, place
from stackgen.vision.reader import Reading, read_picture
from stackgen.world import PAPER_GRID, Grid
from tests.vision.conftest import ARCH, CASTLE, DRAWN, HOUSE, PHOTOS, STACKS, truth

LARGE = Grid(image_size=480, pixels_per_cell=100, ground_margin=40)
Photo, sheet_with, photographed = (DRAWN[name] for name in ("Photo", "sheet_with", "photographed"))


def overlap(reading: Reading, stack: Stack) -> float:
    return iou(fitted(reading.figure, PAPER_GRID), truth(stack))


def photo_of(stack: Stack, **options: Any) -> np.ndarray:
    photo = Photo(**options)
    return photographed(sheet_with(stack, photo, cell=110), photo)


PAPERS: dict[str, dict[str, Any]] = {
    "flat": {"filled": True, "slant": 0, "turn": 0, "light": 0},
    "outline": {"style": "outline", "slant": 0.12, "turn": -8, "light": 0.5, "seed": 5},
    "shadow": {"shadow": 0.55, "softness": 6, "seed": 3},
    "grey table": {"table": (60, 62, 66), "shadow": 0.4, "turn": -5},
    "ruled": {"paper": "ruled", "ink": (40, 60, 160), "style": "outline"},
    "squared": {"paper": "squared", "shadow": 0.3},
    "pencil": {"ink": (130, 130, 135), "width": 4, "style": "outline"},
    "crayon": {"ink": (225, 110, 30), "crayon": 0.2, "width": 12, "style": "outline"},
    "hatched": {"style": "hatched", "ink": (190, 40, 40), "shadow": 0.4},
    "filled, half in a shadow": {"filled": True, "tone": (222, 215, 200), "shadow": 0.5, "softness": 3},
    "hatched, half in a shadow": {"style": "hatched", "ink": (110, 110, 115), "paper": "squared", "shadow": 0.6},
    "light table": {"style": "outline", "table": (165, 160, 150), "zoom": 0.8, "shadow": 0.5, "paper": "ruled"},
    "beside": {"style": "outline", "beside": True},
    "runs off": {"zoom": 1.15, "style": "outline"},
}


@pytest.mark.parametrize("stack", [ARCH, HOUSE], ids=["arch", "house"])
@pytest.mark.parametrize("paper", PAPERS)
def test_the_sketch_in_a_photo_is_read(stack: Stack, paper: str) -> None:
    reading = read_picture(photo_of(stack, **PAPERS[paper]), PAPER_GRID)
    assert reading.kind == "photo" and overlap(reading, stack) >= 0.88


def test_coloured_paper_half_in_a_shadow_is_a_photo_where_no_table_is_seen() -> None:
    paper = {"tone": (242, 228, 130), "zoom": 1.6, "slant": 0.02, "turn": 2, "light": 0.1, "shadow": 0.5, "softness": 3}
    reading = read_picture(photo_of(HOUSE, style="outline", width=12, seed=12, **paper), PAPER_GRID)
    assert reading.kind == "photo" and overlap(reading, HOUSE) >= 0.88


@pytest.mark.parametrize("name", STACKS)
def test_the_examples_show_their_stacks(name: str) -> None:
    reading = read_picture(PHOTOS / f"sketch-{name.lower()}.jpg", PAPER_GRID)
    assert reading.kind == "photo" and overlap(reading, STACKS[name]) >= 0.92
    assert reading.overlay.shape[2] == 3 and reading.overlay.dtype == np.uint8


def test_what_is_left_out_is_told() -> None:
    reading = read_picture(photo_of(ARCH, style="outline", beside=True), PAPER_GRID)
    assert any("ground line" in note for note in reading.notes)
    assert any("left out" in note for note in reading.notes)


def test_a_sketch_half_in_a_shadow_that_fills_the_photo_is_no_drawing_of_two_tones() -> None:
    half = {"style": "outline", "zoom": 1.8, "slant": 0.05, "light": 0, "shadow": 0.6, "softness": 3, "grain": 1}
    photo = Image.fromarray(photo_of(ARCH, **half, ink=(110, 110, 115), tone=(222, 215, 200), table=(165, 160, 150)))
    buffer = io.BytesIO()
    photo.save(buffer, "JPEG", quality=40)
    reading = read_picture(Image.open(buffer), PAPER_GRID)
    assert reading.kind == "photo" and overlap(reading, ARCH) >= 0.9


def test_a_picture_may_be_insisted_to_be_a_photo_or_a_drawing() -> None:
    sheet = sheet_with(ARCH, Photo(style="outline"), cell=110)
    for kind in ("photo", "drawing"):
        reading = read_picture(sheet, PAPER_GRID, as_=kind)
        assert reading.kind == kind and overlap(reading, ARCH) >= 0.9


def test_an_empty_sheet_is_empty_and_never_the_structure() -> None:
    photo = photographed(np.full((840, 1188, 3), 240, dtype=np.uint8), Photo(light=0.6))
    with pytest.raises(StackgenError, match="nothing is drawn"):
        read_picture(photo, PAPER_GRID)


def test_a_drawing_that_runs_off_the_photo_is_refused() -> None:
    sheet = sheet_with(CASTLE, Photo(filled=True), cell=110)
    with pytest.raises(StackgenError, match="runs off the sheet"):
        read_picture(sheet[:, :590], PAPER_GRID, as_="photo")


@pytest.mark.parametrize("sides", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1), (1, 1, 1, 1), (0, 1, 1, 1)])
@pytest.mark.parametrize("stack", [ARCH, CASTLE], ids=["arch", "castle"])
def test_tight_crops_are_read(stack: Stack, sides: tuple[int, int, int, int]) -> None:
    mask = silhouette(stack, LARGE)
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    top, bottom = (rows[0] if sides[0] else 0), (rows[-1] + 1 if sides[1] else 480)
    left, right = (columns[0] if sides[2] else 0), (columns[-1] + 1 if sides[3] else 480)
    picture = np.where(mask, 0, 255).astype(np.uint8)[top:bottom, left:right]
    assert overlap(read_picture(picture, PAPER_GRID), stack) >= 0.97


@pytest.mark.parametrize("border", [1, 2, 5])
@pytest.mark.parametrize("sides", ["all", "one"])
def test_a_border_is_no_structure(border: int, sides: str) -> None:
    picture = Image.fromarray(np.where(silhouette(ARCH, LARGE), 0, 255).astype(np.uint8))
    bordered = ImageOps.expand(picture, border if sides == "all" else (border, 0, 0, 0), 90)
    assert overlap(read_picture(bordered, PAPER_GRID), ARCH) >= 0.97


def test_a_transparent_rim_is_no_structure() -> None:
    pixels = np.full((480, 480, 4), 255, dtype=np.uint8)
    pixels[silhouette(ARCH, LARGE), :3] = 30
    pixels[[0, -1], :, 3] = pixels[:, [0, -1], 3] = 0
    assert overlap(read_picture(Image.fromarray(pixels), PAPER_GRID), ARCH) >= 0.97


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGBA", "CMYK", "I;16"])
def test_pil_images_of_any_mode_are_read(mode: str) -> None:
    grey = np.where(silhouette(ARCH, LARGE), 0, 255)
    image = Image.fromarray((grey * 257).astype(np.uint16)) if mode == "I;16" else Image.fromarray(
        grey.astype(np.uint8)
    ).convert(mode)  # fmt: skip
    assert overlap(read_picture(image, PAPER_GRID), ARCH) >= 0.97


def test_an_outline_on_nothing_is_filled() -> None:
    """Strokes on a transparent ground, as drawing programs save them."""
    sheet = sheet_with(ARCH, replace(Photo(), style="outline", wobble=0.0), cell=110)
    alpha = np.where(sheet.min(axis=2) < 150, 255, 0).astype(np.uint8)
    picture = np.dstack([np.zeros_like(sheet), alpha])
    assert overlap(read_picture(picture, PAPER_GRID), ARCH) >= 0.96


def test_formats_that_start_programs_are_not_opened(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\nshowpage\n")
    with pytest.raises(StackgenError, match=r"a\.png: is not an image that can be read"):
        read_picture(tmp_path / "a.png", PAPER_GRID)


def test_bombs_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(buffer, "PNG")
    (tmp_path / "bomb.png").write_bytes(buffer.getvalue())
    with pytest.raises(StackgenError, match="pixels"):
        read_picture(tmp_path / "bomb.png", PAPER_GRID)


@pytest.mark.parametrize("form", ["PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP"])
def test_cut_files_are_one_line_and_no_other(form: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    buffer = io.BytesIO()
    picture = np.random.default_rng(0).integers(0, 255, (90, 90, 3), dtype=np.uint8)
    Image.fromarray(picture).save(buffer, form)
    path = tmp_path / f"a.{form.lower()}"
    for share in (0.02, 0.5):
        path.write_bytes(buffer.getvalue()[: int(len(buffer.getvalue()) * share)])
        with pytest.raises(StackgenError) as caught:
            read_picture(path, PAPER_GRID)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("high", [1, 2.5, 4])
def test_a_figure_is_placed_as_high_as_asked(high: float) -> None:
    placed = place(np.ones((400, 100), dtype=bool), PAPER_GRID, high)
    rows, columns = np.nonzero(placed)
    assert np.ptp(rows) + 1 == pytest.approx(14 * high, abs=0.51) and rows.max() == 59
    assert columns.min() + columns.max() == 63
