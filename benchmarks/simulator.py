"""Verdicts per second on one core, and how often a slower, finer simulation says the same.

Speed: the stacks of testset-v1, which stand, and the same with noise on their positions, of which many fall.
Agreement: on templates, on what is left of stacks after random removals, and on stacks with noise.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.common import argument_parser, peak_rss_mb, plain_table, report, start
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.sim.checkers import AcceptLimits, accept, fell
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Rollout, Simulator
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD

REFERENCE = Physics(time_step=1 / 960, solver_iterations=200, rest_window=0.25, rest_motion=2e-4, watch=4.0)
"""Twice the steps, three times the iterations, four times the window with a stricter rest, twice the watch.

Few stacks rest by its standard (Bullet's contacts tremble by more than that); what counts is where the
blocks are when its watch is over.
"""


@dataclass(frozen=True)
class Case:
    """A stack and where it came from."""

    source: str
    number: int
    stack: Stack


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--stacks", type=int, default=500, help="stacks of testset-v1 whose verdicts are timed")
    options.add_argument("--agreement", type=int, default=150, help="stacks judged by both, seconds each; 0 for none")
    options.add_argument("--noise", type=float, default=0.1, help="standard deviation on positions [cell]")
    options.add_argument("--seed", type=int, default=0, help="of noise, removals and templates")
    return options


def main() -> None:
    """Speed, then agreement."""
    options = parser().parse_args()
    if options.stacks < 1 or options.agreement < 0:
        raise StackgenError("--stacks must be at least 1 and --agreement at least 0")
    rng = np.random.default_rng(options.seed)
    stacks = testset_stacks()
    some = stacks[: options.stacks]
    noisy = [with_noise(stack, options.noise, rng) for stack in some]
    rows = [
        timed("testset-v1", some, until_fall=True),
        timed(f"noise {options.noise:g}", noisy, until_fall=True),
        timed(f"noise {options.noise:g}, whole watch", noisy, until_fall=False),
    ]
    figures: dict[str, Any] = {"physics": Physics().to_json(), "speed": rows, "peak_rss_mb": peak_rss_mb()}
    tables = [speed_table(rows, figures["peak_rss_mb"])]
    if options.agreement:
        figures["agreement"] = agreement(cases(stacks, options.agreement, options.noise, rng))
        tables += agreement_tables(figures["agreement"])
    report("simulator", figures, tables, options.out)


def testset_stacks() -> list[Stack]:
    """The frozen scenes' stacks, read without torch: the peak of memory is the simulator's."""
    testset = Dataset.open(TESTSET)
    return [sample.stack(testset.world.catalogue) for sample in testset.samples("test")]


def timed(name: str, stacks: Sequence[Stack], until_fall: bool) -> dict[str, Any]:
    """Verdicts and steps per second of one process, the opening of the world left out."""
    physics = Physics()
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
        "steps_per_second": simulated / physics.time_step / seconds,
        "simulated_seconds_per_stack": simulated / len(stacks),
    }


def cases(stacks: Sequence[Stack], number: int, noise: float, rng: np.random.Generator) -> list[Case]:
    """A third each: fresh templates, stacks after one to three random removals, stacks with noise."""
    found = []
    for i in range(number):
        stack = stacks[int(rng.integers(len(stacks)))]
        if i % 3 == 0:
            found.append(Case("template", i, realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD)))
        elif i % 3 == 1:
            found.append(Case("removal", i, without_some(stack, rng)))
        else:
            found.append(Case("noise", i, with_noise(stack, noise, rng)))
    return found


def with_noise(stack: Stack, noise: float, rng: np.random.Generator) -> Stack:
    """The stack with its blocks' positions shifted at random; the lowest of them rests on the ground."""
    poses = stack.poses.copy()
    poses[:, :3] += rng.normal(0, noise, (len(stack), 3))
    poses[:, 2] += max(0.0, (0.5 - poses[:, 2]).max())
    return stack.with_poses(poses)


def without_some(stack: Stack, rng: np.random.Generator) -> Stack:
    """The stack after one to three of its blocks were taken out, one block of the top row kept."""
    top = int(stack.poses[:, 2].argmax())
    others = [i for i in range(len(stack)) if i != top]
    gone = rng.choice(others, min(int(rng.integers(1, 4)), len(others)), replace=False)
    keep = np.setdiff1d(np.arange(len(stack)), gone)
    return Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)


def agreement(asked: Sequence[Case]) -> dict[str, Any]:
    """What both simulations say of each case."""
    fast, slow = Simulator(Physics()), Simulator(REFERENCE)
    judged = [(case, said(fast, case.stack), said(slow, case.stack, must_rest=False)) for case in asked]
    by_source: dict[str, dict[str, int]] = {}
    for case, quick, reference in judged:
        row = by_source.setdefault(case.source, {"number": 0, "stable": 0, "accepted": 0})
        row["number"] += 1
        for key in ("stable", "accepted"):
            row[key] += quick[key] == reference[key]
    return {
        "reference": dataclasses.asdict(REFERENCE),
        "by_source": by_source,
        "disagreements": [
            {"source": case.source, "number": case.number, "blocks": len(case.stack), "fast": quick, "reference": slow}
            for case, quick, slow in judged
            if any(quick[key] != slow[key] for key in ("stable", "accepted"))
        ],
    }


def said(simulator: Simulator, stack: Stack, must_rest: bool = True) -> dict[str, Any]:
    """Both answers to one rollout, and what they rest on.

    Args:
        simulator: Whom to ask.
        stack: Of what.
        must_rest: Whether a stack that still moves at the end is not accepted, wherever its blocks are.
    """
    rollout: Rollout = simulator.rollout(stack)
    return {
        "stable": bool(not fell(rollout, simulator.physics).any()),
        "accepted": accept(rollout if must_rest else dataclasses.replace(rollout, at_rest=True), AcceptLimits()),
        "largest_drop_cells": float(rollout.drop.max()),
        "at_rest": rollout.at_rest,
        "time": rollout.time,
    }


def speed_table(rows: Sequence[dict[str, Any]], rss: float) -> Any:
    """What is printed of the speed."""
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


def agreement_tables(found: dict[str, Any]) -> list[Any]:
    """What is printed of the agreement: counts, and each disagreement."""
    rows = [
        [source, str(row["number"]), str(row["stable"]), str(row["accepted"])]
        for source, row in found["by_source"].items()
    ]
    counts = plain_table("Agreement with the reference", ("stacks", "number", "same `fell`", "same `accept`"), rows)
    listed = [
        [f"{item['source']} {item['number']}", str(item["blocks"]), _words(item["fast"]), _words(item["reference"])]
        for item in found["disagreements"]
    ]
    return [counts, plain_table("Disagreements", ("case", "blocks", "fast", "reference"), listed)]


def _words(answer: dict[str, Any]) -> str:
    kind = "accepted" if answer["accepted"] else "stands" if answer["stable"] else "falls"
    rest = "rests" if answer["at_rest"] else "moves"
    return f"{kind}, drop {answer['largest_drop_cells']:.3f}, {rest} at {answer['time']:.2f} s"


if __name__ == "__main__":
    start(main)
