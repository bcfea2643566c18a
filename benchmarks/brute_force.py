"""Brute force over the frozen test scenes with both block lists, and the naive loop over a few of them.

The searches alone: prediction of the lists and simulation are left out. Seconds are those of the clock and of the
processor; on a busy machine the latter are the ones to compare.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.baselines.brute_force import BruteForce
from stackgen.baselines.heuristic import random_stream
from stackgen.data.dataset import TESTSET
from stackgen.evaluation.protocol import Scene, load_scenes
from stackgen.world import Mask
from tests.baselines.naive import naive_search

Question = tuple[Mask, NDArray[np.int64]]


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--scenes", type=int, default=500, help="scenes of the test set")
    options.add_argument("--num_samples", type=int, default=3, help="stacks for each scene and list")
    options.add_argument("--processes", type=int, default=1, help="processes that share the scenes")
    options.add_argument("--naive", type=int, default=3, help="scenes for the naive loop, one stack each; 0 for none")
    options.add_argument("--block_list_weights", default="default", help="weights of the block-list network")
    return options


def main() -> None:
    """Measure."""
    options = parser().parse_args()
    scenes = load_scenes(TESTSET)[0][: options.scenes]
    metrics: dict[str, Any] = {"scenes": len(scenes), "num_samples": options.num_samples, "lists": {}}
    for name, counts in block_lists(scenes, options.block_list_weights).items():
        questions = list(zip((scene.silhouette for scene in scenes), counts, strict=True))
        clock, processor = searched(questions, options.num_samples, options.processes)
        blocks = int(counts.sum()) * options.num_samples
        metrics["lists"][name] = {"blocks": blocks, "seconds": clock, "processor_seconds": processor}
    metrics["processes"] = options.processes
    if options.naive:
        metrics["naive"] = naive(scenes[: options.naive])
    report("brute_force", metrics, [table(metrics)], options.out)


def block_lists(scenes: Sequence[Scene], weights: str) -> dict[str, NDArray[np.int64]]:
    """(B, S) the true lists and the network's most likely ones."""
    from stackgen.sampling.methods import load_predictor

    pictures = np.stack([scene.silhouette for scene in scenes])
    parts = [
        load_predictor(weights).predict(part)[:, 0] for part in np.array_split(pictures, max(1, len(scenes) // 64))
    ]
    return {"true": np.stack([scene.counts for scene in scenes]), "CNN's": np.concatenate(parts)}


def searched(questions: Sequence[Question], num_samples: int, processes: int) -> tuple[float, float]:
    """Seconds of clock and processor for all scenes; starting the processes is not counted."""
    if processes == 1:
        began = time.perf_counter()
        processor = sum(map(search, questions, repeat(num_samples)))
        return time.perf_counter() - began, processor
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        list(pool.map(search, questions[:processes], repeat(1)))  # imports
        began = time.perf_counter()
        processor = sum(pool.map(search, questions, repeat(num_samples), chunksize=8))
        return time.perf_counter() - began, processor


def search(question: Question, num_samples: int) -> float:
    """Sample a scene; seconds of the processor."""
    picture, counts = question
    return _processor(lambda: BruteForce().sample_batch(picture[None], counts[None], num_samples, 0))


def naive(scenes: Sequence[Scene]) -> dict[str, float]:
    """The loop over single candidates."""
    method = BruteForce()

    def loop() -> None:
        for scene in scenes:
            rng = random_stream(0, scene.silhouette, scene.counts, 0)
            naive_search(method, scene.silhouette, scene.counts, rng)

    return {"blocks": sum(int(scene.counts.sum()) for scene in scenes), "processor_seconds": _processor(loop)}


def _processor(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def table(metrics: dict[str, Any]) -> Any:
    """What is printed."""
    rows = [
        [f"{name} lists", str(f["blocks"]), f"{f['seconds']:.1f}", f"{f['processor_seconds']:.1f}"]
        for name, f in metrics["lists"].items()
    ]
    if "naive" in metrics:
        loop, blocks = metrics["naive"], sum(f["blocks"] for f in metrics["lists"].values())
        once = loop["processor_seconds"] / loop["blocks"]
        rows.append(["naive loop", str(loop["blocks"]), "", f"{loop['processor_seconds']:.1f}"])
        rows.append(["naive loop, both lists (extrapolated)", str(blocks), "", f"{once * blocks:.0f}"])
    title = (
        f"Brute force, {metrics['scenes']} scenes x {metrics['num_samples']} samples, {metrics['processes']} processes"
    )
    return plain_table(title, ("", "blocks", "clock [s]", "processor [s]"), rows)


if __name__ == "__main__":
    start(main)
