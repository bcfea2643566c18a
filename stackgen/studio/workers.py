"""Processes that do the heavy work, shared fairly: clients take turns, and what is cancelled is killed at once.

A process is forked from one that has everything imported, so a new one is there in a moment.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import signal
import tempfile
import traceback
from collections import OrderedDict, deque
from collections.abc import AsyncGenerator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import BaseModel

from stackgen.errors import StackgenError, printable

MOST_WAITING = 8
"""Requests of one client that wait, at most."""

MOST_CLIENTS = 64
"""Clients that wait, at most."""


class Busy(StackgenError):
    """Too many requests wait already."""


class Refused(StackgenError):
    """The work found that the request cannot be answered; the message says why."""


class Broken(Exception):
    """The process that did the work is gone, or has a bug; the message is for the log."""


class Workers:
    """A few processes and the queue before them.

    Args:
        number: Number of processes.
    """

    def __init__(self, number: int) -> None:
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["stackgen.studio.work.tasks"])
        self._waiting: OrderedDict[str, deque[asyncio.Future[_Process]]] = OrderedDict()
        self._threads = ThreadPoolExecutor(number + 2, "studio")
        self._number, self._closed = number, False
        self._idle: deque[_Process] = deque()
        self._starting: set[asyncio.Task[None]] = set()

    def open(self) -> None:
        """Start the processes; they take work once they are ready."""
        for _ in range(self._number):
            self._add()

    def _add(self) -> None:
        task = asyncio.create_task(self._begin())
        self._starting.add(task)
        task.add_done_callback(self._starting.discard)

    async def _begin(self) -> None:
        # The first one waits for the imports of the process that all are forked from.
        make = partial(_Process, self._context, self._threads)
        process = await asyncio.get_running_loop().run_in_executor(self._threads, make)
        try:
            async for _ in process.answer():
                pass
        except Broken as error:
            self._disappoint(error)
        else:
            self._give(process)

    def _disappoint(self, error: Broken) -> None:
        """Tell all who wait that there is nobody to wait for."""
        for queue in self._waiting.values():
            for future in queue:
                if not future.done():
                    future.set_exception(error)
        self._waiting.clear()

    async def work(self, client: str, task: str, request: BaseModel) -> AsyncGenerator[bytes, None]:
        """Do some work, and yield its messages as JSON; when the iterator is closed early, the work is killed.

        Raises:
            Busy: If too many requests wait.
            Refused: If the request cannot be answered.
            Broken: If the process is gone.
        """
        process, whole = await self._turn(client), False
        try:
            process.send(task, request)
            async for line in process.answer():
                yield line
            whole = True
        except Refused:
            whole = True
            raise
        finally:
            if whole:
                self._give(process)
            else:
                process.kill()
                self._add()

    async def _turn(self, client: str) -> _Process:
        """Wait for a process: the clients take turns."""
        if self._idle:
            return self._idle.popleft()
        queue = self._waiting.get(client)
        if len(self._waiting) >= MOST_CLIENTS if queue is None else len(queue) >= MOST_WAITING:
            raise Busy("too many requests are waiting; let one finish or cancel it, then ask again")
        future: asyncio.Future[_Process] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(client, deque()).append(future)
        try:
            return await future
        except asyncio.CancelledError:
            if future.done() and not future.cancelled():
                self._give(future.result())
            raise

    def _give(self, process: _Process) -> None:
        """Hand a process to the next client that waits, or keep it."""
        while self._waiting:
            client, queue = next(iter(self._waiting.items()))
            future = queue.popleft()
            del self._waiting[client]  # to the end of the line
            if queue:
                self._waiting[client] = queue
            if not future.cancelled():
                future.set_result(process)
                return
        if self._closed:
            process.kill()
        else:
            self._idle.append(process)

    def close(self) -> None:
        """End all processes."""
        self._closed = True
        for task in self._starting:
            task.cancel()
        for process in self._idle:
            process.kill()
        self._idle.clear()
        self._threads.shutdown(wait=False, cancel_futures=True)


class _Process:
    """One process, and the pipe to it."""

    def __init__(self, context: Any, threads: ThreadPoolExecutor) -> None:
        self._pipe, theirs = context.Pipe()
        self._threads = threads
        self._files = TemporaryDirectory(prefix="stackgen-studio-", ignore_cleanup_errors=True)
        self._process = context.Process(target=_serve, args=(theirs, self._files.name), daemon=True)
        self._process.start()
        theirs.close()

    def send(self, task: str, request: BaseModel) -> None:
        """Hand over some work."""
        try:
            self._pipe.send((task, request))
        except RecursionError as error:
            raise Refused("the request is nested too deeply") from error
        except OSError as error:
            raise Broken(f"the process was gone before it began: {error}") from error

    async def answer(self) -> AsyncGenerator[bytes, None]:
        """Yield the messages of the work as they come."""
        loop = asyncio.get_running_loop()
        while True:
            kind, content = await loop.run_in_executor(self._threads, self._receive)
            if kind == "message":
                yield content
            elif kind == "end":
                return
            else:
                raise (Refused if kind == "refused" else Broken)(content)

    def _receive(self) -> tuple[str, Any]:
        try:
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            return "broken", f"the process ended: {error!r}"

    def kill(self) -> None:
        """End it, whatever it does, and remove the temporary files that it leaves."""
        self._process.kill()
        self._files.cleanup()


def _serve(pipe: Connection, files: str) -> None:
    """Work until nobody asks any more; temporary files go into a folder that is removed afterwards."""
    import torch

    from stackgen.studio.work.tasks import TASKS, warm_up

    tempfile.tempdir = files
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this
    torch.set_num_threads(1)
    warm_up()
    pipe.send(("end", None))  # it is ready
    while True:
        try:
            task, request = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            TASKS[task](request, lambda message: pipe.send(("message", json.dumps(message, allow_nan=False).encode())))
            pipe.send(("end", None))
        except StackgenError as error:
            pipe.send(("refused", printable(error)))
        except BrokenPipeError:
            return
        except Exception as error:  # noqa: BLE001 - the server stays up, and says so in its log
            traceback.print_exc()
            pipe.send(("broken", f"{type(error).__name__}: {error}"))
