"""Which process visits which samples when: pure functions, the same on every process.

Training goes through an endless row of *passes*, each over all samples in an order of its own. A pass
is dealt out in *steps*; in one step every process gets one batch. An epoch is one pass, or as many
steps of the row as were asked for. How a pass is dealt depends on the :class:`Topology`. A pass that was
begun under another topology is finished by dealing out what is left of it.
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
Rank = tuple[int, int]
"""Number of this process and how many there are."""


def process_rank() -> Rank:
    """Give the rank of this process; (0, 1) outside distributed training."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1


@dataclass(frozen=True)
class Topology:
    """Among how many processes and workers a pass is dealt out, and in what batches.

    Args:
        batch_size: Samples a batch, on each process.
        processes: Training processes.
        workers: Reading processes of each that take turns; 1 where it reads by itself.
    """

    batch_size: int
    processes: int
    workers: int = 1

    @property
    def together(self) -> int:
        """Samples a step, over all processes."""
        return self.batch_size * self.processes


@dataclass(frozen=True)
class Cursor:
    """A place in the row of passes.

    Args:
        number: Number of the pass.
        dealt: Steps of it that were taken under each topology; the last is the present one.
        left: Steps until the epoch ends.
    """

    number: int
    dealt: tuple[tuple[Topology, int], ...]
    left: int

    @staticmethod
    def start(number: int, topology: Topology, left: int, step: int = 0) -> Cursor:
        """Point at a step of a pass that has only known one topology."""
        return Cursor(number, ((topology, step),), left)

    @property
    def topology(self) -> Topology:
        """The present topology."""
        return self.dealt[-1][0]

    @property
    def step(self) -> int:
        """Steps taken under the present topology."""
        return self.dealt[-1][1]

    def moved(self) -> Cursor:
        """Point one step further."""
        return replace(self, dealt=(*self.dealt[:-1], (self.topology, self.step + 1)), left=self.left - 1)

    def next_pass(self) -> Cursor:
        """Point at the beginning of the next pass."""
        return Cursor.start(self.number + 1, self.topology, self.left)

    def to_json(self) -> dict[str, Any]:
        """Give the plain form, for checkpoints."""
        dealt = [[there.batch_size, there.processes, there.workers, steps] for there, steps in self.dealt]
        return {"pass": self.number, "dealt": dealt, "left": self.left}

    @staticmethod
    def from_json(data: dict[str, Any]) -> Cursor:
        """Invert :meth:`to_json`."""
        dealt = tuple((Topology(*map(int, there)), int(steps)) for *there, steps in data["dealt"])
        return Cursor(int(data["pass"]), dealt, int(data["left"]))


# In memory: all samples are at hand and can be dealt out one by one.


def training_groups(
    buckets: Iterable[Indices], batch_size: int, rng: np.random.Generator, processes: int = 1
) -> list[Indices]:
    """Deal out a pass: the samples of each step over all processes, in random order, each from one bucket.

    Process `rank` takes `group[rank::processes]` of each. So all processes have the same number of batches, without
    overlap, and at any time batches of the same bucket and size: none waits for another's longer stacks.

    What is left of a bucket after its last whole group waits for another pass, which leaves out
    others; a bucket smaller than one group is one group.

    Args:
        buckets: Indices of the samples of each bucket.
        batch_size: Samples a batch, on each process.
        rng: Random numbers, in the same state on every process.
        processes: Number of processes.
    """
    groups: list[Indices] = []
    for bucket in buckets:
        order = rng.permutation(bucket)
        bounds = _group_bounds(len(order), batch_size, processes)
        groups += [order[start:stop] for start, stop in bounds]
    return [groups[i] for i in rng.permutation(len(groups))]


def number_of_groups(sizes: Iterable[int], batch_size: int, processes: int = 1) -> int:
    """Count the steps of a pass over buckets of these sizes.

    >>> number_of_groups([100, 3], batch_size=16, processes=2)
    4
    """
    return sum(len(_group_bounds(size, batch_size, processes)) for size in sizes)


def _group_bounds(size: int, batch_size: int, processes: int) -> list[tuple[int, int]]:
    together = batch_size * processes
    whole = size // together * together or size // processes * processes
    return [(start, min(start + together, whole)) for start in range(0, whole, together)]


