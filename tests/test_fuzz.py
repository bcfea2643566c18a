"""The fuzzer's kinds of inputs run, and some inputs of each are right or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.fuzz.__main__ import prepare
from benchmarks.fuzz.kinds import KINDS
from benchmarks.fuzz.worker import Worker


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    prepare()
    worker = Worker()
    yield worker
    worker.process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_inputs_are_right_or_refused_in_one_line(kind: str, worker: Worker) -> None:
    for seed in range(10):
        outcome, text, _ = worker.give(kind, seed)
        assert outcome in ("ok", "refused"), f"{kind} {seed}: {text}"
