"""Checkpoints that survive: whatever ends a training, the last whole state is there under its name."""

from __future__ import annotations

import contextlib
import io
import signal
import threading
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint

from stackgen._lightning import pl
from stackgen.data.sources import is_remote
from stackgen.errors import Terminated
from stackgen.io.files import write_atomically


class WholeCheckpoints(TorchCheckpointIO):
    """Writes each checkpoint beside its place, then moves it there: Lightning's own way leads over TMPDIR.

    A checkpoint is read without unpickling anything but tensors and plain values.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Write, flush, and only then replace the one before.

        Raises:
            StackgenError: If it cannot be written; the one before is as it was.
        """
        if is_remote(str(path)):
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        place = Path(path)
        for left in place.parent.glob(f".{place.name}.*.tmp"):  # by a process that was killed
            with contextlib.suppress(OSError):
                left.unlink()
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_atomically(place, buffer.getbuffer())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        """Read tensors and plain values."""
        return super().load_checkpoint(path, map_location or (lambda storage, _: storage), weights_only=True)


def keep_whole(trainer: pl.Trainer) -> None:
    """Let a trainer write its checkpoints so, unless its strategy or the user has another way."""
    if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
        trainer.strategy.checkpoint_io = WholeCheckpoints()


class KeepOnStop(pl.Callback):
    """Keep the state when a training ends, also by Ctrl-C or SIGTERM, and stop where it can go on from exactly.

    A training step that is under way is finished first; a second signal does not wait for it. ModelCheckpoint alone
    keeps every n-th step, and loses those after the last of them.
    """

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}
        self._stepping, self._asked, self._saved = False, 0, -1

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Answer the signals from here on; where there are several processes, they stop at once."""
        self._saved = trainer.global_step
        if trainer.world_size == 1 and threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}

    def _stop(self, number: int, frame: object) -> None:
        if self._stepping and not self._asked:
            self._asked = number
        else:
            raise _stopped_by(number)

    def on_train_batch_start(self, *_: Any) -> None:
        """Note that weights may be half changed from here on."""
        self._stepping = True

    def on_train_batch_end(self, *_: Any) -> None:
        """Stop, if that was asked for meanwhile."""
        self._stepping = False
        if self._asked:
            raise _stopped_by(self._asked)

    def on_save_checkpoint(self, trainer: pl.Trainer, *_: Any) -> None:
        """Note what is kept already."""
        self._saved = trainer.global_step

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Keep the state as `last.ckpt`, if a whole one is there that is newer than the one kept."""
        self._restore()
        stopped = isinstance(exception, KeyboardInterrupt) and self._before
        if stopped and not self._stepping:
            self._keep(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the signals to others again, and keep the steps since the last checkpoint."""
        self._restore()
        self._keep(trainer)

    def _keep(self, trainer: pl.Trainer) -> None:
        """Save the state as `last.ckpt`, where one is kept and it is older."""
        if trainer.global_step > self._saved:
            folders = {keeper.dirpath for keeper in _keepers(trainer) if keeper.save_last and keeper.dirpath}
            for folder in sorted(map(str, folders)):
                trainer.save_checkpoint(Path(folder) / "last.ckpt")

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


def _keepers(trainer: pl.Trainer) -> list[ModelCheckpoint]:
    return [callback for callback in trainer.checkpoint_callbacks if isinstance(callback, ModelCheckpoint)]


def _stopped_by(number: int) -> KeyboardInterrupt:
    return Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
