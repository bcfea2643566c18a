"""What search, a sample of the network, verified samples and both give for drawings at the scale that a network knows.

Drawings of every kind of docs/taught.md but designs, tidy and untidy, made for this purpose. `search` is asked for its
best stack, `one sample` for the first with the network's list, `verified` draws until its time is up, and `both` lets
the network draw with the search's list for as long as the search leaves, and takes the better answer. Every answer is
simulated; what falls has a front IoU of 0. Seconds are those of one core. Intervals are 95 %, over drawings.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from benchmarks.common import argument_parser, percent, plain_table, report, start
from stackgen.data.generation.drawing.drawings import DrawingSettings, choose, draw, finish
from stackgen.errors import StackgenError
from stackgen.evaluation.intervals import clustered_ratio
from stackgen.geometry import silhouette_iou
from stackgen.world import Mask, World

if TYPE_CHECKING:
    from stackgen.api import Model
    from stackgen.stack import Stack
    from stackgen.vision.reader import Reading

SEARCH, ONE, VERIFIED, BOTH = "search", "one sample", "verified", "both"
EFFORT = 20.0
"""Effort of the search after the usual one, so that it looks on where it has time."""
LEAST = 0.2
"""Time without which nobody is asked after a search [s]."""
BLOCKS = ((1, 10), (11, 20), (21, 40))
"""Groups of drawings, by the number of blocks that the search takes."""
HEIGHTS = ((0, 3), (3, 5), (5, 7), (7, 9), (5, 9))
"""Groups of drawings, by their height [cell]: above the first number, up to the second."""
FAIR = 0.7
"""Front IoU of the search's answer below which blocks hardly make a drawing; such drawings are counted apart."""

Method = Callable[[Mask], "Stack"]
"""Function that answers a silhouette with the stack that it thinks best, as it stands in the end."""


@dataclass(frozen=True)
class Answer:
    """What a method gave for a drawing.

    Args:
        stands: Whether its stack stands.
        front_iou: Front IoU of the settled stack with the drawing; 0 if it fell.
        seconds: Time [s].
        blocks: Number of blocks.
    """

    stands: bool
    front_iou: float
    seconds: float
    blocks: int


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--weights", required=True, help="sampler: a name, file or run folder; its world counts")
    options.add_argument("--block_list_weights", default="default", help="block-list network of that world")
    options.add_argument("--drawings", type=int, default=500, help="number of drawings")
    options.add_argument(
        "--smallest", type=float, default=5.0, help="least width or height, whichever is larger [cell]"
    )
    options.add_argument("--seconds", type=float, default=3.0, help="time for a drawing [s]")
    options.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="who answers")
    options.add_argument("--workers", type=int, default=1, help="processes that share the drawings, each with a core")
    options.add_argument("--seed", type=int, default=1000, help="seed of the drawings and of the network")
    return options


def drawings(world: World, number: int, smallest: float, seed: int) -> list[Mask]:
    """Draw silhouettes (H, W) of one size at least, each with a seed of its own."""
    settings = DrawingSettings(smallest=smallest)
    kinds = {kind: weight for kind, weight in settings.kinds.items() if kind != "design"}
    found: list[Mask] = []
    for i in itertools.count():
        if len(found) == number:
            break
        rng = np.random.default_rng([seed, i])
        kind = choose(kinds, rng)
        drawing = finish(kind, draw(kind, world, settings, rng), world, settings, rng)
        if drawing is not None:
            found.append(drawing.silhouette)
    return found


def _as_it_is(target: Mask) -> Reading:
    """A silhouette as what was read in a picture, so that nobody reads it once more."""
    from stackgen.vision.reader import Reading

    return Reading(target, "drawing", 1.0, np.zeros((*target.shape, 3), np.uint8), exact=target)


def _searched(model: Model, seconds: float, seed: int) -> Method:
    from stackgen.sampling.best import best_stacks
    from stackgen.search.problem import SearchSettings

    def once(target: Mask, effort: float, left: float) -> Stack:
        limits = SearchSettings(seconds=left, effort=effort)
        found = best_stacks(_as_it_is(target), model.world, model.checker, number=1, settings=limits).chosen[0]
        return found.verdict.settled if found.verdict.stable else found.stack

    def ask(target: Mask) -> Stack:
        began = time.perf_counter()
        answers: list[Stack] = []
        for effort in (1.0, EFFORT):  # a search that is cut off may be worse than a short one that ends
            left = seconds - (time.perf_counter() - began)
            if answers and left < LEAST:
                break
            with suppress(StackgenError):  # it found nothing
                answers.append(once(target, effort, max(LEAST, left)))
        if not answers:
            raise StackgenError("the search found nothing")
        return max(answers, key=lambda stack: _fit(model, stack, target))

    return ask


def _one_sample(model: Model, seconds: float, seed: int) -> Method:
    return lambda target: model.sample(_as_it_is(target), 1, seed)[0]


def _verified(model: Model, seconds: float, seed: int) -> Method:
    from stackgen.sampling.verified import Budget

    budget = Budget.parse(f"{seconds}s")
    return lambda target: model.sample_verified(_as_it_is(target), 1, seed, budget=budget).stacks[0]


