"""stackgen prefer: pairs of a model's failures and what would have stood, to fine-tune it on."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from rich.console import Console

from stackgen.api import Trained
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError


def main(
    data: Path,
    out: Path,
    weights: str = "default",
    scenes: int = 4000,
    num_samples: int = 3,
    seed: int = 0,
    iou: float = 0.95,
    workers: int | None = None,
) -> None:
    """Sample for training scenes, simulate, and pair each failure with a stack of the same blocks that stands.

    Args:
        data: A dataset; its training split is used.
        out: A .npz for the pairs; `stackgen fit --config configs/model/ddpm-verdicts.yaml` learns from it.
        weights: Of the sampler that is to learn: a name, a .safetensors, a .ckpt or the folder of a run.
        scenes: Drawn from the training split.
        num_samples: Stacks for each.
        seed: Same seed, same pairs.
        iou: A success stands, and its settled silhouette matches at least this well.
        workers: Processes that simulate; by default one per core.
    """
    from stackgen.data.loading.arrays import load_dataset
    from stackgen.data.preferences import prefer
    from stackgen.evaluation.protocol import ParallelChecker
    from stackgen.models.weights import load_sampler, resolve_weights
    from stackgen.sim.checkers import SimulatorChecker

    if scenes < 1 or num_samples < 1:
        raise StackgenError("prefer: --scenes and --num_samples must be at least 1")
    if out.suffix != ".npz":
        raise StackgenError(f"prefer: --out must be a .npz file, not {out.name}")
    train = load_dataset(data, ("train",))[0]["train"]
    sampler = load_sampler(resolve_weights(weights))
    about = cast(Trained, sampler)
    chosen = np.random.default_rng(seed).choice(len(train), min(scenes, len(train)), replace=False)
    factory = partial(SimulatorChecker, catalogue=about.catalogue, until_fall=True)
    with (
        ParallelChecker(factory, workers or os.cpu_count() or 1) as checker,
        progress_bar("scenes", len(chosen)) as (advance, _),
    ):
        pairs = prefer(
            sampler,
            checker,
            train.select(chosen),
            num_samples,
            seed,
            iou,
            about.catalogue,
            about.grid,
            advance,
        )
    pairs.save(out)
    share = len(pairs) / (len(chosen) * num_samples)
    Console().print(
        f"{len(pairs)} of {len(chosen) * num_samples} samples failed ({share:.1%}); wrote {out}", highlight=False
    )


COMMAND = Command(
    "prefer",
    main,
    """
    stackgen prefer --data data/paper --weights runs/ours --out data/verdicts.npz
    stackgen fit --config configs/model/ddpm-verdicts.yaml --data.path data/paper
    """,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
