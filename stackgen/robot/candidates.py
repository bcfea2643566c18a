"""Which stack is built: those for what was read in a picture, and the first of some stacks that can be built."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from stackgen.api import Model, best
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import StacksFile
from stackgen.robot.build import PlannedBuild
from stackgen.sampling.best import within
from stackgen.sampling.verified import Budget
from stackgen.search.problem import SearchSettings
from stackgen.stack import Stack
from stackgen.vision.reader import Reading

NUMBER = 3
"""Stacks that stand which are looked for in a picture: the first of them may have no safe order."""

SCALES = (5, 4, 3)
"""Heights [cell] that are tried for a picture whose stacks are of too many blocks."""


def stacks_of_picture(
    reading: Reading,
    name: str,
    model: Model | None = None,
    *,
    inventory: str | None = None,
    budget: str | None = None,
    seed: int = 0,
    cells: str = "auto",
    most: int | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> StacksFile:
    """Find stacks for what is in a picture, and keep those that stand, the best first.

    Args:
        reading: What was read in the picture.
        name: Name of the picture, for errors and what is written.
        model: Model that predicts the block list, samples, and checks; by default search and network look for the best
            stacks together, at any scale.
        inventory: Blocks that there are, such as `cube=4,rectangle=3`.
        budget: Time such as `5s`, or number of stacks, that finding a stack may cost.
        seed: Seed of the stacks.
        cells: Height, or width and height, of the structure, as `stackgen sample --cells`; `auto` finds it.
        most: Number of blocks that there is room for where the robot takes them from: of a picture whose best stacks
            need more the best at a smaller scale are taken.
        on_step: Called at most `NUMBER + 1` times, as the work proceeds.

    Raises:
        StackgenError: If no stack stands, or `cells` is given with a model, which has one scale.
    """
    limit = None if budget is None else Budget.parse(budget)
    if model is None:
        scales = ("auto", *map(str, SCALES)) if cells == "auto" else (cells,)
        found = _at_best_scale(reading, scales, seed, inventory, within(limit), most, on_step)
    elif cells != "auto":
        raise StackgenError("--cells belongs to the search: leave out --weights")
    else:
        found = model.sample_verified(reading, NUMBER, seed, inventory=inventory, budget=limit, on_step=on_step)
    standing = tuple(entry for entry in found.entries if entry.verdict is not None and entry.verdict.stable)
    standing = tuple(entry for entry in standing if most is None or len(entry.stack) <= most) or standing
    if not standing:
        raise StackgenError(f"{name}: none of the stacks that were tried stands; try a larger --budget")
    return replace(found, entries=standing, silhouette=name)


def _at_best_scale(
    reading: Reading,
    scales: Sequence[str],
    seed: int,
    inventory: str | None,
    search: SearchSettings,
    most: int | None,
    on_step: Callable[[], None],
) -> StacksFile:
    """Find the best stacks at the first scale; where these have too many blocks, those that fit best at any."""
    tried: list[tuple[float, StacksFile]] = []
    for cells in scales:
        found = best(reading, NUMBER, seed, inventory=inventory, cells=cells, search=search)
        on_step()
        if most is None:
            return found
        few = [entry.front_iou or 0.0 for entry in found.entries if len(entry.stack) <= most]
        tried.append((max(few, default=-1.0), found))
        if cells == scales[0] and few:
            break
    return max(tried, key=lambda pair: pair[0])[1]


def first_buildable(stacks: Sequence[Stack], plan: Callable[[Stack], PlannedBuild]) -> PlannedBuild:
    """Plan the first stack that can be built.

    Args:
        stacks: Stacks to try, the best first; at least one.
        plan: Function that plans a stack, made of :func:`stackgen.robot.build.plan_stack`.

    Raises:
        StackgenError: If none can; it says why the first one cannot.
    """
    reasons = []
    for stack in stacks:
        try:
            return plan(stack)
        except StackgenError as error:
            reasons.append(error)
    raise reasons[0]
