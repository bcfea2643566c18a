"""What search, network and both together cost and find against the size of the problem: blocks, shapes, cells.

Silhouettes are those of random designs that statics calls stable, so each has an answer that fits exactly. The network
is asked where its world fits (four shapes, four cells, ten blocks), with the block list of its CNN; elsewhere both
together are the search alone. An answer counts if its best stack stands in the simulator and has a front IoU of at
least 0.9. Seconds are those of one core, for up to three stacks. Intervals are 95 %, over scenes.
"""

from __future__ import annotations

import argparse
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common import argument_parser, percent, plain_table, report, start
from stackgen.data.generation.designs import DesignSettings, draw_design, realize
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.geometry import silhouette, silhouette_iou
from stackgen.io.files import write_atomically, write_json
from stackgen.stack import Stack
from stackgen.world import PAPER_CATALOGUE, PAPER_GRID, PAPER_WORLD, Catalogue, Grid, Mask, Shape, World

if TYPE_CHECKING:
    from stackgen.protocols import StabilityChecker

MATCH = 0.9
BLOCKS = ((4, 10), (11, 20), (21, 30), (31, 40))
CELLS = (3, 4, 5, 6, 8)
MORE = (
    Shape("beam", ((-2, -0.5), (2, -0.5), (2, 0.5), (-2, 0.5))),
    Shape("ramp", ((-1, -0.5), (1, -0.5), (0.5, 0.5), (-0.5, 0.5))),
    Shape("plank", ((-1, -0.25), (1, -0.25), (1, 0.25), (-1, 0.25))),
)
"""Shapes beyond the paper's four: the last has half the height of the others."""
DESIGNS = 1500
"""Designs that are drawn for a world, at most."""

