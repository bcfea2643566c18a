"""Class paths that classes had before: configurations and command lines that name them keep working."""

from __future__ import annotations

import re

OLD_NAMES = {
    "stackgen.baselines.brute_force.BruteForce": "stackgen.baselines.BruteForce",
    "stackgen.baselines.greedy_random.GreedyRandom": "stackgen.baselines.GreedyRandom",
    "stackgen.baselines.random_placement.RandomPlacement": "stackgen.baselines.RandomPlacement",
    "stackgen.baselines.tran_reg.TranReg": "stackgen.baselines.TranReg",
    "stackgen.baselines.tran_vae.TranVAE": "stackgen.baselines.TranVAE",
    "stackgen.callbacks.Compile": "stackgen.training.Compile",
    "stackgen.callbacks.EMA": "stackgen.training.EMA",
    "stackgen.callbacks.SampleQuality": "stackgen.training.SampleQuality",
    "stackgen.callbacks.StartFrom": "stackgen.training.StartFrom",
    "stackgen.callbacks.Throughput": "stackgen.training.Throughput",
    "stackgen.dashboard.CheckpointArtifact": "stackgen.training.CheckpointArtifact",
    "stackgen.dashboard.StepFigures": "stackgen.training.StepMetrics",
    "stackgen.models.cnn.BlockListCNN": "stackgen.models.BlockListCNN",
    "stackgen.models.ddpm.DDPM": "stackgen.models.DDPM",
    "stackgen.models.preference.VerdictTuning": "stackgen.models.VerdictTuning",
    "stackgen.sim.verdict.SimulatorChecker": "stackgen.sim.checkers.SimulatorChecker",
}

_OLD_NAME = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, OLD_NAMES))})(?!\w)")


def renew(text: str) -> str:
    """Replace old class paths in a text by those that classes have now.

    >>> renew("{class_path: stackgen.callbacks.EMA, init_args: {decay: 0.9}}")
    '{class_path: stackgen.training.EMA, init_args: {decay: 0.9}}'
    """
    return _OLD_NAME.sub(lambda found: OLD_NAMES[found[0]], text)
