"""stackgen prefer: what verdicts teach a sampler or a block-list network, to fine-tune it on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stackgen.commands.output import tell
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError
from stackgen.io.provenance import cores
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.names import CheckerName


def main(
    data: Path | list[Path],
    out: Path,
    weights: str = "default",
    lists: int = 0,
    block_list_weights: str = "default",
    scenes: int = 4000,
    num_samples: int = 3,
    seed: int = 0,
    iou: float = 0.95,
    sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
    checker: CheckerName = "simulator",
    workers: int | None = None,
) -> None:
    """Sample for training scenes, ask what stands, and write what a sampler or a block-list network learns from it.

    Each failure is paired with a stack of the same blocks that stands, for the sampler. With --lists, several block
    lists are tried for each scene instead, for the block-list network.

    Args:
        data: Dataset whose training split gives the scenes, or a list of datasets.
        out: File to write, a .npz; `stackgen fit --config configs/model/ddpm-verdicts.yaml` learns from pairs, and
            configs/worlds/large/lists.yaml from tried lists.
        weights: Weights of the sampler: a name, a .safetensors file, a .ckpt or a run folder. From pairs it learns.
        lists: Number of the network's likeliest block lists that are tried for each scene, beside the scene's own; 0
            makes pairs.
        block_list_weights: With --lists, weights of the block-list network that is to learn; by default those that ship
            for the sampler's world.
        scenes: Number of scenes drawn from the training split.
        num_samples: Number of stacks sampled for each scene, or for each list.
        seed: Seed of the scenes, stacks and pairs; the same seed gives the same file.
        iou: Least match of a success in pairs: it stands, and its settled silhouette has this share of the IoU with the
            target that the dataset's own stack has, which is 1 unless the target is a drawing.
        sampler: Settings by which a diffusion model samples; the weights' own where one is null.
        checker: What says whether a stack stands: `simulator`, or `statics`, which is quicker and a little kinder.
        workers: Number of processes that simulate; by default one for each core.
    """
    from stackgen.data.dataset import Dataset
    from stackgen.data.preferences import prefer, try_lists
    from stackgen.evaluation.parallel import simulating
    from stackgen.evaluation.requests import Method, load_method, require_one_world
    from stackgen.sampling.verified import checker_named
    from stackgen.sim.physics import Physics

    if scenes < 1 or num_samples < 1 or (workers is not None and workers < 1) or min(seed, lists) < 0:
        raise StackgenError("--scenes, --num_samples and --workers must be at least 1, --seed and --lists at least 0")
    if out.suffix != ".npz":
        raise StackgenError(f"--out must be a .npz file, not {out.name}")
    datasets = [Dataset.open(path) for path in (data if isinstance(data, list) else [data])]
    dataset, loaded = Dataset.join(datasets), load_method(Method(weights, block_list_weights, sampler))
    if any(one.manifest.physics != dataset.manifest.physics for one in datasets):
        raise StackgenError("--data: the datasets were made under different physics; choose those of one")
    require_one_world(loaded, dataset.world, dataset.manifest.name)
    train = dataset.split("train")
    chosen = train.select(np.random.default_rng(seed).choice(len(train), min(scenes, len(train)), replace=False))
    with (
        simulating(Physics.recorded(dataset.manifest.physics), workers or cores()) as simulator,
        progress_bar("scenes", len(chosen)) as (advance, _),
    ):
        model, judge = loaded.model, checker_named(checker, simulator)
        options: dict[str, Any] = {"num_samples": num_samples, "seed": seed, "progress": advance}
        if lists:
            tried = try_lists(model.sampler, model.predictor, judge, chosen, number=lists, **options)
        else:
            pairs = prefer(model.sampler, judge, chosen, iou=iou, **options)
    if lists:
        tried.save(out)
        first, best = tried.worth[:, 0].mean(), tried.worth.max(axis=1).mean()
        line = f"front IoU of the likeliest list {first:.3f}, of the best of {lists + 1} {best:.3f}; wrote {out}"
        tell(line, likeliest=float(first), best=float(best), wrote=[out])
        return
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
    stackgen prefer --data data/large --weights large --lists 8 --num_samples 1 --checker statics --out data/lists.npz
    """,
    reports=True,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
