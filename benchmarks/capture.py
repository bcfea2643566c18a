"""From a stack to a stack through a depth camera: the silhouette as seen, and that of the cells it is made of.

Settled stacks of testset-v1 stand before the simulated camera, which is somewhere in front of them. Both silhouettes
are compared with the stack's own. For each of them one verified stack is sampled, whose silhouette is compared with the
stack's own, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks.build_order import drawn, estimate
from benchmarks.common import argument_parser, plain_table, report, start
from stackgen.api import Model, load
from stackgen.errors import StackgenError
from stackgen.geometry import iou, silhouette
from stackgen.stack import Stack
from stackgen.vision.cameras import Rig, simulated_frame
from stackgen.vision.cells import in_cells
from stackgen.vision.depth import find_structure
from stackgen.vision.masks import bounding_box, fitted
from stackgen.world import PAPER_GRID, Mask

KINDS = ("as seen", "in cells")


@dataclass(frozen=True)
class Case:
    """What the camera made of one stack.

    Args:
        seen: IoU of each kind of silhouette with the stack's own.
        whole: Whether the structure was taken to be made of whole cells.
        left_out: What stood beside the structure, as a share of it.
        stands: Whether the verified stack for each kind of silhouette stands.
        again: IoU of the verified stacks' silhouettes with the first stack's own.
    """

    seen: tuple[float, ...]
    whole: bool
    left_out: float
    stands: tuple[bool, ...]
    again: tuple[float, ...]


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--number", type=int, default=100, help="number of stacks")
    options.add_argument("--seed", type=int, default=0, help="seed of the draw, the cameras, their noise and samples")
    return options


def main() -> None:
    """Simulate the camera, sample and compare."""
    options = parser().parse_args()
    if options.number < 1:
        raise StackgenError("--number must be at least 1")
    rng = np.random.default_rng(options.seed)
    model = load()
    cases = [case(stack, rng, model) for stack in track(drawn(options.number, options.seed), "seeing")]
    metrics = {
        "stacks": len(cases),
        "seed": options.seed,
        "made_of_whole_cells": estimate([case.whole for case in cases]),
        "in_one_part": int(sum(case.left_out < 0.05 for case in cases)),
        **{kind: summary(cases, number) for number, kind in enumerate(KINDS)},
    }
    report("capture", metrics, [table(metrics)], options.out)


def case(stack: Stack, rng: np.random.Generator, model: Model) -> Case:
    """Put a stack before a camera somewhere in front of it."""
    distance, elevation, azimuth = rng.uniform([0.55, 0, -15], [0.9, 25, 15])
    rig = Rig(float(distance), float(elevation), float(azimuth))
    seed = int(rng.integers(2**31))
    found = find_structure(simulated_frame(stack, rig, seed=seed))
    as_seen = fitted(found.front, PAPER_GRID)
    in_whole, cells, _ = in_cells(found.front[bounding_box(found.front)], PAPER_GRID)
    own = own_silhouette(stack)
    silhouettes = (as_seen, in_whole)
    best = [model.sample_verified(mask, 1, seed).entries[0] for mask in silhouettes]
    return Case(
        tuple(iou(mask, own) for mask in silhouettes),
        cells is not None,
        found.left_out,
        tuple(entry.verdict is not None and entry.verdict.stable for entry in best),
        tuple(iou(own_silhouette(entry.stack), own) for entry in best),
    )


def own_silhouette(stack: Stack) -> Mask:
    """The stack's silhouette (H, W), framed as captured ones are."""
    return fitted(silhouette(stack, PAPER_GRID), PAPER_GRID)


def summary(cases: Sequence[Case], kind: int) -> dict[str, Any]:
    """Means with 95 % intervals, and quantiles; each stack is a cluster of its own."""
    whole = [case for case in cases if case.left_out < 0.05]
    seen = np.array([case.seen[kind] for case in whole])
    return {
        "iou": estimate([case.seen[kind] for case in cases]),
        "iou_in_one_part": estimate(seen),
        "iou_in_one_part_least": float(seen.min()),
        "verified_stands": estimate([case.stands[kind] for case in cases]),
        "verified_iou_in_one_part": estimate([case.again[kind] for case in whole]),
    }


def table(metrics: Mapping[str, Any]) -> Any:
    """The table to print."""

    def share(e: Mapping[str, float]) -> str:
        return f"{100 * e['value']:.1f} ({100 * e['low']:.1f} to {100 * e['high']:.1f})"

    names = ("iou", "iou_in_one_part", "verified_stands", "verified_iou_in_one_part")
    rows = [[kind, *(share(metrics[kind][name]) for name in names)] for kind in KINDS]
    headings = (
        "silhouette",
        "IoU with the stack's own [%]",
        "of stacks in one part [%]",
        "a verified stack for it stands [%]",
        "IoU of that with the stack's own, in one part [%]",
    )
    title = (
        f"{metrics['stacks']} stacks before a camera, {metrics['in_one_part']} of them in one part;"
        f" {share(metrics['made_of_whole_cells'])} % made of whole cells"
    )
    return plain_table(title, headings, rows)


if __name__ == "__main__":
    start(main)
