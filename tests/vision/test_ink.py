"""What strokes outline is filled; openings, doorways and windows stay open; lines that enclose nothing go."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.vision.ink.choice import choose
from stackgen.vision.ink.outlines import fill
from stackgen.vision.ink.rules import without_rules
from stackgen.vision.photos import find_ink
from stackgen.world import Mask

ARCH = np.array([[100, 100], [400, 100], [400, 400], [300, 400], [300, 200], [200, 200], [200, 400], [100, 400]])


def page() -> np.ndarray:
    return np.zeros((500, 600), dtype=np.uint8)


def solid(*outlines: np.ndarray) -> Mask:
    mask = page()
    cv2.fillPoly(mask, list(outlines), 1)
    return mask > 0


def drawn(*outlines: np.ndarray, width: int = 5, closed: bool = True) -> Mask:
    mask = page()
    cv2.polylines(mask, list(outlines), closed, 1, width)
    return mask > 0


def box(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


@pytest.mark.parametrize("width", [1, 3, 9, 20, 34])
def test_outlines_of_any_stroke_are_filled_to_the_middle_of_the_stroke(width: int) -> None:
    assert iou(fill(drawn(ARCH, width=width)).mask, solid(ARCH)) > 0.96


def test_what_is_solid_stays_as_it_is() -> None:
    assert iou(fill(solid(ARCH)).mask, solid(ARCH)) > 0.99


def test_a_gap_is_closed_and_told() -> None:
    ink = drawn(ARCH)
    ink[90:110, 240:262] = False
    found = fill(ink)
    assert iou(found.mask, solid(ARCH)) > 0.95 and "gap" in " ".join(found.notes)


def test_a_missing_base_line_is_drawn_and_told() -> None:
    open_box = np.array([[100, 400], [100, 100], [400, 100], [400, 400]])
    found = fill(drawn(open_box, closed=False))
    assert iou(found.mask, solid(box(100, 100, 400, 400))) > 0.95 and "base line" in " ".join(found.notes)


def test_an_open_outline_is_refused() -> None:
    with pytest.raises(StackgenError, match="outline of the drawing is open"):
        fill(drawn(np.array([[100, 400], [100, 100], [400, 100]]), closed=False))


@pytest.mark.parametrize(
    ("inner", "stays_open"),
    [
        (box(200, 180, 300, 280), True),  # a window: it touches nothing
        (box(200, 250, 300, 400), True),  # a doorway: on the base line
        (box(100, 300, 400, 400), False),  # a block under another
        (box(300, 100, 400, 200), False),  # a block in a corner
    ],
    ids=["window", "doorway", "base", "corner"],
)
def test_what_is_outlined_within(inner: np.ndarray, stays_open: bool) -> None:
    found = fill(drawn(box(100, 100, 400, 400), inner))
    middle = inner.mean(axis=0).astype(int)
    assert found.mask[middle[1], middle[0]] == (not stays_open)
    assert found.mask[150, 150]


def test_blocks_that_are_drawn_one_by_one_are_filled_and_the_opening_between_them_is_not() -> None:
    blocks = [box(100, 100, 400, 200), *(box(x, y, x + 100, y + 100) for x in (100, 300) for y in (200, 300))]
    assert iou(fill(drawn(*blocks)).mask, solid(ARCH)) > 0.96


@pytest.mark.parametrize("kind", ["solid", "outline"])
def test_the_window_of_a_solid_wall_stays_open(kind: str) -> None:
    wall = solid(box(100, 100, 400, 400)) & ~solid(box(200, 200, 300, 300))
    ink = wall if kind == "solid" else drawn(box(100, 100, 400, 400), box(200, 200, 300, 300))
    assert iou(fill(ink).mask, wall) > 0.95


@pytest.mark.parametrize("ink", [drawn(ARCH, width=6), solid(ARCH)], ids=["outline", "solid"])
def test_a_ground_line_is_no_block(ink: Mask) -> None:
    grounded = ink.copy()
    grounded[399:405, 20:560] = True
    found = choose(grounded)
    assert iou(found.mask, solid(ARCH)) > 0.95 and "ground line" in " ".join(found.notes)


def test_name_and_sun_are_left_out_and_told() -> None:
    ink = drawn(ARCH).astype(np.uint8)
    cv2.putText(ink, "MIA", (460, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 1, 3)
    cv2.circle(ink, (520, 150), 40, 1, -1)
    found = choose(ink > 0)
    assert iou(found.mask, solid(ARCH)) > 0.95 and "left out" in " ".join(found.notes)


def test_of_two_drawings_one_is_asked_for() -> None:
    left, right = box(50, 200, 200, 400), box(350, 100, 550, 400)
    ink = drawn(left, right)
    with pytest.raises(StackgenError, match="2 drawings are in it"):
        choose(ink)
    assert iou(choose(ink, which=1).mask, solid(left)) > 0.95
    assert iou(choose(ink, which=2).mask, solid(right)) > 0.95
    with pytest.raises(StackgenError, match=r"which must lie in 1\.\.2"):
        choose(ink, which=3)
    assert iou(choose(ink, spread=True).mask, solid(left, right)) > 0.95  # both stand on the ground


def test_a_block_between_others_whose_outline_has_gaps_is_not_lost() -> None:
    tower = [box(200, 100 + 100 * row, 400, 200 + 100 * row) for row in range(3)]
    ink = drawn(*tower)
    ink[230:237, 190:210] = ink[250:256, 390:410] = False
    assert iou(choose(ink).mask, solid(*tower)) > 0.95


def test_the_sides_of_a_block_tell_that_the_ground_line_is_its_base() -> None:
    base, top = box(250, 300, 350, 400), box(100, 200, 400, 300)
    ink = drawn(top) | drawn(np.array([[250, 400], [250, 300], [350, 300], [350, 400]]), closed=False)
    ink[399:405, 20:560] = True
    found = choose(ink)
    assert iou(found.mask, solid(base, top)) > 0.95 and "ground line" in " ".join(found.notes)


def test_the_top_of_a_block_that_sticks_out_is_no_ground_line() -> None:
    base, top = box(150, 300, 400, 400), box(150, 200, 300, 300)
    ink = drawn(base, top, width=8)
    ink[399:408, 20:560] = True
    assert iou(choose(ink).mask, solid(base, top)) > 0.95


def test_a_line_that_blocks_lie_below_is_no_ground_line() -> None:
    wall = solid(box(150, 150, 400, 400))
    ink = wall.copy()
    ink[330:334, 40:150] = True  # a line of the paper, beside it
    assert iou(choose(ink).mask, wall) > 0.97


def test_what_the_ground_line_may_close_between_blocks_is_doubted() -> None:
    ink = drawn(box(100, 200, 400, 300), box(100, 300, 200, 400), box(300, 300, 400, 400))
    ink[398:403, 20:560] = True
    assert "uncertain" in " ".join(choose(ink).notes)


def test_a_drawing_that_runs_off_is_not_replaced_by_less_without_a_word() -> None:
    ink = drawn(np.array([[0, 100], [300, 100], [300, 400], [0, 400]]), box(420, 100, 500, 180))
    assert "uncertain" in " ".join(choose(ink).notes)


def test_dots_of_the_paper_beside_a_drawing_are_dirt() -> None:
    ink = solid(ARCH)
    ink[12:500:30, 12:600:30] = ink[13:500:30, 12:600:30] = ink[12:500:30, 13:600:30] = True
    ink[12:500:30, 11:600:30] = ink[11:500:30, 12:600:30] = ink[12:500:30, 14:600:30] = True
    assert iou(choose(ink).mask, solid(ARCH)) > 0.99


def test_an_outline_of_many_dashes_is_one_drawing() -> None:
    ink = drawn(ARCH, width=4)
    y, x = np.mgrid[:500, :600]
    ink &= (x + y) % 24 < 16
    assert iou(choose(ink).mask, solid(ARCH)) > 0.95


@pytest.mark.parametrize("width", [6, 12])
def test_a_base_that_is_drawn_right_on_the_ground_line_is_kept(width: int) -> None:
    ink = drawn(box(150, 150, 300, 400), box(300, 250, 420, 400), width=width)
    level = 400 + width + np.round(2 * np.sin(np.arange(600) / 20)).astype(int)
    for column in range(20, 560):
        ink[level[column] - width // 2 : level[column] + width // 2, column] = True
    found = choose(ink).mask
    rows = np.flatnonzero(found.any(axis=1))
    assert abs(rows[-1] - 400) <= 2


def test_a_large_part_that_touches_only_at_a_corner_is_not_taken_for_a_name() -> None:
    base, top = box(100, 300, 250, 400), box(256, 150, 420, 295)
    assert iou(choose(solid(base, top)).mask, solid(base, top)) > 0.95


@pytest.mark.parametrize("kind", ["hidden", "faint"])
def test_lines_of_the_paper_are_erased_where_a_drawing_hides_them_or_they_are_faint(kind: str) -> None:
    wall = solid(box(80, 150, 480, 270)) if kind == "hidden" else solid(box(200, 150, 400, 270))
    lines = np.zeros_like(wall)
    lines[20::30] = lines[21::30] = True
    lines[:, ::40] &= False
    if kind == "faint":
        lines &= np.arange(600) % 45 < 16
    ink, ruled = without_rules(wall | lines, np.where(wall, 0.8, 0.2).astype(np.float32))
    assert ruled and np.count_nonzero(ink & ~wall) < 0.002 * wall.sum()


@pytest.mark.parametrize("slope", [-9.0, 0.0, 4.0, 8.0])
def test_lines_of_the_paper_may_be_tilted(slope: float) -> None:
    wall = solid(box(200, 150, 400, 270))
    lines = page()
    for row in range(-120, 620, 30):
        cv2.line(lines, (0, row), (600, round(row + 600 * np.tan(np.radians(slope)))), 1, 2)
    ink, ruled = without_rules(wall | (lines > 0), np.where(wall, 0.8, 0.2).astype(np.float32))
    assert ruled and np.count_nonzero(ink & ~wall) < 0.05 * lines.sum()


def test_a_structure_that_is_larger_than_any_piece_of_the_paper_is_ink() -> None:
    sheet = np.full((500, 700, 3), 235, dtype=np.uint8)
    sheet[60:440, 90:610] = 70
    ink, _ = find_ink(sheet)
    assert ink[60:440, 90:610].mean() > 0.98 and ink[:50].mean() < 0.01
