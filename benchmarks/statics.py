"""How often statics and PyBullet agree, and what statics costs.

The stacks are settled ones of testset-v1, others of them less a block, and still others with noise on every
coordinate, which float and interpenetrate a little as a network's samples do; or the stacks of files.
Times are process times: on a busy machine they are too long, never too short.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import read_stacks
from stackgen.protocols import Verdict
from stackgen.sim.checkers import SimulatorChecker
from stackgen.sim.statics.checker import CONTACT_TOLERANCE, SAFETY, StaticsAnswer, StaticsChecker
from stackgen.stack import Stack

KINDS = ("settled", "less a block", "shaken")
TOLERANCES = (0.02, 0.08, 0.2, CONTACT_TOLERANCE, 0.4)
MOVED = 0.3
"""A block that the simulator moved further than this was not held [cell]."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Case:
    """A stack, where it came from, and what PyBullet and statics, without a safety margin, say of it."""

    kind: str
    name: str
    stack: Stack
    simulated: Verdict
    statics: StaticsAnswer

    def said(self, safety: float) -> bool:
        """Whether statics calls it stable with a safety margin [rad]."""
        return self.statics.stable and self.statics.margin >= safety


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=200, help="number of stacks of each kind")
    options.add_argument("--noise", type=float, default=0.02, help="standard deviation on all coordinates [cell, rad]")
    options.add_argument("--seed", type=int, default=0, help="seed of the draw, the removals and the noise")
    options.add_argument("--files", type=Path, nargs="*", default=[], help="stacks files to check instead")
    return options


def main() -> None:
    """Check, compare, measure times."""
    options = parser().parse_args()
    if options.number < 1:
        raise StackgenError("--number must be at least 1")
    stacks = from_files(options.files) if options.files else drawn(options)
    simulator, statics = SimulatorChecker(), StaticsChecker(safety=0)
    cases = [Case(*named, simulator.check(named[2]), statics.answer(named[2])) for named in stacks]
    metrics: dict[str, Any] = {
        "physics": simulator.physics.to_json(),
        "contact_tolerance": CONTACT_TOLERANCE,
        "safety": SAFETY,
        "agreement": agreement(cases),
        "tolerances": tolerances(cases),
        "unheld": unheld(cases),
        "milliseconds": times([case.stack for case in cases]),
        "disagreements": disagreements(cases),
    }
    report("statics", metrics, tables(metrics), options.out)


def from_files(files: Sequence[Path]) -> list[tuple[str, str, Stack]]:
    """The stacks of stacks files."""
    return [
        (str(file), f"{file.name} {number}", stack)
        for file in files
        for number, stack in enumerate(read_stacks(file).stacks, 1)
    ]


def drawn(options: argparse.Namespace) -> list[tuple[str, str, Stack]]:
    """Stacks of each kind, each kind with its own draw."""
    testset = Dataset.open(TESTSET)
    samples = list(testset.samples("test"))
    rng = np.random.default_rng(options.seed)
    found = []
    for kind in KINDS:
        for i in rng.choice(len(samples), min(options.number, len(samples)), replace=False):
            stack = samples[i].stack(testset.world.catalogue)
            if kind == "less a block":
                keep = np.arange(len(stack)) != rng.integers(len(stack))
                stack = Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)
            elif kind == "shaken":
                stack = stack.with_poses(stack.poses + rng.normal(0, options.noise, stack.poses.shape))
            found.append((kind, samples[i].key, stack))
    return found


