"""Drawings survive the way to the server and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stackgen.geometry import silhouette
from stackgen.stack import Stack
from stackgen.studio.requests import Drawing
from stackgen.studio.work.drawings import mask_of, pack, picture_of, unpack, views
from stackgen.vision.reader import read_picture
from stackgen.world import PAPER_GRID


@given(st.integers(4, 8), st.integers(0, 2**32 - 1))
def test_packing_keeps_every_pixel(cells: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random((14 * cells, 14 * cells)) < 0.5
    assert (unpack(pack(mask), 14 * cells) == mask).all()


@pytest.mark.parametrize("cells", [4, 6])
def test_a_drawing_of_the_papers_size_is_read_as_it_was_drawn(cells: int) -> None:
    mask = np.zeros((14 * cells, 14 * cells), dtype=bool)
    mask[:56, 14:42] = True  # floats on the larger paper, and is let down
    picture = picture_of(mask_of(Drawing(cells=cells, bits=pack(mask))))
    reading = read_picture(picture, PAPER_GRID)
    assert reading.exact is not None
    assert reading.exact.sum() == mask.sum()


def test_a_stack_of_the_drawing_itself_matches_from_three_sides() -> None:
    stack = Stack(np.array([0, 1]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
    facts = views(stack, silhouette(stack, PAPER_GRID), PAPER_GRID)
    assert [facts[view]["iou"] for view in ("front", "side", "top")] == [1, 1, 1]
