"""How a trial tells its sweep what it finds: it appends lines of JSON to the file that a variable names.

    {"step": 200, "validation/loss": 0.31, "sample/stability": 0.42}

Any program can; `stackgen fit` does, after each validation.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stackgen._lightning import pl

METRICS_FILE = "STACKGEN_METRICS"
"""The environment variable that names the file."""


def in_a_sweep() -> bool:
    """Whether this process is a trial of `stackgen sweep`."""
    return METRICS_FILE in os.environ


class TellSweep(pl.Callback):
    """Tells the sweep all metrics after each validation; the command line adds it where there is a sweep."""

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Append a line."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
        line = json.dumps({"step": trainer.global_step, **metrics})
        with open(os.environ[METRICS_FILE], "a") as file:
            file.write(line + "\n")


class MetricsReader:
    """Reads what a trial tells while it tells it.

    Args:
        path: Of the file; it need not exist yet.
        metric: The one to look for.
    """

    def __init__(self, path: Path, metric: str) -> None:
        self.path, self.metric = path, metric
        self._place = 0

    def new(self) -> Iterator[float]:
        """The metric's values since the last call, of whole lines."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self._place)
            content = file.read()
        whole = content[: content.rfind(b"\n") + 1]
        self._place += len(whole)
        for line in whole.splitlines():
            value = _parsed(line).get(self.metric)
            if isinstance(value, int | float):
                yield float(value)


def _parsed(line: bytes) -> dict[str, Any]:
    try:
        content = json.loads(line)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}
