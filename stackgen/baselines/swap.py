"""The swap, which makes the heuristics vary (paper, "Greedy-Random Baseline").

Legend: k blocks.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from stackgen.stack import Stack

GAP = 0.5
"""How far apart two blocks of a layer may be and still be next to each other [cell]."""


def swap(stack: Stack, sigma: float, rng: np.random.Generator) -> Stack:
    """With probability sigma, let two neighbouring cubes of a layer change places with a rectangle elsewhere.

    One such change, drawn uniformly from all that are possible; the stack as it is if none is. The
    rectangle's middle goes to the middle of the pair, the cubes side by side to where the rectangle was.
    Any box and any box twice its width count as cube and rectangle.
    """
    if rng.random() >= sigma:
        return stack
    found = swaps(stack)
    return exchange(stack, *found[rng.integers(len(found))]) if found else stack


def swaps(stack: Stack) -> list[tuple[int, int, int]]:
    """List all (left cube, right cube, rectangle) that can change places."""
    widths = np.array([shape.size[0] if shape.is_box else np.nan for shape in stack.catalogue])[stack.shapes]
    x, z = stack.poses[:, 0], stack.poses[:, 2]
    pairs = [
        (i, j)
        for i, j in permutations(range(len(stack)), 2)
        if stack.shapes[i] == stack.shapes[j] and abs(z[i] - z[j]) < 0.5 and 0 < x[j] - x[i] <= widths[i] + GAP
    ]
    return [(i, j, r) for i, j in pairs for r in np.flatnonzero(np.isclose(widths, 2 * widths[i])).tolist()]


def exchange(stack: Stack, left: int, right: int, rectangle: int) -> Stack:
    """Exchange the places of two cubes and a rectangle."""
    poses: NDArray[np.float64] = stack.poses.copy()
    poses[rectangle] = (stack.poses[left] + stack.poses[right]) / 2
    poses[[left, right]] = stack.poses[rectangle]
    poses[[left, right], 0] += np.array([-0.5, 0.5]) * stack.catalogue[int(stack.shapes[left])].size[0]
    return stack.with_poses(poses)
