"""stackgen predict: stacks for the scenes of a dataset, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.asking import arguments_of, load_both, open_run
from stackgen.commands.output import tell
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.data.manifest import Split
from stackgen.evaluation.protocol import BATCH, batch_seed, block_lists_of, draw
from stackgen.evaluation.requests import Method
from stackgen.io.stacks_file import StackEntry, StacksFile, write_stacks
from stackgen.training.runs import RUNS, dropped_if_failing


def main(
    subject: Method,
    config: str,
    ckpt_path: Path | None = None,
    test_set: str | None = None,
    split: Split = "test",
    num_samples: int = 3,
    seed: int = 0,
    predicted_lists: bool = False,
    limit: int | None = None,
    batch_size: int = BATCH,
    name: str = "run",
    runs: Path = RUNS,
) -> None:
    """Sample stacks for every scene of a dataset's split, and write a stacks file for each.

    The stacks are those that `stackgen test` measures with the same options. The files and the configuration go to
    runs/NAME/predict_N.

    Args:
        subject: Method that samples.
        config: All options, as YAML.
        ckpt_path: Checkpoint or run folder to sample with: of a sampler, or of a block-list network.
        test_set: Dataset whose scenes are asked about; by default the frozen `testset-v1`.
        split: Split of the dataset.
        num_samples: Number of stacks sampled for each scene.
        seed: Seed of the sampler; the same seed and batch size give the same stacks.
        predicted_lists: Whether the network's most likely block lists are asked with instead of the true ones.
        limit: Number of scenes to ask about, from the first; all by default.
        batch_size: Number of scenes sampled at once.
        name: Name of the run.
        runs: Folder of all runs.
    """
    loaded, scenes, dataset = load_both(subject, ckpt_path, test_set, limit, split)
    model = loaded.model
    request = loaded.requests(None, num_samples, seed, predicted_lists=predicted_lists, batch_size=batch_size)[-1]
    folder = open_run(name, runs, "predict", config, dataset)
    with dropped_if_failing("[0-9]*.json", folder), progress_bar("scenes", len(scenes)) as (advance, _):
        for number, start in enumerate(range(0, len(scenes), batch_size)):
            batch = scenes[start : start + batch_size]
            block_lists, _ = block_lists_of(request, batch)
            samples = draw(request, batch, block_lists, batch_seed(seed, number))
            for scene, block_list, stacks in zip(batch, block_lists, samples, strict=True):
                content = StacksFile(
                    tuple(map(StackEntry, stacks)),
                    model.world,
                    target=scene.silhouette,
                    block_list=block_list,
                    block_list_source="cnn" if predicted_lists else "given",
                    seed=seed,
                    weights=model.weights,
                    sampler=model.sampler.settings,
                    cell_size=model.physics.cell_size,
                )
                write_stacks(folder / f"{scene.name}.json", content)
            advance(start + len(batch))
    tell(f"wrote {len(scenes)} stacks files to {folder}", folder=folder, scenes=len(scenes))


COMMAND = Command(
    "predict",
    main,
    """
    stackgen predict --ckpt_path runs/ddpm-small/version_0/checkpoints/last.ckpt
    stackgen predict --test_set data/paper --split validation --limit 100
    """,
    settings={"subject": Method},
    reports=True,
    config="config",
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(arguments_of(verb, argv))
