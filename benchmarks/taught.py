"""What teaching changes: samplers on validation scenes of both recipes, and on disturbed ones, never on testset-v1.

Drawings and scenes of the paper's recipe are asked with their true block lists, disturbed scenes and the drawings of
examples/silhouettes with the lists that the search finds, or with those of a network (`--lists`), at the scale and in
the place of the grid's cells. The search itself is a row, and chooses the blocks of disturbed scenes.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common import argument_parser, percent, plain_table, report, start
from benchmarks.out_of_distribution import KINDS, METRICS, OWN_LISTS, AlignedPredictor, scenes_of_kind

if TYPE_CHECKING:
    from stackgen.evaluation.protocol import Scene

MEASURED = (*METRICS, "valid_diversity")
DRAWN, PAPER = "drawings, unseen", "stacks of the paper's recipe, unseen"


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
    for kind, scenes in sets.items():
        for name in options.weights:
            sampler = load_sampler(name)
            request = Request(name, sampler.world, sampler, num_samples=options.num_samples, seed=options.seed)
            if kind not in (DRAWN, PAPER):
                aligned = OWN_LISTS.get(name) or AlignedSampler(sampler)
                request = Request(
                    name, sampler.world, aligned, lists, num_samples=options.num_samples, seed=options.seed
                )
            found = evaluate(request, scenes, checker)
            estimates = {metric: found.estimate(metric) for metric in MEASURED}
            rows.append({"scenes": kind, "number": len(scenes), "method": name}
                        | {metric: value and value.to_json() for metric, value in estimates.items()})  # fmt: skip
            print(kind, len(scenes), name, *(percent(rows[-1][metric]) for metric in MEASURED), flush=True)
    facts = {
        "samples_per_scene": options.num_samples,
        "seed": options.seed,
        "lists_of_disturbed": options.lists,
        "rows": rows,
    }
    lines = [
        [row["scenes"], str(row["number"]), row["method"], *(percent(row[metric]) for metric in MEASURED)]
        for row in rows
    ]
    title = "stability, front IoU and that of the stable, valid diversity, percent"
    report("taught", facts, [plain_table(title, ("scenes", "number", "method", *MEASURED), lines)], options.out)


if __name__ == "__main__":
    start(main)
