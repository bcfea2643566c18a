"""Where each block waits, which way up, and where the jaws take it. Lengths in metres unless marked [cell]."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stackgen.errors import StackgenError
from stackgen.geometry import block_vertices, row_intervals
from stackgen.robot.workcell import Workcell, pose
from stackgen.stack import Stack
from stackgen.world import Shape

Floats = NDArray[np.float64]

LEAN = math.radians(20)
"""A block that leans further than this from the nearest of its faces cannot be set down [rad]."""

TIP_UP = np.diag([-1.0, 1.0, -1.0, 1.0])
"""(4, 4) the tool pointing down, its closing axis along the block's depth."""

_SWEEP = 0.005  # height of the finger tips over the table while they push a block [m]


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """A block in its slot.

    Args:
        frame: (4, 4) frame of the block in the table frame.
        grasp: (4, 4) frame of the finger tips when they hold it there.
        ends: x of its left and right end in the slot's frame at the height at which fingers push it.
        sweep: (4, 4) frame of the slot with the tool pointing down, at the height of the finger tips that push.
        top: Height of the block.
    """

    frame: Floats
    grasp: Floats
    ends: tuple[float, float]
    sweep: Floats
    top: float


def lay_out(stack: Stack, order: tuple[int, ...], workcell: Workcell, cell_size: float) -> dict[int, Waiting]:
    """Give each block a slot, in the order in which they are fetched.

    Raises:
        StackgenError: If a block does not fit between the jaws or into a slot, there are too few slots, or a
            block leans so far that it cannot be set down.
    """
    slots = workcell.staging.slots
    if len(order) > len(slots):
        raise StackgenError(
            f"the staging area is too small: {len(order)} blocks, but {len(slots)} slots; add to cell.staging.slots"
        )
    return {
        block: wait(stack, block, slot=slot, workcell=workcell, cell_size=cell_size)
        for block, slot in zip(order, slots[: len(order)], strict=True)
    }


def wait(
    stack: Stack, block: int, *, slot: tuple[float, float, float], workcell: Workcell, cell_size: float
) -> Waiting:
    """Lay a block into a slot, on the face that is to be its lowest."""
    shape = stack.catalogue[int(stack.shapes[block])]
    jaws, staging = workcell.jaws, workcell.staging
    who = f"block {block} ({shape.name})"
    need = shape.depth * cell_size + 2 * jaws.clearance
    if need > jaws.opening + 1e-9:
        raise StackgenError(
            f"{who} is wider than the jaws: {shape.depth * cell_size * 1e3:.0f} mm and {jaws.clearance * 1e3:.0f} mm on"
            f" either side, but they open {jaws.opening * 1e3:.0f} mm (cell.jaws.opening)"
        )
    turn = resting_turn(shape, stack.poses[block, 3:])
    if turn is None:
        raise StackgenError(
            f"{who} leans more than {math.degrees(LEAN):.0f} degrees from any of its faces: jaws that come from above"
            " cannot set it down"
        )
    corners = shape.vertices @ turn.as_matrix().T * cell_size
    low, high = corners.min(axis=0), corners.max(axis=0)
    beside = 2 * (jaws.pad_width + _START) if staging.straighten else 0.0
    if high[0] - low[0] + beside > staging.length + 1e-9 or jaws.opening + 2 * jaws.pad_thickness > staging.depth:
        raise StackgenError(
            f"the staging area is too small: {who} and the fingers beside it need"
            f" {(high[0] - low[0] + beside) * 1e3:.0f} x {(jaws.opening + 2 * jaws.pad_thickness) * 1e3:.0f} mm, a slot"
            f" has {staging.length * 1e3:.0f} x {staging.depth * 1e3:.0f} mm (cell.staging)"
        )
    slot_frame = pose((slot[0], slot[1], 0.0), slot[2])
    in_slot = np.eye(4)
    in_slot[:3, :3] = turn.as_matrix()
    in_slot[:3, 3] = [-(low[0] + high[0]) / 2, 0.0, -low[2]]
    height = float(high[2] - low[2])
    tip = np.array([0.0, 0.0, jaws.tips_above(height)])
    tip[0] = (in_slot[:3, :3] @ (shape.center_of_mass * cell_size))[0] + in_slot[0, 3]
    sweep = max(_SWEEP, height + _SWEEP - jaws.pad_length)
    return Waiting(
        frame=slot_frame @ in_slot,
        grasp=slot_frame @ pose(tip) @ TIP_UP,
        ends=_ends((corners + in_slot[:3, 3])[:, [0, 2]], sweep),
        sweep=slot_frame @ pose((0.0, 0.0, sweep)) @ TIP_UP,
        top=height,
    )


