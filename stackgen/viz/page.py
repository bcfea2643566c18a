"""One HTML page that shows stacks in 3-D."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.gltf import prism_mesh
from stackgen.viz.render import shape_colour
from stackgen.world import Shape

_VIEWER = Path(__file__).with_name("viewer.html")


def write_html(
    path: str | Path, stacks: Sequence[Stack], verdicts: Sequence[Verdict | None] | None = None, title: str = "Stacks"
) -> None:
    """Write one page that shows the stacks in 3-D: turn, zoom, choose a stack, let it settle.

    The page asks for nothing from outside and runs in any browser with WebGL.

    Args:
        path: File to write.
        stacks: Stacks to choose from, all of one catalogue.
        verdicts: Verdict on each stack, or None where there is none; it shows where the blocks ended and which fell.
        title: Title of the page.

    Raises:
        StackgenError: If it cannot be written.
    """
    write_atomically(path, html_page(stacks, verdicts, title).encode())


def html_page(stacks: Sequence[Stack], verdicts: Sequence[Verdict | None] | None = None, title: str = "Stacks") -> str:
    """Make the content of :func:`write_html`'s file."""
    known = verdicts or [None] * len(stacks)
    if not stacks or len(known) != len(stacks) or any(s.catalogue != stacks[0].catalogue for s in stacks):
        raise StackgenError("a page needs at least one stack, all of one catalogue, and as many verdicts as stacks")
    shapes = []
    for index, shape in enumerate(stacks[0].catalogue):
        points, normals, triangles = prism_mesh(shape)
        colour = [channel / 255 for channel in shape_colour(index)]
        shapes.append(
            {
                "name": shape.name,
                "colour": colour,
                "points": points.round(6).tolist(),
                "normals": normals.round(6).tolist(),
                "triangles": triangles.tolist(),
                "edges": _edges(shape),
            }
        )
    data = {
        "title": title,
        "shapes": shapes,
        "stacks": [_page_stack(*pair) for pair in zip(stacks, known, strict=True)],
    }
    safe = json.dumps(data, allow_nan=False).replace("<", "\\u003c")  # nothing in it can end the script
    return _VIEWER.read_text(encoding="utf-8").replace("/*DATA*/null", safe)


def _page_stack(stack: Stack, verdict: Verdict | None) -> dict[str, Any]:
    plain: dict[str, Any] = {"shapes": stack.shapes.tolist(), "sampled": _quaternion_poses(stack)}
    if verdict is not None:
        plain["stable"] = bool(verdict.stable)
        plain["fell"] = np.flatnonzero(verdict.fell).tolist()
        plain["drop"] = np.asarray(verdict.drop).round(3).tolist()
        plain["settled"] = _quaternion_poses(verdict.settled)
    return plain


def _quaternion_poses(stack: Stack) -> list[list[float]]:
    """List the blocks' poses as (k, 7): position [cell] and quaternion (x, y, z, w)."""
    quaternions = Rotation.from_rotvec(stack.poses[:, 3:]).as_quat()
    return np.concatenate([stack.poses[:, :3], quaternions], axis=1).round(6).tolist()


def _edges(shape: Shape) -> list[list[int]]:
    """List the prism's edges as pairs of indices into the points of :func:`prism_mesh`."""
    n = len(shape.outline)
    # The front face's corners come first in order, then the back face's in reverse.
    back = [2 * n - 1 - i for i in range(n)]
    ring = [[i, (i + 1) % n] for i in range(n)]
    return ring + [[back[i], back[j]] for i, j in ring] + [[i, back[i]] for i in range(n)]
