"""Beam: from the ground up, each row is packed over the supports that the row below offers.

It finds what stands where the search that takes the best combinations first drowns in them: many rows, thin supports,
shapes of different heights.

Lengths and gains in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stackgen.search.problem import Beginning, Ints, Problem
from stackgen.search.rows import NEVER, Row, pack

_BEAM = 12  # beginnings that are kept at a level, at effort 1
_BRANCH = 10  # rows that are tried on each
_SAME_TOP = 3  # beginnings with the same upper row that are kept
_ENDS = 60  # finished stacks that are judged
_LEAN = 0.15  # loss for each pixel that a block's centre of mass lies outside its supports, per pixel row of a cell


def beam(problem: Problem) -> list[Beginning]:
    """Find stacks that stand, the one that gains most first."""
    return _Beam(problem).search()


class _Beam:
    def __init__(self, problem: Problem) -> None:
        self.problem, self.levels, self.world = problem, problem.levels, problem.world
        self.given = problem.limits.all_of_them
        self.areas = np.array([shape.area for shape in self.world.catalogue]) * self.world.grid.pixels_per_cell**2
        z = self.world.grid.vertical("front")
        self.coming = np.stack(
            [self.levels.silhouette[z > k * self.levels.step].sum(axis=0) for k in range(self.levels.number + 8)]
        )

    def search(self) -> list[Beginning]:
        """Build from the ground up, each row over the supports that it has."""
        width = max(2, round(_BEAM * self.problem.settings.effort))
        beginnings, ends = [self.problem.start()], []
        for level in range(self.levels.number):
            grown: list[Beginning] = []
            for begin, rows in zip(beginnings, self._rows_on(beginnings, level), strict=True):
                ends.append(begin)
                grown += [self.problem.on(begin, row, level) for row in rows if row.blocks]
                if begin.blocks and (begin.top > level).any():
                    grown.append(begin)
            beginnings = self._keep(grown, level + 1, width)
            if not beginnings or self.problem.late:
                break
        ends += beginnings
        done = [end for end in ends if end.blocks and not (self.given and any(end.left))]
        done.sort(key=lambda end: -end.gain)
        standing, layouts = [], set()
        for end in done[: round(_ENDS * max(1.0, self.problem.settings.effort))]:
            if end.sequence not in layouts and (stood := self.problem.standing(end)):
                standing.append(stood)
                layouts.add(end.sequence)
        return standing

    def _rows_on(self, beginnings: Sequence[Beginning], level: int) -> list[list[Row]]:
        """Pack rows on each of some beginnings: some with all centres over their supports, some that lean."""
        ppc = self.world.grid.pixels_per_cell
        base = self.levels.gains[level]
        gains = np.repeat(base[None], 2 * len(beginnings), axis=0)
        for b, begin in enumerate(beginnings):
            free = np.concatenate([[0], np.cumsum(begin.top > level)])
            bears = begin.bears & (begin.top == level) if level else np.ones(self.levels.columns, dtype=bool)
            for s, piece in enumerate(self.levels.pieces):
                places = np.arange(self.levels.columns - piece.width + 1)
                if piece.foot is None or not len(places):
                    continue
                taken = free[places + piece.width] > free[places]
                gains[2 * b : 2 * b + 2, s, : len(places)][:, taken] = NEVER
                if level:
                    lean = self._lean(bears, places, s)
                    firm = np.where(lean > -1, NEVER, 0)
                    cost = np.where(lean > piece.width, NEVER, -_LEAN * ppc * np.maximum(lean + 1, 0))
                    gains[2 * b, s, : len(places)] += firm
                    gains[2 * b + 1, s, : len(places)] += cost
        np.maximum(gains, NEVER, out=gains)
        left = np.repeat([begin.left for begin in beginnings], 2, axis=0)
        total = np.array([self.problem.limits.total - len(begin.blocks) for begin in beginnings])
        rows = pack(gains, self.levels.widths, _BRANCH, max(1, min(self.problem.depth, int(total.max()))), left)
        return [
            [row for row in {*rows[2 * b], *rows[2 * b + 1]} if len(row.blocks) <= total[b]]
            for b in range(len(beginnings))
        ]

    def _lean(self, bears: NDArray[np.bool_], places: Ints, s: int) -> NDArray[np.float64]:
        """Measure how far each place's centre of mass lies outside its supports [pixel]; large where there is none."""
        piece, ppc, columns = self.levels.pieces[s], self.world.grid.pixels_per_cell, self.levels.columns
        assert piece.foot is not None
        low, high = round(piece.foot[0] * ppc), round(piece.foot[1] * ppc)
        index = np.arange(columns)
        after = np.minimum.accumulate(np.append(np.where(bears, index, 10**6), 10**6)[::-1])[::-1]
        before = np.maximum.accumulate(np.insert(np.where(bears, index + 1, -(10**6)), 0, -(10**6)))
        first, last = after[places + low], before[places + high]
        centre = places + piece.middle[0] * ppc
        lean = np.maximum(first - centre, centre - last)
        return np.where(first >= last, 10**6, lean)

    def _keep(self, grown: list[Beginning], level: int, width: int) -> list[Beginning]:
        """Keep the most promising beginnings that could hold, few of each upper row."""
        ranked = sorted(grown, key=lambda begin: -self._promise(begin, level))
        kept: list[Beginning] = []
        tops: dict[bytes, int] = {}
        seen: set[object] = set()
        for begin in ranked[: 8 * width]:
            key = np.where(begin.bears, begin.top, -begin.top).tobytes()
            if tops.get(key, 0) >= _SAME_TOP or begin.sequence in seen or not self.problem.could_hold(begin, level):
                continue
            tops[key] = tops.get(key, 0) + 1
            seen.add(begin.sequence)
            kept.append(begin)
            if len(kept) == width:
                break
        return kept

    def _promise(self, begin: Beginning, level: int) -> float:
        """Estimate what a beginning will gain in the end."""
        height = np.minimum(np.maximum(begin.top, level), len(self.coming) - 1)
        coming = float(self.coming[height, np.arange(self.levels.columns)].sum())
        promise = begin.gain + coming
        if self.given:
            promise -= 0.8 * abs(float(np.dot(begin.left, self.areas)) - coming)
        return promise
