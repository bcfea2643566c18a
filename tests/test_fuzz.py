"""The fuzzer's kinds of inputs run, and some inputs of each are right or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.common import save
from benchmarks.fuzz.__main__ import prepare
from benchmarks.fuzz.kinds import KINDS
from benchmarks.fuzz.tally import Tally, added
from benchmarks.fuzz.worker import Worker
from stackgen.errors import StackgenError


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


def test_results_are_gone_on_with_and_added_up(tmp_path: Path) -> None:
    parts = [Tally.begin(tmp_path / "gone.json", name) for name in ("1", "2")]
    for tally, name in zip(parts, ("1", "2"), strict=True):
        for outcome in ("ok", "refused", "hang"):
            tally.inputs[name] += 1
            tally.count("weights", outcome, "what was said", 0.5)
        save("fuzz", tally.figures(), tmp_path / f"{name}.json")
    assert Tally.begin(tmp_path / "1.json", "1") == Tally.read(tmp_path / "1.json") == parts[0]
    assert not Tally.begin(tmp_path / "1.json", "3").inputs
    figures = added(parts).figures()
    assert figures["inputs"] == 6 and figures["totals"]["hang"] == 2 and figures["seconds"] == {"weights": 3.0}
    assert figures["defects"] == {"weights: what was said": 2}
    with pytest.raises(StackgenError, match="each of another run"):
        added([parts[0], parts[0]])
