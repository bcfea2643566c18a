"""The sheet of paper is found where it lies, and seen straight on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stackgen.vision.sheets import find_sheet
from stackgen.vision.straight import sheet_ratio, straight_up

CORNERS = np.array([[150, 90], [640, 120], [700, 500], [90, 470]])


def photo_with(corners: np.ndarray, paper: int = 235, table: tuple[int, int, int] = (110, 85, 60)) -> np.ndarray:
    photo = np.full((600, 800, 3), table, dtype=np.uint8)
    cv2.fillPoly(photo, [corners.astype(np.int32)], (paper, paper, paper - 5))
    return photo


def test_the_sheet_is_found_where_it_lies() -> None:
    sheet = find_sheet(photo_with(CORNERS))
    assert sheet is not None and np.abs(sheet.corners - CORNERS).max() < 3


@pytest.mark.parametrize("softness", [1.0, 25.0], ids=["hard", "soft"])
@pytest.mark.parametrize("table", [(110, 85, 60), (60, 62, 66)], ids=["wood", "grey"])
def test_a_shadow_across_the_sheet_does_no_harm(softness: float, table: tuple[int, int, int]) -> None:
    shade = np.ones((600, 800), dtype=np.float32)
    shade[250:, 380:] = 0.45
    photo = photo_with(CORNERS, table=table) * cv2.GaussianBlur(shade, (0, 0), softness)[..., None]
    sheet = find_sheet(photo.astype(np.uint8))
    assert sheet is not None and np.abs(sheet.corners - CORNERS).max() < 6


def test_stripes_of_the_table_are_no_sides() -> None:
    photo = photo_with(CORNERS, table=(165, 160, 150)).astype(np.float32)
    stripes = 1 + 0.1 * np.sin(np.arange(600) / 9)[:, None, None]
    sheet = find_sheet(np.where(photo > 225, photo, photo * stripes).astype(np.uint8))
    assert sheet is not None and np.abs(sheet.corners - CORNERS).max() < 4


def test_a_shadow_along_a_side_divides_no_sheet() -> None:
    shade = np.ones((600, 800), dtype=np.float32)
    cv2.fillPoly(shade, [np.array([[420, 130], [900, 155], [900, 700], [420, 700]])], 0.4)
    sheet = find_sheet((photo_with(CORNERS, table=(60, 62, 66)) * shade[..., None]).astype(np.uint8))
    assert sheet is not None and np.abs(sheet.corners - CORNERS).max() < 5


def test_coloured_paper_is_found_on_a_grey_table() -> None:
    photo = np.full((600, 800, 3), (154, 154, 150), dtype=np.uint8)
    cv2.fillPoly(photo, [CORNERS.astype(np.int32)], (242, 228, 130))
    sheet = find_sheet(photo)
    assert sheet is not None and np.abs(sheet.corners - CORNERS).max() < 4


def test_a_corner_may_lie_outside_of_the_photo() -> None:
    corners = CORNERS + [120, 0]
    sheet = find_sheet(photo_with(corners))
    assert sheet is not None and np.abs(sheet.corners - corners).max() < 12


def test_a_side_that_the_photo_cuts_off_is_square_to_its_neighbours() -> None:
    lean, focal = np.radians(30), 600.0
    flat = np.array([[-1.4, -1], [1.4, -1], [1.4, 2], [-1.4, 2]])  # its lower side lies beyond the photo's edge
    turn = np.radians(8)
    flat = flat @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    seen = focal * np.stack([flat[:, 0], flat[:, 1] * np.cos(lean)], axis=1) / (3.6 - flat[:, 1:] * np.sin(lean))
    photo = photo_with(seen + [400, 300])
    sheet = find_sheet(photo)
    assert sheet is not None and sheet.seen == 3
    left, right = (sheet.corners[i] - sheet.corners[j] for i, j in ((3, 0), (2, 1)))
    expected = seen[3] - seen[0], seen[2] - seen[1]
    for side, own in zip((left, right), expected, strict=True):
        assert abs(np.cross(np.append(side, 0), np.append(own, 0))[2]) < 0.03 * np.linalg.norm(side) * np.linalg.norm(
            own
        )


def test_a_small_sheet_is_found() -> None:
    corners = (CORNERS - [400, 300]) * 0.35 + [400, 300]
    sheet = find_sheet(photo_with(corners))
    assert sheet is not None and np.abs(sheet.corners - corners).max() < 4


def test_without_a_sheet_there_is_none() -> None:
    assert find_sheet(np.full((600, 800, 3), 230, dtype=np.uint8)) is None


def test_a_corner_of_shadow_and_crayon_is_no_sheet() -> None:
    photo = np.full((600, 800, 3), 235, dtype=np.uint8)
    photo[:34] = (60, 62, 66)  # of the sheet one side is seen
    shade = np.ones((600, 800), dtype=np.float32)
    shade[260:, :330] = 0.45
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(600, 800)), (0, 0), 3)
    crayon = grain < np.quantile(grain, 0.8)
    crayon[:90] = crayon[420:] = crayon[:, :330] = crayon[:, 640:] = False
    photo[crayon] = (225, 110, 30)
    assert find_sheet((photo * cv2.GaussianBlur(shade, (0, 0), 20)[..., None]).astype(np.uint8)) is None


def test_a_rectangle_seen_askew_has_its_own_proportions() -> None:
    corners = np.array([[-1.5, -1], [1.5, -1], [1.5, 1], [-1.5, 1]])
    lean, turn, focal = np.radians(35), np.radians(20), 600.0
    corners = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    points = np.stack([corners[:, 0], corners[:, 1] * np.cos(lean), 6 + corners[:, 1] * np.sin(lean)], axis=1)
    assert sheet_ratio(focal * points[:, :2] / points[:, 2:], 800.0) == pytest.approx(1.5, rel=0.02)


def test_a_drawing_without_a_sheet_is_set_upright_by_its_own_sides() -> None:
    mask = np.zeros((600, 800), dtype=np.uint8)
    corners = np.array([[300, 200], [500, 200], [500, 450], [420, 450], [420, 320], [300, 320]]) - [400, 325]
    turn = np.radians(9)
    turned = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + [400, 325]
    cv2.fillPoly(mask, [np.round(turned).astype(np.int32)], 1)
    straight = straight_up(mask > 0)
    rows = np.flatnonzero(straight.any(axis=1))
    widths = straight[rows].sum(axis=1)
    assert widths[3 : len(rows) // 3].std() < 4 and widths[3] == pytest.approx(2.5 * widths[-5], rel=0.06)


@pytest.mark.parametrize("softness", [2.0, 8.0])
def test_what_a_deep_shadow_divides_off_is_no_sheet(softness: float) -> None:
    corners = np.array([[210, 218], [780, 214], [928, 602], [72, 618]]) * [0.82, 0.95]
    shade = np.ones((600, 800), dtype=np.float32)
    cv2.fillPoly(shade, [np.array([[-100, 150], [340, 170], [375, 700], [-100, 700]])], 0.35)
    photo = photo_with(corners, table=(165, 160, 150)) * cv2.GaussianBlur(shade, (0, 0), softness)[..., None]
    sheet = find_sheet(photo.astype(np.uint8))
    assert sheet is not None and np.abs(sheet.corners - corners).max() < 6


def test_coloured_paper_on_a_table_of_another_colour_is_not_in_a_shadow() -> None:
    corners = np.array([[150, 160], [650, 163], [795, 520], [2, 510]])
    photo = np.full((600, 800, 3), (37, 55, 65), dtype=np.uint8)
    cv2.fillPoly(photo, [corners.astype(np.int32)], (233, 222, 133))
    sheet = find_sheet(photo)
    assert sheet is not None and np.abs(sheet.corners - corners).max() < 4


def test_a_sheet_that_fills_the_photo_but_for_a_strip_of_table_is_found() -> None:
    corners = np.array([[14, 24], [786, 36], [790, 582], [6, 572]])
    sheet = find_sheet(photo_with(corners))
    assert sheet is not None and np.abs(sheet.corners - corners).max() < 5
