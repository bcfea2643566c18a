"""The paper's protocol for anything that samples stacks: scenes in, scores with intervals out.

`evaluate` runs it anywhere; `SamplerEvaluation` is the same under `Trainer.test`. The simulator is
handed in as a StabilityChecker.

Legend: B scenes in a batch, n samples a scene, S shapes, H x W pixels.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stackgen._lightning import pl
from stackgen.data.loading.arrays import Batch, StackArrays, load_dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import SceneScore, list_rank, scene_metrics, score_sample
from stackgen.evaluation.results import PREDICTED_LIST, TOP, TRUE_LIST, Evaluation, SceneResult
from stackgen.geometry import silhouette
from stackgen.protocols import BlockListPredictor, StabilityChecker, StackSampler, Verdict, check_all
from stackgen.sampling.feasible import can_make, has_plain_rows
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, Catalogue, Grid, Mask, View

Progress = Callable[[int, int], None]
"""Told (scenes done, scenes in all)."""


@dataclass(frozen=True)
class Scene:
    """One question of the protocol.

    Args:
        name: Of the scene, in tables.
        silhouette: (H, W) target, front view.
        counts: (S,) true block list.
        truth: The stack it was taken from; None if the target is only a drawing.
    """

    name: str
    silhouette: Mask
    counts: NDArray[np.int64]
    truth: Stack | None = None

    def targets(self, grid: Grid) -> dict[View, Mask]:
        """The target of each view that has one."""
        front: dict[View, Mask] = {"front": self.silhouette}
        if self.truth is None:
            return front
        return {**front, "side": silhouette(self.truth, "side", grid), "top": silhouette(self.truth, "top", grid)}


def scenes_of(arrays: StackArrays, catalogue: Catalogue = PAPER_CATALOGUE) -> list[Scene]:
    """The stacks of a split as scenes."""
    return scenes_of_batch(arrays.batch(np.arange(len(arrays))), catalogue)


def scenes_of_batch(batch: Batch, catalogue: Catalogue = PAPER_CATALOGUE, first: int = 0, step: int = 1) -> list[Scene]:
    """The stacks of a batch as scenes, named by number (`first`, `first + step`, ...) and template."""
    parts = {name: tensor.cpu().numpy() for name, tensor in batch.items()}
    scenes = []
    for i, (shapes, poses, mask) in enumerate(zip(parts["shapes"], parts["poses"], parts["mask"], strict=True)):
        truth = Stack(shapes[mask], poses[mask], catalogue)
        name = f"{first + i * step:05d}-t{parts['template'][i]}"
        scenes.append(Scene(name, parts["silhouette"][i] > 0.5, parts["counts"][i], truth))
    return scenes


def load_scenes(path: str | Path, split: str = "test") -> tuple[list[Scene], dict[str, Any]]:
    """The scenes of a dataset's split, and its manifest.

    Raises:
        StackgenError: If there are none.
    """
    splits, manifest = load_dataset(path, (split,))
    return scenes_of(splits[split], Catalogue.from_json(manifest["catalogue"])), manifest


def evaluate(
    sampler: StackSampler,
    scenes: Sequence[Scene],
    checker: StabilityChecker,
    num_samples: int = 3,
    seed: int = 0,
    predictor: BlockListPredictor | None = None,
    progress: Progress | None = None,
    *,
    method: str = "StackGen",
    batch_size: int = 64,
    grid: Grid = PAPER_GRID,
    facts: dict[str, Any] | None = None,
) -> Evaluation:
    """Run the protocol (paper, "Evaluation in simulation").

    Args:
        sampler: Whom to measure.
        scenes: What to ask.
        checker: The physics.
        num_samples: Stacks per scene.
        seed: With it and the batch size, the same stacks again.
        predictor: Gives the block lists; None takes the true ones.
        progress: Told after each batch.
        method: Name for the tables.
        batch_size: Scenes sampled at once.
        grid: Scale of the silhouettes.
        facts: To be quoted with the results.

    Raises:
        StackgenError: If there is nothing to evaluate.
    """
    if not scenes or num_samples < 1:
        raise StackgenError("evaluation: there must be at least one scene and one sample a scene")
    results: list[SceneResult] = []
    for number, start in enumerate(range(0, len(scenes), batch_size)):
        batch = scenes[start : start + batch_size]
        results += evaluate_batch(sampler, batch, checker, num_samples, batch_seed(seed, number), predictor, grid)
        if progress:
            progress(len(results), len(scenes))
    source = PREDICTED_LIST if predictor else TRUE_LIST
    return Evaluation(method, source, tuple(results), num_samples, seed, physics_of(checker), facts or {})


def evaluate_batch(
    sampler: StackSampler,
    scenes: Sequence[Scene],
    checker: StabilityChecker,
    num_samples: int,
    seed: int,
    predictor: BlockListPredictor | None = None,
    grid: Grid = PAPER_GRID,
) -> list[SceneResult]:
    """Sample, judge and score some scenes."""
    silhouettes = np.stack([scene.silhouette for scene in scenes])
    counts = np.stack([scene.counts for scene in scenes])
    ranks: list[int | None] = [None] * len(scenes)
    if predictor:
        ranked = predictor.predict(silhouettes, top=TOP)
        ranks = list(list_rank(ranked, counts).tolist())
        counts = ranked[:, 0]
    began = time.perf_counter()
    stacks = sampler.sample_batch(silhouettes, counts, num_samples, seed)
    seconds = (time.perf_counter() - began) / (num_samples * len(scenes))
    return [replace(found, seconds=seconds) for found in judge(scenes, stacks, checker, grid, counts, ranks)]


def judge(
    scenes: Sequence[Scene],
    stacks: Sequence[Sequence[Stack]],
    checker: StabilityChecker,
    grid: Grid = PAPER_GRID,
    counts: NDArray[np.int64] | None = None,
    ranks: Sequence[int | None] | None = None,
) -> list[SceneResult]:
    """Judge and score stacks that were made for some scenes.

    Args:
        scenes: B targets.
        stacks: n stacks for each.
        checker: The physics.
        grid: Scale of the silhouettes.
        counts: (B, S) block lists that were asked for; the true ones by default.
        ranks: Place of the true list among the predicted ones; None for a list that was given.
    """
    verdicts = iter(check_all(checker, [stack for samples in stacks for stack in samples]))
    results = []
    for i, (scene, samples) in enumerate(zip(scenes, stacks, strict=True)):
        targets, judged = scene.targets(grid), [next(verdicts) for _ in samples]
        asked = scene.counts if counts is None else counts[i]
        rank = ranks[i] if ranks else None
        score = SceneScore(tuple(score_sample(s, v, targets, grid) for s, v in zip(samples, judged, strict=True)))
        feasible = None
        if rank is not None and has_plain_rows(samples[0].catalogue):
            feasible = can_make(scene.silhouette, asked, samples[0].catalogue, grid)
        fell = tuple(tuple(int(b) for b in np.flatnonzero(v.fell)) for v in judged)
        drop = tuple(float(np.max(v.drop, initial=0.0)) for v in judged)
        asked_list = tuple(int(c) for c in asked)
        results.append(SceneResult(scene.name, asked_list, score, fell, drop, rank, feasible, stacks=tuple(samples)))
    return results


def ceiling(scenes: Sequence[Scene], checker: StabilityChecker, grid: Grid = PAPER_GRID) -> Evaluation:
    """The row no method should beat: the true stacks, simulated again.

    Raises:
        StackgenError: If a scene is only a drawing.
    """
    truths = [scene.truth for scene in scenes]
    known = [truth for truth in truths if truth is not None]
    if not known or len(known) < len(truths):
        raise StackgenError("the ceiling needs scenes that were taken from stacks")
    results = judge(scenes, [[truth] for truth in known], checker, grid)
    return Evaluation("Ground truth, simulated again", TRUE_LIST, tuple(results), 1, 0, physics_of(checker))


def batch_seed(seed: int, number: int, rank: int = 0) -> int:
    """The sampler's seed for a batch."""
    return int(np.random.SeedSequence([seed, number, rank]).generate_state(1)[0])


