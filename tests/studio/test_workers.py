"""Processes are shared fairly, and what is cancelled is killed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi")

from pydantic import BaseModel

from stackgen.studio import workers
from stackgen.studio.requests import StackRequest
from stackgen.studio.workers import MOST_WAITING, Broken, Busy, Refused, Workers

REQUEST = StackRequest(file={})


class Scripted:
    """In the place of a process: it does what it is told, and says so."""

    made: list[Scripted]
    release: asyncio.Event

    def __init__(self, *_: Any) -> None:
        self.killed = False
        self.task: str | None = None
        Scripted.made.append(self)

    def send(self, task: str, request: BaseModel) -> None:
        self.task = task

    async def answer(self) -> AsyncIterator[bytes]:
        if self.task is None:
            return
        await Scripted.release.wait()
        if self.task == "refused":
            raise Refused("no")
        yield self.task.encode()

    def kill(self) -> None:
        self.killed = True


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Workers], Any]], None]:
    """Run a coroutine with one scripted process."""
    monkeypatch.setattr(workers, "_Process", Scripted)
    Scripted.made = []

    def go(test: Callable[[Workers], Any]) -> None:
        async def main() -> None:
            Scripted.release = asyncio.Event()
            pool = Workers(1)
            pool.open()
            await asyncio.sleep(0.05)
            await test(pool)
            pool.close()

        asyncio.run(main())

    return go


async def ask(pool: Workers, client: str, task: str, done: list[str]) -> None:
    async for message in pool.work(client, task, REQUEST):
        done.append(message.decode())


def test_clients_take_turns(run: Callable[[Callable[[Workers], Any]], None]) -> None:
    async def test(pool: Workers) -> None:
        done: list[str] = []
        asked = [("a", "a1"), ("a", "a2"), ("a", "a3"), ("b", "b1"), ("c", "c1"), ("b", "b2")]
        tasks = [asyncio.create_task(ask(pool, client, task, done)) for client, task in asked]
        await asyncio.sleep(0.01)
        Scripted.release.set()
        await asyncio.gather(*tasks)
        assert done == ["a1", "a2", "b1", "c1", "a3", "b2"]
        assert len(Scripted.made) == 1

    run(test)


def test_what_is_cancelled_is_killed_and_replaced_and_who_waits_only_leaves(
    run: Callable[[Callable[[Workers], Any]], None],
) -> None:
    async def test(pool: Workers) -> None:
        done: list[str] = []
        working, waiting = (asyncio.create_task(ask(pool, name, name, done)) for name in ("first", "second"))
        await asyncio.sleep(0.01)
        waiting.cancel()
        await asyncio.sleep(0.01)
        assert [process.killed for process in Scripted.made] == [False]
        working.cancel()
        await asyncio.sleep(0.05)
        assert [process.killed for process in Scripted.made] == [True, False]
        Scripted.release.set()
        with pytest.raises(Refused):
            await ask(pool, "third", "refused", done)
        await ask(pool, "fourth", "fourth", done)
        assert done == ["fourth"]
        assert len(Scripted.made) == 2

    run(test)


def test_a_client_may_not_fill_the_queue(run: Callable[[Callable[[Workers], Any]], None]) -> None:
    async def test(pool: Workers) -> None:
        done: list[str] = []
        tasks = [asyncio.create_task(ask(pool, "a", str(i), done)) for i in range(MOST_WAITING + 1)]
        await asyncio.sleep(0.01)
        with pytest.raises(Busy, match="waiting"):
            await ask(pool, "a", "one more", done)
        other = asyncio.create_task(ask(pool, "b", "another", done))
        await asyncio.sleep(0.01)
        Scripted.release.set()
        await asyncio.gather(*tasks, other)
        assert len(done) == MOST_WAITING + 2

    run(test)


def test_nobody_waits_for_a_process_that_cannot_begin(run: Callable[[Callable[[Workers], Any]], None]) -> None:
    async def test(pool: Workers) -> None:
        done: list[str] = []
        tasks = [asyncio.create_task(ask(pool, name, name, done)) for name in ("working", "waiting")]
        await asyncio.sleep(0.01)
        pool._disappoint(Broken("it ended"))
        with pytest.raises(Broken):
            await tasks[1]
        Scripted.release.set()
        await tasks[0]
        assert done == ["working"]

    run(test)


@pytest.mark.slow
def test_real_processes_work_refuse_and_are_gone_at_once_with_their_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    async def main() -> None:
        pool = Workers(1)
        pool.open()
        cube = {"format": "stackgen.stacks/1", "stacks": [{"blocks": [{"shape": "cube", "position": [0, 0, 0.5]}]}]}
        found = [message async for message in pool.work("a", "check", StackRequest(file=cube))]
        assert json.loads(found[0])["stable"]
        with pytest.raises(Refused, match="stacks file"):
            _ = [message async for message in pool.work("a", "check", REQUEST)]
        async with contextlib.aclosing(pool.work("a", "build", StackRequest(file=cube))) as building:
            assert json.loads(await anext(building))["kind"] == "planned"
            began = time.perf_counter()
        assert time.perf_counter() - began < 1
        pool.close()

    asyncio.run(main())
    assert not list(tmp_path.glob("stackgen-studio-*"))
