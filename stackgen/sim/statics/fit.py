"""How the blocks of a stack lie to each other before anything moves: inside each other, in the ground, or in the air.

Convex bodies are apart if and only if a plane separates them whose normal is that of a face, or lies across an edge of
each (Gottschalk, Lin & Manocha 1996). The same planes say how far one can move down before it touches the other.

Legend: k blocks, A axes, V vertices. Lengths in cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import rotation_matrices
from stackgen.stack import Stack
from stackgen.world import Shape

Floats = NDArray[np.float64]

_LEDGE = 1e-3
"""Blocks that lie over each other by less than this do so for nobody [cell]."""


@dataclass(frozen=True)
class Fit:
    """How blocks lie to each other.

    Args:
        overlap: (k, k) least way that two blocks must be moved to be apart, 0 where they are; symmetric [cell].
        buried: (k,) how far a block reaches below the ground [cell].
        gap: (k,) how far it would fall before it touches the ground or another block [cell].
    """

    overlap: Floats
    buried: Floats
    gap: Floats

    @property
    def largest_overlap(self) -> float:
        """Largest overlap of two blocks, or of a block and the ground [cell]."""
        return float(max(self.overlap.max(initial=0.0), self.buried.max(initial=0.0)))

    @property
    def largest_gap(self) -> float:
        """Largest gap below a block [cell]."""
        return float(self.gap.max(initial=0.0)) + 0.0  # not -0.0


def overlaps_and_gaps(stack: Stack) -> Fit:
    """Measure how blocks lie to each other."""
    k = len(stack)
    turns = rotation_matrices(stack.poses[:, 3:])
    frames = [_frame(stack.catalogue[shape]) for shape in stack.shapes]
    parts = zip(frames, turns, stack.poses[:, :3], strict=True)
    bodies = [tuple(part @ turn.T + move for part, move in zip(f, (at, 0, 0), strict=True)) for f, turn, at in parts]
    lowest = np.array([vertices[:, 2].min() for vertices, *_ in bodies])
    overlap, gap = np.zeros((k, k)), np.maximum(lowest, 0.0)
    low, high = (np.array([edge(vertices, axis=0) for vertices, *_ in bodies]) for edge in (np.min, np.max))
    beside = np.any(low[:, None, :2] >= high[None, :, :2], axis=2)  # neither inside nor above each other
    above = low[:, None, 2] - high[None, :, 2]  # what lies further above something than it can fall needs no look
    pairs = [pair for pair in combinations(range(k), 2) if not (beside[pair] or beside.T[pair])]
    for i, j in sorted(pairs, key=lambda pair: max(above[pair], above.T[pair])):
        if 0 < above[i, j] >= gap[i] or 0 < above[j, i] >= gap[j]:
            continue
        depth, fall, rise = _between(bodies[i], bodies[j])
        overlap[i, j] = overlap[j, i] = depth
        gap[i], gap[j] = min(gap[i], fall), min(gap[j], rise)
    return Fit(overlap, np.maximum(-lowest, 0.0), gap)


CLEAN, IMPOSSIBLE = 0.01, 0.25
"""Overlaps and gaps up to which a stack is clean, as all that is delivered is; a larger one is named. And from where on
no such structure can be: samples lie up to 0.2 inside each other, and are pushed apart by the simulator [cell]."""


@dataclass(frozen=True)
class Misfit:
    """Something that no structure of real blocks has.

    Args:
        kind: What is wrong, in a word.
        depth: How far it is from what can be [cell].
        text: Description that names the blocks.
    """

    kind: Literal["overlaps", "buried", "floats"]
    depth: float
    text: str

    @property
    def impossible(self) -> bool:
        """Whether no structure can be like this, not even nearly."""
        return self.depth > IMPOSSIBLE


def describe_misfits(stack: Stack) -> list[Misfit]:
    """Name the blocks that are inside each other, in the ground or in the air."""
    fit, names = overlaps_and_gaps(stack), [f"block {i} ({name})" for i, name in enumerate(stack.names)]
    found = []
    for i, j in np.argwhere(np.triu(fit.overlap) > CLEAN).tolist():
        depth = float(fit.overlap[i, j])
        found.append(Misfit("overlaps", depth, f"{names[i]} and {names[j]} are {depth:.2f} cells inside each other"))
    for i in np.flatnonzero(fit.buried > CLEAN).tolist():
        depth = float(fit.buried[i])
        found.append(Misfit("buried", depth, f"{names[i]} is {depth:.2f} cells in the ground"))
    for i in np.flatnonzero(fit.gap > CLEAN).tolist():
        depth = float(fit.gap[i])
        found.append(Misfit("floats", depth, f"{names[i]} floats {depth:.2f} cells above what is below it"))
    return found


_Body = tuple[Floats, ...]
"""Vertices (V, 3), normals of faces and directions of edges (A, 3) of a block in the world."""


@lru_cache(maxsize=256)
def _frame(shape: Shape) -> _Body:
    """Give vertices, normals and edges of a prism in its own frame, each direction once."""
    outline = np.asarray(shape.outline, dtype=float)
    sides = np.insert(np.roll(outline, -1, axis=0) - outline, 1, 0.0, axis=1)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    across = np.array([[0.0, 1.0, 0.0]])
    return shape.vertices, np.concatenate([across, sides[:, [2, 1, 0]] * [-1, 1, 1]]), np.concatenate([across, sides])


def _between(one: _Body, other: _Body) -> tuple[float, float, float]:
    """Say how deep two blocks are in each other, and how far each is above the other (infinite if it is not)."""
    crossed = np.cross(one[2][:, None], other[2][None]).reshape(-1, 3)
    axes = np.concatenate([one[1], other[1], crossed])
    lengths = np.linalg.norm(axes, axis=1)
    axes = axes[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    a, b = one[0] @ axes.T, other[0] @ axes.T  # (V, A)
    before, after = a.max(0) - b.min(0), b.max(0) - a.min(0)  # (A,) ways to be apart along an axis, either way
    depth = float(np.minimum(before, after).min())
    return max(depth, 0.0), _fall(axes[:, 2], before, after), _fall(axes[:, 2], after, before)


def _fall(slope: Floats, before: Floats, after: Floats) -> float:
    """Compute how far the first body falls until it meets the second: from when on all axes overlap at once."""
    level = np.abs(slope) < 1e-9
    if (np.minimum(before, after)[level] <= _LEDGE).any():
        return np.inf
    # Along an axis the first body moves by -t * slope: `before` becomes smaller by that, `after` larger.
    ends = np.stack([before[~level], -after[~level]]) / slope[~level]
    enter, leave = ends.min(0).max(initial=-np.inf), ends.max(0).min(initial=np.inf)
    if leave - enter <= _LEDGE or leave < 0:
        return np.inf
    return float(max(enter, 0.0))
