"""Rows of blocks: dynamic programming against enumeration."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen.errors import StackgenError
from stackgen.search.rows import NEVER, pack, step_of
from stackgen.world import Catalogue, Shape


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_rows_are_the_best_of_all_placements_of_their_sequences(seed: int, depth: int) -> None:
    rng = np.random.default_rng(seed)
    widths, columns = np.array([1, 2]), 6
    gains = np.full((1, 2, columns + 1), NEVER, dtype=np.float32)
    for s, width in enumerate(widths):
        gains[0, s, : columns - width + 1] = rng.integers(-5, 9, columns - width + 1)
    best: dict[tuple[int, ...], float] = {(): 0.0}
    for length in range(1, depth + 1):
        for shapes in product(range(2), repeat=length):
            for lefts in product(range(columns + 1), repeat=length):
                ends = [a + widths[s] for a, s in zip(lefts, shapes, strict=True)]
                apart = all(end <= a for end, a in zip(ends, lefts[1:], strict=False))
                if apart and lefts[-1] + widths[shapes[-1]] <= columns:
                    total = float(sum(gains[0, s, a] for s, a in zip(shapes, lefts, strict=True)))
                    best[shapes] = max(best.get(shapes, -np.inf), total)
    (rows,) = pack(gains, widths, 100, depth)
    assert {row.shapes: row.gain for row in rows} == pytest.approx(best)
    assert [row.gain for row in rows] == sorted((row.gain for row in rows), reverse=True)
    for row in rows:
        assert sum(gains[0, s, a] for s, a in row.blocks) == pytest.approx(row.gain)
    few, many = (pack(gains, widths, keep, columns)[0] for keep in (3, 1000))
    assert [row.gain for row in few] == pytest.approx([row.gain for row in many[:3]])


def test_a_row_uses_no_more_blocks_than_there_are() -> None:
    gains = np.ones((1, 1, 7), dtype=np.float32)
    gains[..., 6] = NEVER
    (rows,) = pack(gains, np.array([1]), 10, 6, left=np.array([[2]]))
    assert max(len(row.blocks) for row in rows) == 2


def test_heights_without_a_common_part_are_refused() -> None:
    with pytest.raises(StackgenError, match="common part"):
        step_of(Catalogue((Shape.box("a", 1, 1), Shape.box("b", 1, 0.937))))
