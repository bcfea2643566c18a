"""Agreement of the project's physics, and of the statics of its generator, with two slower simulations and MuJoCo.

The slow one has PyBullet's usual step: 4 s at 240 Hz with 50 iterations, never stopped early. The fine one, 4 s at
960 Hz with 200 iterations, says which of the others is nearer to the truth. All disagreements are listed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.common import argument_parser, plain_table, report, start
from benchmarks.simulator import testset_stacks, with_noise
from stackgen.data.generation.designs import draw_design, realize
from stackgen.errors import StackgenError
from stackgen.geometry import silhouette
from stackgen.sim.checkers import AcceptLimits, accept, fell
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.sim.statics.plane import PlaneStatics, StaticsMargins
from stackgen.stack import Stack
from stackgen.world import PAPER_GRID, PAPER_WORLD

SLOW = Physics(engine="bullet", time_step=1 / 240, solver_iterations=50, watch=4.0, rest_window=8.0)
"""Its window of rest is longer than its watch: it never stops early."""

FINE = Physics(engine="bullet", time_step=1 / 960, solver_iterations=200, rest_window=0.25, rest_motion=2e-4, watch=4.0)
"""Twice the steps of the project's physics, three times the iterations, a stricter rest and twice the watch.

Few stacks rest by its standard (Bullet's contacts tremble by more than that); what counts is where the
blocks are when its watch is over.
"""

FAST = Physics(engine="bullet")
MUJOCO = Physics(engine="mujoco")
SIMULATIONS = {"fast": FAST, "slow": SLOW, "fine": FINE, "mujoco": MUJOCO}


@dataclass(frozen=True)
class Case:
    """A stack, the stage it belongs to and its number there."""

    stage: str
    number: int
    stack: Stack


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=500, help="number of stacks of each stage")
    options.add_argument("--workers", type=int, default=2, help="number of processes")
    options.add_argument("--weights", default="default", help="weights of the model whose samples are checked")
    options.add_argument("--seed", type=int, default=0, help="seed of all that is drawn")
    return options


def main() -> None:
    """Draw stacks, simulate them in four ways, count how often these agree."""
    options = parser().parse_args()
    if options.number < 1 or options.workers < 1:
        raise StackgenError("--number and --workers must be at least 1")
    asked = list(cases(options.number, options.seed, options.weights))
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        answers = list(track(pool.map(answer, asked, chunksize=4), "simulating", total=len(asked)))
    metrics = {
        **{name: physics.to_json() for name, physics in SIMULATIONS.items()},
        "certificate": vars(StaticsMargins()),
        **count(asked, answers),
    }
    report("agreement", metrics, tables(metrics), options.out)


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


def without_some(stack: Stack, rng: np.random.Generator) -> Stack:
    """The stack after one to three of its blocks were taken out, one block of the top row kept."""
    top = int(stack.poses[:, 2].argmax())
    others = [i for i in range(len(stack)) if i != top]
    gone = rng.choice(others, min(int(rng.integers(1, 4)), len(others)), replace=False)
    keep = np.setdiff1d(np.arange(len(stack)), gone)
    return Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)


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


def answer(case: Case) -> dict[str, Any]:
    """Whether the stack falls in each simulation, whether fast and fine accept it, and what statics is certain of."""
    found: dict[str, Any] = {}
    for name, physics in SIMULATIONS.items():
        simulator = _SIMULATORS.setdefault(physics, Simulator(physics))
        rollout = simulator.rollout(case.stack, until_fall=physics is not SLOW)
        found[name] = bool(fell(rollout, physics).any())
        if physics is not SLOW:
            at_rest = rollout.at_rest or physics is FINE
            found[f"{name}_accepts"] = accept(replace(rollout, at_rest=at_rest), AcceptLimits())
    found["statics"] = "not asked"
    if case.stage == "removal":  # parts of settled stacks: what the generator asks statics about
        statics = PlaneStatics(case.stack, Physics().friction, StaticsMargins())
        found["statics"] = statics.outcome(np.arange(len(case.stack)))
    return found


PAIRS = (("fast", "slow"), ("fast", "fine"), ("slow", "fine"), ("mujoco", "fast"), ("mujoco", "fine"))
COUNTED = (
    *("number", "fall", "mujoco_fall", *("_".join(pair) for pair in PAIRS)),
    *("accept_fast_fine", "accept_mujoco_fast", "certain", "certain_wrong"),
)

_SIMULATORS: dict[Physics, Simulator] = {}


def disputed(found: dict[str, Any]) -> bool:
    """Whether the simulations disagree."""
    return len({found[name] for name in SIMULATIONS}) > 1


def wrong(found: dict[str, Any]) -> bool:
    """Whether statics was certain, and the fine simulation says otherwise."""
    return found["statics"] == ("stands" if found["fine"] else "falls")


def count(asked: Sequence[Case], answers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count agreement by stage and in all, and list each dispute."""
    stages: dict[str, dict[str, int]] = {}
    for case, found in zip(asked, answers, strict=True):
        for stage in (case.stage, "all"):
            row = stages.setdefault(stage, dict.fromkeys(COUNTED, 0))
            row["number"] += 1
            row["fall"] += found["fine"]
            row["mujoco_fall"] += found["mujoco"]
            for one, other in PAIRS:
                row[f"{one}_{other}"] += found[one] == found[other]
            row["accept_fast_fine"] += found["fast_accepts"] == found["fine_accepts"]
            row["accept_mujoco_fast"] += found["mujoco_accepts"] == found["fast_accepts"]
            row["certain"] += found["statics"] in ("stands", "falls")
            row["certain_wrong"] += wrong(found)
    stages["all"] = stages.pop("all")
    listed = [
        {"stage": case.stage, "number": case.number, "blocks": len(case.stack), **found}
        for case, found in zip(asked, answers, strict=True)
        if disputed(found) or wrong(found)
    ]
    return {"stages": stages, "disagreements": listed}


def tables(metrics: dict[str, Any]) -> list[Any]:
    """The tables to print."""
    rows = [
        [stage, str(row["number"])]
        + [f"{row[name] / row['number']:.2%}" for name in COUNTED[1:-1]]
        + [str(row["certain_wrong"])]
        for stage, row in metrics["stages"].items()
    ]
    agreements = (*(" = ".join(pair) for pair in PAIRS), "accept: fast = fine", "accept: mujoco = fast")
    headings = ("stage", "stacks", "fall", "in mujoco", *agreements, "statics certain", "and wrong")
    words = {True: "falls", False: "stands"}
    disputes = [
        [f"{d['stage']} {d['number']}", str(d["blocks"]), *(words[d[name]] for name in SIMULATIONS)] + [d["statics"]]
        for d in metrics["disagreements"]
    ]
    return [
        plain_table("Fast against slow, fine and mujoco", headings, rows),
        plain_table("Disagreements", ("case", "blocks", *SIMULATIONS, "statics"), disputes),
    ]


if __name__ == "__main__":
    start(main)
