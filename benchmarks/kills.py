"""Twenty times `kill -9`: does the generator end with the bytes of an undisturbed run?

A small dataset is made once undisturbed, by one worker. Then it is made again, and again from the start whenever
it is complete, while at random moments the whole job, its parent or one of its workers is killed; a run that died
is started again with another number of workers. Every dataset that is complete is compared byte for byte.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.common import ROOT, argument_parser, plain_table, report, run_child, start
from stackgen.errors import StackgenError

KINDS = ("job", "parent", "worker")
PATIENCE = 120.0
"""How long workers may outlive their parent, and a run may stand still, before that is called a failure [s]."""


@dataclass
class Kill:
    """One kill.

    Args:
        dataset: Number of the dataset that was being made.
        what: `job` (parent and workers), `parent` or `worker`.
        workers: Number of workers of the run.
        shards: Number of shards that were whole at that moment.
        workers_gone: How long workers outlived their parent [s]; None where a worker was killed.
        identical: Whether the dataset ended with the bytes of the undisturbed one.
    """

    dataset: int
    what: str
    workers: int
    shards: int
    workers_gone: float | None = None
    identical: bool = False


@dataclass(frozen=True)
class Recipe:
    """Dataset that is made, and the command that makes it."""

    stacks: int
    templates_per_shard: int
    seed: int

    def command(self, out: Path, workers: int) -> list[str]:
        """Words of a run's command line."""
        options = {
            "name": "kills",
            "stacks": self.stacks,
            "templates_per_shard": self.templates_per_shard,
            "seed": self.seed,
            "validation": 0.2,
            "test": 0.2,
            "out": out,
            "workers": workers,
        }
        flags = [text for name, value in options.items() for text in (f"--{name}", str(value))]
        return [sys.executable, "-m", "stackgen", "generate", *flags]


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--kills", type=int, default=20, help="number of kills")
    options.add_argument("--stacks", type=int, default=400, help="stacks of the dataset")
    options.add_argument("--templates_per_shard", type=int, default=4, help="templates of a shard")
    options.add_argument("--seed", type=int, default=0, help="seed of the dataset and of the kills")
    return options


def main() -> None:
    """Kill, resume, compare."""
    options = parser().parse_args()
    if min(options.kills, options.stacks, options.templates_per_shard) < 1:
        raise StackgenError("--kills, --stacks and --templates_per_shard must be at least 1")
    recipe = Recipe(options.stacks, options.templates_per_shard, options.seed)
    with tempfile.TemporaryDirectory(prefix="stackgen-kills-") as folder:
        undisturbed = Path(folder) / "undisturbed"
        child = run_child(recipe.command(undisturbed, 1), threads=1)
        wanted = checksums(undisturbed)
        kills = torture(recipe, Path(folder), wanted, options.kills, np.random.default_rng(options.seed))
    shards = sum(name.endswith(".tar") for name in wanted)
    metrics = {
        "dataset": {**asdict(recipe), "shards": shards, "undisturbed_seconds": round(child.seconds, 1)},
        "kills": [asdict(kill) for kill in kills],
        "datasets": 1 + max(kill.dataset for kill in kills),
        "identical": all(kill.identical for kill in kills),
    }
    rows = [
        [
            str(number),
            kill.what,
            str(kill.workers),
            f"{kill.shards} of {shards}",
            "" if kill.workers_gone is None else f"{kill.workers_gone:.1f}",
            str(kill.dataset + 1),
            "identical" if kill.identical else "DIFFERENT",
        ]
        for number, kill in enumerate(kills, 1)
    ]
    headings = ["kill", "of the", "workers", "whole shards", "workers gone [s]", "dataset", "its bytes in the end"]
    report("kills", metrics, [plain_table(f"kill -9, {len(kills)} times", headings, rows)], options.out)
    if not metrics["identical"]:
        raise StackgenError("a dataset that was killed ended with other bytes")


