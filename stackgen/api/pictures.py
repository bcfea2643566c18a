"""The best stacks for a picture, by search and network together: `stackgen.best(...)`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stackgen.api.model import BlockList, Model, Silhouette, load
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import StackEntry, StacksFile
from stackgen.sampling.verified import Budget
from stackgen.search.problem import SearchSettings
from stackgen.search.sampler import SearchSampler
from stackgen.search.scale import MOST_BLOCKS, Cells
from stackgen.stack import Stack
from stackgen.vision.cells import squared
from stackgen.vision.reader import Reading, read_picture
from stackgen.world import Mask

if TYPE_CHECKING:
    from stackgen.sampling.best import Best
    from stackgen.sampling.inventory import Inventory


def best(
    silhouette: Silhouette,
    num_samples: int = 3,
    seed: int = 0,
    blocks: BlockList | None = None,
    inventory: Inventory | None = None,
    cells: str = "auto",
    search: SearchSettings = SearchSettings(),  # noqa: B008 - frozen
    on_step: Callable[[], None] = lambda: None,
) -> StacksFile:
    """Find the best stacks for a picture at any scale, by search and network together, simulated.

    Args:
        silhouette: Picture of a structure: a drawing, the photo of a sketch, a depth frame; or what was read in one.
        num_samples: Largest number of stacks; they have different layouts, as far as such stacks stand and match.
        seed: Seed of what the network proposes.
        blocks: Block list, all of which is used; by default the search chooses one for each stack.
        inventory: Blocks that are available, in the same forms.
        cells: Height of the structure in cells, such as `6`, or width and height, such as `6x5`; `auto` finds it.
        search: How long and for what the search looks.
        on_step: Called twice: once the picture is read, and once stacks were found.

    Returns:
        What `stacks.json` holds, in a world whose grid is as large as the structure.

    Raises:
        StackgenError: If nothing is seen in the picture, or no stack is found.
    """
    from stackgen.sampling.best import best_stacks
    from stackgen.sim.checkers import SimulatorChecker

    asked = Model(SearchSampler(), checker=SimulatorChecker())
    Model._check_draw(num_samples, seed)
    if blocks is not None and inventory is not None:
        raise StackgenError("give a block list or an inventory to choose it from, not both")
    world = asked.world if blocks is None else replace(asked.world, max_blocks=MOST_BLOCKS)
    listed = None if blocks is None else Model(SearchSampler(world)).counts(blocks)
    there = None if inventory is None else asked.inventory(inventory)
    reading = silhouette if isinstance(silhouette, Reading) else read_picture(silhouette, asked.world.grid)
    asked_cells = Cells.parse(cells)
    noted = len(reading.notes)
    if asked_cells == Cells():
        reading = squared(reading, asked.world.grid)
        asked_cells = Cells(None if reading.cell is None else max(1, round(len(reading.figure) / reading.cell)))
    on_step()
    found = best_stacks(
        reading,
        asked.world if listed is None or listed.sum() <= asked.world.max_blocks else world,
        asked.checker,
        number=num_samples,
        cells=asked_cells,
        block_list=listed,
        inventory=there,
        settings=search,
        proposals=partial(_proposed, num_samples, seed, inventory),
    )
    on_step()
    physics = asked.checker.physics
    return StacksFile(
        tuple(StackEntry(c.stack, c.verdict, c.front_iou if c.verdict.stable else 0.0) for c in found.chosen),
        found.world,
        target=found.target,
        silhouette=Path(silhouette).name if isinstance(silhouette, str | Path) else None,
        block_list=found.chosen[0].stack.counts,
        block_list_source="search" if listed is None else "given",
        inventory=there,
        physics=physics.to_json(),
        seed=seed,
        sampler=SearchSampler(search=search).settings,
        cell_size=physics.cell_size,
        comment=_told(found, num_samples, reading.notes[noted:]),
    )


_PROPOSED = Budget(16)
"""Stacks that the network draws where it is asked."""


def _proposed(
    number: int, seed: int, inventory: Inventory | None, target: Mask, block_list: NDArray[np.int64] | None
) -> list[Stack]:
    """Let the network propose stacks for a target (H, W); none of more blocks than it knows."""
    if block_list is not None and block_list.sum() > _network().world.max_blocks:
        return []
    given = inventory if block_list is None else None
    return _network().sample_verified(target, number, seed, block_list, given, budget=_PROPOSED).stacks


@cache
def _network() -> Model:
    """Load the shipped weights, once."""
    return load()


def _told(found: Best, wanted: int, notes: Sequence[str]) -> str:
    """Say what was made of the picture, where the stacks come from, and why they may be fewer or worse than asked."""
    told = [note[0].lower() + note[1:-1] for note in notes]
    told += [f"stacks proposed: {found.asked[0]} by search, {found.asked[1]} by the network"]
    if len(found.chosen) < wanted:
        told.append(f"no more than {len(found.chosen)} of {wanted} layouts fit nearly as well as the best")
    if found.late:
        told.append("the budget was up: a larger one may find better stacks")
    return "; ".join(told)
