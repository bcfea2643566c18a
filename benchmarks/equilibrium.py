"""How often statics and PyBullet agree, and what statics costs.

    python benchmarks/equilibrium.py --number 200
    python benchmarks/equilibrium.py --stacks out/arch/stacks.json

Judges settled stacks of a dataset, what is left of them when a block is taken away, and the same
stacks with noise on every coordinate, which float and interpenetrate a little as a network's samples
do; or the stacks of files, e.g. samples of a model. Prints a table and every disagreement on settled
stacks. Times are of the process, so a busy machine only blurs them.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stackgen.data.shards import Manifest
from stackgen.protocols import Verdict
from stackgen.sim.equilibrium import CONTACT_TOLERANCE, SAFETY, Equilibrium, EquilibriumChecker
from stackgen.sim.verdict import SimulatorChecker
from stackgen.stack import Stack
from stackgen.stacks_file import read_stacks

TESTSET = Path(__file__).parents[1] / "stackgen" / "assets" / "testset-v1"
TOLERANCES = (0.02, 0.05, CONTACT_TOLERANCE, 0.12)
MOVED = 0.3
"""A block that the simulator moved further than this [cell] was not held."""


@dataclass(frozen=True)
class Judged:
    """A stack and what both say of it."""

    kind: str
    name: str
    stack: Stack
    simulated: Verdict
    statics: Equilibrium


def main() -> None:
    """Parse, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=TESTSET, help="A dataset.")
    parser.add_argument("--number", type=int, default=200, help="Stacks of each kind.")
    parser.add_argument("--noise", type=float, default=0.02, help="On each coordinate of the shaken ones [cell, rad].")
    parser.add_argument("--seed", type=int, default=0, help="Of the draw, the removals and the noise.")
    parser.add_argument("--stacks", type=Path, nargs="*", default=(), help="Stacks files to judge instead.")
    options = parser.parse_args()
    cases = from_files(options.stacks) if options.stacks else drawn(options)
    simulator = SimulatorChecker(catalogue=cases[0][2].catalogue)
    careful, free = EquilibriumChecker(), EquilibriumChecker(safety=0)
    print(f"contact tolerance {CONTACT_TOLERANCE} cells, safety {math.degrees(SAFETY):.2f} degrees, friction "
          f"{careful.physics.friction}, {careful.physics.to_json()['engine']}\n")  # fmt: skip
    judged = [Judged(*case, simulator.check(case[2]), free.equilibrium(case[2])) for case in cases]
    agreement(judged)
    blocks_named(judged)
    tolerances(judged)
    times(judged, careful)
    disagreements([case for case in judged if case.kind != "shaken"])


def drawn(options: argparse.Namespace) -> list[tuple[str, str, Stack]]:
    """Settled stacks, other ones less a block, and still other ones shaken."""
    manifest = Manifest.load(options.data)
    samples = [sample for split in ("train", "test") for sample in manifest.samples(options.data, split)]  # type: ignore[arg-type]
    rng = np.random.default_rng(options.seed)
    cases = []
    for kind in ("settled", "less a block", "shaken"):
        for i in rng.choice(len(samples), min(options.number, len(samples)), replace=False):
            stack = samples[i].stack(manifest.catalogue)
            if kind == "less a block":
                keep = np.arange(len(stack)) != rng.integers(len(stack))
                stack = Stack(stack.shapes[keep], stack.poses[keep], stack.catalogue)
            elif kind == "shaken":
                stack = stack.with_poses(stack.poses + rng.normal(0, options.noise, stack.poses.shape))
            cases.append((kind, samples[i].key, stack))
    return cases


def from_files(files: Iterable[Path]) -> list[tuple[str, str, Stack]]:
    """The stacks of stacks files."""
    return [
        (file.name, f"{file.name} {number}", stack)
        for file in files
        for number, stack in enumerate(read_stacks(file).stacks, 1)
    ]


def kinds(judged: list[Judged]) -> dict[str, list[Judged]]:
    """By kind, and all settled ones together."""
    names = dict.fromkeys(case.kind for case in judged)
    groups = {name: [case for case in judged if case.kind == name] for name in names}
    if {"settled", "less a block"} <= set(groups):
        groups["both of these"] = groups["settled"] + groups["less a block"]
    return groups


