"""The linear programs of rigid-block statics with friction.

Each block needs forces that cancel its weight, and torques about its centre of mass that cancel each
other: six equations. The unknowns are the force and the torque that each patch of contact transmits:
they push, act inside the patch, and stay in the friction cone. Whether such forces exist is a question
for a linear program, and HiGHS answers it.

The margin asks it for tilted ground. The horizontal pulls (x, y), as shares of the weight, that a stack
survives form a convex polygon. Its point furthest in a direction is one more linear program, so the
polygon grows from inside until the side nearest to the origin is known: the worst of all directions
(Bretl and Lall, "Testing Static Equilibrium for Legged Robots", IEEE Transactions on Robotics 2008).

Legend: k blocks, c patches. Lengths in cells, forces in weights of one cubic cell: so neither density
nor gravity nor scale matters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stackgen.geometry import centers_of_mass
from stackgen.sim.statics.contacts import GROUND, Contact, Point
from stackgen.sim.statics.linear import has_solution, linear_program
from stackgen.stack import Stack

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ints = NDArray[np.int64]

CONE_SIDES = 4
"""Sides of the pyramid around the friction cone, along and across an edge of the face. It touches the cone
from outside: a block slides at the angle of friction down its worst slope, later down one at the diagonal."""

_EPSILON = 1e-6
"""Numbers below this are rounding."""


class Statics:
    """The linear programs of one stack.

    The unknowns z are what each patch transmits, force and torque about its centre along its own axes:
    six numbers, and three where there is no friction. Equations: `transmit @ z` is what the 6 k forces
    and torques of the blocks need. Inequalities: `allowed @ z >= 0`.
    """

    def __init__(self, stack: Stack, contacts: tuple[Contact, ...], friction: float) -> None:
        self.k = len(stack)
        self.weights = np.array([stack.catalogue[s].volume for s in stack.shapes])
        self.needed = np.zeros(6 * self.k)
        self.needed[2::6] = self.weights
        centers = centers_of_mass(stack)
        patches = _Patches.of(contacts)
        rough = ~np.array([contact.upright for contact in contacts], dtype=bool)
        kept = np.where(rough[:, None], True, _SMOOTH).ravel()  # which of six unknowns a patch has
        self.transmit = _effects(patches, centers)[:, kept]
        self.allowed = np.concatenate([_in_patch(patches), _in_cone(patches, friction, rough)])[:, kept]
        self.bears = np.repeat(_tree(contacts, self.k), 6)[kept]

    def limit(self, pulled: Ints) -> tuple[float, Floats] | None:
        """Find how hard some blocks may be pulled together in the worst horizontal direction.

        The equations are solved beforehand: a tree of patches that joins every block to the ground
        carries what the other patches and the pull leave over. What remains is a program in few unknowns
        x, the pull and the forces of those other patches; HiGHS gets its dual, with as few rows, in
        which a new direction is only a new right-hand side.

        Returns:
            The pull as a share of their weight, and for `moving` what gives way there; None if no
            forces hold the stack as it is.
        """
        bears = self.bears
        if np.count_nonzero(bears) < 6 * self.k:
            return None  # something hangs in the air
        pull = np.zeros((6 * self.k, 2))
        pull[6 * pulled, 0] = pull[6 * pulled + 1, 1] = self.weights[pulled]
        trunk = self.transmit[:, bears]
        forces = np.zeros((len(bears), 3 + np.count_nonzero(~bears)))  # z as a function of (1, x)
        forces[bears] = np.linalg.solve(trunk, np.column_stack([self.needed, -pull, -self.transmit[:, ~bears]]))
        forces[~bears, 3:] = np.eye(int(np.count_nonzero(~bears)))
        spare = self.allowed @ forces
        solver = linear_program(spare[:, 1:].T, cost=spare[:, 0], rhs=np.zeros(spare.shape[1] - 1))

        def furthest(direction: Floats) -> tuple[Floats, Floats]:
            for row, value in enumerate((-direction).tolist()):
                solver.changeRowBounds(row, value, value)
            if not has_solution(solver):
                raise _NothingHoldsIt
            found = solver.getSolution()
            return -np.array(found.row_dual[:2]), np.array(found.col_value)

        try:
            limit, given_way = inradius(furthest)
        except _NothingHoldsIt:
            return None
        return None if limit < -_EPSILON else (max(limit, 0.0), given_way)  # rounding must not fell a knife-edge

    def moving(self, given_way: Floats) -> Flags:
        """Tell which blocks (k,) take part in the motion in which a pull at its limit parts the patches."""
        parting = given_way @ self.allowed
        return _moves(np.linalg.solve(self.transmit[:, self.bears].T, parting[self.bears]))

    def missing(self) -> tuple[float, Flags]:
        """Find the least sum of missing forces and torques, and which blocks (k,) move for want of them.

        The dual solution is a motion of the blocks, bounded in each coordinate, along which no contact
        resists and the weights do the most work: the blocks that it moves are those that cannot be held.
        """
        rows, columns = self.transmit.shape
        limits = len(self.allowed)
        matrix = np.zeros((rows + limits, columns + 2 * rows))
        matrix[:rows] = np.concatenate([self.transmit, np.eye(rows), -np.eye(rows)], axis=1)
        matrix[rows:, :columns] = self.allowed
        cost = np.r_[np.zeros(columns), np.ones(2 * rows)]
        solver = linear_program(matrix, cost, np.r_[self.needed, np.zeros(limits)], free=columns, inequalities=limits)
        if not has_solution(solver, certain=True):
            raise ArithmeticError("HiGHS found no solution where one is certain")
        return float(solver.getInfo().objective_function_value), _moves(np.array(solver.getSolution().row_dual[:rows]))


class _NothingHoldsIt(Exception):
    """No contact forces solve the equations, whatever the pull."""


def _moves(motion: Floats) -> Flags:
    """Tell which blocks (k,) a motion (6 k,) moves."""
    return np.abs(motion).reshape(-1, 6).max(axis=1) > _EPSILON


def _tree(contacts: tuple[Contact, ...], k: int) -> list[bool]:
    """Choose contacts with friction that join the blocks to the ground: one for each block that is joined at all."""
    joined: set[int] = {GROUND}
    tree = [False] * len(contacts)
    rough = [(number, contact) for number, contact in enumerate(contacts) if not contact.upright]
    before = 0
    while before < len(joined) <= k:
        before = len(joined)
        for number, contact in rough:
            if (contact.block in joined) != (contact.by in joined):
                joined |= {contact.block, contact.by}
                tree[number] = True
    return tree


@dataclass(frozen=True)
class _Patches:
    """Contacts as arrays. The unknowns of a patch are its force and its torque about its centre, along its
    normal, its tangent and across."""

    block: Ints  # (c,)
    by: Ints  # (c,)
    center: Floats  # (c, 3)
    axes: Floats  # (c, 3, 3) normal, tangent, across, in the world
    corners: list[list[Point]]  # about the centre, along the tangent and across

    @staticmethod
    def of(contacts: tuple[Contact, ...]) -> _Patches:
        """Collect contacts."""
        normal = np.array([contact.normal for contact in contacts]).reshape(-1, 3)
        tangent = np.array([contact.tangent for contact in contacts]).reshape(-1, 3)
        axes = np.stack([normal, tangent, np.cross(normal, tangent)], axis=1)
        center = np.array([contact.center for contact in contacts]).reshape(-1, 3)
        corners = [
            ((contact.points - middle) @ own[1:].T).tolist()
            for contact, middle, own in zip(contacts, center, axes, strict=True)
        ]
        block, by = (np.array([getattr(c, name) for c in contacts], dtype=int) for name in ("block", "by"))
        return _Patches(block, by, center, axes, corners)


def _effects(patches: _Patches, centers: Floats) -> Floats:
    """Return the force on each block and the torque about its centre of mass by each unknown, (6 k, 6 c)."""
    k, c = len(centers), len(patches.block)
    effects = np.zeros((c, k, 2, 3, 2, 3))
    for sign, block in ((1.0, patches.block), (-1.0, patches.by)):
        there = np.flatnonzero(block != GROUND)
        axes, arms = patches.axes[there], patches.center[there] - centers[block[there]]
        own = np.zeros((len(there), 2, 3, 2, 3))
        own[:, 0, :, 0] = own[:, 1, :, 1] = axes.transpose(0, 2, 1)
        own[:, 1, :, 0] = np.cross(arms[:, None], axes).transpose(0, 2, 1)
        effects[there, block[there]] = sign * own
    return effects.reshape(c, 6 * k, 6).transpose(1, 0, 2).reshape(6 * k, 6 * c)


def _in_patch(patches: _Patches) -> Floats:
    """Return rows (r, 6 c) that are not negative where each normal force pushes, and acts inside its patch.

    That is the same as forces at the corners that push.
    """
    sides = [(i, *side) for i, corners in enumerate(patches.corners) for side in _half_planes(corners)]
    c = len(patches.corners)
    rows = np.zeros((len(sides) + c, c, 6))
    if sides:
        which, u, v, offset = np.array(sides).T
        number, patch = np.arange(len(sides)), which.astype(int)
        rows[number, patch, 0] = -offset
        rows[number, patch, 4] = v  # a normal force f at (u, v) has the torque (v f, -u f)
        rows[number, patch, 5] = -u
    rows[len(sides) + np.arange(c), np.arange(c), 0] = 1
    return rows.reshape(len(sides) + c, 6 * c)


def _in_cone(patches: _Patches, friction: float, rough: Flags) -> Floats:
    """Return rows (r, 6 c) that are not negative where friction holds, for the patches that have any.

    Friction is at most its share of the normal force in each of `CONE_SIDES` directions; its torque about
    the normal is at most that of all of it at the furthest corner.
    """
    c, which = len(rough), np.flatnonzero(rough)
    rows = np.zeros((len(which), CONE_SIDES + 2, c, 6))
    own = np.zeros((len(which), CONE_SIDES + 2, 6))
    angles = 2 * np.pi / CONE_SIDES * np.arange(CONE_SIDES)
    own[:, :, 0] = friction
    own[:, :-2, 1], own[:, :-2, 2] = np.cos(angles), np.sin(angles)
    own[:, -2:, 0] *= np.array([max(math.hypot(u, v) for u, v in patches.corners[i]) for i in which])[:, None]
    own[:, -2:, 3] = 1, -1
    rows[np.arange(len(which)), :, which] = own
    return rows.reshape(len(which) * (CONE_SIDES + 2), 6 * c)


_SMOOTH = np.array([True, False, False, False, True, True])
"""Which of the six unknowns patches at upright faces have: those without friction.