def groups(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """The cases by kind, and those of the first two kinds together: neither floats."""
    by_kind = {kind: [case for case in cases if case.kind == kind] for kind in dict.fromkeys(c.kind for c in cases)}
    if set(KINDS) <= set(by_kind):
        by_kind["settled and less a block"] = by_kind[KINDS[0]] + by_kind[KINDS[1]]
    return by_kind


def compared(said: Flags, truth: Flags) -> dict[str, float]:
    """Shares of all stacks."""
    return {
        "agree": float((said == truth).mean()),
        "false_stable": float((said & ~truth).mean()),
        "false_unstable": float((~said & truth).mean()),
    }


def simulated(cases: Sequence[Case]) -> Flags:
    """(n,) what PyBullet says."""
    return np.array([case.simulated.stable for case in cases])


def agreement(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Agreement of the verdicts, without and with the safety margin."""
    return [
        {
            "stacks": kind,
            "number": len(some),
            "stand": float(simulated(some).mean()),
            "safety": safety,
            **compared(np.array([case.said(safety) for case in some]), simulated(some)),
        }
        for kind, some in groups(cases).items()
        for safety in (0.0, SAFETY)
    ]


def tolerances(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Agreement by contact tolerance, with the safety margin."""
    rows = []
    for tolerance in TOLERANCES:
        checker = StaticsChecker(contact_tolerance=tolerance)
        for kind, some in groups(cases).items():
            said = np.array([checker.check(case.stack).stable for case in some])
            rows.append({"stacks": kind, "tolerance": tolerance, **compared(said, simulated(some))})
    return rows


def unheld(cases: Sequence[Case]) -> dict[str, Any]:
    """How well the blocks that statics names are those that the simulator moved, where both see a fall."""
    pairs = [
        (case.statics.unheld, np.abs(case.simulated.settled.poses - case.stack.poses)[:, :3].max(axis=1) > MOVED)
        for case in cases
        if not case.statics.stable and not case.simulated.stable
    ]
    if not pairs:
        return {"stacks": 0}
    named, moved = (np.concatenate(flags) for flags in zip(*pairs, strict=True))
    return {
        "stacks": len(pairs),
        "named_that_moved": float((named & moved).sum() / named.sum()),
        "moved_that_were_named": float((named & moved).sum() / moved.sum()),
        "exactly_right": float(np.mean([np.array_equal(a, b) for a, b in pairs])),
    }


def times(stacks: Sequence[Stack]) -> dict[str, Any]:
    """Process times of a verdict with its margin, by number of blocks, and of the push."""
    checker = StaticsChecker()
    each = np.array([milliseconds(lambda s=stack: checker.check(s)) for stack in stacks])  # type: ignore[misc]
    sizes = np.array([len(stack) for stack in stacks])
    pushed = [milliseconds(lambda s=stack: checker.answer(s, True)) for stack in stacks[:50]]  # type: ignore[misc]
    return {
        "mean": float(each.mean()),
        "by_blocks": {int(size): float(each[sizes == size].mean()) for size in np.unique(sizes)},
        "with_push": float(np.mean(pushed)),
        "yardstick_100000_additions": milliseconds(lambda: sum(i for i in range(100_000)), repeats=20),
    }


def milliseconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Process time, the best of some [ms]."""
    best = math.inf
    for _ in range(repeats):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return 1e3 * best


def disagreements(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Every stack on which statics with the safety margin and PyBullet differ."""
    return [
        {
            "stacks": case.kind,
            "name": case.name,
            "statics": "stands" if case.said(SAFETY) else "falls",
            "pybullet": "stands" if case.simulated.stable else "falls",
            "margin_degrees": math.degrees(case.statics.margin),
            "largest_move_cells": float(np.abs(case.simulated.settled.poses - case.stack.poses)[:, :3].max(initial=0)),
        }
        for case in cases
        if case.said(SAFETY) != case.simulated.stable
    ]


def tables(metrics: dict[str, Any]) -> list[Any]:
    """The tables to print."""
    shares = ("agree", "false_stable", "false_unstable")
    percent = [f"{name.replace('_', ' ')} [%]" for name in shares]
    verdicts = [
        [r["stacks"], str(r["number"]), f"{100 * r['stand']:.1f}", f"{math.degrees(r['safety']):.1f}"]
        + [f"{100 * r[share]:.1f}" for share in shares]
        for r in metrics["agreement"]
    ]
    by_tolerance = [
        [r["stacks"], f"{r['tolerance']:.2f}"] + [f"{100 * r[share]:.1f}" for share in shares]
        for r in metrics["tolerances"]
    ]
    costs = metrics["milliseconds"]
    spent = [[f"{size} blocks", f"{value:.2f}"] for size, value in costs["by_blocks"].items()]
    spent += [[name.replace("_", " "), f"{costs[name]:.2f}"] for name in costs if name != "by_blocks"]
    listed = [
        [f"{r['stacks']} {r['name']}", r["statics"], r["pybullet"]]
        + [f"{r['margin_degrees']:.2f}", f"{r['largest_move_cells']:.2f}"]
        for r in metrics["disagreements"]
    ]
    named = [[name.replace("_", " "), f"{value:.3g}"] for name, value in metrics["unheld"].items()]
    compared_headings = ("stacks", "number", "stand [%]", "safety [degree]", *percent)
    tolerance_headings = ("stacks", "tolerance [cell]", *percent)
    listed_headings = ("stack", "statics", "PyBullet", "margin [degree]", "largest move [cell]")
    return [
        plain_table("Agreement with PyBullet", compared_headings, verdicts),
        plain_table("By contact tolerance, with the safety margin", tolerance_headings, by_tolerance),
        plain_table("Blocks named as unheld, where both see a fall", ("what", "value"), named),
        plain_table("Process time of a verdict with its margin", ("what", "[ms]"), spent),
        plain_table("Disagreements, with the safety margin", listed_headings, listed),
    ]


if __name__ == "__main__":
    start(main)