def exact_batches(count: int, batch_size: int, rank: Rank = (0, 1)) -> list[Indices]:
    """Deal out every sample once, in order: equal numbers of batches on all processes, without overlap.

    Raises:
        StackgenError: If there are fewer samples than processes.
    """
    number, processes = rank
    if count < processes:
        raise StackgenError(f"{count} samples cannot be shared by {processes} processes; use fewer")
    share = np.arange(number, count, processes)
    # As many as the longest share needs, but none empty: batches of one may so become batches of two.
    batches = min(math.ceil(math.ceil(count / processes) / batch_size), count // processes)
    return np.array_split(share, batches)


# From shards: they are read one after the other, so each reader is dealt a stretch of a row of shards.

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
    """List all samples, shard by shard in random order."""
    return [Piece(int(i), 0, counts[i]) for i in rng.permutation(len(counts)) if counts[i]]


def cut(pieces: Sequence[Piece], start: int, stop: int) -> list[Piece]:
    """Cut the samples start, ..., stop - 1 out of a row of pieces.

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
    """A row of pieces, dealt out under a topology.

    Each process gets a stretch of the row, equally long; its batches are cut from *windows* of that
    stretch, in which samples are shuffled. Its workers get neighbouring batches, one worker after the
    other, and take turns. The few samples at the end of the row that make no whole step are left out.

    Args:
        pieces: The row.
        topology: Processes, workers and batch size.
    """

    pieces: tuple[Piece, ...]
    topology: Topology

    @cached_property
    def total(self) -> int:
        """Samples in the row."""
        return sum(map(len, self.pieces))

    @cached_property
    def batch_size(self) -> int:
        """Samples a batch: fewer than the topology's if there are not enough for one step."""
        return min(self.topology.batch_size, max(1, self.total // self.topology.processes))

    @cached_property
    def steps(self) -> int:
        """Batches of each process."""
        return self.total // (self.batch_size * self.topology.processes)

    @property
    def batches_per_window(self) -> int:
        """Batches of a whole window; the last of a stretch may have fewer."""
        return max(1, WINDOW // self.batch_size)

    @property
    def windows(self) -> int:
        """Windows of each process."""
        return math.ceil(self.steps / self.batches_per_window)

    def window_batches(self, window: int) -> range:
        """Number the batches of a process that lie in one of its windows."""
        start = window * self.batches_per_window
        return range(start, min(start + self.batches_per_window, self.steps))

    def window(self, rank: int, window: int) -> list[Piece]:
        """List what a process reads for a window."""
        batches = self.window_batches(window)
        begin = rank * self.steps
        return cut(self.pieces, (begin + batches.start) * self.batch_size, (begin + batches.stop) * self.batch_size)

    def worker_batches(self, worker: int, after: int = 0, until: int | None = None) -> range:
        """Number the batches that a worker contributes to the steps after, ..., until - 1 of its process.

        Workers take turns: step i is served by worker i modulo their number.
        """
        workers = self.topology.workers
        share, rest = divmod(self.steps, workers)
        begin = worker * share + min(worker, rest)
        stop = self.steps if until is None else min(until, self.steps)
        return range(begin + _turns(after, worker, workers), begin + _turns(stop, worker, workers))

    def unread(self, steps: int) -> tuple[Piece, ...]:
        """List what is left of the row after some steps: windows not begun, and unfinished ones from their start."""
        rest: list[Piece] = []
        read = np.zeros(self.steps, bool)
        for worker in range(self.topology.workers):
            batches = self.worker_batches(worker, until=steps)
            read[batches.start : batches.stop] = True
        for rank in range(self.topology.processes):
            for window in range(self.windows):
                batches = self.window_batches(window)
                if not read[batches.start : batches.stop].all():
                    rest += self.window(rank, window)
        return (*rest, *cut(self.pieces, self.steps * self.batch_size * self.topology.processes, self.total))


def _turns(steps: int, worker: int, workers: int) -> int:
    """Count how often a worker had its turn in some steps."""
    return (steps - worker + workers - 1) // workers if steps > worker else 0
