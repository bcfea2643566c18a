"""Who is visited when, by which process: pure functions, the same on every process.

Training goes through an endless row of *passes*, each over all samples in an order of its own. A pass
is dealt out in *steps*; in one step every process gets one batch. An epoch is one pass, or as many
steps of the row as were asked for. How a pass is dealt depends on the :class:`Layout`; one that was
begun under another layout is gone on with by dealing out what is left of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stackgen.errors import StackgenError

Indices = NDArray[np.int64]
Place = tuple[int, int]


def process_place() -> Place:
    """(rank, world size) of this process; (0, 1) outside distributed training."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


@dataclass(frozen=True)
class Layout:
    """How a pass is dealt out.

    Args:
        batch_size: Samples a batch, on each process.
        world: Processes.
        workers: Reading processes of each that take turns; 1 where it reads by itself.
    """

    batch_size: int
    world: int
    workers: int = 1

    @property
    def together(self) -> int:
        """Samples a step, over all processes."""
        return self.batch_size * self.world


@dataclass(frozen=True)
class Cursor:
    """A place in the row of passes.

    Args:
        number: Of the pass.
        dealt: The steps of it that were taken, under each layout; the last is the present one.
        left: Steps until the epoch ends.
    """

    number: int
    dealt: tuple[tuple[Layout, int], ...]
    left: int

    @staticmethod
    def start(number: int, layout: Layout, left: int, step: int = 0) -> Cursor:
        """At a step of a pass that has only known one layout."""
        return Cursor(number, ((layout, step),), left)

    @property
    def layout(self) -> Layout:
        """The present one."""
        return self.dealt[-1][0]

    @property
    def step(self) -> int:
        """Steps taken under the present layout."""
        return self.dealt[-1][1]

    def moved(self) -> Cursor:
        """One step on."""
        return replace(self, dealt=(*self.dealt[:-1], (self.layout, self.step + 1)), left=self.left - 1)

    def next_pass(self) -> Cursor:
        """At the beginning of the next pass."""
        return Cursor.start(self.number + 1, self.layout, self.left)

    def to_json(self) -> dict[str, Any]:
        """Plain form, for checkpoints."""
        dealt = [[layout.batch_size, layout.world, layout.workers, steps] for layout, steps in self.dealt]
        return {"pass": self.number, "dealt": dealt, "left": self.left}

    @staticmethod
    def from_json(data: dict[str, Any]) -> Cursor:
        """Inverse of :meth:`to_json`."""
        dealt = tuple((Layout(*map(int, layout)), int(steps)) for *layout, steps in data["dealt"])
        return Cursor(int(data["pass"]), dealt, int(data["left"]))


# In memory: whoever holds all samples can deal them out one by one.


def training_groups(
    buckets: Iterable[Indices], batch_size: int, rng: np.random.Generator, world: int = 1
) -> list[Indices]:
    """The samples of each step of a pass, over all processes, in random order, each from one bucket.

    What is left of a bucket after its last whole group waits for another pass, which leaves out
    others; a bucket smaller than one group is one group.

    Args:
        buckets: Indices of the samples of each bucket.
        batch_size: Of each process.
        rng: In the same state on every process.
        world: Processes.
    """
    groups: list[Indices] = []
    for bucket in buckets:
        order = rng.permutation(bucket)
        bounds = _group_bounds(len(order), batch_size, world)
        groups += [order[start:stop] for start, stop in bounds]
    return [groups[i] for i in rng.permutation(len(groups))]


def training_batches(
    buckets: Iterable[Indices], batch_size: int, rng: np.random.Generator, place: Place = (0, 1)
) -> list[Indices]:
    """One process's share of :func:`training_groups`.

    All processes get the same number of batches, without overlap, and at any time batches of the
    same bucket and size, so that none waits for another's longer stacks.
    """
    rank, world = place
    return [group[rank::world] for group in training_groups(buckets, batch_size, rng, world)]


def number_of_groups(sizes: Iterable[int], batch_size: int, world: int = 1) -> int:
    """Steps of a pass over buckets of these sizes.

    >>> number_of_groups([100, 3], batch_size=16, world=2)
    4
    """
    return sum(len(_group_bounds(size, batch_size, world)) for size in sizes)


def _group_bounds(size: int, batch_size: int, world: int) -> list[tuple[int, int]]:
    together = batch_size * world
    whole = size // together * together or size // world * world
    return [(start, min(start + together, whole)) for start in range(0, whole, together)]


