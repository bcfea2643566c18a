"""How a trial tells its sweep the metrics it measures: it appends lines of JSON to a file that a variable names.

    {"step": 200, "validation/loss": 0.31, "sample/stability": 0.42}

Any program can do so; `stackgen fit` does after each validation.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from stackgen._lightning import pl

METRICS_FILE = "STACKGEN_METRICS"
"""The environment variable that names the file."""


def in_a_sweep() -> bool:
    """Tell whether this process is a trial of `stackgen sweep`."""
    return METRICS_FILE in os.environ


class TellSweep(pl.Callback):
    """Tells the sweep all metrics after each validation; `stackgen fit` adds it to a trial of a sweep."""

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Append a line."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
        line = json.dumps({"step": trainer.global_step, **metrics})
        with open(os.environ[METRICS_FILE], "a") as file:
            file.write(line + "\n")


def values_told(path: Path, metric: str) -> list[float]:
    """Read one metric's values so far, of the lines that are whole and JSON."""
    found = []
    content = path.read_bytes() if path.exists() else b""
    for line in content[: content.rfind(b"\n") + 1].splitlines():
        try:
            value = json.loads(line).get(metric)
        except (ValueError, AttributeError):
            continue
        if isinstance(value, int | float):
            found.append(float(value))
    return found
