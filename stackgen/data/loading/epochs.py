"""What both training loaders share: epochs as stretches of an endless row of passes, and how they are resumed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

from stackgen.data.arrays import Batch
from stackgen.data.loading.passes import Cursor, Rank, Topology
from stackgen.errors import StackgenError


class Epochs(ABC):
    """Training batches; what they are depends on seed, epoch and topology alone.

    An epoch is one pass over the samples, or the next `samples_per_epoch` of an endless row of passes.
    After :meth:`load_state_dict` the next iteration, if it is of the same epoch, continues where that was left,
    on another number of processes too.

    Args:
        batch_size: Samples a batch, on each process.
        samples_per_epoch: Samples an epoch, over all processes; None for one pass.
        seed: Seed of order and reflections.
        epoch: Gives the epoch's number at its start; by default epochs are counted.
        rank: Gives the rank of this process.
        workers: Reading processes of each process.
    """

    def __init__(
        self,
        batch_size: int,
        samples_per_epoch: int | None,
        seed: int,
        epoch: Callable[[], int] | None,
        rank: Callable[[], Rank],
        workers: int = 1,
    ) -> None:
        self.batch_size, self.samples_per_epoch, self.seed, self.rank = batch_size, samples_per_epoch, seed, rank
        self._epoch, self._workers = epoch, workers
        self._passed = 0  # epochs begun
        self._state: dict[str, Any] = {"epoch": -1, "batches": 0}  # where the last iteration is
        self._before = self._state  # one batch earlier
        self.in_hand: Callable[[], bool] = lambda: False  # whether the last batch was taken but not learnt from
        self._resume: tuple[int, int, Cursor] | None = None  # epoch, batches done in it, cursor
        self._leftover_length: int | None = None

    @abstractmethod
    def _steps(self, start: Cursor) -> int:
        """Count the steps of a pass under the present topology, from its beginning there."""

    @abstractmethod
    def _deal(self, cursor: Cursor) -> Iterator[Batch]:
        """Yield this process's batches from a cursor to the end of the pass or of the epoch, whichever comes first."""

    @property
    def topology(self) -> Topology:
        """How passes are dealt out here and now."""
        return Topology(self.batch_size, self.rank()[1], self._workers)

    @property
    def is_leftover(self) -> bool:
        """Whether an epoch that was begun under another topology is being finished: its length is its own."""
        return self._leftover_length is not None

    def __len__(self) -> int:
        """Batches an epoch on this process: the same on all."""
        return self._leftover_length if self._leftover_length is not None else self._length()

    def __iter__(self) -> Iterator[Batch]:
        epoch = self._epoch() if self._epoch else self._passed
        self._passed = epoch + 1
        resume, self._resume = self._resume, None
        if resume is not None and resume[0] == epoch:
            _, done, cursor = resume
        else:
            done, cursor, self._leftover_length = 0, self._beginning(epoch), None
        self._state = {"epoch": epoch, "batches": done, **cursor.to_json()}
        while cursor.left > 0:
            for batch in self._deal(cursor):
                cursor, done = cursor.moved(), done + 1
                self._before, self._state = self._state, {"epoch": epoch, "batches": done, **cursor.to_json()}
                yield batch
            cursor = cursor.next_pass()

    def state_dict(self) -> dict[str, Any]:
        """Say where the epoch is, for checkpoints. A batch that is in hand is still to come."""
        return dict(self._before if self.in_hand() else self._state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Let the next iteration, if it is of the same epoch, continue from there."""
        epoch, done = int(state["epoch"]), int(state["batches"])
        self._leftover_length = None
        if epoch < 0:
            self._resume = None
        elif "dealt" not in state:  # written by a version that knew one topology only
            self._resume = epoch, done, self._beginning(epoch, done)
        else:
            cursor = Cursor.from_json(state)
            if cursor.topology != self.topology:
                cursor = self._dealt_again(cursor)
            if len(cursor.dealt) > 1:
                self._leftover_length = done + cursor.left
            self._resume = epoch, done, cursor

    def _length(self) -> int:
        if self.samples_per_epoch is not None:
            return max(1, self.samples_per_epoch // self.topology.together)
        return self._whole_pass()

    def _whole_pass(self) -> int:
        steps = self._steps(Cursor.start(0, self.topology, 0))
        if not steps:
            raise StackgenError(f"there are fewer training samples than the {self.topology.processes} processes")
        return steps

    def _beginning(self, epoch: int, done: int = 0) -> Cursor:
        """Find an epoch's step if every epoch so far had this topology."""
        length = self._length()
        number, step = divmod(epoch * length + done, self._whole_pass())
        return Cursor.start(number, self.topology, length - done, step)

    def _dealt_again(self, cursor: Cursor) -> Cursor:
        """Deal out what is left of the pass under the present topology."""
        here = Cursor(cursor.number, (*cursor.dealt, (self.topology, 0)), 0)
        if self.samples_per_epoch is None:
            left = self._steps(here) if cursor.left else 0
        else:
            left = -(-cursor.left * cursor.topology.together // self.topology.together)
        return Cursor(here.number, here.dealt, left)