_START = 0.012  # a pushing finger goes down this far beside where the block should end [m]


def push_path(waiting: Waiting, side: int, workcell: Workcell) -> tuple[Floats, Floats, Floats]:
    """Finger tips (4, 4) beside a block, where pushing ends, and backed off.

    Args:
        waiting: The block in its slot.
        side: 1 for its right end, -1 for its left.
        workcell: Workcell with the jaws.
    """
    end = waiting.ends[1] if side > 0 else waiting.ends[0]
    stop = end + side * workcell.jaws.pad_width / 2
    return tuple(_shifted(waiting.sweep, stop + side * away) for away in (_START, 0.0, 0.006))  # type: ignore[return-value]


def _shifted(frame: Floats, x: float) -> Floats:
    """Move a tool frame along its slot: the tool's own x axis points backwards."""
    return frame @ pose((-x, 0.0, 0.0))


def resting_turn(shape: Shape, rotation_vector: Floats) -> Rotation | None:
    """Find the turn about the block's depth that puts its lowest face down; None if it leans too far.

    >>> from stackgen.world import PAPER_CATALOGUE
    >>> import numpy as np
    >>> round(float(resting_turn(PAPER_CATALOGUE[1], np.array([0, 1.5, 0])).magnitude()), 4)
    1.5708
    """
    up = Rotation.from_rotvec(rotation_vector).as_matrix().T[:, 2]  # in the block's frame
    corners = np.asarray(shape.outline)
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]  # outwards
    best = normals[int(np.argmax(-normals @ up[[0, 2]]))]
    if -best @ up[[0, 2]] < math.cos(LEAN):
        return None
    return Rotation.from_rotvec([0, math.atan2(best[0], -best[1]), 0])


def _ends(points: Floats, height: float) -> tuple[float, float]:
    """Left and right end of a convex outline (V, 2) above some height."""
    left, right = row_intervals(points, np.array([height]))
    above = points[points[:, 1] >= height, 0]
    ends = np.concatenate([above, left[np.isfinite(left)], right[np.isfinite(right)]])
    return float(ends.min()), float(ends.max())


def make_room(stack: Stack, gap: float) -> Stack:
    """Move blocks side by side apart along x, as little as gives them a gap [cell].

    Blocks that touch could not be set down one beside the other: the arm is not exact.

    >>> poses = [[-0.5, 0, 0.5, 0, 0, 0], [0.5, 0, 0.5, 0, 0, 0]]
    >>> make_room(Stack([0, 0], poses), 0.1).poses[:, 0].round(3).tolist()
    [-0.55, 0.55]
    """
    corners = block_vertices(stack)
    low, high = np.array([c.min(axis=0) for c in corners]), np.array([c.max(axis=0) for c in corners])
    overlap = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])  # (k, k, 3)
    beside = (overlap[..., 1] > 0.05) & (overlap[..., 2] > 0.05) & (overlap[..., 0] < 0.3)
    middles = (low[:, 0] + high[:, 0]) / 2
    pairs = [(i, j) for i, j in zip(*np.nonzero(beside), strict=True) if middles[i] < middles[j]]
    shift = np.zeros(len(stack))
    for _ in range(200):  # moved apart one pair after the other until nothing is left to move
        lacking = [(gap - (low[j, 0] + shift[j] - high[i, 0] - shift[i]), i, j) for i, j in pairs]
        if not any(missing > 1e-9 for missing, _, _ in lacking):
            break
        for missing, i, j in lacking:
            if missing > 0:
                shift[i] -= missing / 2
                shift[j] += missing / 2
    poses = stack.poses.copy()
    poses[:, 0] += shift
    return stack.with_poses(poses)
