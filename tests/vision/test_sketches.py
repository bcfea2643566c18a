"""From the photo of a drawing to silhouette, cells and block list."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from stackgen.commands.cli import main
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.vision import sketches
from stackgen.vision.sketches import find_sheet, sheet_ratio
from stackgen.world import PAPER_GRID
from tests.vision.conftest import DRAWN, PHOTOS, STACKS, truth

read_sketch = partial(sketches.read_sketch, grid=PAPER_GRID)
Photo, sheet_with, photographed = (DRAWN[name] for name in ("Photo", "sheet_with", "photographed"))


@pytest.mark.parametrize("name", STACKS)
@pytest.mark.parametrize(
    "photo",
    [
        Photo(filled=True, slant=0, turn=0, light=0),
        Photo(filled=False, slant=0.12, turn=-8, light=0.5, seed=5),
        Photo(filled=True, slant=0.08, turn=10, light=0.6, blur=2.0, seed=6),
    ],
    ids=["flat", "outline", "filled"],
)
def test_the_drawing_is_recovered(name: str, photo: object) -> None:
    found = read_sketch(photographed(sheet_with(STACKS[name], photo), photo))
    assert iou(found.silhouette, truth(STACKS[name])) >= 0.9
    assert iou(found.drawn, truth(STACKS[name])) >= 0.85  # with the strokes' width and a hand's wobble


@pytest.mark.parametrize("name", STACKS)
def test_the_examples_show_their_stacks(name: str) -> None:
    found = read_sketch(PHOTOS / f"sketch-{name.lower()}.jpg")
    assert iou(found.silhouette, truth(STACKS[name])) >= 0.95
    assert found.block_list is not None


def test_a_photo_of_the_bare_sheet_needs_no_table() -> None:
    found = read_sketch(np.repeat(sheet_with(STACKS["ARCH"], Photo())[..., None], 3, axis=2))
    assert iou(found.silhouette, truth(STACKS["ARCH"])) >= 0.95


def test_the_sheet_is_found_where_it_lies() -> None:
    photo = np.full((600, 800, 3), (110, 85, 60), dtype=np.uint8)
    corners = np.array([[150, 90], [640, 120], [700, 500], [90, 470]])
    cv2.fillPoly(photo, [corners.astype(np.int32)], (235, 235, 230))
    assert np.abs(find_sheet(photo) - corners).max() < 8


def test_a_rectangle_seen_askew_has_its_own_proportions() -> None:
    corners = np.array([[-1.5, -1], [1.5, -1], [1.5, 1], [-1.5, 1]])
    lean, turn, focal = np.radians(35), np.radians(20), 700.0
    corners = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    points = np.stack([corners[:, 0], corners[:, 1] * np.cos(lean), 6 + corners[:, 1] * np.sin(lean)], axis=1)
    assert sheet_ratio(focal * points[:, :2] / points[:, 2:], 800.0) == pytest.approx(1.5, rel=0.02)


def page() -> np.ndarray:
    return np.full((600, 800), 240, dtype=np.uint8)


def test_a_window_in_a_filled_drawing_stays_open_and_so_does_an_outlined_one() -> None:
    filled, outlined = page(), page()
    cv2.rectangle(filled, (250, 150), (550, 450), 40, -1)
    cv2.rectangle(filled, (350, 250), (450, 350), 240, -1)
    cv2.rectangle(outlined, (250, 150), (550, 450), 40, 5)
    cv2.rectangle(outlined, (352, 252), (448, 348), 40, 5)
    for drawing in (filled, outlined):
        ink = read_sketch(np.repeat(drawing[..., None], 3, axis=2)).ink
        assert not ink[len(ink) // 2, ink.shape[1] // 2] and ink.any()


def test_a_missing_base_line_is_drawn() -> None:
    drawing = page()
    cv2.polylines(drawing, [np.array([[250, 450], [250, 150], [550, 150], [550, 450]])], False, 40, 6)
    assert read_sketch(np.repeat(drawing[..., None], 3, axis=2)).silhouette.sum() > 2500


def _several() -> np.ndarray:
    drawing = page()
    cv2.rectangle(drawing, (80, 200), (230, 400), 40, -1)
    cv2.rectangle(drawing, (500, 200), (650, 400), 40, 6)
    return drawing


def _open() -> np.ndarray:
    drawing = page()
    cv2.polylines(drawing, [np.array([[250, 450], [250, 150], [550, 150]])], False, 40, 6)
    return drawing


def _off() -> np.ndarray:
    drawing = page()
    cv2.rectangle(drawing, (200, 200), (500, 700), 40, -1)
    return drawing


@pytest.mark.parametrize(
    ("drawing", "said"),
    [
        (page(), "nothing is drawn on the sheet"),
        (_several(), "2 drawings are on the sheet"),
        (_open(), "the outline of the drawing is open"),
        (_off(), "runs off the sheet"),
    ],
    ids=["empty", "several", "open", "off"],
)
def test_bad_drawings_are_one_line(
    drawing: np.ndarray, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noisy = drawing + np.random.default_rng(0).normal(0, 3, drawing.shape)
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), np.clip(noisy, 0, 255).astype(np.uint8))
    assert main(["capture", "--sketch", str(photo), "--out", str(tmp_path / "out.png")]) == 2
    error = capsys.readouterr().err
    assert said in error and str(photo) in error and error.count("\n") == 1
    assert not (tmp_path / "out.png").exists()


def test_an_empty_sheet_on_a_table_in_uneven_light_is_empty() -> None:
    photo = Photo(light=0.6)
    with pytest.raises(StackgenError, match="nothing is drawn"):
        read_sketch(photographed(np.full((840, 1188), 240, dtype=np.uint8), photo))


def test_no_photo_is_named(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"no\.jpg: no such file"):
        read_sketch(tmp_path / "no.jpg")
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(StackgenError, match=r"text\.jpg: is not an image"):
        read_sketch(tmp_path / "text.jpg")