def exact_batches(count: int, batch_size: int, place: Place = (0, 1)) -> list[Indices]:
    """Every sample once, in order: equal numbers of batches on all processes, without overlap.

    Raises:
        StackgenError: If there are fewer samples than processes.
    """
    rank, world = place
    if count < world:
        raise StackgenError(f"{count} samples cannot be shared by {world} processes; use fewer")
    share = np.arange(rank, count, world)
    # As many as the longest share needs, but none empty: batches of one may so become batches of two.
    batches = min(math.ceil(math.ceil(count / world) / batch_size), count // world)
    return np.array_split(share, batches)


# From shards: whoever reads them one after the other is dealt stretches of a row of shards.

WINDOW = 16_384
"""Samples that a reader holds and shuffles at a time: 13 MB of the paper's stacks."""


@dataclass(frozen=True)
class Piece:
    """The samples start, ..., stop - 1 of a shard."""

    shard: int
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


def shuffled_shards(counts: Sequence[int], rng: np.random.Generator) -> list[Piece]:
    """All samples, shard by shard in random order."""
    return [Piece(int(i), 0, counts[i]) for i in rng.permutation(len(counts)) if counts[i]]


def cut(pieces: Sequence[Piece], start: int, stop: int) -> list[Piece]:
    """The samples start, ..., stop - 1 of a row of pieces.

    >>> cut([Piece(7, 0, 10), Piece(3, 5, 10)], 8, 12)
    [Piece(shard=7, start=8, stop=10), Piece(shard=3, start=5, stop=7)]
    """
    ends = np.cumsum([len(piece) for piece in pieces])
    found = []
    for i in range(int(np.searchsorted(ends, start, side="right")), len(pieces)):
        piece, begin = pieces[i], int(ends[i]) - len(pieces[i])
        if begin >= stop:
            break
        found.append(
            Piece(piece.shard, piece.start + max(0, start - begin), piece.start + min(len(piece), stop - begin))
        )
    return found


@dataclass(frozen=True)
class Deal:
    """A row of pieces, dealt out under a layout.

    Each process gets a stretch of the row, equally long; its batches are cut from *windows* of that
    stretch, in which samples are shuffled. Its workers get neighbouring batches, one worker after the
    other, and take turns. The few samples at the end of the row that make no whole step are left out.

    Args:
        pieces: Of the row.
        layout: Under which it is dealt.
    """

    pieces: tuple[Piece, ...]
    layout: Layout

    @cached_property
    def total(self) -> int:
        """Samples in the row."""
        return sum(map(len, self.pieces))

    @cached_property
    def batch_size(self) -> int:
        """Of each process: smaller than the layout's if there are not enough samples for one step."""
        return min(self.layout.batch_size, max(1, self.total // self.layout.world))

    @cached_property
    def steps(self) -> int:
        """Batches of each process."""
        return self.total // (self.batch_size * self.layout.world)

    @property
    def batches_per_window(self) -> int:
        """Of a whole window; the last of a stretch may have fewer."""
        return max(1, WINDOW // self.batch_size)

    @property
    def windows(self) -> int:
        """Of each process."""
        return math.ceil(self.steps / self.batches_per_window)

    def window_batches(self, window: int) -> range:
        """The batches of a process that lie in one of its windows."""
        start = window * self.batches_per_window
        return range(start, min(start + self.batches_per_window, self.steps))

    def window(self, rank: int, window: int) -> list[Piece]:
        """What a process reads for a window."""
        batches = self.window_batches(window)
        begin = rank * self.steps
        return cut(self.pieces, (begin + batches.start) * self.batch_size, (begin + batches.stop) * self.batch_size)

    def worker_batches(self, worker: int, after: int = 0, until: int | None = None) -> range:
        """The batches that a worker contributes to the steps after, ..., until - 1 of its process.

        Workers take turns: step i is served by worker i modulo their number.
        """
        workers = self.layout.workers
        share, rest = divmod(self.steps, workers)
        begin = worker * share + min(worker, rest)
        stop = self.steps if until is None else min(until, self.steps)
        return range(begin + _turns(after, worker, workers), begin + _turns(stop, worker, workers))

    def unread(self, steps: int) -> tuple[Piece, ...]:
        """What is left of the row after some steps: windows not begun, and not finished ones from their start."""
        rest: list[Piece] = []
        read = np.zeros(self.steps, bool)
        for worker in range(self.layout.workers):
            batches = self.worker_batches(worker, until=steps)
            read[batches.start : batches.stop] = True
        for rank in range(self.layout.world):
            for window in range(self.windows):
                batches = self.window_batches(window)
                if not read[batches.start : batches.stop].all():
                    rest += self.window(rank, window)
        return (*rest, *cut(self.pieces, self.steps * self.batch_size * self.layout.world, self.total))


def _turns(steps: int, worker: int, workers: int) -> int:
    """How often a worker had its turn in some steps."""
    return (steps - worker + workers - 1) // workers if steps > worker else 0
