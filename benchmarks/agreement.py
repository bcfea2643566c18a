"""Does speed cost truth? The physics of this project and the statics of its generator against two slower simulations.

The slow one has PyBullet's usual step: 4 s at 240 Hz with 50 iterations, never stopped early. The fine one, 4 s at
960 Hz with 200 iterations, says which of the two is nearer to the truth. All disagreements are listed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.common import argument_parser, plain_table, report, start
from benchmarks.simulator import REFERENCE as FINE
from benchmarks.simulator import Case, testset_stacks, with_noise, without_some
from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.sim.checkers import fell
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.sim.statics.plane import PlaneStatics, StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, PAPER_WORLD

SLOW = Physics(time_step=1 / 240, solver_iterations=50, watch=4.0, rest_window=8.0)
"""Its window of rest is longer than its watch: it never stops early."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=500, help="stacks of each stage")
    options.add_argument("--workers", type=int, default=2, help="processes")
    options.add_argument("--weights", default="default", help="of the model whose samples are judged")
    options.add_argument("--seed", type=int, default=0, help="of all that is drawn")
    return options


def main() -> None:
    """Draw, judge, count."""
    options = parser().parse_args()
    if options.number < 1 or options.workers < 1:
        raise StackgenError("--number and --workers must be at least 1")
    asked = list(cases(options.number, options.seed, options.weights))
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        judged = list(track(pool.map(judge, asked, chunksize=4), "judging", total=len(asked)))
    figures = {
        "fast": Physics().to_json(),
        "slow": SLOW.to_json(),
        "fine": FINE.to_json(),
        "certificate": vars(StaticsMargins()),
        **count(asked, judged),
    }
    report("agreement", figures, tables(figures), options.out)


def cases(number: int, seed: int, weights: str) -> Iterator[Case]:
    """Stacks of every stage: designs, what is left of settled stacks, a model's samples, and stacks at their limits."""
    rng = np.random.default_rng(seed)
    stacks = testset_stacks()
    some = [stacks[i] for i in rng.integers(len(stacks), size=number)]
    for i, stack in enumerate(some):
        yield Case("design", i, realize(draw_design(rng, PAPER_WORLD), rng, PAPER_WORLD))
        yield Case("removal", i, without_some(stack, rng))
        yield Case("noise of 0.05", i, with_noise(stack, 0.05, rng))
        yield Case("at its limit", i, at_its_limit(stack, rng))
    for i, stack in enumerate(samples(some, weights, seed)):
        yield Case("model sample", i, stack)


def at_its_limit(stack: Stack, rng: np.random.Generator) -> Stack:
    """The stack with one block left of its top row, pushed to at most 0.1 cell short of where statics lets go."""
    tops = np.flatnonzero(stack.poses[:, 2] > stack.poses[:, 2].max() - 0.5)
    keep = np.setdiff1d(np.arange(len(stack)), np.delete(tops, rng.integers(len(tops))))
    stack = Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)
    block = int(stack.poses[:, 2].argmax())
    statics = StaticsMargins(inset=0.0, pull=0.0, friction_kept=1.0)
    side, poses = rng.choice([-1.0, 1.0]), stack.poses
    for push in np.arange(0.05, 2.0, 0.05):
        pushed = poses.copy()
        pushed[block, 0] += side * push
        whole = PlaneStatics(stack.with_poses(pushed), Physics().friction, statics)
        if whole.outcome(np.arange(len(stack))) != "stands":
            break
    pushed[block, 0] += side * rng.uniform(-0.1, 0.0)
    return stack.with_poses(pushed)


def samples(stacks: Sequence[Stack], weights: str, seed: int) -> list[Stack]:
    """A sample of the model for each stack's silhouette and blocks."""
    from stackgen.sampling.methods import load_sampler

    pictures = np.stack([silhouette(stack, PAPER_GRID) for stack in stacks])
    counts = np.stack([stack.counts for stack in stacks])
    return [row[0] for row in load_sampler(weights).sample_batch(pictures, counts, 1, seed)]


def judge(case: Case) -> dict[str, Any]:
    """Whether the stack falls, to each of them, and what statics is certain of."""
    falls = partial(_falls, case.stack)
    answer: dict[str, Any] = {"fast": falls(Physics(), until_fall=True), "slow": falls(SLOW)}
    answer["fine"] = falls(FINE, until_fall=True)
    answer["statics"] = "not asked"
    if case.source == "removal":  # parts of settled stacks: what the generator asks statics about
        statics = PlaneStatics(case.stack, Physics().friction, StaticsMargins())
        answer["statics"] = statics.outcome(np.arange(len(case.stack)))
    return answer


def _falls(stack: Stack, physics: Physics, until_fall: bool = False) -> bool:
    simulator = _SIMULATORS.setdefault(physics, Simulator(physics))
    return bool(fell(simulator.rollout(stack, until_fall=until_fall), physics).any())


COUNTED = ("number", "fall", "fast_slow", "fast_fine", "slow_fine", "certain", "certain_wrong")

_SIMULATORS: dict[Physics, Simulator] = {}


def disputed(answer: dict[str, Any]) -> bool:
    """Whether the three simulations are not of one mind."""
    return not answer["fast"] == answer["slow"] == answer["fine"]


def wrong(answer: dict[str, Any]) -> bool:
    """Whether statics was certain, and the fine simulation says otherwise."""
    return answer["statics"] == ("stands" if answer["fine"] else "falls")


def count(asked: Sequence[Case], judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Agreement by stage and in all, and each dispute."""
    stages: dict[str, dict[str, int]] = {}
    for case, answer in zip(asked, judged, strict=True):
        for stage in (case.source, "all"):
            row = stages.setdefault(stage, dict.fromkeys(COUNTED, 0))
            row["number"] += 1
            row["fall"] += answer["fine"]
            row["fast_slow"] += answer["fast"] == answer["slow"]
            row["fast_fine"] += answer["fast"] == answer["fine"]
            row["slow_fine"] += answer["slow"] == answer["fine"]
            row["certain"] += answer["statics"] in ("stands", "falls")
            row["certain_wrong"] += wrong(answer)
    stages["all"] = stages.pop("all")
    listed = [
        {"stage": case.source, "number": case.number, "blocks": len(case.stack), **answer}
        for case, answer in zip(asked, judged, strict=True)
        if disputed(answer) or wrong(answer)
    ]
    return {"stages": stages, "disagreements": listed}


def tables(figures: dict[str, Any]) -> list[Any]:
    """What is printed."""
    rows = [
        [stage, str(row["number"])]
        + [f"{row[name] / row['number']:.2%}" for name in COUNTED[1:-1]]
        + [str(row["certain_wrong"])]
        for stage, row in figures["stages"].items()
    ]
    headings = ("stage", "stacks", "fall", "fast = slow", "fast = fine", "slow = fine", "statics certain", "and wrong")
    words = {True: "falls", False: "stands"}
    disputes = [
        [f"{d['stage']} {d['number']}", str(d["blocks"]), *(words[d[name]] for name in ("fast", "slow", "fine"))]
        + [d["statics"]]
        for d in figures["disagreements"]
    ]
    return [
        plain_table("Fast against slow and fine", headings, rows),
        plain_table("Disagreements", ("case", "blocks", "fast", "slow", "fine", "statics"), disputes),
    ]


if __name__ == "__main__":
    start(main)