Method = Callable[[Mask, World], Sequence[Stack]]
"""Function that answers a silhouette."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--scenes", type=int, default=8, help="scenes of each world and number of blocks")
    options.add_argument("--seed", type=int, default=0, help="seed of the designs and of the network")
    options.add_argument("--picture", type=Path, help="file for a chart")
    return options


@dataclass(frozen=True)
class Scene:
    """A silhouette that has an exact answer.

    Args:
        shapes, cells: Size of the world: number of shapes, cells a side.
        blocks: Number of blocks of the design.
        world: World with a grid in which the silhouette lies.
        target: (H, W).
    """

    shapes: int
    cells: int
    blocks: int
    world: World
    target: Mask

    @property
    def known(self) -> bool:
        """Whether the network knows its world."""
        return self.world.grid == PAPER_GRID and self.shapes == len(PAPER_CATALOGUE) and self.blocks <= BLOCKS[0][1]


def grid_of(cells: int) -> Grid:
    """The paper's grid, or a larger one at its scale."""
    if cells <= PAPER_GRID.height:
        return PAPER_GRID
    ppc = PAPER_GRID.pixels_per_cell
    return Grid(cells, cells, int(-(-(cells + 1) * ppc // 8) * 8), ppc, PAPER_GRID.ground_margin)


def scenes_of(shapes: int, cells: int, number: int, seed: int) -> Iterator[Scene]:
    """Draw scenes of a world, as many for each number of blocks as there are."""
    from stackgen.sim.statics.checker import StaticsChecker

    catalogue = Catalogue((*PAPER_CATALOGUE, *MORE)[:shapes])
    world = World(catalogue, grid_of(cells), BLOCKS[-1][1])
    checker, rng = StaticsChecker(), np.random.default_rng([seed, shapes, cells])
    missing = dict.fromkeys(BLOCKS, number)
    for _ in range(DESIGNS):
        fill = DesignSettings(minimum_fill=int(rng.integers(2, cells)), displacement=0.0)
        small = World(catalogue, Grid(cells, cells, world.grid.image_size), BLOCKS[-1][1])
        stack = realize(draw_design(rng, small, fill), rng, small, fill)
        for low, high in BLOCKS:
            if low <= len(stack) <= high and missing[low, high] and checker.check(stack).stable:
                missing[low, high] -= 1
                yield Scene(shapes, cells, len(stack), world, silhouette(stack, world.grid))


def methods_of(checker: StabilityChecker, seed: int) -> dict[str, Method]:
    """The methods by name."""
    from stackgen.api import load
    from stackgen.sampling.best import best_stacks
    from stackgen.search.solver import solve
    from stackgen.vision.reader import Reading

    model = load()

    def together(target: Mask, world: World) -> Sequence[Stack]:
        reading = Reading(target, "drawing", 1.0, np.zeros((*target.shape, 3), np.uint8), exact=target)
        found = best_stacks(
            reading,
            PAPER_WORLD,
            checker,
            proposals=lambda mask, counts: model.sample_verified(mask, 3, seed, counts).stacks,
        )
        return [candidate.stack for candidate in found.chosen]

    return {
        "search": lambda target, world: [answer.stack for answer in solve(target, world)],
        "network": lambda target, world: model.sample(target, 3, seed),
        "both together": together,
    }


def answered(scene: Scene, method: Method, checker: StabilityChecker) -> dict[str, Any]:
    """Ask a method: what its best stack is worth, and what it cost [s]."""
    began = time.process_time()
    stacks = method(scene.target, scene.world)
    seconds = time.process_time() - began
    verdicts = checker.check_all(stacks)
    ious = [
        silhouette_iou(verdict.settled, scene.target, scene.world.grid) if verdict.stable else 0.0
        for verdict in verdicts
    ]
    return {
        "shapes": scene.shapes,
        "cells": scene.cells,
        "blocks": scene.blocks,
        "stacks": len(stacks),
        "stand": sum(verdict.stable for verdict in verdicts),
        "best_iou": max(ious, default=0.0),
        "first_iou": next(iter(ious), 0.0),
        "seconds": seconds,
    }


def main() -> None:
    """Ask for everything; print tables by number of blocks, of shapes and of cells."""
    options = parser().parse_args()
    from stackgen.sim.checkers import SimulatorChecker

    checker = SimulatorChecker(until_fall=True)
    methods = methods_of(checker, options.seed)
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in methods}
    metrics = {"seed": options.seed, "physics": checker.physics.to_json(), "match": MATCH, "scenes": results}
    for shapes in range(len(PAPER_CATALOGUE), len(PAPER_CATALOGUE) + len(MORE) + 1):
        for cells in CELLS:
            scenes = list(scenes_of(shapes, cells, options.scenes, options.seed))
            for name, method in methods.items():
                asked = [scene for scene in scenes if name == "search" or scene.known]
                results[name] += [answered(scene, method, checker) for scene in asked]
            print(f"{shapes} shapes, {cells} cells: {len(scenes)} scenes", flush=True)
            if options.out:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                write_json(options.out, metrics)
    tables = [table(results, side) for side in SIDES]
    metrics["summary"] = {side: list(rows_of(results, side)) for side in SIDES}
    if options.picture:
        draw(results, options.picture)
    report("search_size", metrics, tables, options.out)


SIDES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "blocks": lambda row: next(f"{low} to {high}" for low, high in BLOCKS if low <= row["blocks"] <= high),
    "cells": lambda row: str(row["cells"]),
    "shapes": lambda row: str(row["shapes"]),
}
"""What the results are grouped by."""


def rows_of(results: Mapping[str, Sequence[Mapping[str, Any]]], side: str) -> Iterator[dict[str, Any]]:
    """Sum up the results of each method by one side of their size."""
    for name, some in results.items():
        for group in dict.fromkeys(sorted(map(SIDES[side], some), key=lambda text: int(text.split()[0]))):
            rows = [row for row in some if SIDES[side](row) == group]
            answers = clustered_ratio([row["best_iou"] >= MATCH for row in rows], np.ones(len(rows)))
            stand = clustered_ratio([row["stand"] for row in rows], [row["stacks"] for row in rows])
            seconds = [row["seconds"] for row in rows]
            yield {
                "method": name,
                side: group,
                "scenes": len(rows),
                "answered": answers and answers.to_json(),
                "stands": stand and stand.to_json(),
                "best_iou": float(np.mean([row["best_iou"] for row in rows])),
                "seconds": float(np.median(seconds)),
                "seconds_95": float(np.percentile(seconds, 95)),
            }


def table(results: Mapping[str, Sequence[Mapping[str, Any]]], side: str) -> Any:
    """A line for each method and size."""
    headings = ("method", side, "scenes", "answered", "stacks that stand", "best IoU", "seconds", "95th percentile")
    lines = [
        [
            row["method"], row[side], str(row["scenes"]), percent(row["answered"]), percent(row["stands"]),
            f"{100 * row['best_iou']:.1f}", f"{row['seconds']:.2f}", f"{row['seconds_95']:.2f}",
        ]
        for row in rows_of(results, side)
    ]  # fmt: skip
    return plain_table(f"By number of {side}; shares in percent", headings, lines)


def draw(results: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Draw quality above and cost below, against blocks, cells and shapes."""
    from matplotlib.figure import Figure  # without pyplot: no window, no state

    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplots(2, len(SIDES), sharex="col", sharey="row")
    for column, side in enumerate(SIDES):
        rows = list(rows_of(results, side))
        groups = sorted({row[side] for row in rows}, key=lambda text: int(text.split()[0]))
        for number, name in enumerate(results):
            own = [row for row in rows if row["method"] == name]
            x = [groups.index(row[side]) + 0.12 * (number - 1) for row in own]
            shares = np.array([[100 * row["answered"][k] for k in ("value", "low", "high")] for row in own])
            around = np.abs(shares[:, 1:] - shares[:, :1]).T
            panels[0][column].errorbar(x, shares[:, 0], around, fmt="o-", capsize=2, markersize=4, label=name)
            seconds = np.array([[row["seconds"], row["seconds_95"]] for row in own])
            above = np.stack([np.zeros(len(own)), seconds[:, 1] - seconds[:, 0]])
            panels[1][column].errorbar(x, seconds[:, 0], above, fmt="o-", capsize=2, markersize=4, label=name)
        panels[1][column].set_xticks(range(len(groups)), groups)
        panels[1][column].set_xlabel({"cells": "cells a side"}.get(side, side))
        panels[1][column].set_yscale("log")
    panels[0][0].set_ylabel(f"stands, IoU of {MATCH} [%]")
    panels[0][0].set_ylim(0, 105)
    panels[1][0].set_ylabel("seconds, to the 95th percentile")
    panels[0][0].legend(frameon=False, loc="lower left")
    for panel in panels.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data.getvalue())


if __name__ == "__main__":
    start(main)
