"""The diversity limit: all layouts of a block list that fill a silhouette and stand, counted.

For scenes of testset-v1, evenly spread, with the true block list and with the CNN's. The search is exact
(stackgen.evaluation.diversity_limit); a layout stands if PyBullet says so of one of its placements. How often the
scene's own layout is found to stand tells how complete that is: it did stand when the scene was made. The report takes
the file from the package, where it is written by default.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.data.dataset import TESTSET
from stackgen.data.generation.deconstruction import surely_falls
from stackgen.errors import MALFORMED, StackgenError
from stackgen.evaluation.diversity_limit import PLACEMENTS, Answers, answers, expected_diversity
from stackgen.evaluation.intervals import Estimate, clustered_ratio
from stackgen.evaluation.protocol import Scene, load_scenes
from stackgen.evaluation.report.references import LIMIT_FILE, format_layout
from stackgen.evaluation.results import PREDICTED_LIST, TRUE_LIST
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.methods import load_predictor
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.physics import Physics
from stackgen.stack import Stack, layout
from stackgen.world import PAPER_GRID, PAPER_WORLD

SAMPLES = 3
"""Samples of a scene in the protocol."""

Counts = NDArray[np.int64]


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.set_defaults(out=LIMIT_FILE)
    options.add_argument("--scenes", type=int, default=500, help="scenes, evenly spread over the test set")
    options.add_argument("--placements", type=int, default=PLACEMENTS, help="displaced placements to try of a design")
    options.add_argument("--block_list_weights", default="default", help="weights of the block-list network")
    options.add_argument(
        "--add_to", type=Path, metavar="FILE.json", help="earlier result for as many scenes; its lists are kept"
    )
    options.add_argument("--workers", type=int, default=1, help="processes that search")
    return options


def main() -> None:
    """Search, simulate, count."""
    options = parser().parse_args()
    if min(options.scenes, options.workers) < 1 or options.placements < 0:
        raise StackgenError("--scenes and --workers must be at least 1, --placements at least 0")
    everything, dataset = load_scenes(TESTSET)
    number = min(options.scenes, len(everything))
    scenes = [everything[i] for i in np.linspace(0, len(everything) - 1, number).round().astype(int)]
    predictor = load_predictor(options.block_list_weights)
    predicted = predictor.predict(np.stack([scene.silhouette for scene in scenes]), top=1)[:, 0]
    source = f"{PREDICTED_LIST} by {predictor.card.get('name')}" if options.add_to else PREDICTED_LIST
    lists = {TRUE_LIST: [scene.counts for scene in scenes], source: list(predicted)}
    metrics: dict[str, Any] = {
        "test_set": dataset.manifest.sha256,
        "physics": StaticsFirst().physics.to_json(),
        "samples": SAMPLES,
        "placements": options.placements,
        "block_list_weights": predictor.card.get("sha256"),
        "lists": {},
    }
    if options.add_to:
        metrics |= kept(options.add_to, metrics, number)
        lists.pop(TRUE_LIST)
    for source, counts in lists.items():
        began = time.perf_counter()
        found = list(search(scenes, counts, options.placements, options.workers, source))
        metrics["lists"][source] = {**summary(scenes, counts, found), "seconds": time.perf_counter() - began}
    report("diversity_limit", metrics, tables(metrics), options.out)


def kept(path: Path, metrics: dict[str, Any], scenes: int) -> dict[str, Any]:
    """The lists of an earlier result, and by which weights.

    Raises:
        StackgenError: If it is about other scenes, samples, placements or physics.
    """
    try:
        figures = json.loads(path.read_text())["figures"]
        same = all(figures[name] == metrics[name] for name in ("test_set", "physics", "samples", "placements"))
        same = same and all(len(part["scenes"]) == scenes for part in figures["lists"].values())
    except (OSError, *MALFORMED) as error:
        raise StackgenError(f"--add_to: {path} is no result of benchmarks.diversity_limit") from error
    if not same:
        raise StackgenError(f"--add_to: {path} is about other scenes, placements or physics; leave the option out")
    return {name: figures[name] for name in ("lists", "block_list_weights")}


class StaticsFirst(StabilityChecker):
    """PyBullet, unless a block hangs in the air or beside its support: then it need not be asked."""

    def __init__(self) -> None:
        self.simulator = SimulatorChecker(until_fall=True)

    @property
    def physics(self) -> Physics:
        """The simulator's."""
        return self.simulator.physics

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        if not surely_falls(stack):
            return self.simulator.check(stack)
        return Verdict(False, np.ones(len(stack), dtype=bool), np.ones(len(stack)), stack)


