"""The best stacks there are for a drawing: proposals of the search and of a sampler, and the simulator's word on them.

What is delivered is clean: the search puts blocks exactly on each other, and what a network proposes is delivered as it
settled.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.geometry import silhouette_iou
from stackgen.names import Preference
from stackgen.protocols import StabilityChecker, Verdict
from stackgen.sampling.clean import as_settled
from stackgen.sampling.verified import Budget, Candidate, best
from stackgen.search.problem import CANDIDATES, SearchSettings
from stackgen.search.scale import Cells, Scaled, best_scale
from stackgen.search.solver import solve
from stackgen.stack import Stack, layout
from stackgen.vision.reader import Reading
from stackgen.world import Mask, World

Ints = NDArray[np.int64]

Proposals = Callable[[Mask, Ints | None], Sequence[Stack]]
"""Function that proposes stacks for a target (H, W) and a block list (S,), if one is known."""

ENOUGH = 0.8
"""Front IoU of the search's best stack from which on nobody else is asked."""


@dataclass(frozen=True)
class Best:
    """The best stacks of a drawing.

    Args:
        world: World that they lie in.
        target: (H, W) silhouette.
        chosen: Candidates, the best first.
        asked: Number of stacks that the search and the sampler proposed.
        late: Whether the time of the search was up before it had looked at all.
    """

    world: World
    target: Mask
    chosen: tuple[Candidate, ...]
    asked: tuple[int, int]
    late: bool = False


def within(budget: Budget | None, prefer: Preference = "fit") -> SearchSettings:
    """Limit the search by a budget: a time, or a number of stacks, which it judges instead of drawing them."""
    if budget is None:
        return SearchSettings(prefer=prefer)
    if budget.seconds is not None:
        return SearchSettings(seconds=budget.seconds, prefer=prefer)
    return SearchSettings(effort=budget.draws / CANDIDATES, prefer=prefer)


def best_stacks(
    reading: Reading,
    world: World,
    checker: StabilityChecker,
    *,
    number: int = 3,
    cells: Cells = Cells(),  # noqa: B008 - frozen
    block_list: Ints | None = None,
    inventory: Ints | None = None,
    settings: SearchSettings = SearchSettings(),  # noqa: B008 - frozen
    proposals: Proposals | None = None,
) -> Best:
    """Find the best stacks for what was read in a picture.

    A picture that already is a silhouette of the world's grid keeps its place and scale, unless cells are asked for.

    Args:
        reading: What was read.
        world: World of the sampler.
        checker: Has the last word on which stand.
        number: Number of stacks, at most.
        cells: How many cells the drawing is high, and wide.
        block_list: (S,) blocks, all of which are to be used.
        inventory: (S,) blocks that there are.
        settings: How long and for what the search looks.
        proposals: Proposes more stacks where the search finds too few, or none that fits, within the world's grid.

    Raises:
        StackgenError: If nothing was found that could be simulated.
    """
    began = time.perf_counter()
    at = _search(reading, world, cells, number, block_list, inventory, settings)
    late = settings.seconds is not None and time.perf_counter() - began > settings.seconds
    searched = [answer.stack for answer in at.answers]
    found = _candidates(zip(searched, checker.check_all(searched), strict=True), at)
    more: list[Candidate] = []
    fits = max((c.front_iou for c in found if c.verdict.stable), default=0.0) >= ENOUGH
    if proposals is not None and at.world == world and not fits:
        known = block_list if block_list is not None else searched[0].counts if searched else None
        settled = _candidates(as_settled(proposals(at.target, known), checker), at)
        more = [one for one in settled if one.verdict.stable]
    most = max((one.front_iou for one in [*found, *more] if one.verdict.stable), default=0.0)
    ranked = [one for one in [*found, *more] if one.front_iou >= most - settings.near - 1e-9]
    if settings.prefer == "margin":  # the search has them in that order
        chosen = tuple(sorted(ranked, key=lambda one: not one.verdict.stable)[:number])
    else:
        chosen = best(ranked, number)
    if not chosen:
        way = "a larger budget" if late else "more cells, other blocks, or leave the block list out"
        raise StackgenError(f"nothing that stands was found; give {way}")
    return Best(at.world, at.target, chosen, (len(searched), len(more)), late)


def _search(
    reading: Reading,
    world: World,
    cells: Cells,
    number: int,
    block_list: Ints | None,
    inventory: Ints | None,
    settings: SearchSettings,
) -> Scaled:
    if reading.exact is None or cells != Cells():
        return best_scale(reading.figure, world, cells, number, block_list, inventory, settings)
    answers = solve(reading.exact, world, number, block_list, inventory, settings)
    return Scaled(world, reading.exact, world.grid.height, tuple(answers))


def _candidates(judged: Iterable[tuple[Stack, Verdict]], at: Scaled) -> list[Candidate]:
    grid = at.world.grid
    candidates = []
    for stack, verdict in judged:
        shown = verdict.settled if verdict.stable else stack
        candidates.append(Candidate(stack, verdict, silhouette_iou(shown, at.target, grid), layout(stack, grid)))
    return candidates
