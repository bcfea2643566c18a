"""A trial tells its sweep what it measures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from stackgen.training.sweeps.telling import METRICS_FILE, TellSweep, values_told
from tests.training.test_callbacks import Module, batches, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")


def test_a_sweep_is_told_after_each_validation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Logging(Module):
        def validation_step(self, batch: Any, batch_idx: int) -> None:
            self.log("score", self.weight[0])

    told = tmp_path / "told.jsonl"
    monkeypatch.setenv(METRICS_FILE, str(told))
    trainer = trainer_for(tmp_path, [TellSweep()], max_epochs=3, num_sanity_val_steps=1)
    trainer.fit(Logging(), batches(2), batches(1))
    lines = [json.loads(line) for line in told.read_text().splitlines()]
    assert [(line["step"], line["score"]) for line in lines] == [(2, 2), (4, 4), (6, 6)]
    assert torch.is_tensor(trainer.callback_metrics["score"])
    assert values_told(told, "score") == [2, 4, 6]


def test_only_whole_lines_are_heard(tmp_path: Path) -> None:
    told = tmp_path / "told"
    assert values_told(told, "loss") == []
    told.write_text('{"loss": 2}\nnoise\n[1]\n{"other": 1}\n{"lo')
    assert values_told(told, "loss") == [2]
    with told.open("a") as file:
        file.write('ss": 1}\n')
    assert values_told(told, "loss") == [2, 1]
