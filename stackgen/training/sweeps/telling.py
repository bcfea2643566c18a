"""How a trial tells its sweep the metrics it measures: it appends lines of JSON to a file that a variable names.

    {"step": 200, "validation/loss": 0.31, "sample/stability": 0.42}

Any program can do so; `stackgen fit` does after each validation. A metric that is NaN or infinite, and the line
`{"diverged": true}`, say that the trial leads nowhere.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from stackgen._lightning import pl
from stackgen.training.divergence import DivergedError

METRICS_FILE = "STACKGEN_METRICS"
"""The environment variable that names the file."""
DIVERGED = "diverged"
"""The key of a line which says that the training came to an end because its numbers are no longer finite."""


def in_a_sweep() -> bool:
    """Tell whether this process is a trial of `stackgen sweep`."""
    return METRICS_FILE in os.environ


class TellSweep(pl.Callback):
    """Tells the sweep all metrics after each validation; `stackgen fit` adds it to a trial of a sweep."""

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Append a line."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        self._tell({"step": trainer.global_step, **{n: float(v) for n, v in trainer.callback_metrics.items()}})

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Say so if the training diverged."""
        if isinstance(exception, DivergedError) and trainer.is_global_zero:
            self._tell({"step": trainer.global_step, DIVERGED: True})

    def _tell(self, content: dict[str, Any]) -> None:
        with open(os.environ[METRICS_FILE], "a", encoding="utf-8") as file:
            file.write(json.dumps(content) + "\n")


def values_told(path: Path, metric: str | None) -> list[float]:
    """Read one metric's values so far, of the lines that are whole and JSON; NaN for a trial that diverged."""
    found = []
    content = path.read_bytes() if path.exists() else b""
    for line in content[: content.rfind(b"\n") + 1].splitlines():
        try:
            told = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(told, dict):
            continue
        value = math.nan if told.get(DIVERGED) is True else told.get(metric)
        if isinstance(value, int | float):
            found.append(float(value))
    return found
