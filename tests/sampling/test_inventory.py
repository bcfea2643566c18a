"""Block lists from what is on the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.models.block_list.heads import all_block_lists
from stackgen.sampling.feasible import can_make, lists_that_make
from stackgen.sampling.inventory import allowed_lists, inventory_counts
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Catalogue, Mask, Shape


def blocks(*items: tuple[int, float, float]) -> Stack:
    """(shape, x, z)."""
    return Stack(np.array([i for i, _, _ in items]), np.array([[x, 0, z, 0, 0, 0] for _, x, z in items]))


WIDE = silhouette(blocks((1, 0, 0.5), (1, 0, 1.5)), PAPER_GRID)  # two by two cells
HOUSE = silhouette(blocks((1, 0, 0.5), (3, -0.5, 1.5), (3, 0.5, 1.5)), PAPER_GRID)


class Prefers:
    """Ranks block lists as it is told, keeping to the limit."""

    world = PAPER_WORLD
    card: Mapping[str, Any] = {}

    def __init__(self, *lists: list[int]) -> None:
        self.lists = np.array(lists)
        self.limits: list[NDArray[np.int64] | None] = []

    def predict(self, silhouettes: Mask, top: int = 1, limit: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        self.limits.append(limit)
        assert limit is not None
        allowed = self.lists[(self.lists <= limit).all(axis=1)]
        return np.tile(allowed[:top], (len(silhouettes), 1, 1))


def test_every_form_of_an_inventory_is_one() -> None:
    expected = [40, 0, 0, 1]
    for form in ("cube=40,triangle=1", {"cube": 40, "triangle": 1}, np.array(expected)):
        assert inventory_counts(form, PAPER_CATALOGUE).tolist() == expected


@pytest.mark.parametrize(
    "wrong",
    [
        *("cone=1", "cube", "cube=-1", "", "cube=0"),
        *({"cone": 1}, {"cube": -1}, {"cube": 1.5}, {"cube": "many"}, np.array([1, 2]), np.zeros(4, int)),
    ],
)
def test_what_is_no_inventory_is_refused_by_its_name(wrong: object) -> None:
    with pytest.raises(StackgenError, match=r"inventory|unknown shape"):
        inventory_counts(wrong, PAPER_CATALOGUE)  # type: ignore[arg-type]


def test_the_lists_that_make_a_silhouette_are_those_that_can() -> None:
    """The search and the test of one list agree, over all thousand lists."""
    rng = np.random.default_rng(2)
    everything = all_block_lists(4, 10)
    for _ in range(2):
        stack = realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)
        picture = silhouette(stack, PAPER_GRID)
        found = {counts for counts in lists_that_make(picture, [10] * 4, PAPER_WORLD) if sum(counts) <= 10}
        assert found == {tuple(counts) for counts in everything.tolist() if can_make(picture, counts, PAPER_WORLD)}
        assert len(stack) > 10 or tuple(stack.counts.tolist()) in found


def test_the_network_s_preference_is_kept_within_the_inventory() -> None:
    predictor = Prefers([0, 2, 0, 0], [1, 0, 1, 0], [2, 1, 0, 0], [4, 0, 0, 0])
    found = allowed_lists(WIDE, np.array([4, 1, 0, 0]), PAPER_WORLD, lambda: predictor, top=5)
    assert found.tolist() == [[2, 1, 0, 0], [4, 0, 0, 0]]
    assert [limit.tolist() for limit in predictor.limits if limit is not None] == [[4, 1, 0, 0]]
    assert allowed_lists(WIDE, np.array([9, 9, 9, 9]), PAPER_WORLD, lambda: predictor).tolist() == [[0, 2, 0, 0]]


def test_lists_that_cannot_make_it_are_passed_over_and_those_unknown_to_the_network_searched() -> None:
    predictor = Prefers([3, 0, 0, 0], [0, 1, 0, 0], [4, 0, 0, 0])  # only the last has the area
    assert allowed_lists(WIDE, np.array([4, 2, 0, 0]), PAPER_WORLD, lambda: predictor, top=9).tolist() == [
        [4, 0, 0, 0], [0, 2, 0, 0], [2, 1, 0, 0],
    ]  # fmt: skip
    assert allowed_lists(WIDE, np.array([2, 2, 0, 0]), PAPER_WORLD, lambda: predictor).tolist() == [[0, 2, 0, 0]]
    assert allowed_lists(WIDE, np.array([2, 2, 0, 0]), PAPER_WORLD, None).tolist() == [
        [0, 2, 0, 0]
    ]  # no network at all


@pytest.mark.parametrize(
    ("picture", "inventory", "message"),
    [
        (WIDE, [1, 0, 0, 0], r"inventory cube=1 is too small: .* 4.0 cells, its blocks 1.0; 3.0 cells are missing"),
        (WIDE, [0, 0, 0, 30], r"its blocks 5.0, of which|cannot make"),
        (WIDE, [0, 1, 5, 0], r"cannot make .* with rectangle=1 more it could be rectangle=2"),
        (HOUSE, [20, 20, 0, 0], r"slanted cells need a triangle each; with triangle=2 more"),
        (HOUSE, [20, 20, 0, 1], r"with triangle=1 more"),
    ],
)
def test_impossible_inventories_are_said_to_be_so(picture: Mask, inventory: list[int], message: str) -> None:
    for predictor in (None, lambda: Prefers([0, 2, 0, 0])):
        with pytest.raises(StackgenError, match=message) as caught:
            allowed_lists(picture, np.array(inventory), PAPER_WORLD, predictor)
        assert "\n" not in str(caught.value)


def test_a_stack_takes_no_more_blocks_than_the_model() -> None:
    wall = silhouette(blocks(*((1, x, z + 0.5) for x in (-1, 1) for z in range(3))), PAPER_GRID)  # twelve cells
    with pytest.raises(StackgenError, match=r"its blocks 10.0, of which one stack takes 10 blocks at most; 2.0 cells"):
        allowed_lists(wall, np.array([12, 0, 0, 0]), PAPER_WORLD)
    assert allowed_lists(wall, np.array([12, 9, 0, 0]), PAPER_WORLD).sum() == 6


def test_a_drawing_between_the_lines_is_left_to_the_network() -> None:
    odd = WIDE.copy()
    odd[:, 39:] = False  # one and a half cells wide
    assert not lists_that_make(odd, [10] * 4, PAPER_WORLD)
    predictor = Prefers([0, 2, 0, 0], [4, 0, 0, 0])
    assert allowed_lists(odd, np.array([9, 1, 0, 0]), PAPER_WORLD, lambda: predictor).tolist() == [[4, 0, 0, 0]]
    with pytest.raises(StackgenError, match="give one"):
        allowed_lists(odd, np.array([9, 1, 0, 0]), PAPER_WORLD)


def test_shapes_that_are_not_one_cell_high_are_left_to_the_network() -> None:
    catalogue = Catalogue((Shape.box("cube", 1), Shape.box("plank", 2, 0.5), PAPER_CATALOGUE[2], PAPER_CATALOGUE[3]))
    predictor = Prefers([0, 2, 0, 0], [2, 2, 0, 0], [4, 0, 0, 0])
    found = allowed_lists(WIDE, np.array([2, 9, 0, 0]), replace(PAPER_WORLD, catalogue=catalogue), lambda: predictor, 5)
    assert found.tolist() == [[0, 2, 0, 0], [2, 2, 0, 0]]
