"""Samples that cannot be, mended: blocks that lie in others go to where the drawing is still empty.

A network that is unsure how many blocks a row has may put two of them into one place, and leave another empty. Geometry
alone tells so, and says where to; how the stack then fits together is denoised anew (see `PoseDiffusion.sample`). No
statics and no simulator is asked.

Legend: B stacks, N blocks at most, S shapes, H x W pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stackgen.geometry import silhouette
from stackgen.models.poses import raster_order
from stackgen.sim.statics.fit import overlaps_and_gaps
from stackgen.stack import Stack
from stackgen.world import Grid, Mask, World

CONFLICT = 0.15
"""Overlap above which one of two blocks is moved [cell]. Lesser ones the simulator pushes apart; this is below
`stackgen.sim.statics.fit.IMPOSSIBLE`, from where on no structure can be: two of three samples above this fall."""
_TOUCH, _STRENGTH, _ROUNDS = 0.05, 0.3, 3


def misplaced(stack: Stack) -> list[int]:
    """Say which blocks to take out so that no two are in conflict: of the deepest pair the smaller one, and so on.

    >>> from stackgen.world import PAPER_CATALOGUE
    >>> poses = [[0, 0, 0.5, 0, 0, 0], [0.3, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]
    >>> misplaced(Stack([1, 0, 0], poses, PAPER_CATALOGUE))
    [1]
    """
    overlap = overlaps_and_gaps(stack).overlap
    area = [stack.catalogue[shape].area for shape in stack.shapes]
    out: list[int] = []
    while overlap.max(initial=0.0) > CONFLICT:
        pair = np.unravel_index(overlap.argmax(), overlap.shape)
        worse = min((int(i) for i in pair), key=lambda i: (area[i], -i))
        overlap[worse] = overlap[:, worse] = 0.0
        out.append(worse)
    return sorted(out)


def relocated(stack: Stack, drawing: Mask, grid: Grid) -> Stack | None:
    """Put blocks that lie in others, largest first, to where they fill most of what is empty in the drawing.

    Args:
        stack: Stack as it was sampled.
        drawing: (H, W) silhouette that it is to have.
        grid: Scale of the drawing.

    Returns:
        The stack with these blocks upright in their new places; None if no block lies in another.
    """
    out = misplaced(stack)
    if not out:
        return None
    poses, shapes = stack.poses.copy(), stack.shapes
    area = [stack.catalogue[shape].area for shape in shapes]
    kept = [i for i in range(len(stack)) if i not in out]
    filled = silhouette(Stack(shapes[kept], poses[kept], stack.catalogue), grid)
    for i in sorted(out, key=lambda i: -area[i]):
        poses[i], at = _emptiest(Stack(shapes[[i]], poses[[i]], stack.catalogue), drawing & ~filled, grid)
        filled = filled | at
    return stack.with_poses(poses)


def _emptiest(block: Stack, empty: Mask, grid: Grid) -> tuple[np.ndarray, Mask]:
    """Find the pose (6,) of a block that fills most of what is empty (H, W), the lowest of equals; and its picture."""
    import cv2

    level = np.array([0, 0, block.catalogue[int(block.shapes[0])].size[2] / 2, 0, 0, 0])
    picture = silhouette(block.with_poses([level]), grid)
    (rows, columns) = (np.flatnonzero(picture.any(axis=axis)) for axis in (1, 0))
    shape = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    worth = np.where(empty, 1, -1).astype(np.float32)
    gain = cv2.filter2D(worth, cv2.CV_32F, shape.astype(np.float32), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    gain = gain[rows[0] :: -1, : gain.shape[1] - shape.shape[1] + 1]  # from the ground up
    up, left = np.unravel_index(np.rint(gain).argmax(), gain.shape)
    right = left - columns[0]
    pose = level + np.array([right, 0, up, 0, 0, 0]) / grid.pixels_per_cell
    return pose, np.roll(picture, (-int(up), int(right)), axis=(0, 1))


def mended(poses: Tensor, shapes: Tensor, mask: Tensor, silhouettes: Tensor, world: World) -> tuple[list[int], Tensor]:
    """Find the samples whose blocks lie in each other, with poses in which these have moved.

    Args:
        poses: (B, N, 6) [cell, rad].
        shapes: (B, N) indices, negative at padding.
        mask: (B, N) True at blocks.
        silhouettes: (B, H, W) in {0, 1}.
        world: Shapes, and scale of the silhouettes.

    Returns:
        Their rows, and new poses (rows, N, 6) with equal blocks from the bottom up and left to right.
    """
    rows, moved = [], poses.double().cpu()
    for row, (kinds, real) in enumerate(zip(shapes.cpu().numpy(), mask.cpu().numpy(), strict=True)):
        stack = Stack(kinds[real], moved[row].numpy()[real], world.catalogue)
        better = relocated(stack, silhouettes[row].cpu().numpy() > 0, world.grid)
        if better is not None:
            moved[row, torch.from_numpy(real)] = torch.from_numpy(better.poses)
            rows.append(row)
    if not rows:
        return rows, poses[:0]
    found, kind = moved[rows].to(poses), torch.where(mask, shapes, -1)[rows]
    order = raster_order(found, kind)
    slots = torch.where(kind < 0, kind.max() + 1, kind).argsort(dim=-1, stable=True)
    wide = (-1, -1, found.shape[-1])
    return rows, found.scatter(1, slots[..., None].expand(wide), found.gather(1, order[..., None].expand(wide)))


def pushed_apart(poses: Tensor, shapes: Tensor, mask: Tensor, sizes: Tensor) -> Tensor:
    """Push blocks whose upright boxes overlap a part of the way apart, along the shorter way across or up.

    Args:
        poses: (B, N, 6) [cell, rad].
        shapes: (B, N) indices; any at padding.
        mask: (B, N) True at blocks.
        sizes: (S, 2) width and height of the shapes [cell].
    """
    places, size = poses[..., [0, 2]], sizes[shapes.clamp(min=0)]
    reach = (size[:, :, None] + size[:, None, :]) / 2
    pairs = mask[:, :, None] & mask[:, None, :] & ~torch.eye(mask.shape[1], dtype=torch.bool, device=mask.device)
    number = torch.arange(mask.shape[1], device=mask.device)
    after = torch.where(number[:, None] > number, 1.0, -1.0)[..., None]  # who gives way to whom in the very same place
    for _ in range(_ROUNDS):
        way = places[:, :, None] - places[:, None, :]
        depth = reach - way.abs()
        hit = pairs & (depth > _TOUCH).all(-1)
        across = depth[..., 0] <= depth[..., 1]
        push = depth * torch.where(way == 0, after, way.sign()) * torch.stack([across, ~across], -1) * hit[..., None]
        places = places + _STRENGTH / 2 * push.sum(2)
    return torch.cat([places[..., :1], poses[..., 1:2], places[..., 1:], poses[..., 3:]], -1)
