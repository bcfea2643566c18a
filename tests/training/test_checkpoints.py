"""Checkpoints survive what ends a training, and a stopped training goes on from exactly where it was."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from stackgen._lightning import pl
from stackgen.errors import StackgenError, Terminated
from stackgen.models.weights import last_checkpoint, load_checkpoint
from stackgen.training import checkpoints
from stackgen.training.callbacks import EMA, RAW_WEIGHTS
from stackgen.training.checkpoints import KeepOnStop, WholeCheckpoints, keep_whole
from tests.training.test_callbacks import Module, batches, trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")


class Struck(Module):
    """A module whose process is sent a signal in the middle of a step."""

    def __init__(self, number: int, at: int, validating: bool = False) -> None:
        super().__init__()
        self.number, self.at, self.when_validating = number, at, validating

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        if self.trainer.global_step == self.at and not self.when_validating:
            os.kill(os.getpid(), self.number)
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        if self.trainer.global_step >= self.at and self.when_validating:
            os.kill(os.getpid(), self.number)
        super().validation_step(batch, batch_idx)


def keeper(folder: Path) -> ModelCheckpoint:
    return ModelCheckpoint(folder, save_last=True, save_top_k=0, every_n_train_steps=100)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize(("at", "validating", "kept"), [(2, False, 3), (4, True, 4), (0, False, 1)])
def test_a_stopped_training_keeps_its_state_and_goes_on_from_it(
    number: signal.Signals, at: int, validating: bool, kept: int, tmp_path: Path
) -> None:
    before = {which: signal.getsignal(which) for which in (signal.SIGINT, signal.SIGTERM)}
    trainer = trainer_for(tmp_path, [keeper(tmp_path), KeepOnStop()], max_epochs=3, enable_checkpointing=True)
    keep_whole(trainer)
    try:
        with pytest.raises(SystemExit) as stopped:
            trainer.fit(Struck(number, at, validating), batches(4), batches(2))
    finally:
        terminating = signal.getsignal(signal.SIGTERM)
        for which, handler in before.items():
            signal.signal(which, handler)
    assert isinstance(stopped.value.__context__, Terminated if number == signal.SIGTERM else KeyboardInterrupt)
    assert terminating == before[signal.SIGTERM]
    content = load_checkpoint(tmp_path / "last.ckpt")
    assert content["global_step"] == kept == content["state_dict"]["weight"][0]
    resumed = Module()
    trainer = trainer_for(tmp_path, [], max_epochs=3)
    trainer.fit(resumed, batches(4), batches(2), ckpt_path=str(tmp_path / "last.ckpt"), weights_only=True)
    assert trainer.global_step == 12 == float(resumed.weight[0])


@pytest.mark.parametrize("averaged", [False, True])
def test_the_last_steps_are_kept(tmp_path: Path, averaged: bool) -> None:
    """Ten steps, of which a checkpoint is due at the eighth."""
    keeps = ModelCheckpoint(tmp_path, save_last=True, save_top_k=0, every_n_train_steps=8)
    averages = [EMA(decay=0.5, warmup=False)] if averaged else []
    trainer = trainer_for(
        tmp_path, [*averages, keeps, KeepOnStop()], max_epochs=3, max_steps=10, enable_checkpointing=True
    )
    keep_whole(trainer)
    module = Module()
    trainer.fit(module, batches(4), batches(2))
    content = load_checkpoint(tmp_path / "last.ckpt")
    assert content["global_step"] == 10
    assert float(content["state_dict"]["weight"][0]) == float(module.weight[0])  # the average, where there is one
    assert not averaged or float(content[RAW_WEIGHTS]["weight"][0]) == 10 > float(module.weight[0])


def test_a_checkpoint_is_never_half_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one before stays until the new one is whole, and no other file system is involved."""
    path = tmp_path / "last.ckpt"
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    writer = WholeCheckpoints()
    writer.save_checkpoint({"a": 1}, path)
    (tmp_path / ".last.ckpt.0123abcd.tmp").write_bytes(b"left by a kill")
    monkeypatch.setattr("stackgen.io.files.os.replace", _fails)
    with pytest.raises(StackgenError, match="No space"):
        writer.save_checkpoint({"a": 2}, path)
    assert writer.load_checkpoint(path) == {"a": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.ckpt"]


def _fails(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_nothing_but_tensors_and_plain_values_is_read(tmp_path: Path) -> None:
    torch.save({"a": checkpoints.KeepOnStop()}, tmp_path / "evil.ckpt")
    with pytest.raises(Exception, match=r"[Ww]eights"):
        WholeCheckpoints().load_checkpoint(tmp_path / "evil.ckpt", weights_only=False)


def test_last_goes_by_version_and_a_damaged_one_names_an_older_one(tmp_path: Path) -> None:
    paths = [tmp_path / f"version_{number}" / "checkpoints" / "last.ckpt" for number in (0, 2, 10)]
    for number, path in enumerate(paths):
        WholeCheckpoints().save_checkpoint({"a": number}, path)
        os.utime(path, (0, 1000 - number))
    assert last_checkpoint(tmp_path) == paths[2]
    assert last_checkpoint(tmp_path / "version_0") == paths[0]
    for damage in (b"", paths[2].read_bytes()[:-100], b"text"):
        paths[2].write_bytes(damage)
        with pytest.raises(StackgenError, match=f"damaged; {paths[1]} is older and whole"):
            load_checkpoint(paths[2])
    beside = paths[2].with_name("epoch=1.ckpt")
    WholeCheckpoints().save_checkpoint({"a": 0}, beside)
    with pytest.raises(StackgenError, match=f"damaged; {beside} is older and whole"):
        load_checkpoint(paths[2])


def test_strategies_with_a_way_of_their_own_keep_it(tmp_path: Path) -> None:
    trainer = trainer_for(tmp_path, [])
    keep_whole(trainer)
    assert type(trainer.strategy.checkpoint_io) is WholeCheckpoints
    own = type("Own", (WholeCheckpoints,), {})()
    trainer.strategy.checkpoint_io = own
    keep_whole(trainer)
    assert trainer.strategy.checkpoint_io is own
    assert isinstance(trainer, pl.Trainer)
