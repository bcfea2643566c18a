"""Shapes, block lists, stacks: the nouns everything else speaks in.

Units: cells (the edge of a cube) for lengths, radians for rotation vectors.
World frame: x to the right as the camera sees it, y away from the camera, z up, ground at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stackgen.errors import StackgenError
from stackgen.world import PAPER_CATALOGUE, Catalogue, Grid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Stack:
    """Blocks with poses.

    Args:
        shapes: (k,) indices into the catalogue.
        poses: (k, 6) position [cell] and rotation vector [rad] of each block frame in the world.
        catalogue: What the indices mean.

    Raises:
        StackgenError: If the arrays do not fit each other or hold a value that is not finite.
    """

    shapes: NDArray[np.int64]
    poses: Floats
    catalogue: Catalogue = PAPER_CATALOGUE

    def __post_init__(self) -> None:
        shapes = np.asarray(self.shapes, dtype=np.int64)
        poses = np.asarray(self.poses, dtype=np.float64)
        if shapes.ndim != 1 or poses.shape != (len(shapes), 6):
            raise StackgenError(f"a stack is shapes (k,) and poses (k, 6), got {shapes.shape} and {poses.shape}")
        if len(shapes) and not (0 <= shapes.min() and shapes.max() < len(self.catalogue)):
            raise StackgenError(f"shape indices must lie in 0..{len(self.catalogue) - 1}")
        if not np.isfinite(poses).all():
            raise StackgenError("poses must be finite numbers")
        object.__setattr__(self, "shapes", shapes)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def names(self) -> list[str]:
        """Shape name of each block."""
        return [self.catalogue.names[s] for s in self.shapes]

    @property
    def counts(self) -> NDArray[np.int64]:
        """(S,) block list of the stack: how many of each shape."""
        return np.bincount(self.shapes, minlength=len(self.catalogue))

    def _repr_html_(self) -> str:
        """Show the stack in a notebook, as a view that turns."""
        from stackgen.viz.page import notebook_html

        return notebook_html([self])

    def with_poses(self, poses: ArrayLike) -> Stack:
        """The same blocks at other poses."""
        return Stack(self.shapes, np.asarray(poses, dtype=np.float64), self.catalogue)


def parse_block_list(text: str, catalogue: Catalogue, max_blocks: int) -> NDArray[np.int64]:
    """Counts (S,) from `"cube=3,rectangle=2"`.

    Raises:
        StackgenError: On an unknown shape, a count that is not a whole number of at least 0,
            an empty list, or more than `max_blocks` blocks.

    >>> parse_block_list("cube=3, triangle=1", PAPER_CATALOGUE, 10).tolist()
    [3, 0, 0, 1]
    """
    counts = np.zeros(len(catalogue), dtype=np.int64)
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, number = (p.strip() for p in part.partition("="))
        index = catalogue.index(name)
        if not equals or not number.isascii() or not number.isdigit() or len(number) > 9:
            raise StackgenError(f"block list: {part!r} should read {name}=COUNT, a whole number from 0 to {max_blocks}")
        counts[index] += int(number)
    check_block_list(counts, max_blocks)
    return counts


def check_block_list(counts: ArrayLike, max_blocks: int) -> None:
    """Raise StackgenError unless the counts (S,) are those of 1..max_blocks blocks."""
    array = np.asarray(counts)
    if (array < 0).any():
        raise StackgenError(f"block list: counts must be at least 0, got {array.tolist()}")
    if not 1 <= array.sum() <= max_blocks:
        raise StackgenError(f"block list: {int(array.sum())} blocks, but 1 to {max_blocks} are possible")


def format_block_list(counts: ArrayLike, catalogue: Catalogue) -> str:
    """Inverse of :func:`parse_block_list`; shapes with count 0 are left out.

    >>> format_block_list([3, 0, 0, 1], PAPER_CATALOGUE)
    'cube=3,triangle=1'
    """
    return ",".join(f"{name}={int(n)}" for name, n in zip(catalogue.names, np.asarray(counts), strict=True) if n)


def shapes_of(counts: ArrayLike) -> NDArray[np.int64]:
    """(k,) shape indices of a block list (S,), in catalogue order.

    >>> shapes_of([2, 0, 1]).tolist()
    [0, 0, 2]
    """
    array = np.asarray(counts, dtype=np.int64)
    return np.repeat(np.arange(len(array)), array)


Layout = tuple[tuple[int, ...], ...]


def layout(stack: Stack, grid: Grid) -> Layout:
    """List the shapes of each layer, bottom layer first, left to right; a block is in the layer nearest to its centre.

    >>> stack = Stack([0, 1, 0], [[1, 0, 0.5, 0, 0, 0], [0, 0, 1.6, 0, 0, 0], [-1, 0, 0.4, 0, 0, 0]])
    >>> layout(stack, Grid())
    ((0, 0), (1,), (), ())
    """
    layers = np.clip(np.floor(stack.poses[:, 2]), 0, grid.height - 1).astype(int)
    order = np.argsort(stack.poses[:, 0], kind="stable")
    return tuple(tuple(int(stack.shapes[i]) for i in order if layers[i] == level) for level in range(grid.height))
