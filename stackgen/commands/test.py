"""What `stackgen test` and `stackgen predict` do with weights: the paper's protocol, and stacks for a dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from stackgen._lightning import pl
from stackgen.api import DEFAULT, Model, load
from stackgen.data.datamodule import StackDataModule
from stackgen.data.loading.arrays import Batch
from stackgen.data.provenance import warn_of_other_physics
from stackgen.data.shards import manifest_sha256
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import (
    ParallelChecker,
    SamplerEvaluation,
    batch_seed,
    ceiling,
    physics_of,
    scenes_of,
    scenes_of_batch,
)
from stackgen.evaluation.report.questions import origin, question
from stackgen.evaluation.report.store import PREFIX, Question, write_evaluation
from stackgen.evaluation.results import Evaluation, format_list_table, format_table, write_scenes
from stackgen.io.files import write_atomically
from stackgen.io.provenance import code_version
from stackgen.io.stacks_file import Entry, StacksFile, write_stacks
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.protocols import Judge, StabilityChecker, StackSampler
from stackgen.sampling.verified import Budget, VerifiedSampler, referee


class WeightsUnderTest(pl.LightningModule):
    """Weights, or a sampler without any, and how they are asked.

    Args:
        weights: Of the sampler: a name, a `.safetensors`, a `.ckpt` or the folder of a run; or class_path and
            init_args of any StackSampler.
        block_list_weights: Of the block-list network, likewise.
        num_samples: Stacks per scene.
        seed: With it and the batch size, the same stacks again.
        predicted_lists: Whether to measure with the network's block lists too, not only with the true ones.
        method: Name for the tables; by default that of the weights.
        workers: Processes that simulate.
        sampler: How a diffusion model samples; what is null is as its weights have it.
        verify: Measure verified sampling: the best of many stacks, as this judge says, see docs/sampling.md.
        draws: What that may draw for a scene.
    """

    def __init__(
        self,
        weights: str | StackSampler = DEFAULT,
        block_list_weights: str = DEFAULT,
        num_samples: int = 3,
        seed: int = 0,
        predicted_lists: bool = True,
        method: str | None = None,
        workers: int = 1,
        sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
        verify: Judge | None = None,
        draws: int = 64,
    ) -> None:
        super().__init__()
        if num_samples < 1 or workers < 1:
            raise StackgenError("test: num_samples and workers must be at least 1")
        self.num_samples, self.seed = num_samples, seed
        self.predicted_lists, self.workers = predicted_lists, workers
        self.block_list_weights = block_list_weights
        self.predictions: list[tuple[str, StacksFile]] = []
        self.model: Model = load(weights, block_list_weights, sampler)
        own_name = self.model.weights.name if self.model.weights else type(self.model.sampler).__name__
        self.weights = weights if isinstance(weights, str) else own_name
        self.method = method or (own_name if verify is None else f"{own_name}, verified by {verify}")
        if verify is not None:
            self.model.sampler = self._verified(verify, draws)

    def _verified(self, verify: Judge, draws: int) -> StackSampler:
        from stackgen.sim.checkers import SimulatorChecker  # machines that only train have no PyBullet

        checker = referee(verify, SimulatorChecker(self.model.physics, self.model.catalogue, until_fall=True))
        return VerifiedSampler(self.model.sampler, checker, Budget(draws), self.model.grid, verify)

    def checker(self) -> StabilityChecker:
        """PyBullet, on as many processes as were asked for; a rollout ends at the first fall."""
        from stackgen.sim.checkers import SimulatorChecker  # machines that only train have no PyBullet

        factory = partial(SimulatorChecker, self.model.physics, self.model.catalogue, until_fall=True)
        return factory() if self.workers == 1 else ParallelChecker(factory, self.workers)

    def on_predict_start(self) -> None:
        """Begin with no scene."""
        self.predictions = []
        require_one_world(self, self.trainer.datamodule.test_manifest)  # type: ignore[attr-defined]

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
                sampler=getattr(model.sampler, "settings", None),
            )
            self.predictions.append((scene.name, content))


def run_protocol(trainer: pl.Trainer, subject: WeightsUnderTest, data: StackDataModule, folder: Path | None) -> None:
    """Paper, "Evaluation in simulation": true and predicted block lists, and the ceiling beside them.

    Leaves `metrics.json` and a CSV of every sample in the folder, and a table in the terminal.
    """
    facts: dict[str, Any] = {"weights": subject.weights, "code": code_version()}
    facts |= origin(subject)
    manifest = data.test_manifest
    require_one_world(subject, manifest)
    facts["dataset"] = {"name": manifest.get("name"), "sha256": manifest_sha256(manifest)}
    predictors = [None, subject.model.predictor] if subject.predicted_lists else [None]
    rows: list[Evaluation] = []
    questions: list[Question] = []
    checker = subject.checker()
    if trainer.is_global_zero:
        here, card = physics_of(checker) or {}, getattr(subject.model.sampler, "card", {})
        warn_of_other_physics(f"dataset {data.test_path}", manifest.get("physics"), here)
        warn_of_other_physics(f"what {subject.method} learnt from", (card.get("dataset") or {}).get("physics"), here)
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
            number, size = len(module.evaluation.scenes), data.eval_batch_size
            test_set = facts["dataset"]["sha256"]
            asks = question(subject, module.evaluation.block_list, test_set, number, size, physics_of(checker))
            questions.append(asks)
        asked = {scene.name for scene in rows[0].scenes}
        scenes = [s for s in scenes_of(data.split("test"), subject.model.catalogue) if s.name in asked]
        rows.append(ceiling(scenes, checker, subject.model.grid))
    finally:
        if isinstance(checker, ParallelChecker):
            checker.close()
    if trainer.is_global_zero:
        report(rows, folder)
    # Several processes share out the scenes, and sample others than one would: no answer to these questions.
    if folder is not None and trainer.world_size == 1:
        for row, asks in zip(rows, questions, strict=False):  # the ceiling, which is last, is quickly made
            write_evaluation(folder / f"{PREFIX}{row.block_list.replace(' ', '-')}.json", row, asks)


def require_one_world(subject: WeightsUnderTest, manifest: Mapping[str, Any]) -> None:
    """See that scenes can be put to the weights.

    Raises:
        StackgenError: If the dataset's shapes or grid are not those that the weights know.
    """
    model = subject.model
    plain = {"catalogue": model.catalogue.to_json(), "grid": asdict(model.grid)}
    other = [name for name, value in plain.items() if manifest.get(name, value) != value]
    if other:
        raise StackgenError(
            f"dataset {manifest.get('name')} has another {' and '.join(other)} than {subject.weights} was trained"
            " with: give --data.test_path of a dataset of its world"
        )


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
