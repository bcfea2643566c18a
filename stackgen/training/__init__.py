"""What a training brings beside its model: callbacks, curves and pictures, run folders, sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stackgen._lazy import lazy

if TYPE_CHECKING:
    from stackgen.training.callbacks import EMA, Compile, SampleQuality, StartFrom, Throughput
    from stackgen.training.plots import CheckpointArtifact, StepMetrics

__all__ = ["EMA", "CheckpointArtifact", "Compile", "SampleQuality", "StartFrom", "StepMetrics", "Throughput"]

__getattr__, __dir__ = lazy(
    __name__,
    {name: "plots" if name in ("CheckpointArtifact", "StepMetrics") else "callbacks" for name in __all__},
)
