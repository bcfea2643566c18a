"""Simulations shared by several processes: most of an evaluation's time goes there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from typing import TYPE_CHECKING

from stackgen.errors import StackgenError
from stackgen.io.processes import end_with_parent, without_interrupts
from stackgen.protocols import PhysicsNumbers, StabilityChecker, Verdict
from stackgen.stack import Stack

if TYPE_CHECKING:
    from stackgen.sim.physics import Physics

_worker_checker: StabilityChecker | None = None


@contextmanager
def simulating(physics: Physics | None = None, workers: int = 1) -> Iterator[StabilityChecker]:
    """Open a checker that simulates until the first block falls, on one process or shared by several.

    Args:
        physics: Numbers of the simulation; the project's own by default.
        workers: Processes that simulate; 1 is this one.
    """
    from stackgen.sim.checkers import SimulatorChecker  # machines that only train have no PyBullet

    factory = partial(SimulatorChecker, physics, until_fall=True)
    if workers == 1:
        yield factory()
        return
    with ParallelChecker(factory, workers) as checker:
        yield checker


class ParallelChecker(StabilityChecker):
    """A StabilityChecker that shares its work between processes; to be closed, or used in a `with`.

    Args:
        factory: Makes the checker of each process; it must be possible to pickle it.
        workers: Number of processes.
    """

    def __init__(self, factory: Callable[[], StabilityChecker], workers: int) -> None:
        self._physics = factory().physics
        # Spawned, not forked: torch's threads do not survive a fork.
        self._pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (factory,))

    @property
    def physics(self) -> PhysicsNumbers:
        """The numbers that the verdicts depend on."""
        return self._physics

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        return self.check_all([stack])[0]

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order."""
        with without_interrupts():  # the processes start with their first work
            answers = self._pool.map(_check_in_worker, stacks, chunksize=8)
        try:
            return list(answers)
        except BrokenProcessPool as error:
            raise StackgenError(
                "a process that simulates died, killed perhaps for want of memory: try fewer --workers"
            ) from error

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> ParallelChecker:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _start_worker(factory: Callable[[], StabilityChecker]) -> None:
    global _worker_checker
    end_with_parent()
    _worker_checker = factory()


def _check_in_worker(stack: Stack) -> Verdict:
    assert _worker_checker is not None
    return _worker_checker.check(stack)
