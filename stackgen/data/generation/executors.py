"""Executors that make the shards: processes of this machine, or a Ray cluster.

An executor maps a function over numbers and hands the results over as they come, in any order. It asks for
the next number only when it has a process free, so the numbers may be endless: the caller stops
asking when it has enough. What the function answers depends on its number alone, so nothing depends on the executor.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal, Protocol, TypeVar

from stackgen.errors import StackgenError, require
from stackgen.io.processes import end_with_parent, without_interrupts

ExecutorName = Literal["local", "ray"]
T = TypeVar("T")

ATTEMPTS = 5
"""Workers that may die over one number before the run gives up: a number that kills is not tried for ever."""


class Executor(Protocol):
    """Maps a function over numbers."""

    def map(self, task: Callable[[int], T], numbers: Iterable[int]) -> Generator[tuple[int, T], None, None]:
        """Yield each number with its result, as they come; closing the iterator ends all work.

        Raises:
            StackgenError: If workers die again and again.
        """
        ...


def make_executor(name: ExecutorName, workers: int | None = None) -> Executor:
    """Make an executor by its name.

    Args:
        name: `local` or `ray`.
        workers: Number of processes; by default one for each core, of this machine or of the cluster.

    Raises:
        StackgenError: If there is no such executor, or less than one worker.
    """
    if workers is not None and workers < 1:
        raise StackgenError(f"generate: workers must be at least 1, got {workers}")
    if name == "local":
        return LocalExecutor(workers or os.cpu_count() or 1)
    if name == "ray":
        return RayExecutor(workers)
    raise StackgenError(f"generate: there is no executor {name!r}; there are local and ray")


@dataclass(frozen=True)
class _Answer:
    """Message of a worker: a result, or the error in its place."""

    result: Any = None
    error: Exception | None = None


@dataclass
class _Worker:
    """A process, this side of its pipe, and the number it works on."""

    process: BaseProcess
    pipe: Connection
    number: int

    def end(self) -> None:
        """Kill it, whatever it does."""
        self.pipe.close()
        self.process.kill()
        self.process.join()


@dataclass(frozen=True)
class LocalExecutor:
    """Processes of this machine. One that dies, killed for want of memory say, is replaced and its number
    given to the next; each has a pipe of its own, so that no process can leave a lock behind.

    Args:
        workers: Number of processes.
    """

    workers: int

    def map(self, task: Callable[[int], T], numbers: Iterable[int]) -> Generator[tuple[int, T], None, None]:
        """See :class:`Executor`."""
        waiting = iter(numbers)
        deaths: dict[int, int] = {}
        team = [_start(task, number) for number in islice(waiting, self.workers)]
        try:
            while team:
                # A dead process closes its end of the pipe: what it had sent whole can still be read.
                ready = wait([worker.pipe for worker in team])
                for worker in [worker for worker in team if worker.pipe in ready]:
                    number = worker.number
                    answer = _receive(worker)
                    if answer is None:
                        deaths[number] = deaths.get(number, 0) + 1
                        if deaths[number] >= ATTEMPTS:
                            raise _given_up(number)
                        team[team.index(worker)] = _start(task, number)
                        continue
                    if not _next(worker, waiting):
                        team.remove(worker)
                    if answer.error is not None:
                        raise answer.error
                    yield number, answer.result
        finally:
            for worker in team:
                worker.end()


def _given_up(number: int) -> StackgenError:
    return StackgenError(
        f"generate: {ATTEMPTS} worker processes died over shard {number}, killed perhaps for want of memory; "
        "finished shards are kept: run the command again, with fewer --workers if memory is short"
    )


def _start(task: Callable[[int], T], number: int) -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(task, there), daemon=True)
    with without_interrupts():
        process.start()
    there.close()  # else the pipe would not end with the process
    worker = _Worker(process, here, number)
    _send(worker, number)
    return worker


def _send(worker: _Worker, number: int) -> None:
    worker.number = number
    with contextlib.suppress(OSError):  # it died meanwhile: found when its answer is awaited
        worker.pipe.send(number)


def _next(worker: _Worker, waiting: Iterator[int]) -> bool:
    """Give a worker its next number before its result is looked at; if there is none, let it go."""
    number = next(waiting, None)
    if number is None:
        worker.end()
        return False
    _send(worker, number)
    return True


def _receive(worker: _Worker) -> _Answer | None:
    """Receive the answer of a worker, None if it died."""
    try:
        return worker.pipe.recv()
    except (EOFError, OSError):
        worker.end()
        return None


def _work(task: Callable[[int], T], pipe: Connection) -> None:
    """Answer numbers in the worker process until the pipe is closed."""
    end_with_parent()
    with contextlib.suppress(EOFError, OSError):
        while True:
            number = pipe.recv()
            try:
                answer = _Answer(task(number))
            except MemoryError:
                os._exit(1)  # as if the system had killed it
            except Exception as error:  # noqa: BLE001 - raised again where it can be reported
                answer = _Answer(error=error)
            pipe.send(answer)


@dataclass(frozen=True)
class RayExecutor:
    """A Ray cluster: the one that RAY_ADDRESS names, else one that runs on this machine, else a new one for
    the length of the run. Only results travel, so the machines need not share a file system; stackgen must be
    installed on each, in the same version.

    Args:
        workers: Tasks at a time; by default one for each CPU of the cluster.
    """

    workers: int | None = None

    def map(self, task: Callable[[int], T], numbers: Iterable[int]) -> Generator[tuple[int, T], None, None]:
        """See :class:`Executor`."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else it warns about what it will do
        ray = require("ray", "ray")
        mine = not ray.is_initialized()
        if mine:
            try:
                ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
            except Exception as error:  # it raises bare ones, too
                raise StackgenError(f"generate: no Ray cluster answers: {' '.join(str(error).split())}") from error
        try:
            yield from self._map(ray, task, iter(numbers))
        finally:
            if mine:
                ray.shutdown()

    def _map(self, ray: Any, task: Callable[[int], T], waiting: Iterator[int]) -> Iterator[tuple[int, T]]:
        # A task is tried again when its process or its machine dies, not when it raises an error.
        remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_call)
        shared = ray.put(task)
        places = self.workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        running = {remote.remote(shared, number): number for number in islice(waiting, places)}
        try:
            while running:
                done, _ = ray.wait(list(running), num_returns=1)
                number = running.pop(done[0])
                following = next(waiting, None)
                if following is not None:
                    running[remote.remote(shared, following)] = following
                try:
                    content = ray.get(done[0])
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from error
                except ray.exceptions.RayError as error:
                    raise _given_up(number) from error
                yield number, content
        finally:
            for reference in running:
                ray.cancel(reference, force=True)


def _call(task: Callable[[int], T], number: int) -> T:
    return task(number)
