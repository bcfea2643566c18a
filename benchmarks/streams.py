"""Samples per second of every way that training reads data, and the memory it takes, each in a process of its own.

`cached` gathers batches from a split in memory, on one thread; `fill` reads that split from the shards once; `stream`
reads shards as it goes, in the training process or in workers; `exact` is a validation pass. Shards are read from a
local folder that the system has in its cache. Without --data the stacks are those of testset-v1, over and over, in
shards of 2000.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from benchmarks.common import argument_parser, peak_rss_mb, plain_table, report, run_child, start, summary

SHARD = 2000
PATHS: dict[str, dict[str, Any]] = {
    "cached": {},
    "cached, mirrored": {"mirror": True},
    "cached, mirrored, bucketed": {"mirror": True, "bucket_by_blocks": True},
    "fill": {},
    "stream, 0 workers": {"num_workers": 0},
    "stream, 1 worker": {"num_workers": 1},
    "stream, 2 workers": {"num_workers": 2},
    "exact, 0 workers": {"num_workers": 0},
}
"""What is measured, and the options of its loader."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--data", type=Path, help="dataset folder; made from testset-v1 if left out")
    options.add_argument("--stacks", type=int, default=100_000, help="stacks of the dataset that is made")
    options.add_argument("--batch_size", type=int, default=4096, help="stacks of a batch")
    options.add_argument("--repeats", type=int, default=3, help="epochs that are timed, after one that is not")
    options.add_argument("--paths", nargs="+", choices=PATHS, default=list(PATHS), metavar="PATH", help="ways to read")
    options.add_argument("--child", help=argparse.SUPPRESS)
    return options


def main() -> None:
    """Measure in children: peaks of memory are then each one's own."""
    options = parser().parse_args()
    if options.child == "make":
        make_dataset(options.data, options.stacks)
        return
    if options.child:
        print(json.dumps(measure(options, options.child)))
        return
    with tempfile.TemporaryDirectory(prefix="stackgen-streams-") as made:
        given = options.data is not None
        if not given:
            options.data = Path(made)
            in_child(options, "make")
        rows = [{"path": path, **json.loads(in_child(options, path))} for path in options.paths]
    cells = [
        [
            row["path"],
            f"{row['samples_per_second']['median']:,.0f}",
            f"{row['samples_per_cpu_second']:,.0f}",
            f"{row['peak_rss_mb']:.0f}",
            f"{row['worker_rss_mb']:.0f}" if row["worker_rss_mb"] else "",
        ]
        for row in rows
    ]
    headings = ("path", "samples/s", "samples/CPU s", "RSS [MB]", "worker [MB]")
    what = options.data.name if given else "testset-v1, repeated"
    metrics = {
        "data": what,
        "stacks": rows[0]["stacks"] if rows else 0,
        "batch_size": options.batch_size,
        "rows": rows,
    }
    title = f"Reading {metrics['stacks']:,} stacks ({what}) in batches of {options.batch_size}"
    report("streams", metrics, [plain_table(title, headings, cells)], options.out)


def in_child(options: argparse.Namespace, path: str) -> str:
    """What a child on one thread prints last."""
    command = [sys.executable, "-m", "benchmarks.streams", "--child", path, "--data", str(options.data)]
    command += ["--stacks", str(options.stacks), "--batch_size", str(options.batch_size)]
    command += ["--repeats", str(options.repeats)]
    return (run_child(command, threads=1).output.strip().splitlines() or [""])[-1]


def make_dataset(folder: Path, stacks: int) -> None:
    """A dataset of copies of one shard that holds the stacks of testset-v1 four times."""
    from dataclasses import replace

    from stackgen.data.dataset import TESTSET, Dataset
    from stackgen.data.shards import write_shard

    testset = Dataset.open(TESTSET)
    scenes = list(testset.samples("test"))
    samples = [replace(scene, key=f"{i}{scene.key}") for i in range(SHARD // len(scenes)) for scene in scenes]
    first = write_shard(folder / "train-000000.tar", samples)
    names = [f"train-{number:06d}.tar" for number in range(-(-stacks // SHARD))]
    for name in names[1:]:
        shutil.copyfile(folder / names[0], folder / name)
    entries = tuple({**first, "file": name} for name in names)
    replace(testset.manifest, name="streams", shards=entries).save(folder)


def measure(options: argparse.Namespace, path: str) -> dict[str, Any]:
    """Read the training split some times in this process."""
    import torch

    torch.set_num_threads(1)
    count, epoch = reader(options, path)
    epoch()
    walls, busy = [], []
    for _ in range(options.repeats):
        wall, cpu = time.perf_counter(), cpu_seconds()
        seen = epoch()
        walls.append(seen / (time.perf_counter() - wall))
        busy.append(seen / (cpu_seconds() - cpu))
    kilobytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return {
        "stacks": count,
        "samples_per_second": summary(walls),
        "samples_per_cpu_second": statistics.median(busy),  # what a core does that has nothing else to do
        "peak_rss_mb": peak_rss_mb(),
        "worker_rss_mb": kilobytes / (1e6 if sys.platform == "darwin" else 1e6 / 1024),
    }


def cpu_seconds() -> float:
    """Processor time of this process and of those of its workers that have ended [s]."""
    return sum(os.times()[:4])


def reader(options: argparse.Namespace, path: str) -> tuple[int, Callable[[], int]]:
    """The number of stacks, and a function that reads them once and answers how many it saw."""
    from stackgen.data.dataset import Dataset
    from stackgen.data.loading.cached import CachedLoader
    from stackgen.data.loading.streaming import ExactStream, TrainingStream

    folder, kind = str(options.data), path.partition(",")[0]
    dataset = Dataset.open(folder)
    count = dataset.manifest.count("train")
    if kind == "fill":
        return count, lambda: len(Dataset.open(folder).split("train"))
    loader: Iterable[Any]
    if kind == "cached":
        arrays = dataset.split("train")
        loader = CachedLoader(arrays, options.batch_size, train=True, **PATHS[path])
    elif kind == "stream":
        loader = TrainingStream(dataset, options.batch_size, **PATHS[path])
    else:
        loader = ExactStream(dataset, "train", options.batch_size, **PATHS[path])
    return count, lambda: sum(len(batch["template"]) for batch in loader)


if __name__ == "__main__":
    start(main)
