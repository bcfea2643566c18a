"""Shapes, catalogues, stacks and block lists."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stackgen.errors import StackgenError
from stackgen.stack import Stack, check_block_list, format_block_list, parse_block_list, shapes_of
from stackgen.world import MAX_BLOCKS, PAPER_CATALOGUE, Catalogue, Shape

SQUARE = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
STAR = tuple((math.sin(4 * math.pi * k / 5), math.cos(4 * math.pi * k / 5)) for k in range(5, 0, -1))
CENTERED_STAR = tuple((x, z - (1 + math.cos(0.8 * math.pi)) / 2) for x, z in STAR)

extents = st.floats(0.1, 10)
block_lists = st.lists(st.integers(0, MAX_BLOCKS), min_size=4, max_size=4).filter(lambda c: 1 <= sum(c) <= MAX_BLOCKS)


def regular_polygon(corners: int) -> tuple[tuple[float, float], ...]:
    """Of radius 1, an even number of corners, so that its box is centred."""
    angles = 2 * np.pi * np.arange(corners) / corners
    return tuple((float(np.cos(a)), float(np.sin(a))) for a in angles)


# Shapes.


@given(extents, extents, extents)
def test_a_box_has_the_size_volume_and_centre_of_a_box(width: float, height: float, depth: float) -> None:
    box = Shape.box("box", width, height, depth)
    assert box.size == pytest.approx((width, depth, height))
    assert box.volume == pytest.approx(width * height * depth)
    assert box.center_of_mass == pytest.approx([0, 0, 0], abs=1e-9)
    assert box.is_box == (abs(box.volume - width * depth * height) < 1e-9)


def test_the_paper_s_shapes() -> None:
    sizes = {shape.name: shape.size for shape in PAPER_CATALOGUE}
    assert sizes == {"cube": (1, 1, 1), "rectangle": (2, 1, 1), "long_rectangle": (3, 1, 1), "triangle": (1, 1, 1)}
    triangle = PAPER_CATALOGUE[3]
    assert triangle.volume == pytest.approx(0.5)
    # The centroid is a third of the height above the base, the reference is half of it above.
    assert triangle.center_of_mass == pytest.approx([0, 0, 1 / 3 - 1 / 2])
    assert [shape.is_box for shape in PAPER_CATALOGUE] == [True, True, True, False]


@pytest.mark.parametrize("corners", [4, 6, 8, 32])
def test_a_regular_polygon_has_its_area_and_its_centroid_in_the_middle(corners: int) -> None:
    shape = Shape("coin", regular_polygon(corners), depth=2)
    assert shape.volume == pytest.approx(2 * corners / 2 * math.sin(2 * math.pi / corners))
    assert shape.center_of_mass == pytest.approx([0, 0, 0], abs=1e-9)
    assert not shape.is_box


def test_vertices_span_the_box() -> None:
    for shape in PAPER_CATALOGUE:
        assert np.ptp(shape.vertices, axis=0) == pytest.approx(shape.size)
        assert shape.vertices.min(axis=0) == pytest.approx(-shape.vertices.max(axis=0))


@pytest.mark.parametrize(
    ("outline", "depth", "message"),
    [
        (SQUARE[:2], 1, "at least three"),
        (((0, 0, 0),) * 4, 1, "at least three"),
        (((-0.5, -0.5), (0.5, math.nan), (0.5, 0.5)), 1, "at least three"),
        (SQUARE[::-1], 1, "convex and counter-clockwise.*reverse"),
        (((-1, -1), (0, 0), (1, 1)), 1, "no area"),
        (((0, 0), (0, 0), (0, 0)), 1, "no area"),
        (((-1, -1), (1, -1), (0, -0.5), (1, 1), (-1, 1)), 1, "convex"),
        (((-1, -1), (0, -1), (1, -1), (1, 1), (-1, 1)), 1, "convex"),
        (CENTERED_STAR, 1, "convex"),
        (tuple((x + 1, z) for x, z in SQUARE), 1, r"centred.*subtract \(1, 0\)"),
        (SQUARE, 0, "depth must be positive"),
        (SQUARE, -1, "depth must be positive"),
        (SQUARE, math.nan, "depth must be positive"),
        (SQUARE, math.inf, "depth must be positive"),
    ],
)
def test_a_shape_that_is_none_is_refused_in_one_line(outline: Any, depth: float, message: str) -> None:
    with pytest.raises(StackgenError, match=message) as caught:
        Shape("odd", outline, depth)
    assert "'odd'" in str(caught.value) and "\n" not in str(caught.value)


# Catalogues.


@given(st.lists(st.tuples(extents, extents, extents), min_size=1, max_size=5))
def test_a_catalogue_survives_its_plain_form(boxes: list[tuple[float, float, float]]) -> None:
    catalogue = Catalogue(tuple(Shape.box(f"box{i}", *box) for i, box in enumerate(boxes)))
    assert Catalogue.from_json(catalogue.to_json()) == catalogue


def test_the_paper_s_catalogue_survives_its_plain_form() -> None:
    assert Catalogue.from_json(PAPER_CATALOGUE.to_json()) == PAPER_CATALOGUE


@pytest.mark.parametrize(
    "items", [[], [{"name": "x"}], [{"name": "x", "outline": [[1]]}], [1], 3, [{"outline": SQUARE}]]
)
def test_a_malformed_catalogue_is_refused(items: Any) -> None:
    with pytest.raises(StackgenError, match="catalogue"):
        Catalogue.from_json(items)


def test_a_catalogue_is_written_by_names_boxes_and_outlines() -> None:
    ramp = [[-1, -0.5], [1, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    items: list[Any] = ["triangle", {"name": "plank", "width": 2, "height": 0.5}, {"name": "ramp", "outline": ramp}]
    catalogue = Catalogue.from_config(items)
    assert catalogue.names == ("triangle", "plank", "ramp") and catalogue[0] == PAPER_CATALOGUE[3]
    assert catalogue[1].size == (2, 1, 0.5) and catalogue[1].is_box
    assert catalogue[2].area == pytest.approx(1.5) and catalogue[2].depth == 1
    deep = Catalogue.from_config([{"name": "wall", "width": 3, "depth": 2}])
    assert deep[0].size == (3, 2, 1) and deep[0].volume == 6 and deep[0].area == 3


@given(st.lists(st.tuples(extents, extents, extents), min_size=1, max_size=5))
def test_what_is_printed_of_a_catalogue_is_read_as_one_that_people_write(boxes: list[tuple[float, ...]]) -> None:
    catalogue = Catalogue(tuple(Shape.box(f"box{i}", *box) for i, box in enumerate(boxes)))
    assert Catalogue.from_config(catalogue.to_json()) == catalogue


@pytest.mark.parametrize("items", ["cube", {"name": "cube"}, 3, None, [None], [[]], [{}], [{"name": "x"}], ["Cube"]])
def test_what_is_no_list_of_shapes_is_one_line(items: Any) -> None:
    with pytest.raises(StackgenError, match="catalogue") as caught:
        Catalogue.from_config(items)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a,b", "a=1", " a", "", 5, "x" * 101])
def test_a_name_that_could_not_stand_in_a_block_list_is_refused(name: Any) -> None:
    with pytest.raises(StackgenError, match="name is 1 to 100"):
        Catalogue.from_config([{"name": name, "width": 1}])


def test_more_shapes_than_a_dataset_can_count_are_refused() -> None:
    boxes = [{"name": f"box{i}", "width": 1} for i in range(128)]
    assert len(Catalogue.from_config(boxes[:127])) == 127
    with pytest.raises(StackgenError, match="at most 127"):
        Catalogue.from_config(boxes)


@pytest.mark.parametrize(
    ("outline", "level"),
    [
        (SQUARE, (True, True)),
        (((-0.5, -0.5), (0.5, -0.5), (0, 0.5)), (True, False)),
        (((0, -0.5), (0.5, 0.5), (-0.5, 0.5)), (False, True)),
        (((0, -0.5), (0.5, 0), (0, 0.5), (-0.5, 0)), (False, False)),
    ],
)
def test_a_level_edge_is_told_from_a_corner(outline: Any, level: tuple[bool, bool]) -> None:
    assert Shape("s", outline).level == level


def test_names_are_distinct_and_unknown_ones_are_answered_with_the_known() -> None:
    cube = Shape.box("cube", 1)
    with pytest.raises(StackgenError, match="distinct"):
        Catalogue((cube, cube))
    with pytest.raises(StackgenError, match=r"'sphere'.*cube, rectangle, long_rectangle, triangle"):
        PAPER_CATALOGUE.index("sphere")
    assert [PAPER_CATALOGUE.index(name) for name in PAPER_CATALOGUE.names] == [0, 1, 2, 3]


# Stacks.


@pytest.mark.parametrize(
    ("shapes", "poses", "message"),
    [
        ([0, 1], np.zeros((1, 6)), "fit|poses"),
        ([[0]], np.zeros((1, 6)), "shapes"),
        ([0], np.zeros((1, 7)), "poses"),
        ([4], np.zeros((1, 6)), r"0\.\.3"),
        ([-1], np.zeros((1, 6)), r"0\.\.3"),
        ([0], np.full((1, 6), np.nan), "finite"),
        ([0], np.full((1, 6), np.inf), "finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(shapes: Any, poses: Any, message: str) -> None:
    with pytest.raises(StackgenError, match=message):
        Stack(shapes, poses)


@given(st.lists(st.integers(0, 3), max_size=12))
def test_a_stack_counts_its_blocks(shapes: list[int]) -> None:
    stack = Stack(np.array(shapes, dtype=int), np.zeros((len(shapes), 6)))
    assert len(stack) == len(shapes) == stack.counts.sum()
    assert [stack.counts[s] for s in range(4)] == [shapes.count(s) for s in range(4)]
    assert stack.names == [PAPER_CATALOGUE.names[s] for s in shapes]


# Block lists.


@given(block_lists)
def test_a_block_list_survives_its_text(counts: list[int]) -> None:
    assert parse_block_list(format_block_list(counts, PAPER_CATALOGUE), PAPER_CATALOGUE, MAX_BLOCKS).tolist() == counts


@given(block_lists, st.randoms(use_true_random=False))
def test_order_spaces_and_repetition_do_not_matter(counts: list[int], random: Any) -> None:
    parts = [f" {name} = 1 " for name, n in zip(PAPER_CATALOGUE.names, counts, strict=True) for _ in range(n)]
    random.shuffle(parts)
    assert parse_block_list(",".join(parts), PAPER_CATALOGUE, MAX_BLOCKS).tolist() == counts


@given(block_lists)
def test_a_block_list_is_the_counts_of_its_shapes(counts: list[int]) -> None:
    shapes = shapes_of(counts)
    assert np.bincount(shapes, minlength=4).tolist() == counts
    assert (np.diff(shapes) >= 0).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 blocks, but 1 to 10"),
        (",,", "0 blocks, but 1 to 10"),
        ("cube=0", "0 blocks, but 1 to 10"),
        ("cube=11", "11 blocks, but 1 to 10"),
        ("cube=6,rectangle=5", "11 blocks, but 1 to 10"),
        ("cube", "cube=COUNT"),
        ("cube=", "cube=COUNT"),
        ("cube=-1", "cube=COUNT"),
        ("cube=1.5", "cube=COUNT"),
        ("cube=²", "cube=COUNT"),
        ("cube=٣", "cube=COUNT"),
        ("cube=" + "9" * 30, "cube=COUNT"),
        ("cube=9223372036854775807,rectangle=9223372036854775807,triangle=4", "cube=COUNT"),
        ("cube=" + "9" * 5000, "cube=COUNT"),
        ("sphere=1", "unknown shape 'sphere'"),
        ("=1", "unknown shape"),
    ],
)
def test_a_wrong_block_list_is_one_line(text: str, message: str) -> None:
    with pytest.raises(StackgenError, match=message) as caught:
        parse_block_list(text, PAPER_CATALOGUE, MAX_BLOCKS)
    assert "\n" not in str(caught.value)


@given(st.text(alphabet="cube=3,rectangl_ -\n9", max_size=30))
def test_any_text_is_a_block_list_or_one_line(text: str) -> None:
    try:
        counts = parse_block_list(text, PAPER_CATALOGUE, MAX_BLOCKS)
    except StackgenError as error:
        answer = str(error)
    else:
        answer = format_block_list(counts, PAPER_CATALOGUE)
        assert 1 <= counts.sum() <= MAX_BLOCKS and counts.min() >= 0
    assert answer and "\n" not in answer


def test_negative_counts_are_refused_even_if_the_sum_is_right() -> None:
    with pytest.raises(StackgenError, match="at least 0"):
        check_block_list([3, -1, 0, 0], MAX_BLOCKS)


@pytest.mark.parametrize("name", ["", "a b", "cube\n  movej([0,0,0,0,0,0])", "a,b", "a=1", "\x1b[31m", "x" * 101])
def test_one_rule_for_names_wherever_shapes_are_read(name: str) -> None:
    prism = {"name": name, "outline": [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]}
    for read in (Catalogue.from_json, Catalogue.from_config):
        with pytest.raises(StackgenError, match="name") as refused:
            read([prism])
        assert str(refused.value).isprintable()
