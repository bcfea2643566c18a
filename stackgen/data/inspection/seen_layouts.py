"""Which stacks of one set have a layout that another set holds too: what a network may have learnt by heart.

Two notions of "the same", from coarse to fine. The *layout* is that of
:func:`stackgen.stack.layout`, by which the paper counts diversity: the shapes of each
layer from left to right. The *design* adds the cell in which each block begins, and leaves out displacement
and settling alone; the `layout` of a sample's metadata is one.

Legend: M stacks, N blocks at most.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stackgen.data.arrays import PADDING, StackArrays
from stackgen.data.generation.designs import cells_wide
from stackgen.world import World

_EMPTY = -1


def seen_layouts(
    train: StackArrays,
    test: StackArrays,
    world: World,
    *,
    positions: bool = False,
    mirror: bool = True,
) -> NDArray[np.bool_]:
    """Tell for each stack of `test` (M,) whether `train` holds a stack of the same layout.

    The defaults call a layout seen in case of doubt, so that what is called unseen is.

    Args:
        train: Stacks that were trained on.
        test: M stacks that are asked about.
        world: The world of both.
        positions: Whether to compare designs instead: also the cell in which each block begins.
        mirror: Whether the mirror image of a training stack counts as seen, as in training with `data.mirror`.

    >>> from types import SimpleNamespace
    >>> from stackgen.world import PAPER_WORLD
    >>> def pair(left: int, right: int) -> SimpleNamespace:
    ...     poses = np.array([[[-1, 0, 0.5, 0, 0, 0], [1, 0, 0.5, 0, 0, 0]]], np.float32)
    ...     return SimpleNamespace(shapes=np.array([[left, right]], np.uint8), poses=poses)
    >>> held, asked = pair(0, 1), pair(1, 0)
    >>> [seen_layouts(held, asked, PAPER_WORLD, mirror=mirror).tolist() for mirror in (True, False)]
    [[True], [False]]
    """

    def codes(stacks: StackArrays, mirrored: bool = False) -> NDArray[np.int32]:
        return layout_codes(stacks, world, positions=positions, mirrored=mirrored)

    known = np.concatenate([codes(train), codes(train, mirrored=True)]) if mirror else codes(train)
    columns = max(train.shapes.shape[1], test.shapes.shape[1])
    return np.isin(as_scalars(codes(test), columns), as_scalars(known, columns))


def layout_codes(
    stacks: StackArrays, world: World, *, positions: bool = False, mirrored: bool = False
) -> NDArray[np.int32]:
    """Write layouts as numbers (M, N): equal rows, equal layouts.

    Args:
        stacks: M of them.
        world: World of the stacks.
        positions: Whether to add the cell in which each block begins.
        mirrored: Whether to take the mirror images.
    """
    grid, real = world.grid, stacks.shapes != PADDING
    shapes = np.where(real, stacks.shapes, 0).astype(np.int32)
    x = -stacks.poses[..., 0] if mirrored else stacks.poses[..., 0]
    layers = np.clip(np.floor(stacks.poses[..., 2]), 0, grid.height - 1).astype(np.int32)
    codes = layers * 256 + shapes
    if positions:
        cells = np.array([cells_wide(shape) for shape in world.catalogue])
        left = np.round(x - cells[shapes] / 2 + grid.width / 2)
        codes = codes * 256 + np.clip(left, -128, 127).astype(np.int32) + 128
    order = np.lexsort((x, np.where(real, layers, grid.height)), axis=-1)
    return np.take_along_axis(np.where(real, codes, _EMPTY), order, axis=-1)


def share_in_common(seen: NDArray[np.bool_]) -> str:
    """Say how many of how many.

    >>> share_in_common(np.array([True, False, True, True]))
    '3 of 4 (75.0 %)'
    """
    return f"{int(seen.sum())} of {len(seen)} ({100 * seen.mean() if len(seen) else 0:.1f} %)"


def as_scalars(codes: NDArray[np.int32], columns: int) -> NDArray[np.void]:
    """Make one value of each row of :func:`layout_codes` (M,), padded to so many columns; to sort and compare."""
    padded = np.pad(codes, ((0, 0), (0, columns - codes.shape[1])), constant_values=_EMPTY)
    return np.ascontiguousarray(padded).view(np.dtype((np.void, padded.itemsize * columns))).ravel()