Two neighbours could hold a block between them by squeezing it, and statics would find that force; but
nothing ever squeezed them, so the block falls.
"""


def _half_planes(corners: list[Point]) -> list[tuple[float, float, float]]:
    """Return (u, v, offset) with u x + v y >= offset in a convex counter-clockwise polygon, line or point."""
    if len(corners) == 1:
        (x, y) = corners[0]
        return [(1, 0, x), (-1, 0, -x), (0, 1, y), (0, -1, -y)]
    planes = []
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        length = math.hypot(bx - ax, by - ay)
        along, across = (bx - ax) / length, (by - ay) / length
        planes.append((-across, along, along * ay - across * ax))
        if len(corners) == 2:
            planes.append((along, across, along * ax + across * ay))
    return planes


def inradius(furthest: Callable[[Floats], tuple[Floats, Floats]], tolerance: float = 5e-4) -> tuple[float, Floats]:
    """Find the distance from the origin to the border of a convex set in the plane around it.

    Args:
        furthest: Function from a direction (2,) to the furthest point (2,) of the set, and a note on it.
        tolerance: Largest error of the distance, which is never too small.

    Returns:
        The distance, and the note on the nearest side.
    """
    found: list[tuple[float, Floats]] = []  # (angle of the direction, point): a polygon inside the set
    best, note = math.inf, np.zeros(0)
    asked = [-np.pi / 2, 0.0, np.pi / 2, np.pi]
    while asked:
        for angle in asked:
            direction = np.array([math.cos(angle), math.sin(angle)])
            point, about = furthest(direction)
            found.append((angle, point))
            if direction @ point < best:
                best, note = float(direction @ point), about
        found.sort(key=lambda pair: pair[0])
        distance, angle = min(_sides([point for _, point in found]), default=(math.inf, 0.0))
        asked = [angle] if distance < best - tolerance and len(found) < 64 else []
    return best, note


def _sides(polygon: list[Floats]) -> list[tuple[float, float]]:
    """Return the distance from the origin and the angle of the outward normal of each side of a polygon."""
    sides = []
    for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        length = math.hypot(bx - ax, by - ay)
        if length > 1e-9:
            sides.append((((by - ay) * ax - (bx - ax) * ay) / length, math.atan2(ax - bx, by - ay)))
    return sides
