"""In how many stacks every state of the build stands: the paper's order against the safest one.

Draws settled stacks of testset-v1, plans each in the paper's order, in the safest one by statics and in the safest
one by statics and simulator, and lets PyBullet check every state: each from its own blocks alone.
Times are of the process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.robot.planning.build_order import BuildOrder, TopDownJaws, plan_order
from stackgen.sim.checkers import SimulatorChecker
from stackgen.stack import Stack

ORDERS = ("paper", "safest, statics", "safest, simulator")


@dataclass(frozen=True)
class Case:
    """One stack in one order.

    Args:
        order: Order that was planned.
        stands: Whether each state stands, by the simulator.
        free: Whether the jaws get each block to its place.
        milliseconds: Time of planning [ms].
    """

    order: BuildOrder
    stands: tuple[bool, ...]
    free: tuple[bool, ...]
    milliseconds: float


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=200, help="number of stacks")
    options.add_argument("--seed", type=int, default=0, help="seed of the draw")
    return options


def main() -> None:
    """Plan, check, compare."""
    options = parser().parse_args()
    if options.number < 1:
        raise StackgenError("--number must be at least 1")
    simulator = SimulatorChecker(until_fall=True)
    stacks = drawn(options.number, options.seed)
    standing = [stack for stack in stacks if simulator.check(stack).stable]
    cases: dict[str, list[Case]] = {name: [] for name in ORDERS}
    for stack in track(standing, "ordering"):
        for name in ORDERS:
            cases[name].append(checked(stack, name, simulator))
    metrics: dict[str, Any] = {
        "physics": simulator.physics.to_json(),
        "stacks": len(stacks),
        "standing": len(standing),
        "blocks": float(np.mean([len(stack) for stack in standing])),
        "seed": options.seed,
        "orders": {name: summary(some) for name, some in cases.items()},
        "safest_minus_paper": differences(cases),
    }
    report("build_order", metrics, [table(metrics)], options.out)


def drawn(number: int, seed: int) -> list[Stack]:
    """Draw settled stacks of the frozen test set."""
    testset = Dataset.open(TESTSET)
    samples = list(testset.samples("test"))
    chosen = np.random.default_rng(seed).choice(len(samples), min(number, len(samples)), replace=False)
    return [samples[i].stack(testset.world.catalogue) for i in chosen]


def checked(stack: Stack, name: str, simulator: SimulatorChecker) -> Case:
    """Plan an order and have the simulator check each of its states."""
    begin = time.process_time()
    if name == "paper":
        order = plan_order(stack, strategy="greedy")
    else:
        order = plan_order(stack, checker=simulator if name.endswith("simulator") else None)
    spent = 1e3 * (time.process_time() - begin)
    jaws = TopDownJaws()
    parts = [list(order.blocks[: step + 1]) for step in range(len(stack))]
    stands = tuple(
        simulator.check(Stack(stack.shapes[part], stack.poses[part], stack.catalogue)).stable for part in parts
    )
    return Case(order, stands, tuple(jaws(stack, tuple(part[:-1]), part[-1]) for part in parts), spent)


def summary(cases: Sequence[Case]) -> dict[str, Any]:
    """Estimate shares of stacks and least margins [deg], with 95 % intervals; each stack is a cluster of its own."""
    margins = np.array([case.order.least_margin for case in cases])
    return {
        "every_state_stands": estimate([all(case.stands) for case in cases]),
        "every_way_free": estimate([all(case.free) for case in cases]),
        "both": estimate([all(case.stands) and all(case.free) for case in cases]),
        "called_safe": estimate([case.order.safe for case in cases]),
        "called_safe_but_falls": estimate([case.order.safe and not all(case.stands) for case in cases]),
        "least_margin_degrees": estimate(margins),
        "least_margin_median_degrees": float(np.median(margins)),
        "least_margin_5th_percentile_degrees": float(np.percentile(margins, 5)),
        "milliseconds_mean": float(np.mean([case.milliseconds for case in cases])),
        "milliseconds_largest": max(case.milliseconds for case in cases),
        "sets_judged_mean": float(np.mean([case.order.checks for case in cases])),
    }


def differences(cases: Mapping[str, Sequence[Case]]) -> dict[str, Any]:
    """Compare each safest order with the paper's, paired by stack."""
    base = cases["paper"]

    def paired(some: Sequence[Case]) -> dict[str, Any]:
        pairs = list(zip(some, base, strict=True))
        return {
            "every_state_stands": estimate([float(all(a.stands)) - all(b.stands) for a, b in pairs]),
            "least_margin_degrees": estimate([a.order.least_margin - b.order.least_margin for a, b in pairs]),
            "other_order": float(np.mean([a.order.blocks != b.order.blocks for a, b in pairs])),
        }

    return {name: paired(some) for name, some in cases.items() if name != "paper"}


def estimate(values: Any) -> dict[str, float] | None:
    """Estimate a mean with a 95 % interval."""
    numbers = np.asarray(values, dtype=float)
    found = clustered_ratio(numbers, np.ones(len(numbers)))
    return found.to_json() if found else None


def table(metrics: Mapping[str, Any]) -> Any:
    """Lay out what is printed."""

    def share(name: str, what: str) -> str:
        e = metrics["orders"][name][what]
        return f"{100 * e['value']:.1f} ({100 * e['low']:.1f} to {100 * e['high']:.1f})"

    rows = []
    for name in ORDERS:
        found = metrics["orders"][name]
        margin = found["least_margin_degrees"]
        rows.append(
            [name, *(share(name, what) for what in ("every_state_stands", "both", "called_safe"))]
            + [f"{margin['value']:.2f} ({margin['low']:.2f} to {margin['high']:.2f})"]
            + [f"{found['least_margin_5th_percentile_degrees']:.2f}", f"{found['milliseconds_mean']:.0f}"]
        )
    headings = (
        "order",
        "every state stands [%]",
        "and every way free [%]",
        "called safe [%]",
        "least margin [degree]",
        "5th percentile",
        "time [ms]",
    )
    return plain_table(f"{metrics['standing']} stacks that stand", headings, rows)


if __name__ == "__main__":
    start(main)