def agreement(judged: list[Judged]) -> None:
    """Print the table of verdicts, without and with the safety margin."""
    print("| stacks | n | stand in PyBullet | safety | agree | false stable | false unstable |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind, cases in kinds(judged).items():
        truth = np.array([case.simulated.stable for case in cases])
        for safety in (0.0, SAFETY):
            said = np.array([case.statics.stable and case.statics.margin >= safety for case in cases])
            shares = [truth == said, said & ~truth, ~said & truth]
            print(f"| {kind} | {len(cases)} | {truth.mean():.1%} | {math.degrees(safety):.1f}° | "
                  + " | ".join(f"{share.mean():.1%}" for share in shares) + " |")  # fmt: skip


def blocks_named(judged: list[Judged]) -> None:
    """Print how well the unheld blocks are those that the simulator moved."""
    pairs = [
        (case.statics.unheld, np.abs(case.simulated.settled.poses - case.stack.poses)[:, :3].max(axis=1) > MOVED)
        for case in judged
        if not case.statics.stable and not case.simulated.stable
    ]
    if not pairs:
        return
    named, moved = (np.concatenate(flags) for flags in zip(*pairs, strict=True))
    exact = np.mean([np.array_equal(a, b) for a, b in pairs])
    print(f"\nOf {len(pairs)} stacks that fall by both: {(named & moved).sum() / named.sum():.0%} of the blocks named as "
          f"unheld moved by more than {MOVED} cells, {(named & moved).sum() / moved.sum():.0%} of those that moved were "
          f"named, exactly the right ones in {exact:.0%} of the stacks.")  # fmt: skip


def tolerances(judged: list[Judged]) -> None:
    """Print the agreement by contact tolerance, with the safety margin on."""
    print("\n| stacks | contact tolerance | agree | false stable | false unstable |")
    print("| --- | --- | --- | --- | --- |")
    for kind, cases in kinds(judged).items():
        truth = np.array([case.simulated.stable for case in cases])
        for tolerance in TOLERANCES:
            checker = EquilibriumChecker(contact_tolerance=tolerance)
            said = np.array([checker.check(case.stack).stable for case in cases])
            shares = [truth == said, said & ~truth, ~said & truth]
            print(f"| {kind} | {tolerance} | " + " | ".join(f"{share.mean():.1%}" for share in shares) + " |")


def times(judged: list[Judged], checker: EquilibriumChecker) -> None:
    """Print what a verdict costs, on this machine now."""
    stacks = [case.stack for case in judged]
    eight = [stack for stack in stacks if len(stack) == 8] or stacks
    whole = _milliseconds(checker.check, stacks)
    print(f"\nVerdict and margin: {np.mean(whole):.2f} ms a stack of {np.mean([len(s) for s in stacks]):.1f} blocks in "
          f"the mean, {np.mean(_milliseconds(checker.check, eight)):.2f} ms of {len(eight[0])}; with the push "
          f"{np.mean(_milliseconds(lambda s: checker.equilibrium(s, True), stacks[:50])):.0f} ms. "
          f"Here 100,000 Python additions take {_yardstick():.1f} ms.\n")  # fmt: skip


def _milliseconds(work: Callable[[Stack], object], stacks: list[Stack], repeats: int = 3) -> list[float]:
    """Process time for each stack, the best of some."""
    found = []
    for stack in stacks:
        best = math.inf
        for _ in range(repeats):
            start = time.process_time()
            work(stack)
            best = min(best, time.process_time() - start)
        found.append(best * 1e3)
    return found


def _yardstick() -> float:
    """Process time of a loop that says how fast the machine is just now [ms]."""
    best = math.inf
    for _ in range(10):
        start, total = time.process_time(), 0
        for i in range(100_000):
            total += i
        best = min(best, time.process_time() - start)
    return best * 1e3


def disagreements(judged: list[Judged]) -> None:
    """Print every settled stack on which the two differ."""
    for case in judged:
        said = case.statics.stable and case.statics.margin >= SAFETY
        if said != case.simulated.stable:
            moved = np.abs(case.simulated.settled.poses - case.stack.poses)[:, :3].max()
            print(f"- {case.kind} {case.name}: statics {'stands' if said else 'falls'} "
                  f"(margin {math.degrees(case.statics.margin):.2f}°, unheld {np.flatnonzero(case.statics.unheld).tolist()}), "
                  f"PyBullet {'stands' if case.simulated.stable else 'falls'} (fell "
                  f"{np.flatnonzero(case.simulated.fell).tolist()}, largest move {moved:.2f} cells)")  # fmt: skip


if __name__ == "__main__":
    main()