def _both(model: Model, seconds: float, seed: int) -> Method:
    from stackgen.sampling.verified import Budget

    def ask(target: Mask) -> Stack:
        began = time.perf_counter()
        first = _searched(model, seconds, seed)(target)
        left = seconds - (time.perf_counter() - began)
        if left < LEAST:
            return first
        budget = Budget.parse(f"{left}s")
        second = model.sample_verified(_as_it_is(target), 1, seed, blocks=first.counts, budget=budget).stacks[0]
        return max((first, second), key=lambda stack: _fit(model, stack, target))

    return ask


METHODS: Mapping[str, Callable[[Model, float, int], Method]] = {
    SEARCH: _searched, ONE: _one_sample, VERIFIED: _verified, BOTH: _both,
}  # fmt: skip


def _fit(model: Model, stack: Stack, target: Mask) -> tuple[bool, float]:
    """Say whether a stack stands, and how well it then fits."""
    verdict = model.checker.check(stack)
    return verdict.stable, silhouette_iou(verdict.settled, target, model.world.grid) if verdict.stable else 0.0


def ask_all(method: Method, model: Model, targets: Sequence[Mask]) -> list[Answer]:
    """Ask a method for every drawing; where it has no answer, nothing stands."""
    answers = []
    for target in targets:
        began = time.perf_counter()
        try:
            stack = method(target)
        except StackgenError:  # nothing was found
            answers.append(Answer(False, 0.0, time.perf_counter() - began, 0))
            continue
        seconds = time.perf_counter() - began
        answers.append(Answer(*_fit(model, stack, target), seconds, len(stack)))
    return answers


def asked(options: argparse.Namespace) -> tuple[Model, list[Mask]]:
    """Load the model, and draw what it is asked for."""
    from stackgen.api import load

    model = load(options.weights, options.block_list_weights)
    return model, drawings(model.world, options.drawings, options.smallest, options.seed)


def share(options: argparse.Namespace, name: str, number: int) -> list[Answer]:
    """Ask a method for each drawing that falls to a process, on one thread."""
    import torch

    torch.set_num_threads(1)
    model, targets = asked(options)
    model.sample(_as_it_is(targets[0]), 1, 0)  # what is read or compiled once is not measured
    return ask_all(METHODS[name](model, options.seconds, options.seed), model, targets[number :: options.workers])


def groups_of(targets: Sequence[Mask], searched: Sequence[Answer], world: World) -> dict[str, list[int]]:
    """Sort drawings by what the search answered, and by their height [cell]; one may lie in several groups."""
    groups: dict[str, list[int]] = {"all": list(range(len(targets)))}
    for low, high in BLOCKS:
        groups[f"{low} to {high} blocks"] = [i for i, one in enumerate(searched) if low <= one.blocks <= high]
    groups[f"fitted by {FAIR:g} or more"] = [i for i, one in enumerate(searched) if one.front_iou >= FAIR]
    groups[f"fitted by less than {FAIR:g}"] = [i for i, one in enumerate(searched) if one.front_iou < FAIR]
    tall = [np.count_nonzero(target.any(axis=1)) / world.grid.pixels_per_cell for target in targets]
    for low, high in HEIGHTS:
        groups[f"{low} to {high} cells high"] = [i for i, cells in enumerate(tall) if low < cells <= high]
    return {name: members for name, members in groups.items() if members}


def row_of(answers: Sequence[Answer]) -> dict[str, Any]:
    """Sum up answers."""
    ones = np.ones(len(answers))
    stability = clustered_ratio([answer.stands for answer in answers], ones)
    iou = clustered_ratio([answer.front_iou for answer in answers], ones)
    assert stability is not None and iou is not None
    seconds = float(np.mean([answer.seconds for answer in answers]))
    return {"stability": stability.to_json(), "front_iou": iou.to_json(), "seconds": seconds}


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Lay out what was measured."""
    lines = [
        [row["drawings"], str(row["number"]), row["method"], percent(row["stability"]), percent(row["front_iou"]),
         f"{row['seconds']:.2f}"]
        for row in rows
    ]  # fmt: skip
    headings = ("drawings", "number", "method", "stability", "front IoU", "seconds")
    return plain_table("stability and front IoU in percent, seconds for a drawing", headings, lines)


def main() -> None:
    """Ask every method for every drawing."""
    options = parser().parse_args()
    model, targets = asked(options)
    found: dict[str, list[Answer]] = {}
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as team:
        for name in dict.fromkeys([SEARCH, *options.methods]):
            parts = list(team.map(partial(share, options, name), range(options.workers)))
            found[name] = [parts[i % options.workers][i // options.workers] for i in range(len(targets))]
            total = row_of(found[name])
            shown = percent(total["stability"]), percent(total["front_iou"]), f"{total['seconds']:.2f} s"
            print(name, *shown, flush=True)
    groups = groups_of(targets, found[SEARCH], model.world)
    rows = [
        {"drawings": group, "number": len(members), "method": name} | row_of([answers[i] for i in members])
        for group, members in groups.items()
        for name, answers in found.items()
    ]
    facts = {"smallest": options.smallest, "budget": options.seconds, "seed": options.seed, "rows": rows}
    report("scales", facts, [table_of(rows)], options.out)


if __name__ == "__main__":
    start(main)
