"""The block lists that an inventory allows.

An inventory is the number of blocks of each shape on the table, more than one structure needs or fewer. A search
finds which of the lists it allows can make a silhouette; the network says which of these are the most likely.

Legend: S shapes, H x W pixels, T block lists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.protocols import BlockListPredictor
from stackgen.sampling.feasible import lists_that_make
from stackgen.stack import format_block_list, parse_block_list
from stackgen.world import Catalogue, Mask, World

Inventory = str | Mapping[str, int] | NDArray[np.int64]
"""`"cube=4,rectangle=3"`, `{"cube": 4, "rectangle": 3}` or counts (S,) in catalogue order."""

MOST = 10**6
"""Largest number of blocks of an inventory."""

_RANKED = 64  # lists that the network is asked for; what can be made but is not among them comes after
_SLACK = 0.5  # area that a silhouette may be larger than its blocks [cell]: displacement, gaps, whole pixels


def inventory_counts(inventory: Inventory, catalogue: Catalogue) -> NDArray[np.int64]:
    """Give the counts (S,) of an inventory in any of its forms.

    Raises:
        StackgenError: On an unknown shape, a number that is negative or not whole, or no block at all.

    >>> from stackgen.world import PAPER_CATALOGUE
    >>> inventory_counts("cube=40, triangle=1", PAPER_CATALOGUE).tolist()
    [40, 0, 0, 1]
    """
    try:
        if isinstance(inventory, str):
            return parse_block_list(inventory, catalogue, MOST)
        if isinstance(inventory, Mapping):
            counts = np.zeros(len(catalogue), dtype=np.int64)
            for name, number in inventory.items():
                if not isinstance(number, int | np.integer):
                    raise StackgenError(f"inventory: the number of {name} must be whole, got {number!r}")
                counts[catalogue.index(name)] = number
        else:
            counts = np.asarray(inventory, dtype=np.int64)
    except StackgenError as error:
        raise StackgenError(str(error).replace("block list", "inventory", 1)) from error
    if counts.shape != (len(catalogue),) or (counts < 0).any() or not 1 <= counts.sum() <= MOST:
        names = ", ".join(catalogue.names)
        raise StackgenError(f"inventory: give 0 or more of each of {names}, at least one in all, got {inventory!r}")
    return counts


def allowed_lists(
    silhouette: Mask,
    inventory: NDArray[np.int64],
    world: World,
    predictor: Callable[[], BlockListPredictor] | None = None,
    top: int = 1,
) -> NDArray[np.int64]:
    """Find the block lists that an inventory allows and that can make a silhouette, the most likely first.

    Lists that the network does not know come after those it does, few blocks first. A silhouette that
    no blocks fill row by row, such as a drawing between the lines, is left to the network alone.

    Args:
        silhouette: (H, W), on the cells of the grid.
        inventory: (S,) number of blocks of each shape.
        world: Shapes, grid and longest block list.
        predictor: Function that makes the predictor which ranks lists; None where there is none.
        top: Largest number of lists.

    Returns:
        (T, S), at least one.

    Raises:
        StackgenError: If the inventory cannot make the silhouette; the message says what is missing.
    """
    limit = np.minimum(inventory, world.max_blocks)
    _check_area(silhouette, inventory, world)
    fitting = _fitting(silhouette, limit, world)
    if not fitting and fitting is not None:
        others = _fitting(silhouette, np.full(len(world.catalogue), world.max_blocks), world)
        if others:
            raise StackgenError(_what_is_missing(inventory, others, world.catalogue))
    if predictor is None:
        if not fitting:
            raise StackgenError("this model predicts no block lists, and none was found for this silhouette: give one")
        return np.array(_fewest_first(fitting)[:top])
    ranked = [tuple(counts) for counts in predictor().predict(silhouette[None], _RANKED, limit)[0].tolist()]
    if not fitting:
        return np.array(ranked[:top])
    known = [counts for counts in ranked if counts in fitting]
    return np.array([*known, *_fewest_first(fitting - set(known))][:top])


def _fitting(silhouette: Mask, limit: NDArray[np.int64], world: World) -> set[tuple[int, ...]] | None:
    """Find the block lists that can make the silhouette; None where that cannot be told for these shapes."""
    try:
        found = lists_that_make(silhouette, limit, world)
    except StackgenError:
        return None
    return {counts for counts in found if sum(counts) <= world.max_blocks}


def _fewest_first(lists: set[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return sorted(lists, key=lambda counts: (sum(counts), counts))


def _check_area(silhouette: Mask, inventory: NDArray[np.int64], world: World) -> None:
    """Raise StackgenError if all the blocks together cannot cover the silhouette."""
    catalogue, max_blocks = world.catalogue, world.max_blocks
    wanted = float(np.count_nonzero(silhouette)) / world.grid.pixels_per_cell**2
    areas = np.repeat([shape.area for shape in catalogue], np.minimum(inventory, max_blocks))
    largest = float(np.sort(areas)[::-1][:max_blocks].sum())
    if wanted - largest <= _SLACK:
        return
    given = format_block_list(inventory, catalogue)
    rest = f", of which one stack takes {max_blocks} blocks at most" if inventory.sum() > max_blocks else ""
    raise StackgenError(
        f"the inventory {given} is too small: the silhouette covers {wanted:.1f} cells, its blocks"
        f" {largest:.1f}{rest}; {wanted - largest:.1f} cells are missing"
    )


def _what_is_missing(inventory: NDArray[np.int64], lists: set[tuple[int, ...]], catalogue: Catalogue) -> str:
    """Write one line about the list that lacks the least."""

    def lacking(counts: tuple[int, ...]) -> NDArray[np.int64]:
        return np.maximum(np.array(counts) - inventory, 0)

    nearest = min(lists, key=lambda counts: (lacking(counts).sum(), sum(counts), counts))
    always = np.min([lacking(counts) for counts in lists], axis=0)
    reason = "it has no blocks that fill all its rows"
    tapering = [name for name, n, shape in zip(catalogue.names, always, catalogue, strict=True)
                if n and not shape.level[1]]  # fmt: skip
    if tapering:
        reason = f"its slanted cells need a {' and a '.join(tapering)} each"
    return (
        f"the inventory {format_block_list(inventory, catalogue)} cannot make this silhouette: {reason};"
        f" with {format_block_list(lacking(nearest), catalogue)} more it could be"
        f" {format_block_list(nearest, catalogue)}"
    )
