"""Which stack is built: the reading of a picture that is trusted, and the first of some stacks that can be built."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from stackgen.api import Model
from stackgen.errors import StackgenError
from stackgen.geometry import iou
from stackgen.io.stacks_file import StacksFile
from stackgen.robot.build import PlannedBuild
from stackgen.sampling.verified import Budget
from stackgen.stack import Stack
from stackgen.vision.depth import find_structure, is_depth, read_frame
from stackgen.vision.drawings import read_silhouette
from stackgen.vision.sketches import read_sketch
from stackgen.world import Grid, Mask

SAME = 0.7
"""Front IoU from which on the two ways to read a picture are taken to have seen the same."""

NUMBER = 3
"""Stacks that stand which are looked for in a picture: the first of them may have no safe order."""


def silhouette_of(picture: Path, grid: Grid) -> Mask:
    """Find the silhouette in a drawing, in the photo of one, or in a depth frame.

    A clean picture is read by its colours; that fails, or sees something else, where light is uneven or only the
    outline is drawn: then it is a sketch.

    Args:
        picture: File of the picture.
        grid: Grid of the silhouette.

    Raises:
        StackgenError: If nothing is seen.
    """
    if is_depth(picture):
        frame = read_frame(picture)
        try:
            return find_structure(frame, grid).silhouette
        except StackgenError as error:
            raise StackgenError(f"{picture}: {error}") from error
    try:
        sketch = read_sketch(picture, grid).silhouette
    except StackgenError:
        return read_silhouette(picture, grid)
    try:
        drawing = read_silhouette(picture, grid)
    except StackgenError:
        return sketch
    return drawing if iou(drawing, sketch) >= SAME else sketch


def stacks_of_picture(
    picture: Path,
    model: Model,
    *,
    inventory: str | None = None,
    budget: str | None = None,
    seed: int = 0,
    on_step: Callable[[], None] = lambda: None,
) -> StacksFile:
    """Sample stacks for what is in a picture, and keep those that stand, the best first.

    Args:
        picture: File of the picture, as for :func:`silhouette_of`.
        model: Model that predicts the block list, samples, and checks.
        inventory: Blocks that there are, such as `cube=4,rectangle=3`.
        budget: Time such as `5s`, or number of draws, that finding a stack may cost.
        seed: Seed of the stacks.
        on_step: Called at most `NUMBER + 1` times, as the work proceeds.

    Raises:
        StackgenError: If nothing is seen, or no stack stands.
    """
    found = model.sample_verified(
        silhouette_of(picture, model.world.grid),
        NUMBER,
        seed,
        inventory=inventory,
        budget=None if budget is None else Budget.parse(budget),
        on_step=on_step,
    )
    standing = tuple(entry for entry in found.entries if entry.verdict is not None and entry.verdict.stable)
    if not standing:
        raise StackgenError(f"{picture}: none of the stacks that were tried stands; try a larger --budget")
    return replace(found, entries=standing, silhouette=picture.name)


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
