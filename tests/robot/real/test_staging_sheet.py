"""The sheet: outlines to scale, every slot on some page, pages that fit together."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from stackgen.errors import StackgenError
from stackgen.robot.planning.staging import lay_out
from stackgen.robot.real.staging_sheet import MARGIN, PAGE, area, places, tiles, write_staging_sheet
from stackgen.stack import Stack
from tests.robot.real.arms import WORKCELL

CUBE, RECTANGLE, LONG, TRIANGLE = range(4)
SIZE = 0.05
BLOCKS = Stack(np.arange(4), np.array([[2 * i, 0, 0.5, 0, 0, 0] for i in range(4)]))
ORDER = (2, 0, 3, 1)


def size(points: np.ndarray) -> np.ndarray:
    return points.max(axis=0) - points.min(axis=0)


def test_outlines_have_the_blocks_sizes_and_lie_in_their_slots() -> None:
    found = places(BLOCKS, ORDER, WORKCELL, SIZE)
    assert [(place.slot, place.block) for place in found] == list(enumerate(ORDER, 1))
    widths = {CUBE: 50, RECTANGLE: 100, LONG: 150, TRIANGLE: 50}
    for place in found:
        np.testing.assert_allclose(size(place.outline), [widths[place.block], 50], atol=1e-6)
        assert (place.outline > place.border.min(axis=0)).all() and (place.outline < place.border.max(axis=0)).all()
    triangle = next(place for place in found if place.shape == "triangle")
    assert len(triangle.front) == 3


def test_outlines_lie_where_the_arm_fetches_the_blocks() -> None:
    waiting = lay_out(BLOCKS, ORDER, WORKCELL, SIZE)
    for place in places(BLOCKS, ORDER, WORKCELL, SIZE):
        x, y = 1e3 * waiting[place.block].grasp[:2, 3]
        low, high = place.outline.min(axis=0), place.outline.max(axis=0)
        assert low[0] < x < high[0] and low[1] < y < high[1]


def test_every_slot_is_on_the_pages_and_the_pages_meet() -> None:
    found = places(BLOCKS, ORDER, WORKCELL, SIZE)
    page = np.array(PAGE) - 2 * MARGIN
    corners = [corner for corner, _ in tiles(found)]
    low, _ = area(found)
    for corner in corners:
        np.testing.assert_allclose(((corner - low) / page) % 1, 0, atol=1e-9)
    for place in found:
        for point in place.border * 0.999 + place.border.mean(axis=0) * 0.001:
            assert any((point >= c).all() and (point <= c + page).all() for c in corners)


def test_the_svg_is_to_scale(tmp_path: Path) -> None:
    """The page is as large as its drawing and two margins, and so is the long block's outline in it."""
    path = tmp_path / "sheet.svg"
    write_staging_sheet(path, BLOCKS, order=ORDER, workcell=WORKCELL, cell_size=SIZE)
    root = ElementTree.parse(path).getroot()
    low, high = area(places(BLOCKS, ORDER, WORKCELL, SIZE))
    points = [float(root.get(name, "").removesuffix("pt")) for name in ("width", "height")]
    np.testing.assert_allclose(np.array(points) * 25.4 / 72, high - low + 2 * MARGIN, rtol=1e-4)
    widths = []
    for path_ in root.iter("{http://www.w3.org/2000/svg}path"):
        if "fill: #ededed" in path_.get("style", ""):
            numbers = np.array([float(n) for n in re.findall(r"-?\d+\.?\d*", path_.get("d", ""))]).reshape(-1, 2)
            widths.append(size(numbers)[0] * 25.4 / 72)
    np.testing.assert_allclose(widths, [150, 50, 50, 100], rtol=1e-4)


def test_the_pdf_has_an_overview_and_pages_of_a4_and_is_the_same_twice(tmp_path: Path) -> None:
    write_staging_sheet(tmp_path / "a.pdf", BLOCKS, order=ORDER, workcell=WORKCELL, cell_size=SIZE)
    data = (tmp_path / "a.pdf").read_bytes()
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data)
    sizes = [tuple(round(float(n) * 25.4 / 72) for n in box) for box in boxes]
    number = len(list(tiles(places(BLOCKS, ORDER, WORKCELL, SIZE))))
    assert sorted(sizes) == sorted([(297, 210)] + [(210, 297)] * number)
    write_staging_sheet(tmp_path / "b.pdf", BLOCKS, order=ORDER, workcell=WORKCELL, cell_size=SIZE)
    assert (tmp_path / "b.pdf").read_bytes() == data


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"\.pdf or \.svg"):
        write_staging_sheet(tmp_path / "sheet.docx", BLOCKS, order=ORDER, workcell=WORKCELL, cell_size=SIZE)
    assert not list(tmp_path.iterdir())
