"""Best first: where all shapes have one height, what a row gains does not depend on the others.

So the best combinations of rows come out of a queue in order of their fit (A*, Hart et al. 1968), with the best that
rows above could still gain as the bound. A beginning that nothing on top of it can hold is given up.

Gains in pixels.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from itertools import count

import numpy as np
from numpy.typing import NDArray

from stackgen.search.problem import CANDIDATES, Beginning, Ints, Limits, Problem
from stackgen.search.rows import NEVER, Row, pack

_ROWS = 150  # rows of a level that the search knows; all there are, for lists of the paper's world
_POPS = 4000  # combinations that it takes out of the queue, at effort 1
_SPARE = 4  # stacks of which one is delivered, where the largest margin comes first


def best_first(problem: Problem) -> tuple[list[Beginning], bool]:
    """Find the best combinations of rows that stand, in order of what they gain.

    Returns:
        The stacks, and whether no other can be better or another answer.
    """
    levels, limits, settings = problem.levels, problem.limits, problem.settings
    bounded = limits.all_of_them or bool((limits.most < limits.total).any())
    left = np.broadcast_to(limits.most, (levels.number, len(limits.most)))
    options = pack(levels.gains, levels.widths, _ROWS, problem.depth, left if bounded else None)
    bound = _Bound(options, limits, bounded)
    looks, pops = int(CANDIDATES * settings.effort), int(_POPS * settings.effort)
    wanted = problem.number * (_SPARE if settings.prefer == "margin" else 1)
    worst = settings.near * float(levels.silhouette.sum())
    found: list[Beginning] = []
    layouts: set[object] = set()
    tie = count()
    heap: list[tuple[float, int, Beginning, int, int]] = []

    def offer(begin: Beginning, level: int, place: int) -> None:
        gains, _ = bound.order(level, begin.left)
        if place < len(gains) and gains[place] > NEVER / 2:
            heapq.heappush(heap, (-(begin.gain + float(gains[place])), next(tie), begin, level, place))

    offer(problem.start(), 0, 0)
    while heap and looks > 0 and pops > 0 and not problem.late:
        pops -= 1
        worth, _, begin, level, place = heapq.heappop(heap)
        if found and -worth < found[0].gain - worst:
            return found, True
        offer(begin, level, place + 1)
        row = options[level][bound.order(level, begin.left)[1][place]]
        if row.blocks and not _touches(begin, row, level, problem):
            continue
        end = problem.on(begin, row, level) if row.blocks else begin
        finished = not row.blocks or level + 1 == len(options)
        if finished and (not end.blocks or (limits.all_of_them and any(end.left)) or end.sequence in layouts):
            continue
        looks -= 1
        if not finished:
            if problem.could_hold(end, level + 1):
                offer(end, level + 1, 0)
        elif standing := problem.standing(end):
            found.append(standing)
            layouts.add(end.sequence)
            if len(found) == wanted:
                return found, True
    return found, bool(found) and not heap


def _touches(begin: Beginning, row: Row, level: int, problem: Problem) -> bool:
    """Tell whether each block of a row has something under it."""
    if level == 0:
        return True
    bears = begin.bears & (begin.top == level)
    return all(bears[max(a - 1, 0) : a + problem.levels.pieces[s].width + 1].any() for s, a in row.blocks)


class _Bound:
    """The best that rows from a level on can still gain with the blocks that are left, whatever lies under them."""

    def __init__(self, options: Sequence[Sequence[Row]], limits: Limits, bounded: bool) -> None:
        self.given, self.bounded = limits.all_of_them, bounded
        shapes = len(limits.most)
        self.counts = [
            np.array(
                [np.bincount(row.shapes, minlength=shapes) if row.blocks else np.zeros(shapes, int) for row in rows]
            )
            for rows in options
        ]
        self.gains = [np.array([row.gain for row in rows]) for rows in options]
        self.total = limits.total
        self.most = limits.most
        size = int(np.prod(limits.most + 1.0)) if bounded else limits.total + 1
        self.table = self._table() if (not bounded or size <= 20_000) else None
        self.cache: dict[tuple[int, tuple[int, ...]], tuple[NDArray[np.float64], Ints]] = {}

    def _key(self, left: Sequence[int]) -> tuple[int, ...]:
        """Give what matters of the blocks that are left."""
        return tuple(left) if self.bounded else (self.total - int(np.sum(self.most)) + int(sum(left)),)

    def _table(self) -> list[NDArray[np.float64]]:
        """Tabulate, by what is left, the best that the rows from each level on gain; finishing early gains nothing."""
        shape = tuple(self.most + 1) if self.bounded else (self.total + 1,)
        last = np.full(shape, 0.0 if not self.given else float(NEVER))
        last[(0,) * len(shape)] = 0.0
        tables = [last]
        for counts, gains in zip(reversed(self.counts), reversed(self.gains), strict=True):
            uses = counts if self.bounded else counts.sum(axis=1, keepdims=True)
            best: dict[tuple[int, ...], float] = {}
            for use, gain in zip(map(tuple, uses.tolist()), gains.tolist(), strict=True):
                best[use] = max(gain, best.get(use, -np.inf))
            table = last.copy()
            for use, gain in best.items():
                if not any(use) or any(u >= n for u, n in zip(use, shape, strict=True)):
                    continue
                to = tuple(slice(u, None) for u in use)
                of = tuple(slice(None, n - u) for u, n in zip(use, shape, strict=True))
                np.maximum(table[to], gain + tables[0][of], out=table[to])
            tables.insert(0, table)
        return tables

    def order(self, level: int, left: tuple[int, ...]) -> tuple[NDArray[np.float64], Ints]:
        """Sort the rows of a level by the best that they and what comes above them gain; give these gains too."""
        key = (level, self._key(left))
        if key not in self.cache:
            counts = self.counts[level]
            rest = np.asarray(left) - counts
            ok = (rest >= 0).all(axis=1)
            if not self.bounded:
                ok &= counts.sum(axis=1) <= key[1][0]
            worth = np.full(len(counts), float(NEVER))
            if self.table is None:
                above = sum(float(gains.max()) for gains in self.gains[level + 1 :])
                worth[ok] = self.gains[level][ok] + above
            else:
                inside = rest[ok].T if self.bounded else (key[1][0] - counts[ok].sum(axis=1))[None]
                worth[ok] = self.gains[level][ok] + self.table[level + 1][tuple(inside)]
            empty = counts.sum(axis=1) == 0
            worth[empty] = 0.0 if not self.given or not any(left) else float(NEVER)
            order = np.argsort(-worth, kind="stable")
            self.cache[key] = (worth[order], order)
        return self.cache[key]
