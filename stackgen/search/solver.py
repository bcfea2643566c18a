"""The best stacks for any silhouette, by search: rows of blocks, best first, and each candidate judged by statics.

Two searches share the rows. **Best first**: where all shapes have one height, what a row gains does not depend on the
others, so the best combinations come out of a queue in order of their fit (A*, Hart et al. 1968, with the best that
rows above could still gain as the bound); a beginning that nothing on top of it can hold is given up. **Beam**: from
the ground up the rows are packed over the supports that the row below offers; it finds what stands where the first
search drowns in combinations: many rows, thin supports, shapes of different heights.

Lengths in cells, gains in pixels.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.names import Preference
from stackgen.search.balance import LOOSE, Balance, steadied
from stackgen.search.rows import NEVER, Levels, Placed, Row, pack
from stackgen.stack import Layout, Stack, check_block_list, layout
from stackgen.world import Mask, World

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class SearchSettings:
    """How long and for what the search looks.

    Args:
        effort: Multiple of the combinations that are looked at, at most; the same effort gives the same answers.
        seconds: Time for a silhouette [s], where it is not null; the answers then depend on the machine.
        near: How much less IoU than the best answer another layout may have and be an answer too.
        prefer: What comes first: the best `fit`, or of all that fit nearly as well the largest `margin`.

    Raises:
        StackgenError: If a number is out of range.
    """

    effort: float = 1.0
    seconds: float | None = None
    near: float = 0.02
    prefer: Preference = "fit"

    def __post_init__(self) -> None:
        if not (0 < self.effort < np.inf and 0 <= self.near <= 1 and (self.seconds is None or self.seconds > 0)):
            raise StackgenError(
                "search: effort and seconds must be positive and near in 0..1, got"
                f" {self.effort}, {self.seconds} and {self.near}"
            )


@dataclass(frozen=True)
class Answer:
    """A stack that stands, as far as statics can tell.

    Args:
        stack: Its blocks, upright, none inside another and none above its support.
        iou: Front IoU with the target.
        margin: Largest tilt to either side that it survives [rad].
        layout: Shapes of each layer from left to right.
    """

    stack: Stack
    iou: float
    margin: float
    layout: Layout


@dataclass(frozen=True)
class Limits:
    """The blocks that may be used.

    Args:
        most: (S,) blocks that there are of each shape.
        total: Largest number of blocks.
        all_of_them: Whether every one must be used.
    """

    most: Ints
    total: int
    all_of_them: bool = False


_ROWS = 150  # rows of a level that the best-first search knows; all there are, for lists of the paper's world
_LOOKS = 400  # beginnings that it judges
_MENDINGS = 1200  # squares of the numbers of blocks of the finished stacks that are made to stand by small moves
_MENDABLE = 16  # largest number of blocks for which moves are tried
_POPS = 4000  # combinations that it takes out of the queue
_BEAM = 12  # beginnings that the beam keeps at a level, at effort 1
_BRANCH = 10  # rows that are tried on each
_SAME_TOP = 3  # beginnings with the same upper row that the beam keeps
_ENDS = 60  # finished stacks of the beam that are judged
_LEAN = 0.15  # loss for each pixel that a block's centre of mass lies outside its supports, per pixel row of a cell


def solve(
    target: Mask,
    world: World,
    number: int = 3,
    block_list: Ints | None = None,
    inventory: Ints | None = None,
    settings: SearchSettings = SearchSettings(),
) -> list[Answer]:
    """Find stacks that stand and look like a silhouette, of distinct layouts, the best first.

    Args:
        target: (H, W) front silhouette.
        world: Shapes, grid, and the largest number of blocks.
        number: Largest number of answers.
        block_list: (S,) blocks, all of which are to be used; by default the search chooses them.
        inventory: (S,) blocks that there are, of which it chooses.
        settings: How long and for what it looks.

    Returns:
        Answers of distinct layouts whose IoU is within `settings.near` of the best; none if nothing stands.

    Raises:
        StackgenError: If the silhouette is empty or of another size than the grid's, the block list is impossible, or
            the heights of the shapes have no common part.
    """
    mask = np.asarray(target, dtype=bool)
    if mask.shape != (world.grid.image_size,) * 2:
        raise StackgenError(f"search: the silhouette must be {world.grid.image_size} pixels square, got {mask.shape}")
    if not mask.any():
        raise StackgenError("search: nothing is set in the silhouette; draw a structure")
    search = _Search(Levels(mask, world), world, _limits(world, block_list, inventory), settings, number)
    ends = search.best_first() if search.one_height else []
    if len(ends) < number and not search.exhausted:
        ends += search.beam()
    return search.answers(ends)


def _limits(world: World, block_list: Ints | None, inventory: Ints | None) -> Limits:
    if block_list is not None:
        check_block_list(block_list, world.max_blocks)
        return Limits(np.asarray(block_list), int(np.sum(block_list)), all_of_them=True)
    if inventory is not None:
        return Limits(np.minimum(inventory, world.max_blocks), world.max_blocks)
    return Limits(np.full(len(world.catalogue), world.max_blocks), world.max_blocks)


@dataclass(frozen=True)
class _Beginning:
    """What is built up to some level: blocks from the ground up, what they gain, what is left, and what comes on top.

    Args:
        gain: Gain of all blocks [pixel].
        blocks: The blocks.
        left: (S,) blocks that are left, of each shape.
        top: (W,) level up to which each column is taken.
        bears: (W,) whether something can stand on it there.
        sequence: Level and shapes of each row.
    """

    gain: float
    blocks: tuple[Placed, ...]
    left: tuple[int, ...]
    top: NDArray[np.int16]
    bears: NDArray[np.bool_]
    sequence: tuple[tuple[int, tuple[int, ...]], ...] = ()


@dataclass
class _Search:
    levels: Levels
    world: World
    limits: Limits
    settings: SearchSettings
    number: int
    exhausted: bool = False
    began: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        pieces = self.levels.pieces
        self.one_height = all(piece.height == 1 for piece in pieces)
        self.depth = min(self.limits.total, int(self.levels.columns // self.levels.widths.min()), 10)
        self.area = float(self.levels.silhouette.sum())
        self.areas = np.array([shape.area for shape in self.world.catalogue]) * self.world.grid.pixels_per_cell**2
        self.given = self.limits.all_of_them
        self.mendings = round(_MENDINGS * self.settings.effort)
        self.bounded = self.given or bool((self.limits.most < self.limits.total).any())
        z = self.world.grid.vertical("front")
        self.potential = np.stack(
            [self.levels.silhouette[z > k * self.levels.step].sum(axis=0) for k in range(self.levels.number + 8)]
        )

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        seconds = self.settings.seconds
        return seconds is not None and time.perf_counter() - self.began > seconds

    # Best first.

    def best_first(self) -> list[_Beginning]:
        """Find the best combinations of rows that stand, in order of what they gain."""
        left = np.broadcast_to(self.limits.most, (self.levels.number, len(self.limits.most)))
        options = pack(self.levels.gains, self.levels.widths, _ROWS, self.depth, left if self.bounded else None)
        bound = _Bound(options, self.limits, self.given, self.bounded)
        start = self._start()
        found: list[_Beginning] = []
        layouts: set[object] = set()
        tie, looks, pops = count(), int(_LOOKS * self.settings.effort), int(_POPS * self.settings.effort)
        wanted = self.number * (4 if self.settings.prefer == "margin" else 1)
        heap: list[tuple[float, int, _Beginning, int, int]] = []

        def offer(begin: _Beginning, level: int, place: int) -> None:
            gains, _ = bound.order(level, begin.left)
            if place < len(gains) and gains[place] > NEVER / 2:
                heapq.heappush(heap, (-(begin.gain + float(gains[place])), next(tie), begin, level, place))

        offer(start, 0, 0)
        while heap and looks > 0 and pops > 0 and not self.late:
            pops -= 1
            worth, _, begin, level, place = heapq.heappop(heap)
            if found and -worth < found[0].gain - self.settings.near * self.area:
                self.exhausted = True
                break
            offer(begin, level, place + 1)
            row = options[level][bound.order(level, begin.left)[1][place]]
            if row.blocks and not self._touches(begin, row, level):
                continue
            end = self._on(begin, row, level) if row.blocks else begin
            finished = not row.blocks or level + 1 == len(options)
            if finished and (not end.blocks or (self.given and any(end.left)) or end.sequence in layouts):
                continue
            looks -= 1
            if finished:
                if standing := self._standing(end):
                    found.append(standing)
                    layouts.add(end.sequence)
                    if len(found) == wanted:
                        self.exhausted = True
                        break
            elif self._could_hold(end, level + 1):
                offer(end, level + 1, 0)
        if not heap and found:
            self.exhausted = True
        return found

    def _start(self) -> _Beginning:
        ground = np.ones(self.levels.columns, dtype=bool)
        return _Beginning(0.0, (), tuple(self.limits.most.tolist()), np.zeros(self.levels.columns, np.int16), ground)

    def _touches(self, begin: _Beginning, row: Row, level: int) -> bool:
        """Tell whether each block of a row has something under it."""
        if level == 0:
            return True
        bears = begin.bears & (begin.top == level)
        return all(bears[max(a - 1, 0) : a + self.levels.pieces[s].width + 1].any() for s, a in row.blocks)

    def _on(self, begin: _Beginning, row: Row, level: int) -> _Beginning:
        """Put a row on a beginning."""
        top, bears, left = begin.top.copy(), begin.bears.copy(), list(begin.left)
        for s, a in row.blocks:
            piece = self.levels.pieces[s]
            top[a : a + piece.width] = level + piece.height
            bears[a : a + piece.width] = False
            if piece.head is not None:
                ppc = self.world.grid.pixels_per_cell
                first, last = np.ceil(piece.head[0] * ppc - 1e-6), np.floor(piece.head[1] * ppc + 1e-6)
                bears[a + int(first) : a + int(last)] = True
            left[s] -= 1
        blocks = begin.blocks + tuple(Placed(s, a, level) for s, a in row.blocks)
        sequence = (*begin.sequence, (level, row.shapes))
        return _Beginning(begin.gain + row.gain, blocks, tuple(left), top, bears, sequence)

    def _could_hold(self, begin: _Beginning, level: int) -> bool:
        """Tell whether blocks could hold each other with some weight on those whose heads are still free."""
        balance = Balance(begin.blocks, self.levels, inset=-LOOSE)
        free = [
            i
            for i, block in enumerate(begin.blocks)
            if self.levels.pieces[block.shape].head is not None
            and block.level + self.levels.pieces[block.shape].height >= level
        ]
        return balance.holds(loaded=free)

    def _standing(self, end: _Beginning) -> _Beginning | None:
        """Give what is finished as it stands, where it must after small moves; None if it does not stand."""
        if Balance(end.blocks, self.levels).stands:
            return end
        if self.mendings <= 0 or len(end.blocks) > _MENDABLE:
            return None
        self.mendings -= len(end.blocks) ** 2
        moved = steadied(end.blocks, self.levels)
        return None if moved is None else replace(end, blocks=moved)

    # Beam.

    def beam(self) -> list[_Beginning]:
        """Build from the ground up, each row over the supports that it has."""
        width = max(2, round(_BEAM * self.settings.effort))
        beginnings, ends = [self._start()], []
        highest = self.levels.number
        for level in range(highest):
            grown: list[_Beginning] = []
            for begin, rows in zip(beginnings, self._rows_on(beginnings, level), strict=True):
                ends.append(begin)
                grown += [self._on(begin, row, level) for row in rows if row.blocks]
                if begin.blocks and (begin.top > level).any():
                    grown.append(begin)
            beginnings = self._keep(grown, level + 1, width)
            if not beginnings or self.late:
                break
        ends += beginnings
        done = [end for end in ends if end.blocks and not (self.given and any(end.left))]
        done.sort(key=lambda end: -end.gain)
        standing, layouts = [], set()
        for end in done[: round(_ENDS * max(1.0, self.settings.effort))]:
            if end.sequence not in layouts and (stood := self._standing(end)):
                standing.append(stood)
                layouts.add(end.sequence)
        return standing

    def _rows_on(self, beginnings: Sequence[_Beginning], level: int) -> list[list[Row]]:
        """Pack rows on each of some beginnings: some with all centres over their supports, some that lean."""
        widths, keep, ppc = self.levels.widths, _BRANCH, self.world.grid.pixels_per_cell
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
        total = np.array([self.limits.total - len(begin.blocks) for begin in beginnings])
        rows = pack(gains, widths, keep, max(1, min(self.depth, int(total.max()))), left)
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

    def _keep(self, grown: list[_Beginning], level: int, width: int) -> list[_Beginning]:
        """Keep the most promising beginnings that could hold, few of each upper row."""
        ranked = sorted(grown, key=lambda begin: -self._promise(begin, level))
        kept: list[_Beginning] = []
        tops: dict[bytes, int] = {}
        seen: set[object] = set()
        for begin in ranked[: 8 * width]:
            key = np.where(begin.bears, begin.top, -begin.top).tobytes()
            if tops.get(key, 0) >= _SAME_TOP or begin.sequence in seen or not self._could_hold(begin, level):
                continue
            tops[key] = tops.get(key, 0) + 1
            seen.add(begin.sequence)
            kept.append(begin)
            if len(kept) == width:
                break
        return kept

    def _promise(self, begin: _Beginning, level: int) -> float:
        """Estimate what a beginning will gain in the end."""
        height = np.minimum(np.maximum(begin.top, level), len(self.potential) - 1)
        coming = float(self.potential[height, np.arange(self.levels.columns)].sum())
        promise = begin.gain + coming
        if self.given:
            promise -= 0.8 * abs(float(np.dot(begin.left, self.areas)) - coming)
        return promise

    # Answers.

    def answers(self, ends: Sequence[_Beginning]) -> list[Answer]:
        """Make stacks of what was found: distinct layouts near the best, the best first."""
        grid = self.world.grid
        found: dict[Layout, tuple[float, _Beginning, Stack]] = {}
        for end in ends:
            stack = self._stack(end.blocks)
            kind = layout(stack, grid)
            alike = silhouette_iou(stack, self.levels.silhouette, grid)
            if kind not in found or found[kind][0] < alike:
                found[kind] = (alike, end, stack)
        best = max((alike for alike, _, _ in found.values()), default=0.0)
        near = [(a, k, e, s) for k, (a, e, s) in found.items() if a >= best - self.settings.near - 1e-9]
        answers = [
            Answer(stack, alike, float(np.arctan(Balance(end.blocks, self.levels).slope())), kind)
            for alike, kind, end, stack in near
        ]
        if self.settings.prefer == "margin":
            answers.sort(key=lambda answer: (-round(answer.margin, 3), -answer.iou))
        else:
            answers.sort(key=lambda answer: (-round(answer.iou, 3), -answer.margin))
        return answers[: self.number]

    def _stack(self, blocks: Sequence[Placed]) -> Stack:
        """Make the stack of some blocks, each in the middle of its columns."""
        ppc, step = self.world.grid.pixels_per_cell, self.levels.step
        poses = np.zeros((len(blocks), 6))
        for i, (shape, a, level) in enumerate(blocks):
            poses[i, 0] = self.levels.left_end(a) + self.levels.pieces[shape].width / ppc / 2
            poses[i, 2] = level * step + self.world.catalogue[shape].size[2] / 2
        return Stack(np.array([block.shape for block in blocks], dtype=np.int64), poses, self.world.catalogue)


class _Bound:
    """The best that rows from a level on can still gain with the blocks that are left, whatever lies under them."""

    def __init__(self, options: Sequence[Sequence[Row]], limits: Limits, given: bool, bounded: bool) -> None:
        self.options, self.given, self.bounded = options, given, bounded
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
