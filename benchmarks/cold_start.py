"""From `stackgen sample` typed to the files written, in a fresh process; and where the time goes in a warm one.

The disk cache is warm after the first run, which is listed on its own. Warm times leave out what a process
does once: imports, reading weights, opening the simulator, the first passes of the networks.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common import ROOT, Child, argument_parser, peak_rss_mb, plain_table, report, run_child, start, summary

IMAGE = Path("examples/silhouettes/arch.png")


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--image", type=Path, default=IMAGE, help="silhouette, from the repository root")
    options.add_argument("--num_samples", type=int, default=3, help="stacks for the image")
    options.add_argument("--runs", type=int, default=10, help="cold processes, and warm repetitions")
    options.add_argument("--weights", default="default", help="weights of the sampler")
    options.add_argument("--block_list_weights", default="default", help="weights of the block-list network")
    options.add_argument("--blocks", help="block list such as cube=3; chosen by the network if left out")
    return options


def main() -> None:
    """Cold runs first, while this process is still small; then warm ones in it."""
    options = parser().parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cold = [cold_run(options, Path(folder) / str(number)) for number in range(options.runs)]
        seconds = [child.seconds for child in cold]
        first_call, stages, warm_rss = warm_runs(options, Path(folder) / "warm")
    total = sum(stage["median"] for stage in stages.values())
    metrics: dict[str, Any] = {
        "num_samples": options.num_samples,
        "cold_seconds": {**summary(seconds), "first": seconds[0]},
        "cold_peak_rss_mb": max(child.peak_rss_mb for child in cold),
        "warm_first_call_seconds": first_call,
        "warm_seconds": total,
        "warm_peak_rss_mb": warm_rss,
        "warm_stages": {name: {**stage, "share": stage["median"] / total} for name, stage in stages.items()},
    }
    report("cold_start", metrics, tables(metrics), options.out)


def cold_run(options: argparse.Namespace, out: Path) -> Child:
    """One `stackgen sample` in a process of its own."""
    command = [sys.executable, "-m", "stackgen", "sample", str(options.image), "--out", str(out)]
    command += ["--num_samples", str(options.num_samples)]
    command += ["--weights", options.weights, "--block_list_weights", options.block_list_weights]
    return run_child(command + (["--blocks", options.blocks] if options.blocks else []))


def warm_runs(options: argparse.Namespace, folder: Path) -> tuple[float, dict[str, dict[str, float]], float]:
    """Seconds of the first call with its loading, of each stage of the later ones, and peak memory [MB]."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as `stackgen sample` has it; torch reads it when it is imported
    begin = time.perf_counter()
    from stackgen.api import check, load
    from stackgen.commands.sample_pictures import write_result
    from stackgen.vision.reader import read_picture

    image, n = ROOT / options.image, options.num_samples
    model = load(options.weights, options.block_list_weights)
    result = model.sample_checked(image, n, 0, options.blocks)
    overlay = read_picture(image, model.world.grid).overlay
    write_result(result, folder, overlay)
    first_call = time.perf_counter() - begin

    mask, counts = model.read(image), result.block_list
    assert counts is not None
    stages: dict[str, Callable[[], object]] = {
        "image": lambda: model.read(image),
        "block list": lambda: options.blocks or model.predictor.predict(mask[None]),
        "sampler": lambda: model.sampler.sample_batch(mask[None], counts[None], n, 0),
        "physics": lambda: [check(model.checker, stack, mask, model.world.grid) for stack in result.stacks],
        "drawing and files": lambda: write_result(result, folder, overlay),
    }
    return first_call, {name: repeated(stage, options.runs) for name, stage in stages.items()}, peak_rss_mb()


def repeated(stage: Callable[[], object], runs: int) -> dict[str, float]:
    """Seconds of a stage over some runs."""
    seconds = []
    for _ in range(runs):
        begin = time.perf_counter()
        stage()
        seconds.append(time.perf_counter() - begin)
    return summary(seconds)


def tables(metrics: dict[str, Any]) -> list[Any]:
    """What is printed."""
    cold = metrics["cold_seconds"]
    totals = plain_table(
        f"stackgen sample, one image, {metrics['num_samples']} samples, {cold['runs']} runs",
        ("", "median [s]", "min", "max", "first", "peak RSS [MB]"),
        [
            [
                "cold: typed to written",
                *(f"{cold[key]:.2f}" for key in ("median", "min", "max", "first")),
                f"{metrics['cold_peak_rss_mb']:.0f}",
            ],
            [
                "warm: all stages",
                f"{metrics['warm_seconds']:.3f}",
                *(f"{sum(s[key] for s in metrics['warm_stages'].values()):.3f}" for key in ("min", "max")),
                f"{metrics['warm_first_call_seconds']:.2f}",
                f"{metrics['warm_peak_rss_mb']:.0f}",
            ],
        ],
    )
    rows = [
        [
            name,
            f"{1000 * s['median']:.1f}",
            f"{1000 * s['min']:.1f}",
            f"{1000 * s['max']:.1f}",
            f"{100 * s['share']:.0f}",
        ]
        for name, s in metrics["warm_stages"].items()
    ]
    headings = ("warm stage", "median [ms]", "min", "max", "share [%]")
    return [totals, plain_table("Where the time of a warm call goes", headings, rows)]


if __name__ == "__main__":
    start(main)
