"""What a stored stack costs the generator, how right statics is where it speaks, and whether the stored stacks stand.

Makes the stacks of some templates with the project's settings, and those of every third template by simulating
everything once, as the paper does. Then the simulator is asked what statics decided without it, and every
stored stack is put down again. With `--recipe drawings` the stacks are the search's answers to drawings.
Times are of the process: on a busy machine they are too long, never too short.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.common import argument_parser, peak_rss_mb, plain_table, report, start
from stackgen.data.generation.deconstruction import Settled, Settler, deconstruct, surely_falls
from stackgen.data.generation.designs import draw_design, realize
from stackgen.data.generation.recipes import samples_of
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.shards import Sample, encode_shard
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.sim.checkers import AcceptLimits, accept, fell
from stackgen.sim.simulator import Rollout, Simulator
from stackgen.sim.statics.plane import Outcome, StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_WORLD

EVERY = 3
"""One of so many templates is also made by simulating everything."""


class Counting(Simulator):
    """A simulator that counts."""

    rollouts = 0
    steps = 0
    seconds = 0.0

    def rollout(self, stack: Stack, **options: Any) -> Rollout:
        """Simulate, and count."""
        begin = time.process_time()
        rollout = super().rollout(stack, **options)
        self.seconds += time.process_time() - begin
        self.rollouts += 1
        self.steps += round(rollout.time / self.physics.step)
        return rollout


@dataclass(frozen=True)
class Recording(Settler):
    """A settler that writes down what statics said of each remainder."""

    said: list[tuple[Stack, Outcome]] = field(default_factory=list)

    def settle_rest(self, rest: Settled) -> Settled | None:
        """Settle a remainder, and write down what statics said of it."""
        self.said.append((rest.stack, rest.outcome))
        return super().settle_rest(rest)


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--templates", type=int, default=150, help="templates whose stacks are made")
    options.add_argument("--recipe", choices=("deconstruction", "drawings"), default="deconstruction")
    options.add_argument("--seed", type=int, default=1000, help="seed of the templates")
    return options


def main() -> None:
    """Make, ask again, put down again."""
    options = parser().parse_args()
    if options.templates < EVERY:
        raise StackgenError(f"--templates must be at least {EVERY}")
    settings = GenerateSettings("benchmark", 1, seed=options.seed, recipe=options.recipe)
    plain = replace(settings, settle_twice=False, certificate=StaticsMargins(enabled=False))
    numbers = range(options.templates)
    families, cost = made(settings, numbers, "making")
    _, simulated = made(plain, numbers[::EVERY], "simulating everything")
    metrics: dict[str, Any] = {
        "settings": settings.to_json(),
        "physics": settings.physics.to_json(),
        "cost": {"generator": cost, "everything simulated once": simulated},
        "decisions": decisions(settings, numbers) if options.recipe == "deconstruction" else None,
        "stored": put_down_again(families),
        "peak_rss_mb": peak_rss_mb(),
    }
    report("generator", metrics, tables(metrics), options.out)


def made(settings: GenerateSettings, numbers: Sequence[int], what: str) -> tuple[list[list[Stack]], dict[str, float]]:
    """The stored stacks of each template, and what they cost in one process, the writing of the shard included."""
    families: list[list[Sample]] = []
    with contextlib.closing(Counting(settings.physics)) as simulator:
        simulator.rollout(Stack(np.zeros(1, dtype=np.int64), np.array([[0, 0, 0.5, 0, 0, 0]])))  # opens the world
        opened = (simulator.rollouts, simulator.steps, simulator.seconds)
        begin = time.process_time()
        for number in track(numbers, what, transient=True):
            families.append(samples_of(settings, number, frozenset(), simulator))
        encode_shard([sample for family in families for sample in family])
        seconds = time.process_time() - begin
        rollouts, steps, simulating = (
            now - before
            for now, before in zip((simulator.rollouts, simulator.steps, simulator.seconds), opened, strict=True)
        )
    stored = sum(map(len, families))
    if not stored:
        raise StackgenError("these templates gave no stack; ask for more --templates")
    cost = {
        "templates": len(numbers),
        "stored": stored,
        "milliseconds": 1e3 * seconds / stored,
        "milliseconds_simulating": 1e3 * simulating / stored,
        "rollouts": rollouts / stored,
        "steps": steps / stored,
    }
    return [[sample.stack(settings.catalogue) for sample in family] for family in families], cost


def decisions(settings: GenerateSettings, numbers: Sequence[int]) -> dict[str, Any]:
    """What statics said of remainders, and what the simulator says of those of which it was certain.

    Remainders with a block that plainly hangs in the air are left out: nobody doubts those.
    """
    counts = {word: {"number": 0, "not_accepted": 0, "fell": 0} for word in ("stands", "falls", "unsure")}
    wrong: list[dict[str, Any]] = []
    limits = AcceptLimits()
    with Simulator(settings.physics) as simulator:
        for number in track(numbers, "asking the simulator, too", transient=True):
            rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(number,)))
            design = realize(draw_design(rng, PAPER_WORLD, settings.template), rng, PAPER_WORLD, settings.template)
            settler = Recording(simulator, settings.accept, settings.settle_twice, settings.certificate)
            list(deconstruct(design, settler, settings.max_removals))
            for stack, word in settler.said:
                if surely_falls(stack):
                    continue
                counts[word]["number"] += 1
                if word == "unsure":
                    continue
                rollout = simulator.rollout(stack, until_fall=True)
                taken, falls = accept(rollout, limits), bool(fell(rollout, settings.physics).any())
                counts[word]["not_accepted"] += not taken
                counts[word]["fell"] += falls
                if taken != (word == "stands"):
                    wrong.append({"template": number, "statics": word, **_seen(stack, rollout)})
    return {"counts": counts, "wrong": wrong}


def put_down_again(families: Sequence[Sequence[Stack]]) -> dict[str, Any]:
    """How many of the stored stacks stand when they are simulated from their stored poses."""
    stand, accepted, poor = [], [], []
    with Simulator() as simulator:
        for number, family in enumerate(track(families, "putting down again", transient=True)):
            rollouts = [simulator.rollout(stack, until_fall=True) for stack in family]
            fallen = [bool(fell(rollout, simulator.physics).any()) for rollout in rollouts]
            taken = [accept(rollout, AcceptLimits()) for rollout in rollouts]
            stand.append(len(family) - sum(fallen))
            accepted.append(sum(taken))
            poor += [
                {"template": number, "fell": falls, **_seen(stack, rollout)}
                for stack, rollout, falls, good in zip(family, rollouts, fallen, taken, strict=True)
                if not good
            ]
    sizes = [len(family) for family in families]
    ratios = {name: clustered_ratio(sums, sizes) for name, sums in (("stand", stand), ("accepted", accepted))}
    return {
        "number": sum(sizes),
        **{name: ratio.to_json() for name, ratio in ratios.items() if ratio is not None},
        "not_accepted": poor,
    }


def _seen(stack: Stack, rollout: Rollout) -> dict[str, Any]:
    moved = float(np.abs(rollout.end.poses - stack.poses)[:, :3].max())
    return {"blocks": len(stack), "moved": moved, "at_rest": rollout.at_rest, "time": rollout.time}


def tables(metrics: dict[str, Any]) -> list[Any]:
    """What is printed."""
    cost = [
        [name, str(row["templates"]), str(row["stored"])]
        + [f"{row[key]:.2f}" for key in ("milliseconds", "milliseconds_simulating", "rollouts", "steps")]
        for name, row in metrics["cost"].items()
    ]
    stored = metrics["stored"]
    again = [
        [name, str(stored["number"])] + [f"{100 * stored[name][key]:.2f}" for key in ("value", "low", "high")]
        for name in ("stand", "accepted")
    ]
    per_stack = ("CPU [ms]", "of it simulating [ms]", "rollouts", "steps")
    shown = [
        plain_table("Cost of a stored stack", ("how", "templates", "stored", *per_stack), cost),
        plain_table("Stored stacks put down again", ("what", "stacks", "[%]", "from", "to"), again),
    ]
    if metrics["decisions"] is not None:
        said = [
            [word, str(row["number"])]
            + ([str(row["not_accepted"]), str(row["fell"])] if word != "unsure" else ["", ""])
            for word, row in metrics["decisions"]["counts"].items()
        ]
        shown.insert(
            1, plain_table("Rests: statics, and the simulator", ("statics", "rests", "not accepted", "fell"), said)
        )
    return shown


if __name__ == "__main__":
    start(main)
