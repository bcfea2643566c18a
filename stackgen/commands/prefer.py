"""stackgen prefer: pairs of a model's failures and what would have stood, to fine-tune it on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stackgen.commands.output import tell
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError
from stackgen.io.provenance import cores


def main(
    data: Path | list[Path],
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
        data: Dataset whose training split gives the scenes, or a list of datasets.
        out: File for the pairs, a .npz; `stackgen fit --config configs/model/ddpm-verdicts.yaml` learns from it.
        weights: Weights of the sampler that is to learn: a name, a .safetensors file, a .ckpt or a run folder.
        scenes: Number of scenes drawn from the training split.
        num_samples: Number of stacks sampled for each scene.
        seed: Seed of the scenes, stacks and pairs; the same seed gives the same pairs.
        iou: Least match of a success: it stands, and its settled silhouette has this share of the IoU with the target
            that the dataset's own stack has, which is 1 unless the target is a drawing.
        workers: Number of processes that simulate; by default one for each core.
    """
    from stackgen.data.dataset import Dataset
    from stackgen.data.preferences import prefer
    from stackgen.evaluation.parallel import simulating
    from stackgen.evaluation.requests import Method, load_method, require_one_world
    from stackgen.sim.physics import Physics

    if scenes < 1 or num_samples < 1 or (workers is not None and workers < 1) or seed < 0:
        raise StackgenError("--scenes, --num_samples and --workers must be at least 1, --seed at least 0")
    if out.suffix != ".npz":
        raise StackgenError(f"--out must be a .npz file, not {out.name}")
    datasets = [Dataset.open(path) for path in (data if isinstance(data, list) else [data])]
    dataset, loaded = Dataset.join(datasets), load_method(Method(weights))
    if any(one.manifest.physics != dataset.manifest.physics for one in datasets):
        raise StackgenError("--data: the datasets were made under different physics; choose those of one")
    require_one_world(loaded, dataset.world, dataset.manifest.name)
    train = dataset.split("train")
    chosen = np.random.default_rng(seed).choice(len(train), min(scenes, len(train)), replace=False)
    with (
        simulating(Physics.recorded(dataset.manifest.physics), workers or cores()) as checker,
        progress_bar("scenes", len(chosen)) as (advance, _),
    ):
        pairs = prefer(
            loaded.model.sampler,
            checker,
            train.select(chosen),
            num_samples=num_samples,
            seed=seed,
            iou=iou,
            progress=advance,
        )
    pairs.save(out)
    sampled = len(chosen) * num_samples
    line = f"{len(pairs)} of {sampled} samples failed ({len(pairs) / sampled:.1%}); wrote {out}"
    tell(line, failed=len(pairs), sampled=sampled, wrote=[out])


COMMAND = Command(
    "prefer",
    main,
    """
    stackgen prefer --data data/paper --weights runs/ours --out data/verdicts.npz
    stackgen prefer --data '[data/drawings, data/paper]' --weights runs/taught-small --out data/verdicts.npz
    stackgen fit --config configs/model/ddpm-verdicts.yaml --data.path data/paper
    """,
    reports=True,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
