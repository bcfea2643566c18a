"""The fuzzer's kinds of inputs run, and some inputs of each are right or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks import fuzz


@pytest.fixture(scope="module")
def worker() -> Iterator[fuzz.Worker]:
    fuzz.prepare()
    worker = fuzz.Worker()
    yield worker
    worker.process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_inputs_are_right_or_refused_in_one_line(kind: str, worker: fuzz.Worker) -> None:
    for seed in range(10):
        outcome, text = worker.give(kind, seed)
        assert outcome in ("ok", "refused"), f"{kind} {seed}: {text}"
