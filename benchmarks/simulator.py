"""Verdicts per second on one core.

The stacks are those of testset-v1, which stand, and the same with noise on their positions, of which many fall.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.common import argument_parser, peak_rss_mb, plain_table, report, start
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.sim.checkers import fell
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.stack import Stack

ENGINES = (Physics(engine="bullet"), Physics(engine="mujoco"))


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--stacks", type=int, default=500, help="number of stacks of testset-v1")
    options.add_argument("--noise", type=float, default=0.1, help="standard deviation on positions [cell]")
    options.add_argument("--seed", type=int, default=0, help="seed of the noise")
    return options


def main() -> None:
    """Measure the speed of each engine on three kinds of stacks."""
    options = parser().parse_args()
    if options.stacks < 1:
        raise StackgenError("--stacks must be at least 1")
    rng = np.random.default_rng(options.seed)
    some = testset_stacks()[: options.stacks]
    noisy = [with_noise(stack, options.noise, rng) for stack in some]
    rows = [
        timed(f"{name}, {physics.engine}", physics, stacks, until_fall)
        for physics in ENGINES
        for name, stacks, until_fall in (
            ("testset-v1", some, True),
            (f"noise {options.noise:g}", noisy, True),
            (f"noise {options.noise:g}, whole watch", noisy, False),
        )
    ]
    metrics = {
        **{str(physics.engine): physics.to_json() for physics in ENGINES},
        "speed": rows,
        "peak_rss_mb": peak_rss_mb(),
    }
    report("simulator", metrics, [speed_table(rows, peak_rss_mb())], options.out)


def testset_stacks() -> list[Stack]:
    """The frozen scenes' stacks, read without torch: the peak of memory is the simulator's."""
    testset = Dataset.open(TESTSET)
    return [sample.stack(testset.world.catalogue) for sample in testset.samples("test")]


def timed(name: str, physics: Physics, stacks: Sequence[Stack], until_fall: bool) -> dict[str, Any]:
    """Verdicts and steps per second of one process, without the opening of the simulator."""
    with Simulator(physics) as simulator:
        simulator.rollout(stacks[0])
        begin = time.perf_counter()
        rollouts = [simulator.rollout(stack, until_fall=until_fall) for stack in stacks]
        seconds = time.perf_counter() - begin
    simulated = sum(rollout.time for rollout in rollouts)
    return {
        "stacks": name,
        "number": len(stacks),
        "stable": sum(not fell(rollout, physics).any() for rollout in rollouts) / len(stacks),
        "verdicts_per_second": len(stacks) / seconds,
        "steps_per_second": simulated / physics.step / seconds,
        "simulated_seconds_per_stack": simulated / len(stacks),
    }


def with_noise(stack: Stack, noise: float, rng: np.random.Generator) -> Stack:
    """The stack with its blocks' positions shifted at random; the lowest of them rests on the ground."""
    poses = stack.poses.copy()
    poses[:, :3] += rng.normal(0, noise, (len(stack), 3))
    poses[:, 2] += max(0.0, (0.5 - poses[:, 2]).max())
    return stack.with_poses(poses)


def speed_table(rows: Sequence[dict[str, Any]], rss: float) -> Any:
    """The table to print."""
    cells = [
        [
            row["stacks"],
            str(row["number"]),
            f"{100 * row['stable']:.1f}",
            f"{row['verdicts_per_second']:.1f}",
            f"{row['steps_per_second']:.0f}",
            f"{row['simulated_seconds_per_stack']:.3f}",
        ]
        for row in rows
    ]
    headings = ("stacks", "number", "stable [%]", "verdicts/s", "steps/s", "simulated [s]")
    return plain_table(f"One core; peak RSS {rss:.0f} MB", headings, cells)


if __name__ == "__main__":
    start(main)
