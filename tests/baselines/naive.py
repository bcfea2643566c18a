"""Brute force as the paper's words have it: one candidate after the other, each drawn as a picture.

For comparison with `stackgen.baselines.brute_force`, in tests and in the benchmark.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stackgen.baselines.brute_force import REACH, BruteForce
from stackgen.geometry import silhouette
from stackgen.stack import Stack, shapes_of
from stackgen.world import Mask


def naive_search(method: BruteForce, target: Mask, counts: NDArray[np.int64], rng: np.random.Generator) -> Stack:
    """The stack before the swap, by trying k x n candidates in a loop."""
    shapes = sorted(shapes_of(counts).tolist(), key=lambda s: -method.world.catalogue[s].volume)
    placed = Stack(np.zeros(0, dtype=np.int64), np.zeros((0, 6)), method.world.catalogue)
    for shape in shapes:
        pictures = [_picture(method, s, pose) for s, pose in zip(placed.shapes.tolist(), placed.poses, strict=True)]
        best_key, best_pose = None, None
        for x, level in zip(*method.candidates(rng), strict=True):
            pose = np.array([x, 0, level + 0.5, 0, 0, 0])
            picture = _picture(method, shape, pose)
            covered = np.count_nonzero(picture & target)
            collision = sum(np.count_nonzero(picture & other) for other in pictures)
            free = target.copy()
            for other in pictures:
                free &= ~other
            key = (-(covered - method.penalty * collision), _free_beside(picture, free), -level, x)
            if best_key is None or key < best_key:
                best_key, best_pose = key, pose
        assert best_pose is not None
        placed = Stack(np.append(placed.shapes, shape), np.vstack([placed.poses, best_pose]), method.world.catalogue)
    return placed


def _picture(method: BruteForce, shape: int, pose: NDArray[np.float64]) -> Mask:
    return silhouette(Stack(np.array([shape]), pose[None], method.world.catalogue), method.world.grid)


def _free_beside(picture: Mask, free: Mask) -> int:
    """Free pixels of the silhouette up to REACH to the left and right of the block, row by row."""
    number = 0
    for row, line in zip(picture, free, strict=True):
        columns = np.flatnonzero(row)
        if len(columns):
            first, last = columns[0], columns[-1]
            number += int(np.count_nonzero(line[max(first - REACH, 0) : first]))
            number += int(np.count_nonzero(line[last + 1 : last + 1 + REACH]))
    return number