_checker: StaticsFirst | None = None


def _answers(job: tuple[Scene, Counts], placements: int) -> Answers:
    """The layouts of one scene, by this process's own simulator."""
    global _checker
    _checker = _checker or StaticsFirst()
    return answers(job[0].silhouette, job[1], _checker, PAPER_WORLD, placements)


def search(
    scenes: Sequence[Scene], counts: Sequence[Counts], placements: int, workers: int, source: str
) -> Iterator[Answers]:
    """The layouts of each scene with its block list, in order."""
    jobs, work = list(zip(scenes, counts, strict=True)), partial(_answers, placements=placements)
    if workers == 1:
        yield from track(map(work, jobs), f"{source} lists", total=len(jobs))
        return
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        yield from track(pool.map(work, jobs), f"{source} lists", total=len(jobs))


def summary(scenes: Sequence[Scene], counts: Sequence[Counts], found: Sequence[Answers]) -> dict[str, Any]:
    """What was found with one kind of block list."""
    ones = np.ones(len(found))
    valid = np.array([len(some.valid) for some in found])
    own = [(layout(scene.truth, PAPER_GRID), some) for scene, list_, some in zip(scenes, counts, found, strict=True)
           if scene.truth is not None and np.array_equal(list_, scene.counts)]  # fmt: skip
    shares = {
        "diversity_limit": clustered_ratio([expected_diversity(number, SAMPLES) for number in valid], ones),
        "most_possible": clustered_ratio(np.minimum(valid, SAMPLES) / SAMPLES, ones),
        "matching_layouts": clustered_ratio([len(some.matching) for some in found], ones),
        "valid_layouts": clustered_ratio(valid, ones),
        "scenes_with_one_valid_layout": clustered_ratio(valid == 1, ones),
        "scenes_without_valid_layout": clustered_ratio(valid == 0, ones),
        "own_layout_found_to_stand": clustered_ratio([mine in some.valid for mine, some in own], np.ones(len(own))),
    }
    return {
        **{name: value and value.to_json() for name, value in shares.items()},
        "scenes": [
            {
                "scene": scene.name,
                "counts": list_.tolist(),
                "matching": len(some.matching),
                "valid": list(map(format_layout, some.valid)),
            }
            for scene, list_, some in zip(scenes, counts, found, strict=True)
        ],
    }


def tables(metrics: dict[str, Any]) -> list[Any]:
    """What is printed."""
    parts = metrics["lists"]
    names = [name for name, value in parts[TRUE_LIST].items() if isinstance(value, dict)]
    rows = [[name.replace("_", " "), *(_text(part[name]) for part in parts.values())] for name in names]
    rows.append(["scenes", *(str(len(part["scenes"])) for part in parts.values())])
    rows.append(["seconds", *(f"{part['seconds']:.0f}" for part in parts.values())])
    return [plain_table(f"Valid layouts, {SAMPLES} samples a scene, mean and 95 % interval", ("metric", *parts), rows)]


def _text(value: dict[str, float] | None) -> str:
    if value is None:
        return "-"
    estimate = Estimate(**value)
    return f"{estimate.value:.3f} ({estimate.low:.3f} to {estimate.high:.3f})"


if __name__ == "__main__":
    start(main)
