"""The paper's protocol for anything that samples stacks: scenes in, scores with intervals out.

`evaluate` is the one way to measure: `stackgen test`, `stackgen report` and the benchmarks call it. A StabilityChecker
says which stacks stand; stackgen.evaluation.parallel has one that shares the work between processes.

Legend: B scenes in a batch, n samples a scene, S shapes, H x W pixels.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.data.arrays import Batch, StackArrays
from stackgen.data.dataset import Dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.metrics import SceneScore, list_rank, score_sample
from stackgen.evaluation.results import PREDICTED_LIST, TOP, TRUE_LIST, Evaluation, SceneResult
from stackgen.geometry import silhouette
from stackgen.protocols import BlockListPredictor, StabilityChecker, StackSampler
from stackgen.sampling.feasible import can_make, has_plain_rows
from stackgen.stack import Stack
from stackgen.world import Catalogue, Grid, Mask, View, World

BATCH = 64
"""Scenes sampled at once; another number gives other samples."""

GROUND_TRUTH = "Ground truth, simulated again"

Progress = Callable[[int, int], None]
"""Told (scenes done, scenes in all)."""


@dataclass(frozen=True)
class Scene:
    """A target, and the blocks to build it from.

    Args:
        name: Name of the scene, in tables.
        silhouette: (H, W) target, front view.
        counts: (S,) true block list.
        truth: The stack it was taken from; None if the target is only a drawing.
    """

    name: str
    silhouette: Mask
    counts: NDArray[np.int64]
    truth: Stack | None = None

    def targets(self, grid: Grid) -> dict[View, Mask]:
        """Give the target of each view that has one."""
        front: dict[View, Mask] = {"front": self.silhouette}
        if self.truth is None:
            return front
        return {**front, "side": silhouette(self.truth, grid, "side"), "top": silhouette(self.truth, grid, "top")}


def load_scenes(path: str | Path, split: str = "test") -> tuple[list[Scene], Dataset]:
    """Read the scenes of a dataset's split; answer the dataset too.

    Raises:
        StackgenError: If there are none.
    """
    dataset = Dataset.open(path)
    return scenes_of(dataset.split(split), dataset.world.catalogue), dataset


def scenes_of(arrays: StackArrays, catalogue: Catalogue) -> list[Scene]:
    """Make scenes of the stacks of a split."""
    return scenes_of_batch(arrays.batch(np.arange(len(arrays))), catalogue)


def scenes_of_batch(batch: Batch, catalogue: Catalogue) -> list[Scene]:
    """Make scenes of the stacks of a batch, named by number and template."""
    parts = {name: tensor.cpu().numpy() for name, tensor in batch.items()}
    scenes = []
    for i, (shapes, poses, mask) in enumerate(zip(parts["shapes"], parts["poses"], parts["mask"], strict=True)):
        truth = Stack(shapes[mask], poses[mask], catalogue)
        name = f"{i:05d}-t{parts['template'][i]}"
        scenes.append(Scene(name, parts["silhouette"][i] > 0.5, parts["counts"][i], truth))
    return scenes


@dataclass(frozen=True)
class Request:
    """What is asked of a method: stacks for scenes, with the true block lists or with predicted ones.

    Args:
        method: Name of the method, in tables.
        world: World of the scenes.
        sampler: Samples the stacks; None asks for the ground truth, the true stacks simulated again.
        predictor: Gives the block lists; None takes the true ones.
        num_samples: Stacks of each scene.
        seed: With it and the batch size, the same stacks again.
        batch_size: Scenes sampled at once.
        facts: What is to be quoted with the result.
        identity: What tells the sampler from all others, as JSON allows; see stackgen.evaluation.requests.
        predictor_sha256: Hash of the predictor's weights.

    Raises:
        StackgenError: If a number is out of its range.
    """

    method: str
    world: World
    sampler: StackSampler | None
    predictor: BlockListPredictor | None = None
    num_samples: int = 3
    seed: int = 0
    batch_size: int = BATCH
    facts: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    predictor_sha256: str | None = None

    def __post_init__(self) -> None:
        if self.num_samples < 1 or self.batch_size < 1 or not 0 <= self.seed < 2**63:
            raise StackgenError("evaluation: num_samples and batch_size must be at least 1, seed at least 0")

    @property
    def block_list(self) -> str:
        """Whose block lists it is asked with: `true` or `predicted`."""
        return PREDICTED_LIST if self.predictor else TRUE_LIST

    @staticmethod
    def ground_truth(world: World, facts: Mapping[str, Any] | None = None) -> Request:
        """Ask for what no method should beat: the true stacks, simulated again."""
        identity = {"weights": "ground-truth"}
        return Request(GROUND_TRUTH, world, None, num_samples=1, facts=facts or {}, identity=identity)


def evaluate(
    request: Request, scenes: Sequence[Scene], checker: StabilityChecker, progress: Progress | None = None
) -> Evaluation:
    """Run the protocol (paper, "Evaluation in simulation").

    Args:
        request: Who samples, and how.
        scenes: What to ask.
        checker: Says which stacks stand.
        progress: Told after each batch.

    Raises:
        StackgenError: If there is nothing to evaluate, or ground truth is asked of a mere drawing.
    """
    if not scenes:
        raise StackgenError("evaluation: there must be at least one scene")
    results: list[SceneResult] = []
    sampling, began = 0.0, time.perf_counter()
    for number, start in enumerate(range(0, len(scenes), request.batch_size)):
        batch = scenes[start : start + request.batch_size]
        found, spent = _evaluate_batch(request, batch, checker, batch_seed(request.seed, number))
        results, sampling = results + found, sampling + spent
        if progress:
            progress(len(results), len(scenes))
    return Evaluation(
        request.method,
        request.block_list,
        tuple(results),
        num_samples=request.num_samples,
        seed=request.seed,
        physics=checker.physics.to_json(),
        facts=dict(request.facts),
        checking_seconds=time.perf_counter() - began - sampling,
    )


def _evaluate_batch(
    request: Request, scenes: Sequence[Scene], checker: StabilityChecker, seed: int
) -> tuple[list[SceneResult], float]:
    """Sample, check and score some scenes; answer what the sampler took too [s]."""
    if request.sampler is None:
        truths = [[scene.truth] for scene in scenes if scene.truth is not None]
        if len(truths) < len(scenes):
            raise StackgenError("ground truth needs scenes that were taken from stacks")
        return check_scenes(scenes, truths, checker, request.world), 0.0
    block_lists, ranks = block_lists_of(request, scenes)
    began = time.perf_counter()
    stacks = draw(request, scenes, block_lists, seed)
    spent = time.perf_counter() - began
    each = spent / (request.num_samples * len(scenes))
    found = check_scenes(scenes, stacks, checker, request.world, block_lists=block_lists, ranks=ranks)
    return [replace(result, seconds=each) for result in found], spent


def block_lists_of(request: Request, scenes: Sequence[Scene]) -> tuple[NDArray[np.int64], list[int | None]]:
    """(B, S) block lists that a method is asked with, and the place of each true one among those predicted."""
    truths = np.stack([scene.counts for scene in scenes])
    if request.predictor is None:
        return truths, [None] * len(scenes)
    ranked = request.predictor.predict(np.stack([scene.silhouette for scene in scenes]), top=TOP)
    return ranked[:, 0], list(list_rank(ranked, truths).tolist())


def draw(
    request: Request, scenes: Sequence[Scene], block_lists: NDArray[np.int64], seed: int
) -> Sequence[Sequence[Stack]]:
    """Sample the stacks of some scenes with the block lists (B, S) given."""
    assert request.sampler is not None
    silhouettes = np.stack([scene.silhouette for scene in scenes])
    return request.sampler.sample_batch(silhouettes, block_lists, request.num_samples, seed)


def check_scenes(
    scenes: Sequence[Scene],
    stacks: Sequence[Sequence[Stack]],
    checker: StabilityChecker,
    world: World,
    *,
    block_lists: NDArray[np.int64] | None = None,
    ranks: Sequence[int | None] | None = None,
) -> list[SceneResult]:
    """Check and score stacks that were made for some scenes.

    Args:
        scenes: B targets.
        stacks: n stacks for each.
        checker: Says which stand.
        world: World of the scenes.
        block_lists: (B, S) block lists that were asked for; the true ones by default.
        ranks: Place of the true list among the predicted ones; None for a list that was given.
    """
    verdicts = iter(checker.check_all([stack for samples in stacks for stack in samples]))
    results = []
    for i, (scene, samples) in enumerate(zip(scenes, stacks, strict=True)):
        targets, said = scene.targets(world.grid), [next(verdicts) for _ in samples]
        asked = scene.counts if block_lists is None else block_lists[i]
        scores = (score_sample(s, v, targets, world.grid) for s, v in zip(samples, said, strict=True))
        rank, feasible = ranks[i] if ranks else None, None
        if rank is not None and has_plain_rows(world.catalogue):
            feasible = can_make(scene.silhouette, asked, world)
        results.append(
            SceneResult(
                scene.name,
                tuple(int(c) for c in asked),
                SceneScore(tuple(scores)),
                fell=tuple(tuple(int(b) for b in np.flatnonzero(v.fell)) for v in said),
                drop=tuple(float(np.max(v.drop, initial=0.0)) for v in said),
                list_rank=rank,
                feasible=feasible,
                stacks=tuple(samples),
            )
        )
    return results


def batch_seed(seed: int, number: int, rank: int = 0) -> int:
    """Give the sampler's seed for a batch (of a process, in training)."""
    return int(np.random.SeedSequence([seed, number, rank]).generate_state(1)[0])
