"""What `stackgen test` and `stackgen predict` do with weights: the paper's protocol, and stacks for a dataset."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from stackgen._lightning import pl
from stackgen.api import DEFAULT, Model, load
from stackgen.data.arrays import Batch
from stackgen.data.datamodule import StackDataModule
from stackgen.data.shards import Manifest
from stackgen.evaluation import ParallelChecker, SamplerEvaluation, batch_seed, ceiling, scenes_of, scenes_of_batch
from stackgen.files import write_atomically
from stackgen.protocols import StabilityChecker
from stackgen.results import Evaluation, format_list_table, format_table, write_scenes
from stackgen.runs import code_version
from stackgen.stack import StackgenError
from stackgen.stacks_file import Entry, StacksFile, write_stacks


class WeightsUnderTest(pl.LightningModule):
    """Weights, and how they are asked.

    Args:
        weights: Of the sampler: a name, a `.safetensors`, a `.ckpt` or the folder of a run.
        block_list_weights: Of the block-list network, likewise.
        num_samples: Stacks per scene.
        seed: With it and the batch size, the same stacks again.
        predicted_lists: Whether to measure with the network's block lists too, not only with the true ones.
        method: Name for the tables; by default that of the weights.
        workers: Processes that simulate.
    """

    def __init__(
        self,
        weights: str = DEFAULT,
        block_list_weights: str = DEFAULT,
        num_samples: int = 3,
        seed: int = 0,
        predicted_lists: bool = True,
        method: str | None = None,
        workers: int = 1,
    ) -> None:
        super().__init__()
        if num_samples < 1 or workers < 1:
            raise StackgenError("test: num_samples and workers must be at least 1")
        self.weights, self.num_samples, self.seed = weights, num_samples, seed
        self.predicted_lists, self.workers = predicted_lists, workers
        self.predictions: list[tuple[str, StacksFile]] = []
        self.model: Model = load(weights, block_list_weights)
        self.method = method or (self.model.weights.name if self.model.weights else str(weights))

    def checker(self) -> StabilityChecker:
        """PyBullet, on as many processes as were asked for; a rollout ends at the first fall."""
        from stackgen.sim.verdict import SimulatorChecker  # machines that only train have no PyBullet

        factory = partial(SimulatorChecker, catalogue=self.model.catalogue, until_fall=True)
        return factory() if self.workers == 1 else ParallelChecker(factory, self.workers)

    def on_predict_start(self) -> None:
        """Begin with no scene."""
        self.predictions = []

    def predict_step(self, batch: Batch, batch_idx: int) -> None:
        """Stacks with the true block list for the scenes of a batch, kept in `predictions` with the scenes' names.

        Lightning would take what is returned here apart in search of tensors.
        """
        model, world, rank = self.model, self.trainer.world_size, self.global_rank
        scenes = scenes_of_batch(batch, model.catalogue, len(self.predictions) * world + rank, world)
        masks, counts = batch["silhouette"].cpu().numpy() > 0.5, batch["counts"].cpu().numpy()
        seed = batch_seed(self.seed, batch_idx, rank)
        samples = model.sampler.sample_batch(masks, counts, self.num_samples, seed)
        for scene, stacks in zip(scenes, samples, strict=True):
            content = StacksFile(
                tuple(map(Entry, stacks)),
                model.catalogue,
                model.grid,
                target=scene.silhouette,
                block_list=scene.counts,
                block_list_source="given",
                seed=self.seed,
                weights=model.weights,
            )
            self.predictions.append((scene.name, content))


def run_protocol(trainer: pl.Trainer, subject: WeightsUnderTest, data: StackDataModule, folder: Path | None) -> None:
    """Paper, "Evaluation in simulation": true and predicted block lists, and the ceiling beside them.

    Leaves `metrics.json` and a CSV of every sample in the folder, and a table in the terminal.
    """
    facts: dict[str, Any] = {"weights": subject.weights, "code": code_version()}
    if subject.model.weights is not None:
        facts["weights_sha256"] = subject.model.weights.sha256
    if data.test_path.is_dir():
        manifest = Manifest.load(data.test_path)
        facts["dataset"] = {"name": manifest.name, "sha256": manifest.sha256}
    predictors = [None, subject.model.predictor] if subject.predicted_lists else [None]
    rows: list[Evaluation] = []
    checker = subject.checker()
    try:
        for predictor in predictors:
            module = SamplerEvaluation(
                subject.model.sampler,
                checker,
                subject.num_samples,
                subject.seed,
                predictor,
                subject.method,
                subject.model.catalogue,
                subject.model.grid,
                facts,
            )
            trainer.test(module, datamodule=data, verbose=False)
            assert module.evaluation is not None
            rows.append(module.evaluation)
        asked = {scene.name for scene in rows[0].scenes}
        scenes = [s for s in scenes_of(data.split("test"), subject.model.catalogue) if s.name in asked]
        rows.append(ceiling(scenes, checker, subject.model.grid))
    finally:
        if isinstance(checker, ParallelChecker):
            checker.close()
    if trainer.is_global_zero:
        report(rows, folder)


def write_predictions(predictions: list[tuple[str, StacksFile]], folder: Path) -> None:
    """Write one stacks file for each scene."""
    for name, content in predictions:
        write_stacks(folder / f"{name}.json", content)
    print(f"wrote {len(predictions)} stacks files to {folder}")


def report(rows: list[Evaluation], folder: Path | None) -> None:
    """Print the rows; write them where there is a folder."""
    console = Console()
    console.print(format_table(rows))
    lists = format_list_table(rows)
    if lists is not None:
        console.print(lists)
    if folder is None:
        return
    content: dict[str, Any] = {"format": "stackgen.protocol/1", "rows": [row.summary() for row in rows]}
    write_atomically(folder / "metrics.json", (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    for row in rows:
        name = f"{row.method} {row.block_list}".lower()
        write_scenes(folder / f"scenes-{''.join(c if c.isalnum() else '-' for c in name)}.csv", row)
    console.print(f"wrote {folder / 'metrics.json'}", highlight=False)