def torture(recipe: Recipe, folder: Path, wanted: dict[str, str], number: int, rng: np.random.Generator) -> list[Kill]:
    """Kill until there were enough kills and the last dataset is complete."""
    kills: list[Kill] = []
    dataset = 0
    with Console(stderr=True).status("killing") as status:
        while len(kills) < number or any(kill.dataset == dataset for kill in kills):
            out = folder / str(dataset)
            mine = [] if len(kills) >= number else [KINDS[len(kills) % len(KINDS)]]
            run = Run(recipe, out, int(rng.integers(1, 4)))
            try:
                for what in mine:
                    kill = run.disturb(what, dataset, wanted, rng)
                    if kill is not None:
                        kills.append(kill)
                        status.update(f"{len(kills)} of {number} kills, dataset {dataset + 1}")
                complete = run.result()
            finally:
                run.end()
            if complete:
                same = checksums(out) == wanted
                for kill in kills:
                    if kill.dataset == dataset:
                        kill.identical = same
                dataset += 1
    return kills


class Run:
    """A command in a session of its own.

    Args:
        recipe: Recipe of the dataset that it makes.
        out: Folder of the dataset.
        workers: Number of workers.
    """

    def __init__(self, recipe: Recipe, out: Path, workers: int) -> None:
        self.out, self.workers = out, workers
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            recipe.command(out, workers),
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def disturb(self, what: str, dataset: int, wanted: dict[str, str], rng: np.random.Generator) -> Kill | None:
        """Wait for a random number of whole shards and a moment more, then kill; None if the run was faster."""
        total = sum(name.endswith(".tar") for name in wanted)
        target = int(rng.integers(min(self.shards(), total), total + 1))  # there may be more, made ahead
        if not self._until(lambda: self.shards() >= target and bool(self.pids())):
            return None
        time.sleep(float(rng.exponential(0.1)))
        victims = {"job": [*self.pids(), self.process.pid], "parent": [self.process.pid], "worker": self.pids()}[what]
        if self.process.poll() is not None or not victims:
            return None
        kill = Kill(dataset, what, self.workers, self.shards())
        for pid in [victims[int(rng.integers(len(victims)))]] if what == "worker" else victims:
            signal_9(pid)
        if what != "worker":
            begin = time.monotonic()
            self.process.wait()
            while self.pids():
                if time.monotonic() - begin > PATIENCE:
                    raise StackgenError(f"workers outlived their parent by {PATIENCE:g} s")
                time.sleep(0.05)
            kill.workers_gone = round(time.monotonic() - begin, 2)
        return kill

    def result(self) -> bool:
        """Wait for the end; whether the dataset is complete."""
        _, errors = self.process.communicate(timeout=PATIENCE * 5)
        if self.process.returncode not in (0, -signal.SIGKILL):
            raise StackgenError(f"a run ended with {self.process.returncode}: {errors.strip()[-300:]}")
        return self.process.returncode == 0

    def end(self) -> None:
        """Leave nothing of it running."""
        for pid in [self.process.pid, *self.pids()]:
            if self.process.poll() is None or pid != self.process.pid:
                signal_9(pid)

    def shards(self) -> int:
        """Whole shards so far."""
        return len(list(self.out.glob("*.tar")))

    def pids(self) -> list[int]:
        """Process ids of the workers."""
        command = ["ps", "-ww", "-s", str(self.process.pid), "-o", "pid=,args="]
        lines = subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()
        return [int(line.split()[0]) for line in lines if "spawn_main" in line]

    def _until(self, condition: Callable[[], bool]) -> bool:
        """Wait for something; False if the run ends before."""
        begin = time.monotonic()
        while not condition():
            if self.process.poll() is not None:
                return False
            if time.monotonic() - begin > 5 * PATIENCE:
                raise StackgenError(f"a run stood still for {5 * PATIENCE:g} s")
            time.sleep(0.02)
        return True


def signal_9(pid: int) -> None:
    """Kill a process, if it is still there."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def checksums(folder: Path) -> dict[str, str]:
    """Checksums of every file in a dataset."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


if __name__ == "__main__":
    start(main)