def physics_of(checker: StabilityChecker) -> dict[str, Any] | None:
    """The numbers a checker's verdicts hold for, if it tells."""
    physics = getattr(checker, "physics", None)
    return physics.to_json() if physics is not None else None


_worker_checker: StabilityChecker | None = None


def _start_worker(factory: Callable[[], StabilityChecker]) -> None:
    global _worker_checker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started the processes
    _worker_checker = factory()


def _check_in_worker(stack: Stack) -> Verdict:
    assert _worker_checker is not None
    return _worker_checker.check(stack)


class ParallelChecker:
    """A StabilityChecker that shares its work between processes; to be closed, or used in a `with`.

    Args:
        factory: Makes the checker of each process; can be pickled.
        workers: Number of processes.
    """

    def __init__(self, factory: Callable[[], StabilityChecker], workers: int) -> None:
        self.physics = getattr(factory(), "physics", None)
        # Spawned, not forked: torch's threads do not survive a fork.
        self._pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (factory,))

    def check(self, stack: Stack) -> Verdict:
        """Judge one stack."""
        return self.check_all([stack])[0]

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Judge many, in order."""
        return list(self._pool.map(_check_in_worker, stacks, chunksize=8))

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> ParallelChecker:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class SamplerEvaluation(pl.LightningModule):
    """The protocol under `Trainer.test`, for any sampler; the result is left in `evaluation`.

    Args:
        sampler: Whom to measure.
        checker: The physics.
        num_samples: Stacks per scene.
        seed: With it, the batch size and the number of processes, the same stacks again.
        predictor: Gives the block lists; None takes the true ones.
        method: Name for the tables.
        catalogue: What the shape indices of the batches mean.
        grid: Scale of the silhouettes.
        facts: To be quoted with the results.
    """

    def __init__(
        self,
        sampler: StackSampler,
        checker: StabilityChecker,
        num_samples: int = 3,
        seed: int = 0,
        predictor: BlockListPredictor | None = None,
        method: str = "StackGen",
        catalogue: Catalogue = PAPER_CATALOGUE,
        grid: Grid = PAPER_GRID,
        facts: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.sampler, self.checker, self.predictor = sampler, checker, predictor
        self.num_samples, self.seed, self.method = num_samples, seed, method
        self.catalogue, self.grid, self.facts = catalogue, grid, facts or {}
        self.metrics = scene_metrics("test/")
        self.results: list[SceneResult] = []
        self.evaluation: Evaluation | None = None

    def on_test_start(self) -> None:
        """Forget an earlier run."""
        self.results, self.evaluation = [], None

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Sample, judge and score the scenes of one batch."""
        world = self.trainer.world_size
        # The data module deals the scenes to the processes in turn.
        first = len(self.results) * world + self.global_rank
        scenes = scenes_of_batch(batch, self.catalogue, first, world)
        seed = batch_seed(self.seed, batch_idx, self.global_rank)
        found = evaluate_batch(self.sampler, scenes, self.checker, self.num_samples, seed, self.predictor, self.grid)
        self.metrics.update([result.score for result in found])
        self.results += found

    def on_test_epoch_end(self) -> None:
        """Put the processes' results together and log the metrics."""
        self.log_dict(self.metrics.compute(), sync_dist=True)  # the same on all processes already
        self.metrics.reset()
        results = self.results
        if self.trainer.world_size > 1:
            shares: list[list[SceneResult]] = [[] for _ in range(self.trainer.world_size)]
            torch.distributed.all_gather_object(shares, results)
            results = sorted((r for share in shares for r in share), key=lambda r: r.name)
        source = PREDICTED_LIST if self.predictor else TRUE_LIST
        self.evaluation = Evaluation(
            self.method, source, tuple(results), self.num_samples, self.seed, physics_of(self.checker), self.facts
        )
