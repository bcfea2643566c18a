"""What a training brings beside its model: callbacks, curves and pictures, run folders, sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from stackgen.training.callbacks import EMA, Compile, SampleQuality, StartFrom, StepMetrics, Throughput
    from stackgen.training.loggers import CheckpointArtifact

__all__ = ["EMA", "CheckpointArtifact", "Compile", "SampleQuality", "StartFrom", "StepMetrics", "Throughput"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "callbacks": ["EMA", "Compile", "SampleQuality", "StartFrom", "StepMetrics", "Throughput"],
        "loggers": ["CheckpointArtifact"],
    },
)
