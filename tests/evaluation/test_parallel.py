"""Processes that simulate end with the one that started them, and see no Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from tests.conftest import CHILD, allow_interrupts, workers_of

PROGRAM = """
import sys
import numpy as np
from stackgen.errors import StackgenError
from stackgen.evaluation.parallel import simulating
from stackgen.stack import Stack

tower = Stack(np.zeros(6, dtype=int), np.array([[0, 0, 0.5 + i, 0, 0, 0] for i in range(6)]))
try:
    with simulating(workers=2) as checker:
        print("simulating", flush=True)
        while True:
            checker.check_all([tower] * 64)
            print("checked", flush=True)
except StackgenError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    sys.exit(130)
"""


@contextmanager
def started() -> Iterator[subprocess.Popen[str]]:
    """A process that simulates on two others, in a group of its own; what is left ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=CHILD,
        start_new_session=True,
        preexec_fn=allow_interrupts,
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_until_gone(session: int) -> None:
    deadline = time.monotonic() + 60
    while workers_of(session):
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.parametrize("after", [pytest.param("simulating", marks=pytest.mark.slow), "checked"])
def test_workers_end_with_a_parent_that_was_killed(after: str) -> None:
    with started() as process:
        assert process.stdout is not None
        while process.stdout.readline().strip() != after:
            assert process.poll() is None
        while len(workers_of(process.pid)) < 2:
            assert process.poll() is None
        os.kill(process.pid, signal.SIGKILL)
        wait_until_gone(process.pid)


@pytest.mark.parametrize("after", ["simulating", pytest.param("checked", marks=pytest.mark.slow)])
def test_ctrl_c_for_all_is_answered_by_the_parent_alone(after: str) -> None:
    """Also while the workers are only half there: a terminal sends it to the whole group."""
    with started() as process:
        assert process.stdout is not None
        while process.stdout.readline().strip() != after:
            assert process.poll() is None
        while len(workers_of(process.pid)) < 2:
            assert process.poll() is None
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (130, "")
        wait_until_gone(process.pid)


def test_a_worker_that_dies_is_said_in_one_line() -> None:
    with started() as process:
        assert process.stdout is not None
        while process.stdout.readline().strip() != "checked":
            assert process.poll() is None
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 1 and "fewer --workers" in err and len(err.splitlines()) == 1
