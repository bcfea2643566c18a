"""What teaching changes: samplers on validation scenes of both recipes, and on disturbed ones, never on testset-v1.

Drawings and scenes of the paper's recipe are asked with their true block lists, disturbed scenes and the drawings of
examples/silhouettes with the lists that the search finds, or with those of a network (`--lists`), at the scale and in
the place of the grid's cells. The search itself is a row, and chooses the blocks of disturbed scenes. A second table
says how often samples for the paper's recipe stand, by the tilt that statics says they survive as they come.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from benchmarks.common import argument_parser, percent, plain_table, report, start
from benchmarks.out_of_distribution import KINDS, METRICS, OWN_LISTS, AlignedPredictor, scenes_of_kind

if TYPE_CHECKING:
    from stackgen.evaluation.protocol import Scene
    from stackgen.protocols import PhysicsNumbers, StabilityChecker, Verdict
    from stackgen.stack import Stack

MEASURED = (*METRICS, "valid_diversity")
DRAWN, PAPER = "drawings, unseen", "stacks of the paper's recipe, unseen"
TILTS = (0.0, 0.05, 0.1, 0.15)
"""Tilts between which samples are counted [rad]."""


class Witness:
    """A checker that remembers, of each stack it was shown, the margin that statics gives it and whether it stood."""

    def __init__(self, checker: StabilityChecker) -> None:
        from stackgen.sim.statics.checker import StaticsChecker

        self.checker, self.statics = checker, StaticsChecker()
        self.seen: list[tuple[float, bool]] = []

    @property
    def physics(self) -> PhysicsNumbers:
        """The physics of the checker itself."""
        return self.checker.physics

    def check(self, stack: Stack) -> Verdict:
        """Give the verdict on one stack."""
        return self.check_all([stack])[0]

    def check_all(self, stacks: Iterable[Stack]) -> list[Verdict]:
        """Give the verdicts on many stacks, in order."""
        stacks = list(stacks)
        verdicts = self.checker.check_all(stacks)
        margins = [self.statics.check(stack).margin or 0.0 for stack in stacks]
        self.seen += [(margin, verdict.stable) for margin, verdict in zip(margins, verdicts, strict=True)]
        return verdicts

    def by_margin(self) -> list[dict[str, float]]:
        """Count samples and those that fell, between the tilts."""
        places = np.searchsorted(TILTS, [margin for margin, _ in self.seen], side="right") - 1
        fell = np.array([not stood for _, stood in self.seen])
        return [{"from": tilt, "samples": int((places == i).sum()), "fell": int(fell[places == i].sum())}
                for i, tilt in enumerate(TILTS)]  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--weights", nargs="+", default=["default"], help="samplers: names, files or run folders")
    options.add_argument("--drawings", default="data/drawings", help="dataset of drawings")
    options.add_argument("--paper", default="data/paper", help="dataset of the paper's recipe")
    options.add_argument("--kinds", nargs="*", choices=KINDS[1:], default=[], help="kinds of disturbed scenes")
    options.add_argument(
        "--lists", default="search", help="who gives the lists of disturbed scenes: `search` or weights"
    )
    options.add_argument("--scenes", type=int, default=50, help="scenes of each set, evenly spread")
    options.add_argument("--disturbed", type=int, default=20, help="scenes of each kind of disturbance")
    options.add_argument("--num_samples", type=int, default=3, help="samples of each scene")
    options.add_argument("--seed", type=int, default=0, help="seed of disturbances and noise")
    return options


def spread(scenes: list[Scene], number: int) -> list[Scene]:
    """Some scenes, evenly spread."""
    return [scenes[i] for i in np.linspace(0, len(scenes) - 1, min(number, len(scenes))).round().astype(int)]


def tables_of(rows: list[dict[str, Any]], margins: list[dict[str, Any]]) -> list[Table]:
    """Lay out what was measured, and what fell by its margin."""
    title = "stability, front IoU and that of the stable, valid diversity, percent"
    lines = [
        [row["scenes"], str(row["number"]), row["method"], *(percent(row[metric]) for metric in MEASURED)]
        for row in rows
    ]
    counts = [[part["method"], f"{part['from']:g}", str(part["samples"]), str(part["fell"])] for part in margins]
    return [
        plain_table(title, ("scenes", "number", "method", *MEASURED), lines),
        plain_table(f"{PAPER}: samples by the tilt they survive", ("method", "from [rad]", "samples", "fell"), counts),
    ]


def main() -> None:
    """Ask every sampler for every set of scenes."""
    options = parser().parse_args()
    from stackgen.evaluation.protocol import Request, evaluate, load_scenes
    from stackgen.sampling.alignment import AlignedSampler
    from stackgen.sampling.methods import load_predictor, load_sampler
    from stackgen.sim.checkers import SimulatorChecker

    checker, lists = SimulatorChecker(until_fall=True), AlignedPredictor(load_predictor(options.lists))
    paper = load_scenes(options.paper, "validation")[0]
    sets = {
        DRAWN: spread(load_scenes(options.drawings, "validation")[0], options.scenes),
        PAPER: spread(paper, options.scenes),
    }
    few = spread(paper, options.disturbed)
    sets |= {kind: scenes_of_kind(kind, few, checker, options.seed) for kind in options.kinds}
    rows: list[dict[str, Any]] = []
    margins: list[dict[str, Any]] = []
    for kind, scenes in sets.items():
        for name in options.weights:
            witness = Witness(checker)
            sampler = load_sampler(name)
            request = Request(name, sampler.world, sampler, num_samples=options.num_samples, seed=options.seed)
            if kind not in (DRAWN, PAPER):
                aligned = OWN_LISTS.get(name) or AlignedSampler(sampler)
                request = Request(
                    name, sampler.world, aligned, lists, num_samples=options.num_samples, seed=options.seed
                )
            found = evaluate(request, scenes, witness if kind == PAPER else checker)
            margins += [{"method": name, **part} for part in witness.by_margin() if witness.seen]
            estimates = {metric: found.estimate(metric) for metric in MEASURED}
            rows.append({"scenes": kind, "number": len(scenes), "method": name}
                        | {metric: value and value.to_json() for metric, value in estimates.items()})  # fmt: skip
            print(kind, len(scenes), name, *(percent(rows[-1][metric]) for metric in MEASURED), flush=True)
    facts = {
        "samples_per_scene": options.num_samples,
        "seed": options.seed,
        "lists_of_disturbed": options.lists,
        "rows": rows,
        "by_margin": margins,
    }
    report("taught", facts, tables_of(rows, margins), options.out)


if __name__ == "__main__":
    start(main)
