"""Quality against steps, what mending and verified sampling add, and what they cost, on validation scenes.

Three tables: each kind of sampler at some numbers of steps, samples mended some times, and verified sampling with both
checkers. Intervals are 95 %, clustered by scene. The time is that of one silhouette's samples alone, warm; verified
sampling is timed with its checker. Each row is printed and written when it is there.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.names import CheckerName

KINDS = {
    "ddpm": SamplerConfig("ddpm"),
    "ddim": SamplerConfig("ddim"),
    "dpm": SamplerConfig("dpm"),
    "dpm-sde": SamplerConfig("dpm", eta=1.0),
}
TABLES = ("steps", "mended", "verified")
METRICS = ("stability", "front_iou", "iou_given_stable", "valid_diversity")


@dataclass(frozen=True)
class Row:
    """What is measured.

    Args:
        table, name: Table and line that it stands in.
        sampler: Settings of the sampler.
        verify: Checker of verified sampling; None for single samples.
    """

    table: str
    name: str
    sampler: SamplerConfig
    verify: CheckerName | None = None


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--weights", default="default", help="weights of a diffusion model")
    options.add_argument("--data", default="data/base.npz", help="dataset with a validation split")
    options.add_argument("--lists", default=None, help="weights that predict the block lists; the true ones by default")
    options.add_argument("--scenes", type=int, default=150, help="drawn from the validation split")
    options.add_argument("--num_samples", type=int, default=3, help="samples of each scene")
    options.add_argument("--seed", type=int, default=0, help="seed of scenes and noise")
    options.add_argument("--tables", nargs="+", choices=TABLES, default=["steps", "verified"], help="what to measure")
    options.add_argument(
        "--kinds", nargs="+", choices=list(KINDS), default=["ddpm", "ddim", "dpm"], help="kinds of samplers"
    )
    options.add_argument("--steps", nargs="+", type=int, default=[50, 25, 16, 10, 8, 5, 4], help="calls of the network")
    options.add_argument("--mends", nargs="+", type=int, default=[0, 1, 2, 4], help="times that a sample is mended")
    options.add_argument("--spacing", type=float, default=None, help="spacing of the steps, see SamplerConfig")
    options.add_argument("--checker", choices=get_args(CheckerName), default="simulator", help="checker that chooses")
    options.add_argument("--draws", type=int, default=64, help="stacks that verified sampling may draw for a scene")
    options.add_argument("--runs", type=int, default=10, help="timed calls a row")
    return options


def rows_of(options: argparse.Namespace) -> list[Row]:
    """What the options ask for."""
    rows = []
    fast = SamplerConfig("ddpm", 8, options.spacing)
    if "steps" in options.tables:
        for kind in options.kinds:
            for steps in options.steps:
                settings = KINDS[kind].over(SamplerConfig(steps=steps, spacing=options.spacing))
                rows.append(Row("steps", f"{kind} {steps}", settings))
    if "mended" in options.tables:
        rows += [Row("mended", f"mended {times} times", SamplerConfig(mend=times)) for times in options.mends]
    if "verified" in options.tables:
        rows.append(Row("verified", "single samples", fast))
        rows += [Row("verified", checker, fast, checker) for checker in get_args(CheckerName)]
    return rows


def main() -> None:
    """Measure and print."""
    options = parser().parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as `stackgen sample` has it; torch reads it when it is imported
    rows = rows_of(options)
    from stackgen.evaluation.protocol import load_scenes
    from stackgen.sampling.methods import load_predictor, load_sampler
    from stackgen.sim.checkers import SimulatorChecker

    loaded: Any = load_sampler(options.weights)
    if not hasattr(loaded, "configured"):
        raise StackgenError(f"{options.weights} is no diffusion model")
    scenes, dataset = load_scenes(options.data, "validation")
    chosen = np.random.default_rng(options.seed).choice(len(scenes), min(options.scenes, len(scenes)), replace=False)
    scenes = [scenes[i] for i in sorted(chosen)]
    checker = SimulatorChecker(until_fall=True)
    lists = None if options.lists is None else load_predictor(options.lists)
    metrics: dict[str, Any] = {
        "weights": loaded.card.get("name", options.weights),
        "weights_sha256": loaded.card.get("sha256"),
        "dataset": dataset.manifest.name,
        "lists": options.lists or "the scenes'",
        "scenes": len(scenes),
        "samples_per_scene": options.num_samples,
        "seed": options.seed,
        "checker": options.checker,
        "physics": checker.physics.to_json(),
        "rows": [],
    }
    for number, row in enumerate(rows, 1):
        found = measure(row, loaded.configured(row.sampler), scenes, checker, lists, options)
        metrics["rows"].append(found)
        line = ", ".join(f"{name} {percent(found[name])}" for name in METRICS)
        print(f"{number}/{len(rows)} {row.table}: {row.name}: {line}, {found['milliseconds']:.0f} ms", flush=True)
        if options.out is not None:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            write_json(options.out, metrics)
    report("sampling", metrics, tables(metrics["rows"], len(scenes), options.num_samples), options.out)


def measure(
    row: Row, sampler: Any, scenes: Sequence[Any], checker: Any, lists: Any, options: argparse.Namespace
) -> dict[str, Any]:
    """Quality and time of a row."""
    from stackgen.evaluation.protocol import Request, evaluate
    from stackgen.sampling.verified import Budget, VerifiedSampler, checker_named

    if row.verify is not None:
        chooser = checker_named(row.verify, checker)
        sampler = VerifiedSampler(sampler, chooser, Budget(options.draws), row.verify)
    request = Request(row.name, sampler.world, sampler, lists, num_samples=options.num_samples, seed=options.seed)
    found = evaluate(request, scenes, checker_named(options.checker, checker))
    estimates = {name: found.estimate(name) for name in METRICS}

    def once(number: int) -> Callable[[], object]:
        scene = scenes[number % len(scenes)]
        asked = scene.silhouette[None], scene.counts[None], options.num_samples, number
        return lambda: sampler.sample_batch(*asked)

    once(0)()
    return {
        "table": row.table,
        "name": row.name,
        "sampler": sampler.settings,
        "milliseconds": statistics.median(milliseconds(once(i)) for i in range(options.runs)),
        **{name: estimate and estimate.to_json() for name, estimate in estimates.items()},
    }


def milliseconds(call: Callable[[], object]) -> float:
    """Wall time of a call."""
    begin = time.perf_counter()
    call()
    return 1000 * (time.perf_counter() - begin)


def tables(results: Sequence[dict[str, Any]], scenes: int, samples: int) -> list[Any]:
    """What is printed."""
    printed = []
    for name in TABLES:
        lines = [
            [found["name"], *(percent(found[metric]) for metric in METRICS), f"{found['milliseconds']:.0f}"]
            for found in results
            if found["table"] == name
        ]
        headings = ("", "stability", "front IoU", "IoU if stable", "valid diversity", f"ms for {samples}")
        if lines:
            printed.append(plain_table(f"{name}: {scenes} scenes x {samples}, percent", headings, lines))
    return printed


def percent(estimate: dict[str, float] | None) -> str:
    """A metric with its interval."""
    if estimate is None:
        return "-"
    return f"{100 * estimate['value']:.1f} ({100 * estimate['low']:.0f}-{100 * estimate['high']:.0f})"


if __name__ == "__main__":
    start(main)
