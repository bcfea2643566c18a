"""Executors map numbers, survive what dies, and end with the process that asked."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import time
from itertools import count, islice
from pathlib import Path

import pytest

from stackgen.data.generation import executors
from stackgen.data.generation.executors import Executor, LocalExecutor, RayExecutor, make_executor
from stackgen.data.generation.generate import generate
from stackgen.errors import StackgenError
from tests.conftest import CHILD, workers_of
from tests.data.generation.dying import Deadly, killed, out_of_memory, refused, slow
from tests.data.generation.making import SMALL, contents

FEWER = 3
"""Attempts that are allowed here."""


@pytest.fixture(autouse=True)
def fewer_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each costs a process."""
    monkeypatch.setattr(executors, "ATTEMPTS", FEWER)


def test_every_number_has_its_result_whoever_dies(tmp_path: Path) -> None:
    task = Deadly(tmp_path, {0: 1, 3: FEWER - 1}, killed)
    assert sorted(LocalExecutor(2).map(task, range(6))) == [(n, n**2) for n in range(6)]
    assert len(list(tmp_path.iterdir())) == 1 + FEWER - 1


def test_a_number_that_always_kills_ends_the_run_with_a_line(tmp_path: Path) -> None:
    task = Deadly(tmp_path, {2: 1000}, out_of_memory)
    with pytest.raises(StackgenError, match=rf"{FEWER} worker processes died over shard 2.*fewer --workers") as caught:
        list(LocalExecutor(2).map(task, count()))
    assert "\n" not in str(caught.value) and not multiprocessing.active_children()


def test_an_error_of_the_task_is_raised_where_the_results_are_wanted(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match="no such thing"):
        list(LocalExecutor(1).map(Deadly(tmp_path, {1: 1}, refused), range(3)))
    assert not multiprocessing.active_children()


def test_who_stops_asking_ends_all_work() -> None:
    results = LocalExecutor(2).map(slow, count())
    begin = time.monotonic()
    assert next(results) == (0, 0)
    results.close()
    assert time.monotonic() - begin < 50 and not multiprocessing.active_children()


ENDLESS = """
from itertools import count
from stackgen.data.generation.executors import LocalExecutor
from tests.conftest import CHILD, workers_of
from tests.data.generation.dying import slow
if __name__ == "__main__":
    for number, _ in LocalExecutor(2).map(slow, count()):
        print(number, flush=True)
"""


def test_workers_end_with_the_process_that_asked(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(ENDLESS)
    command, session = [sys.executable, str(script)], {"env": CHILD, "start_new_session": True}
    with subprocess.Popen(command, stdout=subprocess.PIPE, **session) as process:  # type: ignore[call-overload]
        assert process.stdout.readline() == b"0\n"
        process.kill()
        process.wait()
        deadline = time.monotonic() + 60
        while workers_of(process.pid):
            assert time.monotonic() < deadline
            time.sleep(0.1)


def test_numbers_are_asked_for_only_as_far_as_there_are_workers(tmp_path: Path) -> None:
    asked: list[int] = []

    def numbers() -> islice[int]:
        return islice((asked.append(n) or n for n in count()), 100)  # type: ignore[func-returns-value]

    results = LocalExecutor(2).map(Deadly(tmp_path, {}, killed), numbers())
    for done in range(1, 4):
        next(results)
        assert len(asked) <= 2 + done
    results.close()


def test_workers_make_what_is_made_without_them(small: Path, tmp_path: Path) -> None:
    stored: list[int] = []
    generate(SMALL, tmp_path / "again", workers=2, progress=stored.append)
    assert contents(tmp_path / "again") == contents(small)
    assert stored == sorted(stored) and stored[-1] == 45 and len(stored) > 2


def test_executors_are_made_by_name() -> None:
    assert make_executor("local", 3) == LocalExecutor(3)
    assert make_executor("ray") == RayExecutor(None)
    with pytest.raises(StackgenError, match="at least 1"):
        make_executor("local", 0)
    with pytest.raises(StackgenError, match="there are local and ray"):
        make_executor("cloud")  # type: ignore[arg-type]


def test_a_missing_ray_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(StackgenError, match=r"pip install 'stackgen\[ray\]'"):
        next(RayExecutor(1).map(slow, count()))


@pytest.mark.slow
def test_ray_makes_the_same_bytes_and_survives_deaths(small: Path, tmp_path: Path) -> None:
    """On a cluster of this machine alone; the last executor starts and ends one itself."""
    ray = pytest.importorskip("ray")
    executor: Executor = RayExecutor(2)
    ray.init(num_cpus=2, include_dashboard=False)
    try:
        generate(SMALL, tmp_path / "ray", executor=executor)
        assert contents(tmp_path / "ray") == contents(small)
        (tmp_path / "deaths").mkdir()
        task = Deadly(tmp_path / "deaths", {1: 2}, killed)
        assert sorted(executor.map(task, range(3))) == [(0, 0), (1, 1), (2, 4)]
        with pytest.raises(StackgenError, match="no such thing"):
            list(executor.map(Deadly(tmp_path, {1: 1}, refused), range(3)))
        assert ray.is_initialized()
    finally:
        ray.shutdown()
    assert sorted(executor.map(Deadly(tmp_path, {}, killed), range(2))) == [(0, 0), (1, 1)]
    assert not ray.is_initialized()
