"""Stacks as plain data for all that draws them in 3-D: the page of `stackgen show`, notebooks and the studio.

Lengths in cells, z up; a pose is a position and a unit quaternion (x, y, z, w).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import quaternions
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.gltf import prism_mesh
from stackgen.viz.render import shape_colour
from stackgen.world import Catalogue, Shape


def scene(stacks: Sequence[Stack], verdicts: Sequence[Verdict | None]) -> dict[str, Any]:
    """Describe stacks of one catalogue, at least one, and the verdicts on them.

    Returns:
        `shapes`: name, colour (red, green, blue: 0..1), points, normals, triangles and edges of each shape; `stacks`:
        the number of each block's shape, the poses as `sampled`, and where there is a verdict whether it is `stable`,
        which blocks `fell`, how far they `drop` [cell] and the poses as `settled`.
    """
    pairs = zip(stacks, verdicts, strict=True)
    return {"shapes": shape_meshes(stacks[0].catalogue), "stacks": [_stack(*pair) for pair in pairs]}


def shape_meshes(catalogue: Catalogue) -> list[dict[str, Any]]:
    """Describe the shapes of a catalogue, as :func:`scene` does."""
    shapes = []
    for index, shape in enumerate(catalogue):
        points, normals, triangles = prism_mesh(shape)
        shapes.append(
            {
                "name": shape.name,
                "colour": [channel / 255 for channel in shape_colour(index)],
                "points": points.round(6).tolist(),
                "normals": normals.round(6).tolist(),
                "triangles": triangles.tolist(),
                "edges": _edges(shape),
            }
        )
    return shapes


def quaternion_poses(poses: NDArray[np.float64], digits: int = 6) -> list[Any]:
    """List poses (..., 6) with rotation vectors as positions [cell] and quaternions (..., 7)."""
    turned = quaternions(poses[..., 3:])
    return np.concatenate([poses[..., :3], turned], axis=-1).round(digits).tolist()


def _stack(stack: Stack, verdict: Verdict | None) -> dict[str, Any]:
    plain: dict[str, Any] = {"shapes": stack.shapes.tolist(), "sampled": quaternion_poses(stack.poses)}
    if verdict is not None:
        plain["stable"] = bool(verdict.stable)
        plain["fell"] = np.flatnonzero(verdict.fell).tolist()
        plain["drop"] = np.asarray(verdict.drop).round(3).tolist()
        plain["settled"] = quaternion_poses(verdict.settled.poses)
    return plain


def _edges(shape: Shape) -> list[list[int]]:
    """List the prism's edges as pairs of indices into the points of :func:`prism_mesh`."""
    n = len(shape.outline)
    # The front face's corners come first in order, then the back face's in reverse.
    back = [2 * n - 1 - i for i in range(n)]
    ring = [[i, (i + 1) % n] for i in range(n)]
    return ring + [[back[i], back[j]] for i, j in ring] + [[i, back[i]] for i in range(n)]
